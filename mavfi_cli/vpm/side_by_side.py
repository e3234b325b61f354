"""Model and flights side by side: each number of the model, what was flown, and the difference."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

from mavfi_cli.vpm import measures
from mavfi_cli.vpm.flight_plan import NOT_SCALED, FlightPlan
from mavfi_cli.vpm.overhead import Overhead
from mavfi_cli.vpm.schemes import REFERENCE, SCHEMES

Measure = Callable[[Mapping[str, Any]], float | None]
BASE = "none"  # ratios of flights are over one board without protection
MODEL = {"velocity": "velocity_mps", "flight_time": "flight_time_s", "energy": "energy_j"}


class Estimate(Protocol):
    """A number with its 95 % interval; not a number where there are too few flights."""

    @property
    def value(self) -> float:
        """The estimate itself."""

    @property
    def low(self) -> float:
        """Lower end of the interval."""

    @property
    def high(self) -> float:
        """Upper end of the interval."""

    @property
    def count(self) -> int:
        """How many flights, or pairs of them, it is of."""


class Proportion(Protocol):
    """A success rate with its interval."""

    @property
    def share(self) -> float:
        """Of all missions, 0 to 1."""

    @property
    def low(self) -> float:
        """Lower end of the interval."""

    @property
    def high(self) -> float:
        """Upper end of the interval."""

    @property
    def total(self) -> int:
        """How many missions were flown."""


class Flights(Protocol):
    """All missions of a vehicle with a scheme."""

    @property
    def errors(self) -> Sequence[str]:
        """Why missions could not be flown."""

    @property
    def outcomes(self) -> Mapping[str, int]:
        """How many missions ended in each way."""

    @property
    def success(self) -> Proportion:
        """Of those that were flown."""

    def mean(self, measure: Measure) -> Estimate:
        """Of the successful ones."""


# Mean of each flight of the second over the same mission of the first.
PairedRatio = Callable[[Any, Any, Measure, Measure], Estimate]


def side_by_side(
    told: Mapping[str, Any],
    plans: Mapping[tuple[str, str], FlightPlan | str],
    flown: Mapping[tuple[str, str], Flights],
    ratio: PairedRatio,
    overheads: Mapping[str, Overhead],
) -> dict[str, Any]:
    """What is not scaled, overheads, and for each vehicle a flat row a scheme.

    Args:
        told: the model's report, with the overheads that the plans have.
        plans: by vehicle and scheme; a text where the scheme cannot be flown, and why.
        flown: the flights of those that can.
        ratio: of two arms over the missions in which both succeeded.
        overheads: measured in these flights, by detector.
    """
    return {
        "ratios_over": BASE,
        "paper_ratios_over": REFERENCE,
        "not_scaled": list(NOT_SCALED),
        "overheads": [_overhead(each) for each in overheads.values()],
        "vehicles": [
            {
                "vehicle": one["vehicle"],
                "board": one["board"],
                "schemes": [
                    {
                        **_scheme(one["vehicle"], row, plans, flown),
                        **_over(one, row, plans, flown, ratio),
                    }
                    for row in one["schemes"]
                ],
            }
            for one in told["vehicles"]
        ],
    }


def _overhead(measured: Overhead) -> dict[str, Any]:
    paper = next(scheme for scheme in SCHEMES if scheme.name == measured.detector)
    return {
        "detector": measured.detector,
        "flights": measured.flights,
        "alarms": measured.alarms,
        "measured_percent": 100.0 * measured.share,
        "checks_percent": 100.0 * measured.checks_share,
        "checks_of_host_kernels_percent": 100.0 * measured.checks_host_share,
        "paper_percent": 100.0 * paper.overhead,
    }


def _scheme(
    vehicle: str,
    row: Mapping[str, Any],
    plans: Mapping[tuple[str, str], FlightPlan | str],
    flown: Mapping[tuple[str, str], Flights],
) -> dict[str, Any]:
    key = (vehicle, row["scheme"])
    plan = plans[key]
    told: dict[str, Any] = {
        "scheme": row["scheme"], "title": row["title"], "boards": row["boards"],
        "overhead_percent": row["overhead_percent"], "mass_kg": row["mass_kg"], "problem": None,
        "errors": [], "cut": [],
    }  # fmt: skip
    if isinstance(plan, str):
        return {**told, "problem": plan}
    return {
        **told,
        "v_max_mps": plan.mission.v_max_mps,
        "a_max_mps2": plan.mission.a_max_mps2,
        "braking_velocity_mps": plan.braking_velocity_mps,
        "cut": list(plan.cut),
        "errors": list(flown[key].errors),
        **_success(flown[key]),
        **_numbers(row, plan, flown[key]),
    }


def _over(
    one: Mapping[str, Any],
    row: Mapping[str, Any],
    plans: Mapping[tuple[str, str], FlightPlan | str],
    flown: Mapping[tuple[str, str], Flights],
    ratio: PairedRatio,
) -> dict[str, float]:
    """Ratios over one board without protection, and the paper's: over detection and recovery."""
    rows = {each["scheme"]: each for each in one["schemes"]}
    told: dict[str, float] = {}
    for over, suffix, names in (
        (BASE, "", tuple(MODEL)),
        (REFERENCE, f"_over_{REFERENCE}", ("flight_time",)),
    ):
        first, second = (one["vehicle"], over), (one["vehicle"], row["scheme"])
        base, plan = plans[first], plans[second]
        if isinstance(base, str) or isinstance(plan, str):
            continue
        for name in names:
            model = row[MODEL[name]] / rows[over][MODEL[name]]
            measures_of = _measure(name, base), _measure(name, plan)
            found = ratio(flown[first], flown[second], *measures_of)
            told |= _beside(f"{name}{suffix}", "_ratio", model, found)
            told[f"pairs{suffix}"] = found.count
    return told


