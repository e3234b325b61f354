"""Tracking of a trajectory: its reference, and PID control with feed-forward.

A sampled trajectory is interpolated between its waypoints. Waypoint i holds for durations_s[i]. The
reference t seconds after its start is

    p = p_i + v_i t + a_i t^2 / 2,   v = v_i + a_i t,   a = a_i,

so the acceleration is part of the motion. Yaw turns at a constant rate towards the next waypoint's
yaw, the shorter way round. After the end the reference stays at the last waypoint's final point. A
duration that is NaN or negative counts as zero. A waypoint with an infinite duration never ends.

Control acts on the position error e:

    v = v_ref + Kp e + Ki integral(e) + Kd (v_ref - v_now),   |v| <= v_max
    a = a_ref,                                                |a| <= a_max

The clock of the trajectory runs at `rate`. At a rate r that changes by dr/dt, the reference has the
velocity r v and the acceleration r^2 a + dr/dt v.

With `stretches_clock`, the `pace` of a command that the speed limit clips is the ratio of clipped
to demanded speed. The trajectory's clock runs slower by this factor while the command holds, so
that a waypoint lasts until its distance is covered, as in the released common.cpp. That code flies
a waypoint in slices of 10 ms and sleeps through a stretched slice. Its C++ library (ROS Kinetic,
GCC 5) passes a slice of 2^63 s or more to nanosleep as a negative number of seconds. nanosleep
rejects it, so the slice and the waypoint end at once.

A slice of 10 ms of the trajectory can take longer than 10 ms, because the released follower calls
the simulator in every slice. `slice_period_s` is the time that a slice takes. The clock then runs
at the ratio 0.01 / slice_period_s, but the commanded velocity is that of the waypoint, so the
vehicle runs ahead of the reference until the position error balances the difference.

A term of a corrupted reference that is not finite is left out: the position error, the velocity or
the acceleration of that axis counts as zero, and the last yaw is kept. Position and velocity
between waypoints depend on the acceleration, so a NaN there disables the whole axis. Finite values
are followed within the limits. The output is always finite and within its limits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from mavfi_cli.core.compiled import compiled
from mavfi_cli.core.types import Command, FloatArray, Trajectory

TWO_PI = 2.0 * math.pi
SLICE_S = 0.01  # time slice of a waypoint in the released common.cpp
ENDLESS_S = 2.0**63  # a slice of this length overflows a signed 64-bit number of seconds


def reference_waypoint(trajectory: Trajectory, time_s: float) -> FloatArray:
    """Return the reference state of a trajectory `time_s` seconds after its start.

    The result is an array (10,) in the order of WAYPOINT_FIELDS. Before the start it is the first
    waypoint, and after the end it is the last point, at rest. Corrupted waypoints are used
    unchanged.
    """
    out = np.empty(10)
    _reference(trajectory.waypoints, trajectory.durations_s, time_s, out)
    return out


def waypoint_index(trajectory: Trajectory, time_s: float) -> int:
    """Return the index of the waypoint at `time_s`, or 0 if the trajectory has no waypoint."""
    return max(0, int(locate(trajectory.durations_s, time_s)[0]))


def without_waypoint(trajectory: Trajectory, index: int) -> Trajectory:
    """Return a trajectory in which the motion of the next waypoint replaces waypoint `index`.

    The next waypoint's motion is extended backwards over the dropped duration, so the trajectory
    keeps its timing and stays continuous there. The last waypoint is replaced by rest at the end of
    the one before it. A single waypoint stays unchanged.
    """
    waypoints = trajectory.waypoints.copy()
    last = len(waypoints) - 1
    if last == 0:
        return trajectory
    if index < last:
        source, time_s = waypoints[index + 1], -float(trajectory.durations_s[index])
    else:
        source, time_s = waypoints[last - 1], float(trajectory.durations_s[last - 1])
    velocity, acceleration = source[4:7], source[7:10]
    waypoints[index, 0:3] = source[0:3] + velocity * time_s + 0.5 * acceleration * time_s**2
    waypoints[index, 3] = source[3]
    waypoints[index, 4:7] = velocity + acceleration * time_s if index < last else 0.0
    waypoints[index, 7:10] = acceleration if index < last else 0.0
    return replace(trajectory, waypoints=waypoints)


@compiled
def locate(durations_s: FloatArray, time_s: float) -> tuple[int, float]:
    """Return the index of the waypoint at `time_s`, and the time in seconds since it began.

    A `time_s` that is NaN or negative counts as zero. Without waypoints, the result is (-1, 0).
    """
    left = time_s if time_s > 0.0 else 0.0
    last = len(durations_s) - 1
    for index in range(last + 1):
        duration = durations_s[index]
        if not duration > 0.0:
            duration = 0.0
        if left < duration:
            return index, left
        if index == last:
            return index, duration
        left -= duration
    return -1, 0.0


@compiled
def _reference(
    waypoints: FloatArray, durations_s: FloatArray, time_s: float, out: FloatArray
) -> None:
    """Write the reference at `time_s` into `out` (10,), or NaN if there is no waypoint."""
    index, t = locate(durations_s, time_s)
    if index < 0 or index >= waypoints.shape[0]:
        out[:] = math.nan
        return
    for axis in range(3):
        p, v, a = waypoints[index, axis], waypoints[index, 4 + axis], waypoints[index, 7 + axis]
        out[axis] = p + v * t + 0.5 * a * t * t
        out[4 + axis] = v + a * t
        out[7 + axis] = a
    yaw = waypoints[index, 3]
    duration = durations_s[index]
    if index + 1 < waypoints.shape[0] and duration > 0.0:
        yaw += _angle_between(yaw, waypoints[index + 1, 3]) * min(1.0, t / duration)
    elif t >= duration:  # at rest after the end
        out[4:10] = 0.0
    out[3] = yaw


@compiled
def _angle_between(start_rad: float, end_rad: float) -> float:
    """Return the shorter turn from one angle to another, in (-pi, pi].

    The result is NaN if an angle is not finite.
    """
    turn = (end_rad - start_rad) % TWO_PI
    return turn - TWO_PI if turn > math.pi else turn


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackingParams:
    """Gains and limits of control. v_max, a_max and yaw rate are those of the released code."""

    kp_per_s: float = 0.8
    kp_climb_per_s: float = 0.8
    ki_per_s2: float = 0.05
    kd: float = 0.1
    integral_max_mps: float = 0.5  # limit of the integral term for each axis
    v_max_mps: float = 3.0
    a_max_mps2: float = 5.0
    yaw_rate_max_radps: float = math.pi / 2.0
    step_max_s: float = 0.1  # upper limit of the time step
    stretches_clock: bool = False
    skips_endless_slices: bool = False
    slice_period_s: float = SLICE_S


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackingState:
    """State of the controller between two ticks: integral term, last commanded yaw, last stamp."""

    integral_mps: FloatArray = field(default_factory=lambda: np.zeros(3))  # (3,)
    yaw_rad: float
    stamp_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackingInputs:
    """Inputs of one tick: the vehicle's state and the reference to follow."""

    stamp_s: float
    position_enu_m: FloatArray  # (3,)
    velocity_enu_mps: FloatArray  # (3,)
    trajectory: Trajectory | None  # None: hold
    time_s: float = 0.0  # time on the trajectory, since its first waypoint
    rate: float = 1.0  # trajectory seconds per second
    rate_change_per_s: float = 0.0
    hold_enu_m: FloatArray  # (3,) position to hold without a trajectory
    hold_yaw_rad: float


