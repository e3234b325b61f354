"""The active trajectory and its clock.

The clock may run slower than time, so that the vehicle slows down on the checked path. The rate of
the clock is ramped within the braking limit: along a path of planned speed v, a rate r gives the
velocity r v, and a ramp dr/dt gives the acceleration v dr/dt.
"""

from __future__ import annotations

import math

import numpy as np

from mavfi_cli.autonomy.trajectory import end_of_waypoint, reference_waypoint, waypoint_index
from mavfi_cli.core.types import FloatArray, Trajectory

SPEED_MIN_MPS = 0.5  # lower limit of the speed from which the ramp is computed


class ActivePlan:
    """The active trajectory and the present point on it.

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
            self.time_s = end_of_waypoint(self.trajectory, self.waypoint)

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
