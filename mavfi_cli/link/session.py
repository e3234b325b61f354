"""The companion's side of a MAVLink flight, as a state machine without sockets or clock.

Lockstep, real time and tests drive it alike: `handle` every message that came, then `tick` with
the stamp; send what `tick` returns, in that order.
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

_HEIGHT_REACHED_M = 0.3  # so close below the wanted height counts as there
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
        telemetry: what was heard before, where this session is not the first on its link.

    Attributes:
        phase: how far the flight is.
        failure: why the phase became FAILED; None while it never did.
        failsafe_text: why the autopilot no longer follows (its mode changed unasked, or it
            disarmed); None while it does. Never taken back.
        telemetry: everything else that the autopilot told.
        camera: the camera component of the same system.
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

    # The phases ---------------------------------------------------------------------------------

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
        """Nothing more to ask for; the setpoints go on, for the other end may wait for them."""


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
