"""The companion's MAVLink session as a state machine without sockets or clock.

Lockstep, real time and tests drive it the same way. Call `handle` with every received message, then
`tick` with the stamp, and send the messages that `tick` returns in their order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

from mavfi_cli.core.errors import LinkError, NoAutopilot
from mavfi_cli.core.types import VehicleState
from mavfi_cli.link.camera import CameraClient
from mavfi_cli.link.codec import Message, dialect
from mavfi_cli.link.commands import CommandChannel
from mavfi_cli.link.replies import Replies
from mavfi_cli.link.requests import Requests
from mavfi_cli.link.setpoint import Target
from mavfi_cli.link.telemetry import LandedState, Telemetry
from mavfi_cli.link.texts import Text

_HEIGHT_REACHED_M = 0.3  # tolerance below the take-off height
_DISARM_AFTER_S = 5.0  # time on the ground after which the session disarms the vehicle itself
_WARNING = dialect.MAV_SEVERITY_WARNING


class Phase(Enum):
    """Phase of the flight."""

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

    system: int = 1  # own system id, which is that of the vehicle
    component: int = dialect.MAV_COMP_ID_ONBOARD_COMPUTER
    takeoff_height_m: float = 2.5  # above the ground at take-off
    request_streams: bool = True  # request message streams; lockstep sends them anyway
    state_rate_hz: float = 50.0
    connect_timeout_s: float = 10.0
    ready_timeout_s: float = 60.0
    arm_timeout_s: float = 15.0
    takeoff_timeout_s: float = 30.0
    land_timeout_s: float = 60.0


class OffboardSession:
    """Connects, arms, takes off, streams setpoints and lands.

    Args:
        settings: Settings and time-outs.
        url: URL of the link, for error messages.
        telemetry: Telemetry so far, if this session is not the first on its link.

    Attributes:
        phase: Present phase of the flight.
        failure: Cause of the phase FAILED; None before that.
        failsafe_text: Reason why the autopilot no longer follows (it changed its mode or disarmed);
            None while it follows. Never reset.
        telemetry: Newest telemetry of the autopilot.
        camera: Camera component of the same system.
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
        self.phase = Phase.CONNECTING
        self.failure: LinkError | None = None
        self.failsafe_text: str | None = None
        self._commands = CommandChannel(self._settings.system, self._settings.component)
        self.camera = CameraClient(self._commands)
        self._requests = Requests(self._commands, self.telemetry)
        self._target = Target()
        self._replies = Replies()
        self._now_s = 0.0
        self._phase_since_s: float | None = None
        self._ground_m: float | None = None
        self._was_up = False
        self._down_since_s: float | None = None

    # State for the mission ----------------------------------------------------------------------

    @property
    def state(self) -> VehicleState | None:
        """Newest vehicle state in ENU; None before position and attitude are known."""
        return self.telemetry.state

    @property
    def armed(self) -> bool:
        """True if HEARTBEAT says armed."""
        return self.telemetry.armed

    @property
    def mode(self) -> str:
        """Name of the flight mode in HEARTBEAT; "" before the first."""
        return self.telemetry.mode

    @property
    def landed_state(self) -> LandedState:
        """Landed state in EXTENDED_SYS_STATE."""
        return self.telemetry.landed_state

    @property
    def failsafe(self) -> bool:
        """True once the autopilot has stopped following us without a request."""
        return self.failsafe_text is not None

    @property
    def collision_text(self) -> str | None:
        """Text that reported a collision; None without one."""
        return self.telemetry.collision_text

    @property
    def link_lost(self) -> bool:
        """True if no HEARTBEAT of the autopilot has arrived for three seconds."""
        return self.telemetry.link_lost

    @property
    def texts(self) -> Sequence[Text]:
        """Newest STATUSTEXTs of the autopilot, oldest first."""
        return self.telemetry.texts.texts

    def state_at(self, stamp_s: float) -> VehicleState | None:
        """Return the state at a stamp, exact or interpolated; None outside the last ten seconds."""
        return self.telemetry.history.at(stamp_s)

    # Requests of the mission --------------------------------------------------------------------

    def set_target(
        self,
        velocity_enu_mps: Sequence[float],
        yaw_enu_rad: float | None = None,
        acceleration_enu_mps2: Sequence[float] | None = None,
    ) -> None:
        """Set the target from the next tick on.

        Args:
            velocity_enu_mps: Velocity (3,), m/s.
            yaw_enu_rad: Yaw, counter-clockwise from east; None keeps the heading.
            acceleration_enu_mps2: Feed-forward acceleration (3,), m/s^2; None for none.
        """
        vx, vy, vz = velocity_enu_mps
        acceleration = None
        if acceleration_enu_mps2 is not None:
            ax, ay, az = acceleration_enu_mps2
            acceleration = (ax, ay, az)
        self._target = Target(
            velocity_enu_mps=(vx, vy, vz),
            yaw_enu_rad=yaw_enu_rad,
            acceleration_enu_mps2=acceleration,
        )

    def hold(self) -> None:
        """Hold position and heading from the next tick on."""
        self._target = Target()

    def announce(self, text: str) -> None:
        """Send a STATUSTEXT with severity WARNING to ground stations."""
        self._replies.announce(_WARNING, text)

    def request_land(self) -> None:
        """Land at the present position and disarm. Before arming, end the session at once."""
        if self.phase not in (Phase.LANDING, Phase.DONE):
            self._enter(Phase.LANDING)

    # Received messages --------------------------------------------------------------------------

    def handle(self, message: Message) -> None:
        """Handle a received message. Messages for other receivers are ignored."""
        telemetry = self.telemetry
        telemetry.handle(message)
        if telemetry.heard and message.get_srcSystem() == telemetry.system:
            if isinstance(message, dialect.MAVLink_command_ack_message):
                self._commands.acknowledge(message)
            elif message.get_srcComponent() == dialect.MAV_COMP_ID_CAMERA:
                self.camera.handle(message)
        self._replies.handle(message, self._now_s)

    # Sent messages ------------------------------------------------------------------------------

    def tick(self, stamp_s: float) -> list[Message]:
        """Advance to a stamp. Return the messages to send; the setpoint of this stamp is the last.

        Every tick has a setpoint, because OFFBOARD requires setpoints before its entry and a
        lockstep peer waits for them. ArduCopter is the exception: it has no such handshake and
        aborts a take-off at a setpoint, so it gets setpoints in the OFFBOARD phase only.
        """
        self._now_s = self.telemetry.now_s = self._requests.now_s = stamp_s
        if self._phase_since_s is None:
            self._phase_since_s = stamp_s
        self.telemetry.expire()
        try:
            _STEPS[self.phase](self)
        except LinkError as failure:
            self._enter(Phase.FAILED)
            self.failure = failure
        out = self._replies.take(stamp_s)
        system = self.telemetry.system
        if system:
            out += self._commands.poll(stamp_s, system)
        if self.telemetry.autopilot.early_setpoints or self.phase is Phase.OFFBOARD:
            component = dialect.MAV_COMP_ID_AUTOPILOT1 if system else 0
            out.append(self._target.message(stamp_s, system, component))
        return out

    # Phases -------------------------------------------------------------------------------------

    def _enter(self, phase: Phase) -> None:
        self.phase = phase
        self._phase_since_s = self._now_s
        self._requests.begin()

    def _elapsed_s(self) -> float:
        since = self._phase_since_s
        return 0.0 if since is None else self._now_s - since

    def _connecting(self) -> None:
        if self.telemetry.heard:
            if self._settings.request_streams:
                self._requests.streams(self._settings.state_rate_hz)
            self._enter(Phase.WAITING_READY)
        elif self._elapsed_s() >= self._settings.connect_timeout_s:
            raise NoAutopilot(self._url, self._settings.connect_timeout_s)

    def _waiting_ready(self) -> None:
        telemetry, requests = self.telemetry, self._requests
        if telemetry.armed and telemetry.in_air and telemetry.state is not None:
            self._was_up = True
            self._enter(Phase.TAKING_OFF)
            return
        autopilot = telemetry.autopilot
        in_mode = telemetry.mode in autopilot.arming_modes
        if not in_mode and not requests.mode(autopilot.arming_modes[0]):
            return
        if autopilot.takeoff_amsl and telemetry.home_amsl_m is None:
            requests.home()
        elif in_mode and telemetry.ready and telemetry.state is not None:
            self._ground_m = float(telemetry.state.position_enu_m[2])
            self._enter(Phase.ARMING)
            return
        timeout_s = self._settings.ready_timeout_s
        if self._elapsed_s() >= timeout_s:
            requests.refuse("arming", f"{self._missing()} within {timeout_s:g} s")

    def _missing(self) -> str:
        if self.telemetry.state is None:
            return "no position and attitude"
        if self.telemetry.autopilot.takeoff_amsl and self.telemetry.home_amsl_m is None:
            return "no home position"
        return "not ready to arm"

    def _arming(self) -> None:
        if self.telemetry.armed:
            self._enter(Phase.TAKING_OFF)
        elif self._requests.insist("arming", dialect.MAV_CMD_COMPONENT_ARM_DISARM, 1.0):
            self._requests.look_at_heartbeat()
            if self._elapsed_s() >= self._settings.arm_timeout_s:
                self._requests.refuse("arming", "accepted, but it did not arm")

    def _taking_off(self) -> None:
        telemetry, requests = self.telemetry, self._requests
        if not telemetry.armed:
            requests.refuse("take-off", "disarmed before the height was reached")
        self._was_up = self._was_up or self._climbed()
        if self._was_up:
            if requests.mode(telemetry.autopilot.offboard_mode):
                self._enter(Phase.OFFBOARD)
            return
        if not (requests.asked and telemetry.in_air):
            parameters = [telemetry.autopilot.unused] * 6 + [self._takeoff_altitude_m()]
            requests.insist("take-off", dialect.MAV_CMD_NAV_TAKEOFF, *parameters)
        timeout_s = self._settings.takeoff_timeout_s
        if self._elapsed_s() >= timeout_s:
            requests.refuse("take-off", f"height not reached within {timeout_s:g} s")

    def _takeoff_altitude_m(self) -> float:
        if not self.telemetry.autopilot.takeoff_amsl:
            return self._settings.takeoff_height_m
        return (self.telemetry.home_amsl_m or 0.0) + self._settings.takeoff_height_m

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
        telemetry, requests = self.telemetry, self._requests
        if not telemetry.armed:
            self._enter(Phase.DONE)
            return
        if telemetry.mode != telemetry.autopilot.land_mode:
            unused = telemetry.autopilot.unused
            requests.insist("landing", dialect.MAV_CMD_NAV_LAND, unused=unused)
            requests.look_at_heartbeat()
        elif telemetry.landed_state is LandedState.ON_GROUND:
            self._disarm_late()
        timeout_s = self._settings.land_timeout_s
        if self._elapsed_s() >= timeout_s:
            requests.refuse("landing", f"not down and disarmed within {timeout_s:g} s")

    def _disarm_late(self) -> None:
        if self._down_since_s is None:
            self._down_since_s = self._now_s
        elif self._now_s - self._down_since_s >= _DISARM_AFTER_S:
            self._down_since_s = self._now_s
            self._commands.submit(dialect.MAV_CMD_COMPONENT_ARM_DISARM, 0.0)

    def _ended(self) -> None:
        """Do nothing. Setpoints continue, because the other end may wait for them."""


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
