"""Guides the vehicle in each flight mode: computes a setpoint from the state of the flight.

Speeds and heights are PX4's parameters. The sequences (brake, then hold; climb, then cross, then
descend) are those of PX4's multicopter modes.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from mavfi_cli.core.frames import Vector, dot, norm
from sitl.autopilot.commander import FlightMode, Setpoint, Severity, Snapshot
from sitl.autopilot.parameters import Parameters
from sitl.vehicle.cascade import SP_THRUST
from sitl.vehicle.truth import Truth

_POSITION_GAIN_PER_S = 0.95  # MPC_XY_P of PX4
_CLIMB_MPS = 0.3  # minimum climb speed of a setpoint that leaves the ground
_CLIMB_M = 0.3
_STOPPED_MPS = 0.3

_HORIZONTAL = slice(0, 2)
_ALL_AXES = slice(0, 3)

_TAKEOFF_FIRST_MPS = 0.4
_TAKEOFF_NEAR_M = 0.2
_ARRIVED_M = 0.5
_STICK_INVALID = 32767
_LIFTING = 0.1  # a setpoint with a larger thrust wants to leave the ground


# Guidance of a flight mode, from entering the mode to leaving it. At every tick it writes its
# setpoint into an array of NaN.
Guidance = Callable[[Snapshot, Setpoint], None]


def climbs(out: Setpoint, truth: Truth) -> bool:
    """Return True if the position or the velocity of a setpoint requests a climb.

    So does a thrust. A component that is NaN requests nothing.
    """
    lift = out[2] - truth.position_ned_m[2]
    return bool(out[5] < -_CLIMB_MPS or lift < -_CLIMB_M or out[SP_THRUST] > _LIFTING)


def _approach(delta: Vector, *, speed_mps: float, acceleration_mps2: float) -> Vector:
    """Return a velocity (n,) towards a point at offset `delta` (n,), slow enough to stop there.

    Its norm is the least of `speed_mps`, the position gain times the distance d, and sqrt(2 a d),
    from which the vehicle stops within d at a = `acceleration_mps2` / 2.
    """
    distance = norm(delta)
    if distance < 1e-6:
        return np.zeros_like(delta)
    stopping = math.sqrt(acceleration_mps2 * distance)
    return delta * (min(speed_mps, stopping, _POSITION_GAIN_PER_S * distance) / distance)


def _limit_velocity(out: Setpoint, parameters: Parameters) -> None:
    """Limit the velocity of a setpoint to MPC_XY_VEL_MAX and MPC_Z_VEL_MAX_*, in place."""
    speed = math.hypot(out[3], out[4])
    fastest = parameters.effective("MPC_XY_VEL_MAX")
    if speed > fastest:
        out[3:5] *= fastest / speed
    up, down = parameters.effective("MPC_Z_VEL_MAX_UP"), parameters.effective("MPC_Z_VEL_MAX_DN")
    out[5] = min(max(out[5], -up), down)  # NaN stays


class _Anchor:
    """A position hold, which brakes first and then holds the point where the vehicle stopped.

    If a place is given, it holds that place without braking.
    """

    def __init__(self, axes: slice, place: Vector | None = None) -> None:
        self._axes = axes
        self._place = place

    def hold(self, now: Snapshot, out: Setpoint) -> None:
        """Write to `out` the position to hold, or zero velocity while braking, for these axes."""
        axes = self._axes
        if self._place is None:
            velocity = now.truth.velocity_ned_mps[axes]
            if dot(velocity, velocity) > _STOPPED_MPS**2:
                out[3:6][axes] = 0.0
                return
            self._place = np.array(now.truth.position_ned_m[axes])
        out[0:3][axes] = self._place


def _hold(target_ned_m: Vector | None = None, yaw_rad: float = math.nan) -> Guidance:
    """Return the guidance of AUTO.LOITER: fly straight to the target, if given, and stay there."""
    anchor = _Anchor(_ALL_AXES, target_ned_m)

    def fly(now: Snapshot, out: Setpoint) -> None:
        out[9] = yaw_rad
        if target_ned_m is not None:
            delta = target_ned_m - now.truth.position_ned_m
            if dot(delta, delta) > _ARRIVED_M**2:
                _go(now, out, delta)
                return
        anchor.hold(now, out)

    return fly


def _take_off(target_down_m: float) -> Guidance:
    """Return the guidance of AUTO.TAKEOFF: climb straight to a height.

    The speed ramps up over MPC_TKO_RAMP_T. LOITER follows, at the target height or 0.5 m below the
    height reached, whichever is higher.
    """
    anchor, climbing_s = _Anchor(_HORIZONTAL), 0.0

    def fly(now: Snapshot, out: Setpoint) -> None:
        nonlocal climbing_s
        anchor.hold(now, out)
        delta = target_down_m - float(now.truth.position_ned_m[2])
        if not now.commander.landed and delta > -_TAKEOFF_NEAR_M:
            out[2] = target_down_m
            place = np.array(now.truth.position_ned_m)
            place[2] = min(target_down_m, float(place[2]) + 0.5)
            now.hold = place, math.nan
            now.commander.user_mode = FlightMode.LOITER
            return
        if now.spooled_up:
            climbing_s += now.elapsed_s
        ramp_s = max(now.parameters.effective("MPC_TKO_RAMP_T"), now.elapsed_s)
        fastest = now.parameters.effective("MPC_TKO_SPEED") * min(1.0, climbing_s / ramp_s)
        out[5] = -min(max(fastest, _TAKEOFF_FIRST_MPS), max(-delta, _TAKEOFF_FIRST_MPS))

    return fly


def _land(over: Vector | None = None) -> Guidance:
    """Return the guidance of AUTO.LAND: descend, more slowly below MPC_LAND_ALT1."""
    anchor = _Anchor(_HORIZONTAL, over)

    def fly(now: Snapshot, out: Setpoint) -> None:
        anchor.hold(now, out)
        value = now.parameters.effective
        height = float(now.home_ned_m[2] - now.truth.position_ned_m[2])
        high, low = value("MPC_LAND_ALT1"), value("MPC_LAND_ALT2")
        share = (height - low) / (high - low) if high > low else float(height > low)
        slow = value("MPC_LAND_SPEED")
        out[5] = slow + (value("MPC_Z_V_AUTO_DN") - slow) * min(max(share, 0.0), 1.0)

    return fly


def _return() -> Guidance:
    """Return the guidance of AUTO.RTL: climb, fly home, descend and land there."""
    down_m: float | None = None
    anchor = _Anchor(_HORIZONTAL)
    landing: Guidance | None = None
    crosses = False

    def fly(now: Snapshot, out: Setpoint) -> None:
        nonlocal down_m, landing, crosses
        if now.commander.landed:
            out[5] = now.parameters.effective("MPC_LAND_SPEED")
            return
        if down_m is None:
            height_m, home_down_m = _return_height_m(now), float(now.home_ned_m[2])
            down_m = home_down_m - height_m
            altitudes = f"{now.amsl_m(home_down_m) + height_m:.0f} m ({height_m:.0f} m above"
            text = f"RTL: start return at {altitudes} destination)"
            now.commander.queue_text(Severity.INFO, text)
        to_home = now.home_ned_m - now.truth.position_ned_m
        to_home[2] = down_m - float(now.truth.position_ned_m[2])
        if landing is not None:
            landing(now, out)
        elif crosses:
            _go(now, out, to_home)
            if math.hypot(to_home[0], to_home[1]) < _ARRIVED_M:
                landing = _land(np.array(now.home_ned_m[:2]))
        else:
            anchor.hold(now, out)
            _go_vertical(now, out, float(to_home[2]))
            crosses = to_home[2] > -_ARRIVED_M

    return fly


def _return_height_m(now: Snapshot) -> float:
    """Return the height above home, m, at which AUTO.RTL flies home.

    It is RTL_RETURN_ALT, or lower inside a cone around home, but never below the vehicle.
    """
    value = now.parameters.effective
    away = now.truth.position_ned_m - now.home_ned_m
    distance, above = math.hypot(away[0], away[1]), -float(away[2])
    height = value("RTL_RETURN_ALT")
    cone = math.radians(value("RTL_CONE_ANG"))
    if distance < value("RTL_MIN_DIST") and cone > 0.0:
        in_cone = distance / math.tan(cone) if cone < math.pi / 2.0 else 0.0
        height = min(height, max(in_cone, 2.0 * value("NAV_ACC_RAD")))
    return max(height, above)


def _follow_companion(now: Snapshot, out: Setpoint) -> None:
    """Guide OFFBOARD: follow the companion's newest setpoint.

    Along an axis with neither position nor velocity, the vehicle stops.
    """
    values = now.offboard.tolist()
    if not math.isnan(values[SP_THRUST]):  # an attitude or body rates, which PX4 does not limit
        out[:] = values
        return
    for axis in range(3):
        if math.isnan(values[axis]) and math.isnan(values[3 + axis]):
            values[3 + axis] = 0.0
    out[:] = values
    _limit_velocity(out, now.parameters)


def _follow_sticks(now: Snapshot, out: Setpoint) -> None:
    """Guide POSCTL: the stick positions, in -1000..1000, set velocity and yaw rate.

    A throttle of 500, in 0..1000, keeps the height.
    """
    x, y, z, r = now.sticks
    value = now.parameters.effective
    forward, right = (_stick(s) * value("MPC_VEL_MANUAL") for s in (x, y))
    heading_rad = now.truth.euler_rad[2]
    cosine, sine = math.cos(heading_rad), math.sin(heading_rad)
    out[3] = cosine * forward - sine * right
    out[4] = sine * forward + cosine * right
    lift = 0.0 if z == _STICK_INVALID else _stick(2 * z - 1000)
    out[5] = -lift * value("MPC_Z_VEL_MAX_UP" if lift > 0.0 else "MPC_Z_VEL_MAX_DN")
    out[10] = _stick(r) * math.radians(value("MPC_MAN_Y_MAX"))
    _limit_velocity(out, now.parameters)


def _stick(value: int) -> float:
    return 0.0 if value == _STICK_INVALID else min(max(value / 1000.0, -1.0), 1.0)


def _go(now: Snapshot, out: Setpoint, delta: Vector) -> None:
    value = now.parameters.effective
    out[3:5] = _approach(
        delta[:2], speed_mps=value("MPC_XY_CRUISE"), acceleration_mps2=value("MPC_ACC_HOR")
    )
    _go_vertical(now, out, float(delta[2]))


def _go_vertical(now: Snapshot, out: Setpoint, delta_m: float) -> None:
    name = "MPC_Z_V_AUTO_UP" if delta_m < 0.0 else "MPC_Z_V_AUTO_DN"
    limit = now.parameters.effective(name)
    out[5] = _approach(np.array([delta_m]), speed_mps=limit, acceleration_mps2=3.0)[0]


def begin(mode: FlightMode, now: Snapshot) -> Guidance:
    """Return the guidance of a mode that is being entered. LOITER takes and clears `now.hold`."""
    if mode is FlightMode.OFFBOARD:
        return _follow_companion
    if mode is FlightMode.POSCTL:
        return _follow_sticks
    if mode is FlightMode.TAKEOFF:
        default_down_m = float(now.home_ned_m[2]) - now.parameters.effective("MIS_TAKEOFF_ALT")
        is_default = math.isnan(now.takeoff_down_m)
        return _take_off(default_down_m if is_default else now.takeoff_down_m)
    if mode is FlightMode.LAND:
        return _land()
    if mode is FlightMode.RTL:
        return _return()
    hold, now.hold = now.hold, None
    return _hold(*(hold or ()))
