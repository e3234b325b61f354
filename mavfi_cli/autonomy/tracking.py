"""Path tracking: a PID on the position error with velocity and acceleration feed-forward.

    v = v_ref + Kp e + Ki integral(e) + Kd (v_ref - v_now),   |v| <= v_max
    a = a_ref,                                                |a| <= a_max

The reference is the trajectory's (see `trajectory`), run at `rate`: slowed down by a rate r that
changes by dr/dt, it has the velocity r v and the acceleration r^2 a + dr/dt v.

A command that the limit clips to a share of its speed has that share as its `pace`, where the
follower's clock is stretched: then the trajectory's clock runs that much slower while the command
is in force, so that a waypoint is flown until its distance is flown (the released common.cpp).
There a waypoint is flown in slices of 10 ms, and a stretched slice is slept through. The release's
C++ library (ROS Kinetic, GCC 5) hands a slice of 2^63 s or more to nanosleep as a negative number
of seconds, which nanosleep refuses: such a slice, and with it the waypoint, is over at once.

A corrupted reference: a term that is not finite is left out (the position error, the velocity or
the acceleration of that axis counts as zero, a yaw as the last one). As position and velocity
between waypoints depend on acceleration, a NaN there takes the whole axis out. Anything finite is
obeyed as far as the limits let it. So the output is always finite and within its limits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from mavfi_cli.autonomy.trajectory import angle_between, reference
from mavfi_cli.core.compiled import compiled
from mavfi_cli.core.types import Command, FloatArray, Trajectory

SLICE_S = 0.01  # of a waypoint, in the released common.cpp
ENDLESS_S = 2.0**63  # a slice that is stretched so far does not fit into a count of seconds


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackingParams:
    """Gains and limits. v_max, a_max and the yaw rate are the reference's (facts, section 4.1)."""

    kp_per_s: float = 0.8
    kp_climb_per_s: float = 0.8
    ki_per_s2: float = 0.05
    kd: float = 0.1
    integral_max_mps: float = 0.5  # limit of the integral term, each axis
    v_max_mps: float = 3.0
    a_max_mps2: float = 5.0
    yaw_rate_max_radps: float = math.pi / 2.0
    step_max_s: float = 0.1  # longer pauses between calls count as this long
    stretches_clock: bool = False
    skips_endless_slices: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackingState:
    """What the controller remembers: integral term, last commanded yaw, last stamp."""

    integral_mps: FloatArray = field(default_factory=lambda: np.zeros(3))  # (3,)
    yaw_rad: float
    stamp_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackingInputs:
    """One tick's worth: where the vehicle is, and what to follow."""

    stamp_s: float
    position_enu_m: FloatArray  # (3,)
    velocity_enu_mps: FloatArray  # (3,)
    trajectory: Trajectory | None  # None: hold
    time_s: float = 0.0  # point on the trajectory, from its first waypoint
    rate: float = 1.0  # trajectory seconds per second
    rate_change_per_s: float = 0.0
    hold_enu_m: FloatArray  # (3,) where there is no trajectory
    hold_yaw_rad: float


def step(
    state: TrackingState, inputs: TrackingInputs, params: TrackingParams
) -> tuple[TrackingState, Command]:
    """One control tick: the command, and the state for the next."""
    target = np.zeros(10)
    if inputs.trajectory is None:
        target[0:3] = inputs.hold_enu_m
        target[3] = inputs.hold_yaw_rad
    else:
        trajectory = inputs.trajectory
        reference(trajectory.waypoints, trajectory.durations_s, inputs.time_s, target)
    if params.kp_climb_per_s != params.kp_per_s:  # one gain for all axes, so the error is scaled
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
        stretch = max(1.0, demanded_mps(*law, *limits) / params.v_max_mps)
    yaw_rad = float(out[9])
    command = Command(
        stamp_s=inputs.stamp_s,
        velocity_enu_mps=out[0:3].copy(),
        yaw_rad=yaw_rad,
        acceleration_enu_mps2=out[3:6].copy(),
        pace=1.0 / stretch,
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
    """The controller on plain numbers; writes velocity, acceleration, integral, yaw into `out`."""
    step_s = elapsed_s if elapsed_s > 0.0 else 0.0
    step_s = min(step_s, step_max_s)
    for axis in range(3):
        v_planned = finite_or(target[4 + axis], 0.0)
        v_ref = finite_or(rate * v_planned, 0.0)
        a_ref = finite_or(rate * rate * finite_or(target[7 + axis], 0.0), 0.0)
        error = finite_or(target[axis] - position[axis], 0.0)
        damping = kd * (v_ref - velocity[axis])
        out[axis] = finite_or(v_ref + kp * error + integral[axis] + damping, v_ref)
        out[3 + axis] = finite_or(a_ref + rate_change_per_s * v_planned, a_ref)
        grown = finite_or(integral[axis] + ki * error * step_s, 0.0)
        out[6 + axis] = min(max(grown, -integral_max), integral_max)
    if limit_norm(out, 0, v_max):
        # Anti-windup: while the output is at its limit, the integral may only shrink.
        for axis in range(3):
            if abs(out[6 + axis]) > abs(integral[axis]):
                out[6 + axis] = integral[axis]
    limit_norm(out, 3, a_max)
    last_yaw = finite_or(last_yaw, 0.0)
    turn = finite_or(angle_between(last_yaw, target[3]), 0.0)
    reach = yaw_rate_max * step_s
    out[9] = angle_between(0.0, last_yaw + min(max(turn, -reach), reach))


@compiled
def demanded_mps(
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
    a_max: float,
    yaw_rate_max: float,
    step_max_s: float,
) -> float:
    """Speed that the controller would command without its speed limit, m/s; inf at an overflow."""
    out = np.empty(10)
    track(
        target, rate, rate_change_per_s, position, velocity, integral, last_yaw, elapsed_s,
        kp, ki, kd, integral_max, math.inf, a_max, yaw_rate_max, step_max_s, out,
    )  # fmt: skip
    largest = max(abs(out[0]), abs(out[1]), abs(out[2]))
    if largest == 0.0:
        return 0.0
    x, y, z = out[0] / largest, out[1] / largest, out[2] / largest
    return float(largest * math.sqrt(x * x + y * y + z * z))


@compiled
def finite_or(value: float, fallback: float) -> float:
    """The value, or the fallback where it is NaN or infinite."""
    return value if math.isfinite(value) else fallback


@compiled
def limit_norm(vectors: FloatArray, start: int, limit: float) -> bool:
    """Scale the three components from `start` to at most `limit` in norm; True where it did.

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