def step(
    state: TrackingState, inputs: TrackingInputs, params: TrackingParams
) -> tuple[TrackingState, Command]:
    """Run one control tick. Return the state for the next tick, and the command."""
    target = np.zeros(10)
    if inputs.trajectory is None:
        target[0:3] = inputs.hold_enu_m
        target[3] = inputs.hold_yaw_rad
    else:
        trajectory = inputs.trajectory
        _reference(trajectory.waypoints, trajectory.durations_s, inputs.time_s, target)
    if params.kp_climb_per_s != params.kp_per_s:  # scale the error, as `track` has one gain
        height_m = inputs.position_enu_m[2]
        share = params.kp_climb_per_s / params.kp_per_s
        target[2] = height_m + share * (target[2] - height_m)
    law = (
        target,
        inputs.rate,
        inputs.rate_change_per_s,
        inputs.position_enu_m,
        inputs.velocity_enu_mps,
        state.integral_mps,
        state.yaw_rad,
        inputs.stamp_s - state.stamp_s,
        params.kp_per_s,
        params.ki_per_s2,
        params.kd,
        params.integral_max_mps,
    )
    limits = (params.a_max_mps2, params.yaw_rate_max_radps, params.step_max_s)
    out = np.empty(10)
    track(*law, params.v_max_mps, *limits, out)
    stretch = 1.0
    if params.stretches_clock:
        stretch = max(1.0, _demanded_mps(law, limits) / params.v_max_mps)
    yaw_rad = float(out[9])
    command = Command(
        stamp_s=inputs.stamp_s,
        velocity_enu_mps=out[0:3].copy(),
        yaw_rad=yaw_rad,
        acceleration_enu_mps2=out[3:6].copy(),
        pace=1.0 / max(stretch, params.slice_period_s / SLICE_S),
        skips_waypoint=params.skips_endless_slices and SLICE_S * stretch >= ENDLESS_S,
    )
    return (
        TrackingState(integral_mps=out[6:9].copy(), yaw_rad=yaw_rad, stamp_s=inputs.stamp_s),
        command,
    )


