"""Runs the companion's MAVLink session as a state machine without sockets or a clock.

Lockstep flights, real-time flights and tests drive it the same way: call `handle` with every
received message, then `tick` with the stamp, and send the messages that `tick` returns, in order.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from mavfi_cli.core.errors import LinkError, NoAutopilot
from mavfi_cli.core.frames import ned_yaw_from_enu
from mavfi_cli.core.types import VehicleState
from mavfi_cli.link.codec import Message, dialect, text_messages
from mavfi_cli.link.commands import Commands, Ticket
from mavfi_cli.link.telemetry import AUTOPILOT, CAMERA, Telemetry

# POSITION_TARGET_TYPEMASK
_IGNORED = 0x0807  # position and yaw rate
_NO_ACCELERATION = 0x01C0
_NO_YAW = 0x0400
_LARGEST_FLOAT32 = 3.4028234663852886e38

_HANDLED = (
    dialect.MAVLINK_MSG_ID_TIMESYNC,
    dialect.MAVLINK_MSG_ID_PING,
    dialect.MAVLINK_MSG_ID_COMMAND_ACK,
    dialect.MAVLINK_MSG_ID_HEARTBEAT,
    dialect.MAVLINK_MSG_ID_STATUSTEXT,
    dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED_SYSTEM_GLOBAL_OFFSET,
)
_HEARTBEAT_INTERVAL_S = 1.0
_MAX_ANSWERS = 64  # maximum replies per tick; further requests are ignored
_HEIGHT_REACHED_M = 0.3  # tolerance below the take-off height
_LISTEN_S = 1.2  # time within which a second autopilot would send a HEARTBEAT
_DISARM_AFTER_S = 5.0  # time on the ground after which the session disarms the vehicle itself


def _float32(vector: Sequence[float]) -> Sequence[float]:
    """Return the vector with each component beyond the range of float32 replaced by infinity.

    NaN stays NaN.
    """
    if sum(map(abs, vector)) <= _LARGEST_FLOAT32:
        return vector
    return [
        math.copysign(math.inf, number) if abs(number) > _LARGEST_FLOAT32 else number
        for number in map(float, vector)
    ]


def _heartbeat() -> Message:
    return dialect.MAVLink_heartbeat_message(
        dialect.MAV_TYPE_ONBOARD_CONTROLLER, dialect.MAV_AUTOPILOT_INVALID, 0, 0,
        dialect.MAV_STATE_ACTIVE, 3,
    )  # fmt: skip


class Phase(Enum):
    """The phase of a flight, from the first contact with the autopilot to the landing."""

    CONNECTING = "connecting"
    WAITING_READY = "waiting until ready"
    ARMING = "arming"
    TAKING_OFF = "taking off"
    OFFBOARD = "offboard"
    LANDING = "landing"
    DONE = "done"
    FAILED = "failed"


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionSettings:
    """Settings and time-outs of the session, in simulated seconds."""

    system: int = 1  # system id of the companion, equal to the vehicle's
    component: int = dialect.MAV_COMP_ID_ONBOARD_COMPUTER
    takeoff_height_m: float = 2.5  # above the ground at take-off
    request_streams: bool = True  # request message streams; a lockstep peer sends them anyway
    needs_camera: bool = False  # wait for a camera, and for the origin that it may report
    state_rate_hz: float = 50.0
    connect_timeout_s: float = 10.0
    camera_timeout_s: float = 5.0
    ready_timeout_s: float = 60.0
    arm_timeout_s: float = 15.0
    takeoff_timeout_s: float = 30.0
    land_timeout_s: float = 60.0


class OffboardSession:
    """The MAVLink session of one flight: it connects, arms, takes off, streams setpoints and lands.

    Args:
        url: URL of the link, for error messages.
        telemetry: Telemetry of an earlier session on this link, if any.
    """

    def __init__(
        self,
        settings: SessionSettings | None = None,
        *,
        url: str = "the link",
        telemetry: Telemetry | None = None,
    ) -> None:
        self._settings = settings or SessionSettings()
        self._url = url
        self.telemetry = telemetry or Telemetry()
        self.phase, self._step = Phase.CONNECTING, _STEPS[Phase.CONNECTING]
        self.failure: LinkError | None = None  # cause of the phase FAILED
        # Why the autopilot stopped following setpoints: it changed mode or disarmed. Never reset.
        self.failsafe_text: str | None = None
        own = self._settings.system, self._settings.component
        self._commands = Commands(*own, self.telemetry)
        self._camera_heard = self._greeted = False
        self._origin_request: Ticket | None = None
        self.hold()
        self._answers: list[Message] = []  # sent at the next tick
        self._next_heartbeat_s = -math.inf
        self._texts = 0
        self._now_s = 0.0
        self._phase_since_s: float | None = None
        self._ground_m: float | None = None
        self._ground_amsl_m: float | None = None
        self._was_up = False
        self._down_since_s: float | None = None

    @property
    def state(self) -> VehicleState | None:
        """Newest vehicle state in ENU, or None before position and attitude are known."""
        return self.telemetry.state

    @property
    def is_up(self) -> bool:
        """True if the vehicle is in the air, or has reached the take-off height at least once."""
        return self._was_up or self.telemetry.in_air

    def state_at(self, stamp_s: float) -> VehicleState | None:
        """Return the vehicle state at a stamp, interpolated if needed.

        Return None if the history of states does not include the stamp.
        """
        return self.telemetry.history.at(stamp_s)

    # Requests of the mission --------------------------------------------------------------------

    def set_target(
        self,
        velocity_enu_mps: Sequence[float],
        yaw_enu_rad: float | None = None,
        acceleration_enu_mps2: Sequence[float] | None = None,
    ) -> None:
        """Set the velocity (3,), yaw and feed-forward acceleration (3,) to send from the next tick.

        A value beyond float32 becomes infinity, as in a C++ companion, and NaN stays NaN. The
        autopilot decides how to handle a corrupted command. Without a yaw, the vehicle keeps its
        heading.
        """
        mask, yaw, ax, ay, az = _IGNORED, 0.0, 0.0, 0.0, 0.0
        east, north, up = _float32(velocity_enu_mps)
        if acceleration_enu_mps2 is None:
            mask |= _NO_ACCELERATION
        else:
            ay, ax, az = _float32(acceleration_enu_mps2)
        if yaw_enu_rad is None:
            mask |= _NO_YAW
        else:
            yaw = ned_yaw_from_enu(yaw_enu_rad)
        self._target = (mask, 0.0, 0.0, 0.0, north, east, -up, ax, ay, -az, yaw, 0.0)

    def hold(self) -> None:
        """Command zero velocity and the current heading, starting with the next tick."""
        self.set_target((0.0, 0.0, 0.0))

    def announce(self, text: str) -> None:
        """Send a STATUSTEXT with severity WARNING to ground stations."""
        self._texts = self._texts % 0xFFFF + 1
        data = text.encode("ascii", "replace")
        self._answers += text_messages(dialect.MAV_SEVERITY_WARNING, data, self._texts)

    def start_camera(self, interval_s: float) -> None:
        """Request a depth frame from the camera every `interval_s` seconds, indefinitely."""
        self._commands.submit(
            dialect.MAV_CMD_IMAGE_START_CAPTURE, 0.0, interval_s, 0.0, 0.0,
            component=CAMERA, unused=math.nan, refusals=3,
        )  # fmt: skip

    def request_land(self) -> None:
        """Land at the current position and disarm. Before arming, this ends the session at once."""
        if self.phase not in (Phase.LANDING, Phase.DONE):
            self._enter(Phase.LANDING)

    # Received messages --------------------------------------------------------------------------

    def handle(self, message: Message) -> None:
        """Handle a message from the autopilot or its camera. Ignore other senders."""
        telemetry, number = self.telemetry, type(message).id
        telemetry.handle(message)
        if number not in _HANDLED:
            return
        of_camera = telemetry.is_from(message, CAMERA)
        if not (of_camera or telemetry.is_from(message, AUTOPILOT)):
            return
        reply = None
        if number == dialect.MAVLINK_MSG_ID_TIMESYNC:
            if message.tc1 == 0:  # a request; a reply to our own request needs no reply
                reply = dialect.MAVLink_timesync_message(round(self._now_s * 1e9), message.ts1)
        elif number == dialect.MAVLINK_MSG_ID_PING:
            if message.target_system == message.target_component == 0:
                asker = (message.get_srcSystem(), message.get_srcComponent())
                reply = dialect.MAVLink_ping_message(message.time_usec, message.seq, *asker)
        else:
            if number == dialect.MAVLINK_MSG_ID_COMMAND_ACK:
                self._commands.acknowledge(message)
            if of_camera:
                self._handle_camera(number, message)
        if reply is not None and len(self._answers) < _MAX_ANSWERS:
            self._answers.append(reply)

    def _handle_camera(self, number: int, message: Message) -> None:
        """Handle a message from the camera, which runs the referee for a foreign autopilot."""
        if number == dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED_SYSTEM_GLOBAL_OFFSET:
            if self.phase is Phase.CONNECTING:  # a later origin would displace a flying vehicle
                origin = np.array([message.y, message.x, -message.z], dtype=np.float64)
                self.telemetry.move_origin(origin)
        elif number == dialect.MAVLINK_MSG_ID_STATUSTEXT:
            self.telemetry.take_text(message)
        else:
            is_new = number == dialect.MAVLINK_MSG_ID_HEARTBEAT and not self._camera_heard
            self._camera_heard = True
            if is_new and not self._settings.needs_camera:
                self._request_origin()

    def _request_origin(self) -> None:
        """Request the origin from the camera.

        If positions are already in the world frame, request CAMERA_INFORMATION instead.
        """
        wanted = dialect.MAVLINK_MSG_ID_CAMERA_INFORMATION
        if self._settings.needs_camera:
            wanted = dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED_SYSTEM_GLOBAL_OFFSET
        request = dialect.MAV_CMD_REQUEST_MESSAGE
        self._origin_request = self._commands.submit(request, wanted, component=CAMERA)

    # Sent messages ------------------------------------------------------------------------------

    def tick(self, stamp_s: float) -> list[Message]:
        """Advance the session to a stamp. Return the messages to send, with the setpoint last.

        Every tick has a setpoint, because OFFBOARD requires setpoints before it is entered and a
        lockstep peer waits for them. ArduCopter is the exception: it has no such handshake, and a
        setpoint aborts its take-off, so it gets setpoints only in the OFFBOARD phase.
        """
        self._now_s = self.telemetry.now_s = self._commands.now_s = stamp_s
        if self._phase_since_s is None:
            self._phase_since_s = stamp_s
        self.telemetry.expire()
        try:
            self._step(self)
        except LinkError as failure:
            self._enter(Phase.FAILED)
            self.failure = failure
        out, self._answers = self._answers, []
        if not self._next_heartbeat_s - _HEARTBEAT_INTERVAL_S <= stamp_s < self._next_heartbeat_s:
            self._next_heartbeat_s = stamp_s + _HEARTBEAT_INTERVAL_S
            out.append(_heartbeat())
        system = self.telemetry.system
        if system:
            out += self._commands.poll(system)
        if self.telemetry.autopilot.early_setpoints or self.phase is Phase.OFFBOARD:
            component = dialect.MAV_COMP_ID_AUTOPILOT1 if system else 0
            out.append(
                dialect.MAVLink_set_position_target_local_ned_message(
                    round(stamp_s * 1e3) & 0xFFFF_FFFF, system, component,
                    dialect.MAV_FRAME_LOCAL_NED, *self._target,
                )
            )  # fmt: skip
        return out

    # Phases -------------------------------------------------------------------------------------

    def _enter(self, phase: Phase) -> None:
        self.phase, self._step = phase, _STEPS[phase]
        self._phase_since_s = self._now_s
        self._commands.begin()

    def _elapsed_s(self) -> float:
        since = self._phase_since_s
        return 0.0 if since is None else self._now_s - since

    def _connecting(self) -> None:
        self._require_fit()
        if not self.telemetry.heard:
            if self._elapsed_s() >= self._settings.connect_timeout_s:
                waited_s = self._settings.connect_timeout_s
                raise NoAutopilot(
                    f"no autopilot at {self._url}: no heartbeat within {waited_s:g} s"
                )
            return
        if not self._greeted:
            self._greeted, self._phase_since_s = True, self._now_s
            if self._settings.request_streams:
                self._commands.request_streams(self._settings.state_rate_hz)
            if self._settings.needs_camera:
                self._request_origin()
        if self._position_known():
            self._enter(Phase.WAITING_READY)

    def _require_fit(self) -> None:
        if self.telemetry.unfit:
            raise LinkError(f"{self._url}: {self.telemetry.unfit}")

    def _position_known(self) -> bool:
        """Return True once the camera has answered and a state has arrived.

        Also return True if no camera is needed.

        Raises LinkError if the camera or the state does not arrive in time.
        """
        settings, request = self._settings, self._origin_request
        if not settings.needs_camera or request is None:
            return True
        if not self._camera_heard and self._elapsed_s() >= settings.camera_timeout_s:
            raise LinkError(
                f"{self._url}: no camera (MAVLink component 100) answered within "
                f"{settings.camera_timeout_s:g} s, so the vehicle does not take off; "
                "to start one, use --eyes"
            )
        self._require_soon()
        if self._elapsed_s() < _LISTEN_S:
            return False
        return self._camera_heard and not request.pending and self.telemetry.state is not None

    def _waiting_ready(self) -> None:
        telemetry, commands = self.telemetry, self._commands
        self._require_fit()
        if telemetry.armed and telemetry.in_air and telemetry.state is not None:
            self._was_up = True
            self._enter(Phase.TAKING_OFF)
            return
        autopilot = telemetry.autopilot
        in_mode = telemetry.mode in autopilot.arming_modes
        if not in_mode and not commands.request_mode(autopilot.arming_modes[0]):
            return
        if autopilot.takeoff_amsl and telemetry.home_amsl_m is None:
            commands.request_home()
        elif in_mode and telemetry.ready and telemetry.state is not None:
            self._ground_m = float(telemetry.state.position_enu_m[2])
            if self._settings.needs_camera:  # the home position may be from an earlier flight
                self._ground_amsl_m = telemetry.amsl_m
            self._enter(Phase.ARMING)
            return
        self._require_soon()

    def _require_soon(self) -> None:
        timeout_s = self._settings.ready_timeout_s
        if self._elapsed_s() >= timeout_s:
            self._commands.refuse("arming", f"{self._missing()} within {timeout_s:g} s")

    def _missing(self) -> str:
        if self.telemetry.state is None:
            return "no position and attitude"
        if self.phase is Phase.CONNECTING:
            return "no origin from the camera"
        if self.telemetry.autopilot.takeoff_amsl and self.telemetry.home_amsl_m is None:
            return "no home position"
        return "not ready to arm"

    def _arming(self) -> None:
        self._require_fit()
        if self.telemetry.armed:
            self._enter(Phase.TAKING_OFF)
        elif self._commands.insist("arming", dialect.MAV_CMD_COMPONENT_ARM_DISARM, 1.0):
            self._commands.request_heartbeat()
            if self._elapsed_s() >= self._settings.arm_timeout_s:
                self._commands.refuse("arming", "accepted, but the vehicle did not arm")

    def _taking_off(self) -> None:
        telemetry, commands = self.telemetry, self._commands
        if not telemetry.armed:
            commands.refuse("take-off", "disarmed before the height was reached")
        self._was_up = self._was_up or self._climbed()
        if self._was_up:
            if commands.request_mode(telemetry.autopilot.offboard_mode):
                self._enter(Phase.OFFBOARD)
            return
        if not (commands.commanded and telemetry.in_air):
            parameters = [telemetry.autopilot.unused] * 6 + [self._takeoff_altitude_m()]
            commands.insist("take-off", dialect.MAV_CMD_NAV_TAKEOFF, *parameters)
        timeout_s = self._settings.takeoff_timeout_s
        if self._elapsed_s() >= timeout_s:
            commands.refuse("take-off", f"height not reached within {timeout_s:g} s")

    def _takeoff_altitude_m(self) -> float:
        if not self.telemetry.autopilot.takeoff_amsl:
            return self._settings.takeoff_height_m
        ground_m = self._ground_amsl_m or self.telemetry.home_amsl_m or 0.0
        return ground_m + self._settings.takeoff_height_m

    def _climbed(self) -> bool:
        state = self.telemetry.state
        if state is None or self._ground_m is None:
            return False
        height_m = float(state.position_enu_m[2]) - self._ground_m
        return height_m >= self._settings.takeoff_height_m - _HEIGHT_REACHED_M

    def _offboard(self) -> None:
        if self.failsafe_text is not None:
            return
        telemetry = self.telemetry
        if not telemetry.armed:
            self.failsafe_text = "the autopilot disarmed in flight"
        elif telemetry.mode != telemetry.autopilot.offboard_mode:
            self.failsafe_text = (
                f"the autopilot left {telemetry.autopilot.offboard_mode} for {telemetry.mode}"
            )

    def _landing(self) -> None:
        telemetry, commands = self.telemetry, self._commands
        if not telemetry.armed:
            self._enter(Phase.DONE)
            return
        if telemetry.mode != telemetry.autopilot.land_mode:
            unused = telemetry.autopilot.unused
            commands.insist("landing", dialect.MAV_CMD_NAV_LAND, unused=unused)
            commands.request_heartbeat()
        elif telemetry.landed_state == dialect.MAV_LANDED_STATE_ON_GROUND:
            self._disarm_late()
        timeout_s = self._settings.land_timeout_s
        if self._elapsed_s() >= timeout_s:
            commands.refuse("landing", f"not landed and disarmed within {timeout_s:g} s")

    def _disarm_late(self) -> None:
        if self._down_since_s is None:
            self._down_since_s = self._now_s
        elif self._now_s - self._down_since_s >= _DISARM_AFTER_S:
            self._down_since_s = self._now_s
            self._commands.submit(dialect.MAV_CMD_COMPONENT_ARM_DISARM, 0.0)

    def _ended(self) -> None:
        """Do nothing. Setpoints continue, because a lockstep peer may wait for them."""


_STEPS = {
    Phase.CONNECTING: OffboardSession._connecting,
    Phase.WAITING_READY: OffboardSession._waiting_ready,
    Phase.ARMING: OffboardSession._arming,
    Phase.TAKING_OFF: OffboardSession._taking_off,
    Phase.OFFBOARD: OffboardSession._offboard,
    Phase.LANDING: OffboardSession._landing,
    Phase.DONE: OffboardSession._ended,
    Phase.FAILED: OffboardSession._ended,
}
