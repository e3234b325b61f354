"""Quality of flight (QoF): time, distance, energy and clearance (paper, section IV).

Flight time runs from the companion's take-over at take-off height to the end of the mission, as in
the paper, where take-off precedes the measurement.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

Truth = dict[str, np.ndarray]


@dataclass(frozen=True, slots=True, kw_only=True)
class QualityOfFlight:
    """Quality of a flight. Unknown values are None, because a foreign autopilot has no referee."""

    flight_time_s: float | None = None
    distance_m: float | None = None
    mean_speed_mps: float | None = None
    max_speed_mps: float | None = None
    min_clearance_m: float | None = None
    goal_distance_m: float | None = None  # at the end of the mission
    energy_regression_j: float | None = None  # MAVBench's regression, see docs/flight.md
    energy_propeller_j: float | None = None  # from JSBSim's propeller shaft power, all rotors

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for the record of the run."""
        return asdict(self)


def from_truth(
    truth: Truth, start_s: float, end_s: float, goal_enu_m: np.ndarray
) -> QualityOfFlight:
    """Compute the quality of flight between two stamps from the referee's log.

    Args:
        truth: Columns with one row per control tick, see `sitl.referee`.
        start_s: Stamp of the companion's take-over, s.
        end_s: Stamp of the mission's end, s.
        goal_enu_m: Goal (3,), m.
    """
    stamps = truth["stamp_s"]
    window = (stamps >= start_s - 1e-9) & (stamps <= end_s + 1e-9)
    if int(window.sum()) < 2:
        return QualityOfFlight()
    stamps, positions = stamps[window], truth["position_enu_m"][window]
    steps_m = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    speeds = np.linalg.norm(truth["velocity_enu_mps"][window], axis=1)
    flight_time_s = float(stamps[-1] - stamps[0])
    distance_m = float(steps_m.sum())
    return QualityOfFlight(
        flight_time_s=flight_time_s,
        distance_m=distance_m,
        mean_speed_mps=distance_m / flight_time_s,
        max_speed_mps=float(speeds.max()),
        min_clearance_m=_finite(float(truth["clearance_m"][window].min())),
        goal_distance_m=float(np.linalg.norm(positions[-1] - goal_enu_m)),
        energy_regression_j=_integral(stamps, truth["power_regression_w"][window]),
        energy_propeller_j=_integral(stamps, truth["power_propeller_w"][window]),
    )


def from_states(
    stamps: np.ndarray, positions_enu_m: np.ndarray, velocities: np.ndarray, goal: np.ndarray
) -> QualityOfFlight:
    """Compute the part of the quality of flight that follows from received states.

    Args:
        stamps: (n,) s, positions_enu_m: (n, 3), velocities: (n, 3) m/s, goal: (3,) m.
    """
    if len(stamps) < 2:
        return QualityOfFlight()
    distance_m = float(np.linalg.norm(np.diff(positions_enu_m, axis=0), axis=1).sum())
    flight_time_s = float(stamps[-1] - stamps[0])
    return QualityOfFlight(
        flight_time_s=flight_time_s,
        distance_m=distance_m,
        mean_speed_mps=distance_m / flight_time_s,
        max_speed_mps=float(np.linalg.norm(velocities, axis=1).max()),
        goal_distance_m=float(np.linalg.norm(positions_enu_m[-1] - goal)),
    )


def _integral(stamps: np.ndarray, power_w: np.ndarray) -> float:
    return float(np.trapezoid(power_w, stamps))


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
