"""Response time of the pipeline from a depth frame to a setpoint."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True)
class Reaction:
    """Response of the pipeline to one depth frame."""

    frame_stamp_s: float
    setpoint_stamp_s: float


def response_times(reactions: list[Reaction]) -> dict[str, float | None]:
    """Return median and 95th percentile of the response time, s."""
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
