"""What detection and recovery cost one flight, from its record.

As in the paper's Table V, "the total detection and recomputation time for each mission". The checks
take what they took on the host that flew; what is computed again takes its latency on the flight's
platform, in simulated time.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from mavfi_cli.core.types import Stage

# What is computed again when a stage raises an alarm: from its first kernel to its last.
RECOMPUTED = {
    Stage.PERCEPTION.value: ("point_cloud", "octomap", "collision_check"),
    Stage.PLANNING.value: ("planner",),
    Stage.CONTROL.value: ("control",),
}
KERNELS = tuple(kernel for kernels in RECOMPUTED.values() for kernel in kernels)
# Said wherever the checks stand beside simulated time: no factor between hosts is known.
HOST_CHECKS = "checks take the time of the host that flew, not scaled to the platform"
UNKNOWN = "an unknown platform"
_AGAIN = ("recompute", "hold")  # responses to an alarm after which something is computed again


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectionCost:
    """What a detector cost in one flight.

    Attributes:
        checks: messages that passed the gate, looks through plans included.
        checks_host_s: all of them together, host time.
        flight_s: flight time; where that is not known, the simulated time of the whole mission.
        recomputations: of each stage. The record lists the first alarms one by one and counts the
            others, which are shared among the stages as those are; so these may be fractions.
        recovery_s: of each stage, simulated: its recomputations, each at the mean latency that its
            kernels had in this flight.
        compute_s, host_compute_s: all kernels, recomputations included: simulated, and host time.
        platform: what the mission calls it.
        faulty: whether the flight has a fault.
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
        """Mean host time of a check."""
        return self.checks_host_s / self.checks

    @property
    def detection_share(self) -> float:
        """Host time of all checks over the flight time; 0.01 is one per cent."""
        return self.checks_host_s / self.flight_s

    @property
    def recovered_s(self) -> float:
        """Simulated seconds that all recomputations took."""
        return math.fsum(self.recovery_s.values())

    @property
    def recovery_share(self) -> float:
        """Simulated time of all recomputations over the flight time."""
        return self.recovered_s / self.flight_s


def detection_cost(result: Mapping[str, Any]) -> DetectionCost | None:
    """The cost of detection and recovery in a flight.

    Args:
        result: result.json.

    Returns:
        None where no detector watched, or where the flight ended before anything was checked.
    """
    detection = result.get("detection")
    walls = (result.get("host") or {}).get("stage_wall_s") or {}
    checks_host_s = walls.get("gate")
    if not detection or not checks_host_s:
        return None
    checks = sum(detection["checks"].values())
    quality = result.get("quality_of_flight") or {}
    flight_s = quality.get("flight_time_s") or result.get("simulated_s")
    if not checks or not flight_s:
        return None
    again = _recomputations(detection)
    kernels = result.get("kernels") or {}
    return DetectionCost(
        detector=detection["detector"],
        checks=checks,
        checks_host_s=checks_host_s,
        flight_s=flight_s,
        recomputations=again,
        recovery_s={
            stage: math.fsum(again[stage] * _mean_s(kernels.get(name)) for name in names)
            for stage, names in RECOMPUTED.items()
        },
        compute_s=math.fsum(kernels[name]["busy_s"] for name in KERNELS if name in kernels),
        host_compute_s=math.fsum(walls.get(name, 0.0) for name in KERNELS),
        platform=str(result.get("config", {}).get("platform", UNKNOWN)),
        faulty=bool(result.get("fault")),
    )


def _recomputations(detection: Mapping[str, Any]) -> dict[str, float]:
    """How often each stage computed again; the alarms beyond the listed ones are shared alike."""
    listed = [alarm["stage"] for alarm in detection["alarms"] if alarm["response"] in _AGAIN]
    total = sum(detection["responses"].get(response, 0) for response in _AGAIN)
    return {
        stage: listed.count(stage) * total / len(listed) if listed else 0.0 for stage in RECOMPUTED
    }


def _mean_s(kernel: Mapping[str, Any] | None) -> float:
    """Mean latency of an invocation, s."""
    return kernel["busy_s"] / kernel["invocations"] if kernel and kernel["invocations"] else 0.0