def _measure(name: str, plan: FlightPlan) -> Measure:
    known: dict[str, Measure] = {
        "velocity": measures.mean_velocity_mps,
        "flight_time": measures.flight_time_s,
        "energy": lambda result: measures.energy_j(result, plan),
    }
    return known[name]


def _success(flights: Flights) -> dict[str, Any]:
    success = flights.success
    return {
        "missions": success.total,
        "outcomes": dict(flights.outcomes),
        "success_percent": 100.0 * success.share,
        "success_low_percent": 100.0 * success.low,
        "success_high_percent": 100.0 * success.high,
    }


def _numbers(row: Mapping[str, Any], plan: FlightPlan, flights: Flights) -> dict[str, Any]:
    """Absolute numbers of the successful flights; the model's are for the same missions."""
    velocity: float = row["velocity_mps"]
    power_w: float = row["power_w"]

    def model_time_s(result: Mapping[str, Any]) -> float:
        """The straight way of a mission at the model's velocity, s."""
        return measures.straight_m(result) / velocity

    time_s = flights.mean(model_time_s).value
    return {
        **_beside("velocity", "_mps", velocity, flights.mean(measures.mean_velocity_mps)),
        **_beside("top_velocity", "_mps", velocity, flights.mean(measures.top_velocity_mps)),
        **_beside("flight_time", "_s", time_s, flights.mean(measures.flight_time_s)),
        **_beside("path", "_ratio", 1.0, flights.mean(measures.path_ratio)),
        **_beside("energy", "_j", power_w * time_s,
                  flights.mean(_measure("energy", plan))),
        **_beside("response", "_s", 1.0 / row["throughput_hz"], flights.mean(measures.response_s)),
        "flight_shaft_energy_j": flights.mean(measures.shaft_energy_j).value,
        "flight_hover_shaft_w": flights.mean(measures.hover_shaft_w).value,
        "flight_replans": flights.mean(measures.replans).value,
        "flight_alarms": flights.mean(measures.alarms).value,
    }  # fmt: skip


def _beside(name: str, unit: str, model: float, flight: Estimate) -> dict[str, float]:
    """The model's number, the flights' with its interval, and by how much they differ."""
    of = "_ratio" if unit == "_ratio" else ""
    return {
        f"model_{name}{unit}": model,
        f"flight_{name}{unit}": flight.value,
        f"flight_{name}_low{unit}": flight.low,
        f"flight_{name}_high{unit}": flight.high,
        f"{name}{of}_difference_percent": 100.0 * (flight.value / model - 1.0),
    }
