"""Cost of detection and recovery in a flight, computed from its record.

The cost is "the total detection and recomputation time for each mission" (paper, Table V). Checks
count with their time on the host of the flight. Recomputations count with their latency on the
flight's platform, in simulated time.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from mavfi_cli.core.types import Stage
from mavfi_cli.mission.record.measures import record_of

# Kernels that are recomputed after an alarm of a stage, from first to last.
RECOMPUTED = {
    Stage.PERCEPTION.value: ("point_cloud", "octomap", "collision_check"),
    Stage.PLANNING.value: ("planner",),
    Stage.CONTROL.value: ("control",),
}
KERNELS = tuple(kernel for kernels in RECOMPUTED.values() for kernel in kernels)
# Note for every comparison of checks with simulated time, as no factor between hosts is known.
HOST_CHECKS = "checks take the time of the host that flew, not scaled to the platform"
UNKNOWN = "an unknown platform"
_AGAIN = ("recompute", "hold")  # responses to an alarm that cause a recomputation


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectionCost:
    """Cost of a detector in one flight.

    Attributes:
        flight_s: Flight time, or simulated time of the whole mission if that is unknown, s.
        recomputations: Number of recomputations per stage. The record lists the first alarms and
            only counts the others, which are distributed over the stages in the same ratio.
            Numbers may therefore be fractions.
        recovery_s: Simulated time of the recomputations per stage, each at the mean latency of its
            kernels in this flight, s.
    """

    detector: str
    checks: int
    checks_host_s: float
    flight_s: float
    recomputations: Mapping[str, float]
    recovery_s: Mapping[str, float]
    compute_s: float
    host_compute_s: float
    platform: str
    faulty: bool

    @property
    def check_host_s(self) -> float:
        """Mean host time of a check, s."""
        return self.checks_host_s / self.checks

    @property
    def detection_share(self) -> float:
        """Ratio of the checks' host time to the flight time."""
        return self.checks_host_s / self.flight_s

    @property
    def recovered_s(self) -> float:
        """Simulated time of all recomputations, s."""
        return math.fsum(self.recovery_s.values())

    @property
    def recovery_share(self) -> float:
        """Ratio of the recomputations' simulated time to the flight time."""
        return self.recovered_s / self.flight_s


def detection_cost(result: Mapping[str, Any]) -> DetectionCost | None:
    """Compute the cost of detection and recovery in a flight.

    Returns:
        Cost; None without a detector or without any check.
    """
    flight = record_of(result)
    detection, kernels = flight.detection, flight.kernels
    walls = flight.host.get("stage_wall_s") or {}
    checks_host_s = walls.get("gate")
    if not detection or not checks_host_s:
        return None
    checks = sum(detection["checks"].values())
    flight_s = flight.quality_of_flight.get("flight_time_s") or flight.simulated_s
    if not checks or not flight_s:
        return None
    again = _recomputations(detection)

    def mean_s(kernel: Mapping[str, Any] | None) -> float:
        """Return the mean latency of an invocation, s."""
        if not kernel or not kernel["invocations"]:
            return 0.0
        return float(kernel["busy_s"] / kernel["invocations"])

    return DetectionCost(
        detector=detection["detector"],
        checks=checks,
        checks_host_s=checks_host_s,
        flight_s=flight_s,
        recomputations=again,
        recovery_s={
            stage: math.fsum(again[stage] * mean_s(kernels.get(name)) for name in names)
            for stage, names in RECOMPUTED.items()
        },
        compute_s=math.fsum(kernels[name]["busy_s"] for name in KERNELS if name in kernels),
        host_compute_s=math.fsum(walls.get(name, 0.0) for name in KERNELS),
        platform=str(flight.config.get("platform", UNKNOWN)),
        faulty=bool(flight.fault),
    )


def _recomputations(detection: Mapping[str, Any]) -> dict[str, float]:
    """Return the recomputations per stage; unlisted alarms are distributed in the same ratio."""
    listed = [alarm["stage"] for alarm in detection["alarms"] if alarm["response"] in _AGAIN]
    total = sum(detection["responses"].get(response, 0) for response in _AGAIN)
    return {
        stage: listed.count(stage) * total / len(listed) if listed else 0.0 for stage in RECOMPUTED
    }