@compiled
def track(
    target: FloatArray,
    rate: float,
    rate_change_per_s: float,
    position: FloatArray,
    velocity: FloatArray,
    integral: FloatArray,
    last_yaw: float,
    elapsed_s: float,
    kp: float,
    ki: float,
    kd: float,
    integral_max: float,
    v_max: float,
    a_max: float,
    yaw_rate_max: float,
    step_max_s: float,
    out: FloatArray,
) -> None:
    """Compute one step of the control law.

    Velocity (3,), acceleration (3,), integral term (3,) and yaw are written to `out` (10,).
    """
    step_s = elapsed_s if elapsed_s > 0.0 else 0.0
    step_s = min(step_s, step_max_s)
    for axis in range(3):
        v_planned = _finite_or(target[4 + axis], 0.0)
        v_ref = _finite_or(rate * v_planned, 0.0)
        a_ref = _finite_or(rate * rate * _finite_or(target[7 + axis], 0.0), 0.0)
        error = _finite_or(target[axis] - position[axis], 0.0)
        damping = kd * (v_ref - velocity[axis])
        out[axis] = _finite_or(v_ref + kp * error + integral[axis] + damping, v_ref)
        out[3 + axis] = _finite_or(a_ref + rate_change_per_s * v_planned, a_ref)
        grown = _finite_or(integral[axis] + ki * error * step_s, 0.0)
        out[6 + axis] = min(max(grown, -integral_max), integral_max)
    if _limit_norm(out, 0, v_max):
        # Anti-windup: the integral may only shrink while the output is at its limit.
        for axis in range(3):
            if abs(out[6 + axis]) > abs(integral[axis]):
                out[6 + axis] = integral[axis]
    _limit_norm(out, 3, a_max)
    last_yaw = _finite_or(last_yaw, 0.0)
    turn = _finite_or(_angle_between(last_yaw, target[3]), 0.0)
    reach = yaw_rate_max * step_s
    out[9] = _angle_between(0.0, last_yaw + min(max(turn, -reach), reach))


@compiled
def _demanded_mps(law: tuple[Any, ...], limits: tuple[float, float, float]) -> float:
    """Return the speed, in m/s, that would be commanded without the speed limit.

    It is infinite on overflow. `law` and `limits` are the arguments of `track` that precede and
    follow the speed limit.
    """
    out = np.empty(10)
    track(*law, math.inf, *limits, out)  # type: ignore[call-arg]  # `law` has twelve arguments
    largest = max(abs(out[0]), abs(out[1]), abs(out[2]))
    if largest == 0.0:
        return 0.0
    x, y, z = out[0] / largest, out[1] / largest, out[2] / largest
    return float(largest * math.sqrt(x * x + y * y + z * z))


@compiled
def _finite_or(value: float, fallback: float) -> float:
    """Return the value, or the fallback if the value is NaN or infinite."""
    return value if math.isfinite(value) else fallback


@compiled
def _limit_norm(vectors: FloatArray, start: int, limit: float) -> bool:
    """Limit the norm of three components, starting at index `start`. Return True if it scaled them.

    Safe for components whose squares overflow.
    """
    x, y, z = vectors[start], vectors[start + 1], vectors[start + 2]
    largest = max(abs(x), abs(y), abs(z))
    if largest == 0.0:
        return False
    norm = math.sqrt((x / largest) ** 2 + (y / largest) ** 2 + (z / largest) ** 2)
    if largest * norm <= limit:
        return False
    for axis in range(3):
        vectors[start + axis] = (vectors[start + axis] / largest) * (limit / norm)
    return True
