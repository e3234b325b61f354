"""How long the pipeline takes from a depth frame to a setpoint."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True)
class Reaction:
    """How long a depth frame took to reach a setpoint: the pipeline's response time."""

    frame_stamp_s: float
    setpoint_stamp_s: float


def response_times(reactions: list[Reaction]) -> dict[str, float | None]:
    """Median and 95th percentile of the time from a depth frame to a setpoint, s."""
    if not reactions:
        return {"median": None, "p95": None, "count": 0}
    times = np.array([r.setpoint_stamp_s - r.frame_stamp_s for r in reactions])
    times = times[np.isfinite(times)]
    if not len(times):
        return {"median": None, "p95": None, "count": 0}
    return {
        "median": round(float(np.median(times)), 9),
        "p95": round(float(np.percentile(times, 95.0)), 9),
        "count": len(times),
    }
