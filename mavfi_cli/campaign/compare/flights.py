"""What each flight of a comparison came to, in the words of the comparison."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from mavfi_cli.campaign.compare.plan import GOLDEN, NONE
from mavfi_cli.campaign.ledger import Ledger
from mavfi_cli.campaign.outcome import MissionResult, State
from mavfi_cli.campaign.stopping import COUNTED
from mavfi_cli.core.types import Outcome


@dataclass(frozen=True, slots=True, kw_only=True)
class Flown:
    """One flight. A number that the flight does not have is not a number.

    Attributes:
        setting: golden, `none`, or the detector.
        target: what the fault was to strike; empty in a golden flight.
        seed, fault_seed: with these the flight repeats.
        counted: golden, or with a fault that struck something that was read or caught.
        response_median_s, response_p95_s: of this flight, from a depth frame to its setpoint.
    """

    platform: str
    setting: str
    target: str
    seed: int
    fault_seed: int | None
    outcome: str
    counted: bool
    flight_time_s: float
    distance_m: float
    energy_regression_j: float
    energy_propeller_j: float
    replans: float
    response_median_s: float
    response_p95_s: float

    @property
    def succeeded(self) -> bool:
        """Whether it reached its goal."""
        return self.outcome == Outcome.SUCCESS.value

    @property
    def mission(self) -> tuple[int, str]:
        """What the flights of all platforms and detectors share: seed, and what was struck."""
        return self.seed, self.target


def flights_of(ledger: Ledger) -> tuple[list[Flown], list[str]]:
    """All flights in the order of the list, and why missions could not be flown."""
    flights, errors = [], []
    for entry in ledger.results():
        if entry.state is State.FLOWN:
            flights.append(_flown(entry))
        else:
            errors.append(f"mission {entry.number}: {entry.reason}")
    return flights, errors


def _flown(entry: MissionResult) -> Flown:
    config, result = entry.mission.config, entry.result
    quality: Mapping[str, Any] = result.get("quality_of_flight") or {}
    pilot: Mapping[str, Any] = result.get("pilot") or {}
    response: Mapping[str, Any] = result.get("response_time_s") or {}
    fault = config.fault
    bare = GOLDEN if fault is None else NONE
    return Flown(
        platform=config.platform,
        setting=bare if config.detector is None else config.detector.name,
        target="" if fault is None else fault.target,
        seed=config.seed,
        fault_seed=None if fault is None else fault.seed,
        outcome=str(entry.outcome),
        counted=entry.injected is not None and entry.injected.value in COUNTED,
        flight_time_s=_number(quality.get("flight_time_s")),
        distance_m=_number(quality.get("distance_m")),
        energy_regression_j=_number(quality.get("energy_regression_j")),
        energy_propeller_j=_number(quality.get("energy_propeller_j")),
        replans=_number(pilot.get("replans")),
        response_median_s=_number(response.get("median")),
        response_p95_s=_number(response.get("p95")),
    )


def _number(value: Any) -> float:
    return math.nan if value is None else float(value)
