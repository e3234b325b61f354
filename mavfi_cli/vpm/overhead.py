"""The compute overhead of detection and recovery, from the records of flights.

As the paper's Table V: the time of all detection and recomputation of a mission, over the time that
the pipeline computes without them. Kernels take as long as on the flight's platform, recomputations
too; the checks take as long as they took on the host.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
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
_RESPONSES = ("recompute", "hold")  # to alarms after which something is computed again


@dataclass(frozen=True, slots=True, kw_only=True)
class Overhead:
    """What a detector cost in a number of flights.

    Attributes:
        detection_s: all checks of the gate, host time.
        recompute_s: recomputations, each at the mean latency of its stage's kernels, simulated.
        compute_s: all kernels, recomputations included, simulated.
        host_compute_s: all kernels, host time.
        alarms: after which something was computed again.
    """

    detector: str
    flights: int
    detection_s: float
    recompute_s: float
    compute_s: float
    host_compute_s: float
    alarms: int

    @property
    def share(self) -> float:
        """Of the compute time without detection and recovery; 0.01 is one per cent."""
        return (self.detection_s + self.recompute_s) / (self.compute_s - self.recompute_s)

    @property
    def checks_share(self) -> float:
        """The part of `share` that the checks take; the rest is recomputation."""
        return self.detection_s / (self.compute_s - self.recompute_s)

    @property
    def checks_host_share(self) -> float:
        """The checks over the host's own kernel time, whose workload is far below the paper's."""
        return self.detection_s / self.host_compute_s

    def told(self, where: str) -> str:
        """Where the number comes from, for the table."""
        again = self.share - self.checks_share
        return (
            f"measured in {self.flights} {'flight' if self.flights == 1 else 'flights'} of "
            f"{where}: checks {100.0 * self.checks_share:.4g} %, {self.alarms} "
            f"{'recomputation' if self.alarms == 1 else 'recomputations'} {100.0 * again:.4g} %"
        )


def overheads_of(results: Iterable[Mapping[str, Any]]) -> dict[str, Overhead]:
    """The overhead of every detector in these records, over all of its flights together.

    Flights with a fault do not count: their alarms are the fault's.

    Args:
        results: result.json of flights.
    """
    found: dict[str, Overhead] = {}
    for result in results:
        flown = _of_flight(result)
        if flown is not None:
            known = found.get(flown.detector)
            found[flown.detector] = flown if known is None else _sum(known, flown)
    return found


def _of_flight(result: Mapping[str, Any]) -> Overhead | None:
    detection, host = result.get("detection"), result.get("host") or {}
    walls, kernels = host.get("stage_wall_s") or {}, result.get("kernels") or {}
    if not detection or result.get("fault") or "gate" not in walls:
        return None
    compute_s = math.fsum(kernels[name]["busy_s"] for name in KERNELS if name in kernels)
    recompute_s = recomputed_s(result)
    host_compute_s = math.fsum(walls.get(name, 0.0) for name in KERNELS)
    if compute_s <= recompute_s or host_compute_s <= 0.0:
        return None
    return Overhead(
        detector=detection["detector"],
        flights=1,
        detection_s=walls["gate"],
        recompute_s=recompute_s,
        compute_s=compute_s,
        host_compute_s=host_compute_s,
        alarms=round(math.fsum(_recomputations(detection).values())),
    )


def recomputed_s(result: Mapping[str, Any]) -> float:
    """Simulated seconds that what a detector had computed again took in a flight with one."""
    kernels = result.get("kernels") or {}
    return math.fsum(
        count * _mean_s(kernels.get(name))
        for stage, count in _recomputations(result["detection"]).items()
        for name in RECOMPUTED[stage]
    )


def _recomputations(detection: Mapping[str, Any]) -> dict[str, float]:
    """How often each stage computed again; the alarms beyond the listed ones are shared alike."""
    listed = [alarm["stage"] for alarm in detection["alarms"] if alarm["response"] in _RESPONSES]
    total = sum(detection["responses"].get(response, 0) for response in _RESPONSES)
    return {
        stage: listed.count(stage) * total / len(listed) if listed else 0.0 for stage in RECOMPUTED
    }


def _mean_s(kernel: Mapping[str, Any] | None) -> float:
    """Mean latency of an invocation, s."""
    return kernel["busy_s"] / kernel["invocations"] if kernel and kernel["invocations"] else 0.0


def _sum(first: Overhead, second: Overhead) -> Overhead:
    return Overhead(
        detector=first.detector,
        flights=first.flights + second.flights,
        detection_s=first.detection_s + second.detection_s,
        recompute_s=first.recompute_s + second.recompute_s,
        compute_s=first.compute_s + second.compute_s,
        host_compute_s=first.host_compute_s + second.host_compute_s,
        alarms=first.alarms + second.alarms,
    )
