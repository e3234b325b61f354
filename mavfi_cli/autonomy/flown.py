"""The trajectory that is flown, and its own clock.

The clock may run slower than time: then the vehicle stays on the path that was checked. Its rate
is ramped within the braking limit: along a path flown at speed v, a rate r gives the velocity r v
and a ramp dr/dt the acceleration v dr/dt.
"""

from __future__ import annotations

import math

import numpy as np

from mavfi_cli.autonomy.trajectory import end_of_waypoint, reference_waypoint, waypoint_index
from mavfi_cli.core.types import FloatArray, Trajectory

SPEED_MIN_MPS = 0.5  # for the ramp: a slower plan's clock changes no faster


class FlownPlan:
    """Where on which trajectory the vehicle should be.

    Args:
        v_max_mps: speed limit; what a plan asks for beyond it does not count.
        brake_mps2: deceleration that stopping counts on.

    Attributes:
        trajectory: None while hovering.
        time_s: point on the trajectory, from its first waypoint.
        rate: trajectory seconds per second, 0..1.
        rate_change_per_s: how fast the rate changes.
        pace: share of the planned speed that the command in force leaves, 0..1; the clock runs
            that much slower.
    """

    def __init__(self, v_max_mps: float, brake_mps2: float) -> None:
        self._v_max_mps = v_max_mps
        self._brake_mps2 = brake_mps2
        self.stand()

    def stand(self) -> None:
        """No trajectory any more: hover."""
        self.begin(None, time_s=0.0, rate=0.0)

    def begin(self, trajectory: Trajectory | None, *, time_s: float, rate: float) -> None:
        """Fly a trajectory from that point on, its clock running at that rate."""
        self.trajectory = trajectory
        self.time_s = time_s
        self.rate = rate
        self.rate_change_per_s = 0.0
        self.pace = 1.0

    def advance(self, step_s: float, target_rate: float) -> None:
        """Run the clock for a step, ramping its rate towards the target."""
        speed = max(self.planned_speed_mps(), SPEED_MIN_MPS)
        ramp = self._brake_mps2 / speed * step_s
        change = min(max(target_rate - self.rate, -ramp), ramp)
        before = self.rate
        self.rate += change
        self.rate_change_per_s = change / step_s if step_s > 0.0 else 0.0
        self.time_s += 0.5 * (before + self.rate) * step_s * self.pace

    def skip_waypoint(self) -> None:
        """Go on with the next waypoint; over where there is none."""
        if self.trajectory is not None:
            self.time_s = end_of_waypoint(self.trajectory, self.waypoint)

    @property
    def over(self) -> bool:
        """Whether the clock is past the trajectory's end; also where there is no telling."""
        return self.trajectory is None or not self.time_s < self.trajectory.duration_s

    @property
    def waypoint(self) -> int:
        """Index of the waypoint that is followed; 0 without a trajectory."""
        return 0 if self.trajectory is None else waypoint_index(self.trajectory, self.time_s)

    def reference(self, ahead_s: float = 0.0) -> FloatArray:
        """The reference (10,), in the order of WAYPOINT_FIELDS, now or ahead at the present rate.

        Velocity and acceleration are those at rate 1.
        """
        assert self.trajectory is not None
        return reference_waypoint(self.trajectory, self.time_s + self.rate * ahead_s)

    def planned_speed_mps(self) -> float:
        """Speed that the trajectory asks for at its present point and rate 1, m/s."""
        if self.trajectory is None:
            return 0.0
        speed = float(np.linalg.norm(self.reference()[4:7]))
        return min(speed, self._v_max_mps) if math.isfinite(speed) else self._v_max_mps

    def stopping_s(self) -> float:
        """How long braking from the present speed takes, s."""
        return self.rate * self.planned_speed_mps() / self._brake_mps2
