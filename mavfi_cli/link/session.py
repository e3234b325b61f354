"""The companion's side of a MAVLink flight, as a state machine without sockets or clock.

Lockstep, real time and tests drive it alike: `handle` every message that came, then `tick` with
the stamp; send what `tick` returns, in that order.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

from mavfi_cli.core.errors import CommandRefused, LinkError, NoAutopilot
from mavfi_cli.core.types import VehicleState
from mavfi_cli.link.camera import CameraClient
from mavfi_cli.link.codec import Message, dialect
from mavfi_cli.link.commands import CommandChannel, Ticket, Verdict
from mavfi_cli.link.replies import Replies
from mavfi_cli.link.setpoint import Target
from mavfi_cli.link.telemetry import LandedState, Telemetry
from mavfi_cli.link.texts import Text

_HEIGHT_REACHED_M = 0.3  # so close below the wanted height counts as there
_SETTLE_S = 0.5  # an autopilot's words may follow its refusal
_EFFECT_S = 3.0  # what was accepted shows an effect within this
_MODE_TRIES = 5
_MODE_PATIENCE_S = 1.5  # HEARTBEAT comes once a second
_LOOK_INTERVAL_S = 0.2
_HOME_INTERVAL_S = 1.0
_DISARM_AFTER_S = 5.0  # on the ground, where the autopilot should have done so by itself
_WARNING = dialect.MAV_SEVERITY_WARNING


class Phase(Enum):
    """How far the flight is."""

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
    """What the session asks for, and how long it waits, in simulated seconds."""

    system: int = 1  # own system id: that of the vehicle we ride on
    component: int = dialect.MAV_COMP_ID_ONBOARD_COMPUTER
    takeoff_height_m: float = 2.5  # above where it stands
    request_streams: bool = True  # ask for the streams we need (lockstep has them anyway)
    state_rate_hz: float = 50.0
    connect_timeout_s: float = 10.0
    ready_timeout_s: float = 60.0
    arm_timeout_s: float = 15.0
    takeoff_timeout_s: float = 30.0
    land_timeout_s: float = 60.0


class OffboardSession:
    """Connects, arms, takes off, streams setpoints, lands.

    Args:
        settings: what to ask for and how long to wait.
        url: the link, for messages to people.

    Attributes:
        phase: how far the flight is.
        failure: why the phase became FAILED; None while it never did.
        failsafe_text: why the autopilot no longer follows (its mode changed unasked, or it
            disarmed); None while it does. Never taken back.
        telemetry: everything else that the autopilot told.
        camera: the camera component of the same system.
    """

    def __init__(self, settings: SessionSettings | None = None, *, url: str = "the link") -> None:
        self._settings = settings or SessionSettings()
        self._url = url
        self.telemetry = Telemetry()
        self.phase = Phase.CONNECTING
        self.failure: LinkError | None = None
        self.failsafe_text: str | None = None
        self._commands = CommandChannel(self._settings.system, self._settings.component)
        self.camera = CameraClient(self._commands)
        self._target = Target()
        self._replies = Replies()
        self._now_s = 0.0
        self._phase_since_s: float | None = None
        self._next_look_s = -math.inf
        self._ticket: Ticket | None = None  # the one command that the phase hangs on
        self._look: Ticket | None = None
        self._home: Ticket | None = None
        self._next_home_s = -math.inf
        self._mode_since_s = -math.inf
        self._mode_tries = 0
        self._texts_before = 0
        self._decided_s: float | None = None
        self._ground_m: float | None = None
        self._was_up = False
        self._down_since_s: float | None = None

    # What the mission looks at ------------------------------------------------------------------

    @property
    def state(self) -> VehicleState | None:
        """The vehicle's newest state in ENU; None before position and attitude are known."""
        return self.telemetry.state

    @property
    def armed(self) -> bool:
        """HEARTBEAT's word."""
        return self.telemetry.armed

    @property
    def mode(self) -> str:
        """Name of the flight mode by HEARTBEAT, "" before the first."""
        return self.telemetry.mode

    @property
    def landed_state(self) -> LandedState:
        """EXTENDED_SYS_STATE's word."""
        return self.telemetry.landed_state

    @property
    def failsafe(self) -> bool:
        """Whether the autopilot stopped following us without being asked to."""
        return self.failsafe_text is not None

    @property
    def collision_text(self) -> str | None:
        """The text in which a collision was reported."""
        return self.telemetry.collision_text

    @property
    def link_lost(self) -> bool:
        """Whether the autopilot's HEARTBEAT has been missing for three seconds."""
        return self.telemetry.link_lost

    @property
    def texts(self) -> Sequence[Text]:
        """The autopilot's newest STATUSTEXTs, oldest first."""
        return self.telemetry.texts.texts

    def state_at(self, stamp_s: float) -> VehicleState | None:
        """The state at a stamp, exact or interpolated; None outside the last ten seconds."""
        return self.telemetry.history.at(stamp_s)

    # What the mission asks for ------------------------------------------------------------------

    def set_target(
        self,
        velocity_enu_mps: Sequence[float],
        yaw_enu_rad: float | None = None,
        acceleration_enu_mps2: Sequence[float] | None = None,
    ) -> None:
        """Fly this from the next tick on.

        Args:
            velocity_enu_mps: (3,), m/s.
            yaw_enu_rad: from east, counter-clockwise; None keeps the heading.
            acceleration_enu_mps2: (3,) feed-forward, m/s^2; None for none.
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
        """Stand still and keep the heading from the next tick on."""
        self._target = Target()

    def announce(self, text: str) -> None:
        """Tell ground stations, as a STATUSTEXT of the severity of a warning."""
        self._replies.announce(_WARNING, text)

    def request_land(self) -> None:
        """Land where it is and disarm; before arming, end at once."""
        if self.phase not in (Phase.LANDING, Phase.DONE):
            self._enter(Phase.LANDING)

    # Messages in --------------------------------------------------------------------------------

    def handle(self, message: Message) -> None:
        """Take one received message; anything that is not for us is ignored."""
        telemetry = self.telemetry
        telemetry.handle(message)
        if telemetry.heard and message.get_srcSystem() == telemetry.system:
            if isinstance(message, dialect.MAVLink_command_ack_message):
                self._commands.acknowledge(message)
            elif message.get_srcComponent() == dialect.MAV_COMP_ID_CAMERA:
                self.camera.handle(message)
        self._replies.handle(message, self._now_s)

    # Messages out -------------------------------------------------------------------------------

    def tick(self, stamp_s: float) -> list[Message]:
        """Go on to a stamp; the messages to send, the setpoint of this stamp being the last.

        There is a setpoint in every tick, because OFFBOARD wants them before it is entered and a
        lockstep peer waits for them. Only ArduCopter, which knows no such handshake and breaks
        off a take-off when a setpoint comes, gets them in the OFFBOARD phase alone.
        """
        self._now_s = self.telemetry.now_s = stamp_s
        if self._phase_since_s is None:
            self._phase_since_s = stamp_s
        self.telemetry.expire()
        _STEPS[self.phase](self)
        out = self._replies.take(stamp_s)
        system = self.telemetry.system
        if system:
            out += self._commands.poll(stamp_s, system)
        if self.telemetry.autopilot.early_setpoints or self.phase is Phase.OFFBOARD:
            component = dialect.MAV_COMP_ID_AUTOPILOT1 if system else 0
            out.append(self._target.message(stamp_s, system, component))
        return out

    # The phases ---------------------------------------------------------------------------------

    def _enter(self, phase: Phase) -> None:
        self.phase = phase
        self._phase_since_s = self._now_s
        self._ticket = None
        self._mode_since_s, self._mode_tries = -math.inf, 0
        self._texts_before = self.telemetry.texts.total
        self._decided_s = None

    def _elapsed_s(self) -> float:
        since = self._phase_since_s
        return 0.0 if since is None else self._now_s - since

    def _fail(self, failure: LinkError) -> None:
        self._enter(Phase.FAILED)
        self.failure = failure

    def _refuse(self, command: str, result: str) -> None:
        self.telemetry.texts.expire(self._now_s, 0.0)
        texts = self.telemetry.texts.since(self._texts_before)
        words = dict.fromkeys(text.text for text in texts if text.severity <= _WARNING)
        self._fail(CommandRefused(command, result, words))

    def _connecting(self) -> None:
        if self.telemetry.heard:
            if self._settings.request_streams:
                self._request_streams()
            self._enter(Phase.WAITING_READY)
        elif self._elapsed_s() >= self._settings.connect_timeout_s:
            self._fail(NoAutopilot(self._url, self._settings.connect_timeout_s))

    def _request_streams(self) -> None:
        state_us = 1e6 / self._settings.state_rate_hz
        for message_id, interval_us in (
            (dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, state_us),
            (dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED, state_us),
            (dialect.MAVLINK_MSG_ID_EXTENDED_SYS_STATE, 2e5),
            (dialect.MAVLINK_MSG_ID_SYS_STATUS, 5e5),
            (dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT, 5e5),
        ):
            self._commands.submit(dialect.MAV_CMD_SET_MESSAGE_INTERVAL, message_id, interval_us)

    def _waiting_ready(self) -> None:
        telemetry = self.telemetry
        if telemetry.armed and telemetry.in_air and telemetry.state is not None:
            self._was_up = True
            self._enter(Phase.TAKING_OFF)
            return
        autopilot = telemetry.autopilot
        in_mode = telemetry.mode in autopilot.arming_modes
        if not in_mode and not self._seek_mode(autopilot.arming_modes[0]):
            return
        if autopilot.takeoff_amsl and telemetry.home_amsl_m is None:
            self._ask_home()
        elif in_mode and telemetry.ready and telemetry.state is not None:
            self._ground_m = float(telemetry.state.position_enu_m[2])
            self._enter(Phase.ARMING)
            return
        timeout_s = self._settings.ready_timeout_s
        if self._elapsed_s() >= timeout_s:
            self._refuse("arming", f"{self._missing()} within {timeout_s:g} s")

    def _missing(self) -> str:
        if self.telemetry.state is None:
            return "no position and attitude"
        if self.telemetry.autopilot.takeoff_amsl and self.telemetry.home_amsl_m is None:
            return "no home position"
        return "not ready to arm"

    def _ask_home(self) -> None:
        if self._now_s >= self._next_home_s and not (self._home and self._home.pending):
            self._next_home_s = self._now_s + _HOME_INTERVAL_S
            self._home = self._commands.submit(
                dialect.MAV_CMD_REQUEST_MESSAGE, dialect.MAVLINK_MSG_ID_HOME_POSITION
            )

    def _arming(self) -> None:
        if self.telemetry.armed:
            self._enter(Phase.TAKING_OFF)
        elif self._insist("arming", dialect.MAV_CMD_COMPONENT_ARM_DISARM, 1.0):
            self._look_at_heartbeat()
            if self._elapsed_s() >= self._settings.arm_timeout_s:
                self._refuse("arming", "accepted, but it did not arm")

    def _taking_off(self) -> None:
        telemetry = self.telemetry
        if not telemetry.armed:
            self._refuse("take-off", "disarmed before the height was reached")
            return
        self._was_up = self._was_up or self._climbed()
        if self._was_up:
            if telemetry.mode == telemetry.autopilot.offboard_mode or self._seek_mode(
                telemetry.autopilot.offboard_mode
            ):
                self._enter(Phase.OFFBOARD)
            return
        if self._ticket is None or not telemetry.in_air:
            parameters = [telemetry.autopilot.unused] * 6 + [self._takeoff_altitude_m()]
            self._insist("take-off", dialect.MAV_CMD_NAV_TAKEOFF, *parameters)
        timeout_s = self._settings.takeoff_timeout_s
        if self.phase is Phase.TAKING_OFF and self._elapsed_s() >= timeout_s:
            self._refuse("take-off", f"height not reached within {timeout_s:g} s")

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
        telemetry = self.telemetry
        if not telemetry.armed:
            self._enter(Phase.DONE)
        elif telemetry.mode != telemetry.autopilot.land_mode:
            self._insist("landing", dialect.MAV_CMD_NAV_LAND, unused=telemetry.autopilot.unused)
            self._look_at_heartbeat()
        elif telemetry.landed_state is LandedState.ON_GROUND:
            self._disarm_late()
        timeout_s = self._settings.land_timeout_s
        if self.phase is Phase.LANDING and self._elapsed_s() >= timeout_s:
            self._refuse("landing", f"not down and disarmed within {timeout_s:g} s")

    def _disarm_late(self) -> None:
        if self._down_since_s is None:
            self._down_since_s = self._now_s
        elif self._now_s - self._down_since_s >= _DISARM_AFTER_S:
            self._down_since_s = self._now_s
            self._commands.submit(dialect.MAV_CMD_COMPONENT_ARM_DISARM, 0.0)

    def _ended(self) -> None:
        """Nothing more to ask for; the setpoints go on, for the other end may wait for them."""

    # Helpers of the phases ----------------------------------------------------------------------

    def _insist(self, name: str, command: int, *parameters: float, unused: float = 0.0) -> bool:
        """Bring one command home; True once it is accepted. A final refusal ends the session.

        An accepted one that shows no effect is sent again, for as long as the phase calls this.
        """
        if self._ticket is None:
            self._ticket = self._commands.submit(command, *parameters, unused=unused, refusals=2)
            self._decided_s = None
        ticket = self._ticket
        if ticket.pending:
            return False
        if self._decided_s is None:
            self._decided_s = self._now_s
        waited_s = self._now_s - self._decided_s
        if ticket.verdict is Verdict.ACCEPTED:
            if waited_s >= _EFFECT_S:
                self._ticket = None
            return True
        if waited_s >= _SETTLE_S:
            self._refuse(name, ticket.result)
        return False

    def _seek_mode(self, mode: str) -> bool:
        """Ask for a mode until HEARTBEAT shows it; an acknowledgement alone is not believed."""
        if self.telemetry.mode == mode:
            return True
        pending = self._ticket is not None and self._ticket.pending
        if not pending and self._now_s - self._mode_since_s >= _MODE_PATIENCE_S:
            if self._mode_tries >= _MODE_TRIES:
                result = self._ticket.result if self._ticket is not None else ""
                self._refuse(f"mode {mode}", f"{result}, mode stays {self.telemetry.mode}")
                return False
            self._mode_tries += 1
            self._mode_since_s = self._now_s
            enabled = dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
            if self.telemetry.armed:
                enabled |= dialect.MAV_MODE_FLAG_SAFETY_ARMED
            self._ticket = self._commands.submit(
                dialect.MAV_CMD_DO_SET_MODE,
                enabled,
                *self.telemetry.autopilot.mode_parameters(mode),
            )
        self._look_at_heartbeat()
        return False

    def _look_at_heartbeat(self) -> None:
        """Ask for a HEARTBEAT now, to see a change sooner than once a second shows it."""
        if self._now_s >= self._next_look_s and not (self._look and self._look.pending):
            self._next_look_s = self._now_s + _LOOK_INTERVAL_S
            self._look = self._commands.submit(
                dialect.MAV_CMD_REQUEST_MESSAGE, dialect.MAVLINK_MSG_ID_HEARTBEAT
            )


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
