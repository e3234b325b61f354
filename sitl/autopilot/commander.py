"""Manages modes, arming and failsafe as PX4's commander does, and holds the flight's state.

Texts, results and delays are those observed in messages of PX4 v1.17.
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum, IntEnum

import numpy as np

from mavfi_cli.core.frames import Vector
from mavfi_cli.link.codec import dialect
from sitl.autopilot.parameters import Parameters
from sitl.geodesy import Origin
from sitl.vehicle.truth import Truth

GPS_FIX_US = 2_500_000  # first fix and home position after boot
POSITION_US = 3_060_000  # global position fused
READY_US = 4_000_000  # pre-arm checks pass
_CONTROL_BACK_US = 1_000_000  # how long a lost input must be back before the failsafe ends
_STILL_MPS = 0.5

_STABILIZE: int = dialect.MAV_MODE_FLAG_STABILIZE_ENABLED
_AUTO: int = _STABILIZE | dialect.MAV_MODE_FLAG_AUTO_ENABLED | dialect.MAV_MODE_FLAG_GUIDED_ENABLED


class FlightMode(Enum):
    """A flight mode: PX4's main mode, its sub mode, and the name that PX4's texts use.

    custom_mode = main << 16 | sub << 24 (PX4's px4_custom_mode.h, confirmed with v1.17).
    """

    MANUAL = (1, 0, "Manual")
    POSCTL = (3, 0, "Position")
    TAKEOFF = (4, 2, "Takeoff")
    LOITER = (4, 3, "Hold")
    RTL = (4, 5, "Return")
    LAND = (4, 6, "Land")
    OFFBOARD = (6, 0, "Offboard")

    def __init__(self, main: int, sub: int, label: str) -> None:
        self.main = main
        self.sub = sub
        self.label = label
        self.custom_mode = main << 16 | sub << 24

    @classmethod
    def from_numbers(cls, main: int, sub: int) -> FlightMode | None:
        """Return the mode that param2 and param3 of DO_SET_MODE request, or None for other numbers.

        The sub mode is used only for AUTO. AUTO without a sub mode is LOITER.
        """
        auto = main == cls.LOITER.main
        numbers = (main, (sub or cls.LOITER.sub) if auto else 0)
        return next((mode for mode in cls if (mode.main, mode.sub) == numbers), None)

    def base_mode(self, *, armed: bool) -> int:
        """Return the value of HEARTBEAT.base_mode for this mode, as PX4 v1.17 sends it."""
        flags: int = dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        if armed:
            flags |= dialect.MAV_MODE_FLAG_SAFETY_ARMED
        if self.main == FlightMode.LOITER.main:
            return flags | _AUTO
        if self in (FlightMode.OFFBOARD, FlightMode.POSCTL):
            flags |= _STABILIZE
        if self is not FlightMode.OFFBOARD:
            flags |= dialect.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED
        return flags


class Severity(IntEnum):
    """The levels of MAV_SEVERITY that the autopilot's status texts use."""

    EMERGENCY = 0
    CRITICAL = 2
    WARNING = 4
    INFO = 6


class Result(IntEnum):
    """The values of MAV_RESULT with which the autopilot acknowledges commands."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3
    FAILED = 4


_RETRIED_MODES = (FlightMode.TAKEOFF, FlightMode.LAND, FlightMode.RTL)  # ended by disarming
_UNARMABLE = (FlightMode.LAND, FlightMode.RTL)
_OBL_ACTIONS = {4: FlightMode.LAND, 5: FlightMode.LOITER}  # COM_OBL_RC_ACT; RTL for other values
_OBL_TERMINATE = 6
# Modes that need an external input, and the parameter that limits how long it may be missing.
_INPUT_LIMITS = {FlightMode.OFFBOARD: "COM_OF_LOSS_T", FlightMode.POSCTL: "COM_RC_LOSS_T"}
_LANDED_STATES: dict[FlightMode, int] = {
    FlightMode.TAKEOFF: dialect.MAV_LANDED_STATE_TAKEOFF,
    FlightMode.LAND: dialect.MAV_LANDED_STATE_LANDING,
}


class Commander:
    """State machine of flight mode, arming, landing and failsafe."""

    def __init__(self, parameters: Parameters) -> None:
        self._parameters = parameters
        self.stamp_us = 0
        self.user_mode = self.mode_before_offboard = FlightMode.LOITER
        self.failsafe: FlightMode | None = None  # failsafe mode that overrides the user's
        self.armed = False
        self.landed = True  # on the ground
        self._settled_us: int | None = None  # when it came to rest on the ground
        self.terminated = False  # True after flight termination: the motors stay off
        self.texts: list[tuple[Severity, str]] = []  # pending; the owner removes them
        self._armed_us = self._landed_us = 0
        self._flown_since_arming = False
        self._input_us: dict[FlightMode, int] = {}  # stamps of newest setpoint and sticks
        self._control_back_us: int | None = None
        self._battery_warned = 0

    @property
    def mode(self) -> FlightMode:
        """Active mode: that of the failsafe if it is active, otherwise that of the user."""
        return self.failsafe or self.user_mode

    @property
    def armed_for_s(self) -> float:
        """Time since arming, in seconds. It is meaningless while the vehicle is disarmed."""
        return (self.stamp_us - self._armed_us) * 1e-6

    @property
    def has_gps_fix(self) -> bool:
        """True once GPS has a fix and home is known."""
        return self.stamp_us >= GPS_FIX_US

    @property
    def has_global_position(self) -> bool:
        """True once the estimator uses GPS."""
        return self.stamp_us >= POSITION_US

    @property
    def can_arm(self) -> bool:
        """True if the pre-arm checks pass, as the PREARM_CHECK bit of SYS_STATUS reports."""
        return (
            self.stamp_us >= READY_US
            and not self.terminated
            and self.mode not in _UNARMABLE
            and self.is_available(self.user_mode)
        )

    @property
    def system_status(self) -> int:
        """MAV_STATE of the vehicle, for HEARTBEAT.system_status."""
        if self.terminated:
            return int(dialect.MAV_STATE_FLIGHT_TERMINATION)
        if self.failsafe is not None:
            return int(dialect.MAV_STATE_CRITICAL)
        if self.armed:
            return int(dialect.MAV_STATE_ACTIVE)
        return int(dialect.MAV_STATE_STANDBY if self.can_arm else dialect.MAV_STATE_UNINIT)

    @property
    def landed_state(self) -> int:
        """MAV_LANDED_STATE of the vehicle, for EXTENDED_SYS_STATE.landed_state."""
        if self.landed:
            return int(dialect.MAV_LANDED_STATE_ON_GROUND)
        return int(_LANDED_STATES.get(self.mode, dialect.MAV_LANDED_STATE_IN_AIR))

    def is_available(self, mode: FlightMode) -> bool:
        """Return True if the inputs that a mode needs are arriving.

        OFFBOARD needs setpoints, and POSCTL needs stick positions. MANUAL is never available.
        """
        if mode in _INPUT_LIMITS:
            stamp_us = self._input_us.get(mode, -math.inf)
            limit_s = self._parameters.effective(_INPUT_LIMITS[mode])
            return self.stamp_us - stamp_us <= limit_s * 1e6
        return mode is not FlightMode.MANUAL  # MANUAL needs radio control, which is not simulated

    def input_arrived(self, mode: FlightMode) -> None:
        """Record that an input for OFFBOARD or POSCTL has arrived at the current stamp."""
        self._input_us[mode] = self.stamp_us

    def queue_text(self, severity: Severity, text: str) -> None:
        """Queue a status text for every client."""
        self.texts.append((severity, text))

    # Requests of clients.

    def request_mode(self, mode: FlightMode | None) -> Result:
        """Change the mode requested by the user, and return the result to acknowledge.

        A disarmed vehicle accepts any mode. None stands for an unknown mode, which is rejected.
        """
        if mode is None:
            return Result.TEMPORARILY_REJECTED
        if self.armed and not self.is_available(mode):
            self.queue_text(
                Severity.CRITICAL, f"Switching to {mode.label} is currently not available"
            )
            return Result.TEMPORARILY_REJECTED
        if self.user_mode is not FlightMode.OFFBOARD:
            self.mode_before_offboard = self.user_mode
        self.user_mode = mode
        self.failsafe = None
        return Result.ACCEPTED

    def request_arm(self, *, force: bool) -> Result:
        """Arm if the pre-arm checks pass or `force` is set. Return the result to acknowledge."""
        if self.armed:
            return Result.ACCEPTED
        if self.terminated or not (force or self.can_arm):
            why = "Resolve system health failures first"
            if self.terminated:
                why = "terminated, a reboot begins again"
            self.queue_text(Severity.CRITICAL, f"Arming denied: {why}")
            return Result.TEMPORARILY_REJECTED
        self.armed = True
        self._armed_us = self.stamp_us
        self._flown_since_arming = False
        self.queue_text(Severity.INFO, "Armed by external command")
        return Result.ACCEPTED

    def request_disarm(self, *, force: bool) -> Result:
        """Disarm, but in the air only if `force` is set. Return the result to acknowledge."""
        if self.armed and not self.landed and not force:
            self.queue_text(Severity.CRITICAL, "Disarming denied: not landed")
            return Result.TEMPORARILY_REJECTED
        if self.armed:
            self._disarm("external command")
        return Result.ACCEPTED

    def terminate(self, text: str) -> None:
        """Stop the motors permanently, and queue `text` as an emergency text for every client."""
        if not self.terminated:
            self.terminated = True
            self.queue_text(Severity.EMERGENCY, text)

    # Updates over time.

    def update(self, stamp_us: int, truth: Truth, *, wants_up: bool) -> None:
        """Advance to a stamp: update landing, failsafe, disarming and battery warnings.

        `wants_up` is True if the active setpoint climbs.
        """
        self.stamp_us = stamp_us
        self._detect_landing(truth, wants_up=wants_up)
        if self.armed:
            self._watch_control()
            self._auto_disarm()
        self._watch_battery(truth.battery_remaining)

    def _detect_landing(self, truth: Truth, *, wants_up: bool) -> None:
        """Update `landed`, with PX4's LNDMC_TRIG_TIME as hysteresis."""
        before = self.landed
        north, east, down = map(abs, truth.velocity_ned_mps.tolist())
        moves = not north + east + down < _STILL_MPS
        if self.landed or not truth.on_ground or wants_up or moves:
            self.landed = self.landed and truth.on_ground
            self._settled_us = None
        else:
            self._settled_us = self.stamp_us if self._settled_us is None else self._settled_us
            trigger_us = self._parameters.effective("LNDMC_TRIG_TIME") * 1e6
            self.landed = self.stamp_us - self._settled_us >= trigger_us
        if self.landed == before:
            return
        self._landed_us = self.stamp_us
        if not self.landed:
            self._flown_since_arming = True
        if self.armed:
            what = "Landing" if self.landed else "Takeoff"
            self.queue_text(Severity.INFO, f"{what} detected")

    def _watch_control(self) -> None:
        """Enter or leave the failsafe when the input of the user's mode is lost or returns."""
        if self.is_available(self.user_mode):
            if self.failsafe is None:
                return
            if self._control_back_us is None:
                self._control_back_us = self.stamp_us
            if self.stamp_us - self._control_back_us >= _CONTROL_BACK_US:
                self.failsafe = None
            return
        self._control_back_us = None
        if self.failsafe is not None or self.terminated:
            return
        action = int(self._parameters.effective("COM_OBL_RC_ACT"))
        self.failsafe = _OBL_ACTIONS.get(action, FlightMode.RTL)
        self.queue_text(Severity.CRITICAL, "Failsafe activated")
        if action >= _OBL_TERMINATE:
            self.terminate("Flight termination active")

    def _auto_disarm(self) -> None:
        if not self.landed:
            return
        wait, since, reason = "COM_DISARM_PRFLT", self._armed_us, "auto preflight disarming"
        if self._flown_since_arming:
            wait, since, reason = "COM_DISARM_LAND", self._landed_us, "landing"
        limit_s = self._parameters.effective(wait)
        if limit_s > 0.0 and self.stamp_us - since >= limit_s * 1e6:
            self._disarm(reason)

    def _disarm(self, reason: str) -> None:
        self.armed = False
        self.failsafe = None
        self._control_back_us = None
        self.queue_text(Severity.INFO, f"Disarmed by {reason}")
        if self.user_mode in _RETRIED_MODES:
            self.user_mode = FlightMode.LOITER

    def _watch_battery(self, remaining: float) -> None:
        levels = (("BAT_LOW_THR", "Low battery level"), ("BAT_CRIT_THR", "Critical battery level"))
        if self._battery_warned == len(levels):
            return
        threshold, text = levels[self._battery_warned]
        if remaining < self._parameters.effective(threshold):
            self._battery_warned += 1
            self.queue_text(Severity.WARNING, text)


# State of the flight ------------------------------------------------------------------------------

# Position, velocity, acceleration (NED; m, m/s, m/s^2), yaw (rad), yaw rate (rad/s), thrust (0..1),
# attitude (w x y z, body FRD to NED), body rates (rad/s) (19,); NaN means not controlled.
Setpoint = Vector
_UNSET = np.full(19, math.nan)


def no_setpoint() -> Setpoint:
    """Return a new setpoint that controls nothing: NaN in all components."""
    return _UNSET.copy()


_STRAIGHT_DOWN_MPS = 0.3
_STRAIGHT_DOWN_M = 0.5  # a place below the vehicle that is no farther away horizontally


@dataclass(slots=True, kw_only=True)
class Snapshot:
    """State of the flight, for guidance and telemetry. The autopilot updates it at every tick."""

    commander: Commander
    parameters: Parameters
    origin: Origin
    truth: Truth
    home_ned_m: Vector  # (3,)
    stamp_us: int = 0
    setpoint: Setpoint = field(default_factory=no_setpoint)
    motors_on: bool = False
    offboard: Setpoint = field(default_factory=no_setpoint)  # newest one of the companion
    sticks: tuple[int, int, int, int] = (0, 0, 500, 0)  # newest x, y, z, r of MANUAL_CONTROL
    takeoff_down_m: float = math.nan  # of the next TAKEOFF; NaN: MIS_TAKEOFF_ALT above home
    hold: tuple[Vector, float] | None = None  # NED position (3,) and yaw of the next LOITER
    elapsed_s: float = 0.0  # since the previous tick
    consumed_mah: float = 0.0

    @staticmethod
    def touches_down(setpoint: Sequence[float], place: Sequence[float]) -> bool:
        """Return True if a setpoint leads straight down, so that it may end on the ground.

        Args:
            setpoint: Position (3,) and velocity (3,), NED, m and m/s; NaN if not requested.
            place: Position (3,) of the vehicle, NED, m.
        """
        north, east, down = setpoint[3:6]
        if math.hypot(north, east) < _STRAIGHT_DOWN_MPS and down > 0.0:
            return True
        north, east, down = (there - here for there, here in zip(setpoint[:3], place, strict=True))
        return math.hypot(north, east) < _STRAIGHT_DOWN_M and down > 0.0

    @property
    def spooled_up(self) -> bool:
        """True once an armed vehicle's motors turn fast enough to take off."""
        return self.commander.armed_for_s >= self.parameters.effective("COM_SPOOLUP_TIME")

    @property
    def boot_ms(self) -> int:
        """Boot clock in milliseconds, which wraps around after 32 bits."""
        return self.stamp_us // 1000 & 0xFFFFFFFF

    @property
    def heading_deg(self) -> float:
        """Heading from north, 0 to 360 degrees."""
        return math.degrees(self.truth.euler_rad[2]) % 360.0

    def geodetic_e7(self, north_m: float, east_m: float) -> tuple[int, int]:
        """Return the latitude and longitude of a point in the local frame, in 1e-7 degrees."""
        latitude, longitude = self.origin.geodetic(north_m, east_m)
        return round(latitude * 1e7), round(longitude * 1e7)

    def amsl_m(self, down_m: float) -> float:
        """Return the altitude above sea level, m, at a local down coordinate, m."""
        return self.origin.altitude_amsl_m - down_m

    @property
    def thrust(self) -> float:
        """Mean motor command, in 0..1.

        The commands are added one by one, because Python 3.12's `sum` rounds differently.
        """
        commands = self.truth.motor_commands.tolist()
        return float(functools.reduce(operator.add, commands)) / len(commands)
