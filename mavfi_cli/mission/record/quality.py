"""Quality of flight (QoF): time, distance, energy and clearance (paper, section IV).

Flight time runs from the companion's take-over at take-off height to the end of the mission, as in
the paper, where take-off precedes the measurement. Unknown values are None, because a foreign
autopilot has no referee.
"""

from __future__ import annotations

from typing import Any

import numpy as np

Truth = dict[str, np.ndarray]
QUALITY = (
    "flight_time_s", "distance_m", "mean_speed_mps", "max_speed_mps", "min_clearance_m",
    "goal_distance_m",  # at the end of the mission
    "energy_regression_j",  # MAVBench's regression, see docs/reference/records.md
    "energy_propeller_j",  # from JSBSim's propeller shaft power, all rotors
)  # fmt: skip


def from_truth(
    truth: Truth, start_s: float, end_s: float, goal_enu_m: np.ndarray
) -> dict[str, float | None]:
    """Compute QUALITY between two stamps, s, from the referee's log.

    Args:
        truth: Columns with one row per control tick, see `sitl.referee`.
        start_s: Stamp of the companion's take-over.
        goal_enu_m: Goal (3,), m.
    """
    inside = (truth["stamp_s"] >= start_s - 1e-9) & (truth["stamp_s"] <= end_s + 1e-9)
    flown = {name: column[inside] for name, column in truth.items()}
    stamps = flown["stamp_s"]
    found = from_states(stamps, flown["position_enu_m"], flown["velocity_enu_mps"], goal_enu_m)
    if len(stamps) < 2:
        return found
    return {
        **found,
        "min_clearance_m": _known(flown["clearance_m"].min()),
        "energy_regression_j": _known(np.trapezoid(flown["power_regression_w"], stamps)),
        "energy_propeller_j": _known(np.trapezoid(flown["power_propeller_w"], stamps)),
    }


def _known(value: Any) -> float | None:
    """Return a number; None without obstacles, or if the referee could not measure it."""
    return float(value) if np.isfinite(value) else None


def from_states(
    stamps: np.ndarray, positions_enu_m: np.ndarray, velocities: np.ndarray, goal: np.ndarray
) -> dict[str, float | None]:
    """Compute the part of QUALITY that follows from received states.

    Args:
        stamps: (n,) s, positions_enu_m: (n, 3), velocities: (n, 3) m/s, goal: (3,) m.
    """
    found: dict[str, float | None] = dict.fromkeys(QUALITY)
    if len(stamps) < 2:
        return found
    distance_m = float(np.linalg.norm(np.diff(positions_enu_m, axis=0), axis=1).sum())
    flight_time_s = float(stamps[-1] - stamps[0])
    return {
        **found,
        "flight_time_s": flight_time_s,
        "distance_m": distance_m,
        "mean_speed_mps": distance_m / flight_time_s,
        "max_speed_mps": float(np.linalg.norm(velocities, axis=1).max()),
        "goal_distance_m": float(np.linalg.norm(positions_enu_m[-1] - goal)),
    }
