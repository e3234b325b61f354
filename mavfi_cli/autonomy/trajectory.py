"""Interpolation of a sampled trajectory between its waypoints.

Waypoint i holds for durations_s[i]. The reference t seconds after its start is

    p = p_i + v_i t + a_i t^2 / 2,   v = v_i + a_i t,   a = a_i,

so the acceleration is part of the motion. Yaw turns at a constant rate towards the next waypoint's
yaw, the shorter way round. After the end the reference stays at the last waypoint's final point. A
duration that is NaN or negative counts as zero. An infinite duration never ends.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from mavfi_cli.core.compiled import compiled
from mavfi_cli.core.types import FloatArray, Trajectory

TWO_PI = 2.0 * math.pi


def reference_waypoint(trajectory: Trajectory, time_s: float) -> FloatArray:
    """Return the reference (10,), in the order of WAYPOINT_FIELDS, `time_s` after the start.

    Before the start it is the first waypoint, after the end the last point at rest. Corrupted
    waypoints are used unchanged.
    """
    out = np.empty(10)
    reference(trajectory.waypoints, trajectory.durations_s, time_s, out)
    return out


def waypoint_index(trajectory: Trajectory, time_s: float) -> int:
    """Return the index of the waypoint at that time; 0 if the trajectory has none."""
    return max(0, int(locate(trajectory.durations_s, time_s)[0]))


def _end_of_waypoint(trajectory: Trajectory, index: int) -> float:
    """Return the end of a waypoint, s after the start of the first one."""
    durations_s = trajectory.durations_s[: index + 1]
    return float(durations_s[durations_s > 0.0].sum())


def without_waypoint(trajectory: Trajectory, index: int) -> Trajectory:
    """Drop one waypoint and fill its time from the next one.

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
    """Return the waypoint at `time_s` and the time since its start; (-1, 0) if there is none.

    A time that is NaN counts as zero.
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
def reference(
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
        yaw += angle_between(yaw, waypoints[index + 1, 3]) * min(1.0, t / duration)
    elif t >= duration:  # at rest after the end
        out[4:10] = 0.0
    out[3] = yaw


@compiled
def angle_between(start_rad: float, end_rad: float) -> float:
    """Return the shorter turn from start to end in (-pi, pi]; NaN if an angle is not finite."""
    turn = (end_rad - start_rad) % TWO_PI
    return turn - TWO_PI if turn > math.pi else turn


SPEED_MIN_MPS = 0.5  # lower limit of the speed from which the ramp is computed


class ActivePlan:
    """The active trajectory, its clock, and the present point on it.

    The clock may run slower than time, so that the vehicle slows down on the checked path. Its rate
    is ramped within the braking limit: along a path of planned speed v, a rate r gives the velocity
    r v, and a ramp dr/dt gives the acceleration v dr/dt.

    Args:
        v_max_mps: Speed limit, which also caps the planned speed.
        brake_mps2: Deceleration assumed for stopping.

    Attributes:
        trajectory: Active trajectory; None while hovering.
        time_s: Present point on the trajectory, from its first waypoint.
        rate: Trajectory seconds per second, 0..1.
        rate_change_per_s: Time derivative of the rate.
        pace: Factor on the clock's rate from the current command, 0..1.
        checked: Trajectory that was last sent to the collision check.
    """

    def __init__(self, v_max_mps: float, brake_mps2: float) -> None:
        self._v_max_mps = v_max_mps
        self._brake_mps2 = brake_mps2
        self.checked: Trajectory | None = None
        self.stand()

    def stand(self) -> None:
        """Drop the trajectory and hover."""
        self.begin(None, time_s=0.0, rate=0.0)

    def begin(self, trajectory: Trajectory | None, *, time_s: float, rate: float) -> None:
        """Fly a trajectory from `time_s` on with its clock at `rate`."""
        self.trajectory = trajectory
        self.time_s = time_s
        self.rate = rate
        self.rate_change_per_s = 0.0
        self.pace = 1.0

    def advance(self, step_s: float, target_rate: float) -> None:
        """Advance the clock by a step and ramp its rate towards the target."""
        speed = max(self.planned_speed_mps(), SPEED_MIN_MPS)
        ramp = self._brake_mps2 / speed * step_s
        change = min(max(target_rate - self.rate, -ramp), ramp)
        before = self.rate
        self.rate += change
        self.rate_change_per_s = change / step_s if step_s > 0.0 else 0.0
        self.time_s += 0.5 * (before + self.rate) * step_s * self.pace

    def exchange(self, flown: Trajectory, changed: Trajectory) -> None:
        """Replace a trajectory by a changed version, without a new collision check."""
        if self.trajectory is flown:
            self.trajectory = changed
        if self.checked is flown:
            self.checked = changed

    def skip_waypoint(self) -> None:
        """Skip to the next waypoint, or to the end if there is none."""
        if self.trajectory is not None:
            self.time_s = _end_of_waypoint(self.trajectory, self.waypoint)

    @property
    def over(self) -> bool:
        """True if there is no trajectory, or its end has passed or is NaN."""
        return self.trajectory is None or not self.time_s < self.trajectory.duration_s

    @property
    def waypoint(self) -> int:
        """Index of the current waypoint; 0 without a trajectory."""
        return 0 if self.trajectory is None else waypoint_index(self.trajectory, self.time_s)

    def reference(self, ahead_s: float = 0.0) -> FloatArray:
        """Return the reference (10,), in the order of WAYPOINT_FIELDS, `ahead_s` from now.

        The clock is assumed to keep its rate. Velocity and acceleration are those at rate 1.
        """
        assert self.trajectory is not None
        return reference_waypoint(self.trajectory, self.time_s + self.rate * ahead_s)

    def planned_speed_mps(self) -> float:
        """Return the planned speed at the present point at rate 1, m/s."""
        if self.trajectory is None:
            return 0.0
        speed = float(np.linalg.norm(self.reference()[4:7]))
        return min(speed, self._v_max_mps) if math.isfinite(speed) else self._v_max_mps

    def stopping_s(self) -> float:
        """Return the time to brake from the present speed to rest, s."""
        return self.rate * self.planned_speed_mps() / self._brake_mps2
