"""Compare model and flights: each number of the model, the measured one, and the difference."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from mavfi_cli.analysis.flights import changed, chosen, flags, known, numbers, paired
from mavfi_cli.analysis.overhead import ComputeOverhead
from mavfi_cli.core.types import FloatArray
from mavfi_cli.stats.bootstrap import Interval, interval
from mavfi_cli.stats.shares import rate
from mavfi_cli.studies.flight_plan import NOT_SCALED, FlightPlan
from mavfi_cli.vpm.model import REFERENCE, SCHEMES, named

BASE = "none"  # reference of ratios: one board without protection
MODEL = {"velocity": "velocity_mps", "flight_time": "flight_time_s", "energy": "energy_j"}
PLACE = ("world", "seed")  # columns that identify a mission in all schemes
_BY_PLACE = [(name, "ascending") for name in PLACE]
Key = tuple[str, str]  # vehicle and scheme


@dataclass(frozen=True, slots=True, kw_only=True)
class Beside:
    """The flights of a scheme.

    Attributes:
        plan: plan of its flights, or the reason why it cannot be flown.
        flights: ended flights, as in `analysis.flights`.
        errors: why missions could not be flown.
    """

    plan: FlightPlan | str
    flights: pa.Table | None = None
    errors: Sequence[str] = ()

    def measured(self, name: str, flights: pa.Table) -> FloatArray:
        """A quantity of MODEL for each flight, (n,); NaN if a flight has none.

        Electrical energy of rotors and boards is shaft energy times the model's hover power over
        the simulated vehicle's, which is the same for any number of boards, plus the boards' power
        times the flight time.
        """
        if name == "velocity":
            return numbers(flights, "mean_speed_mps")
        time_s = numbers(flights, "flight_time_s")
        if name == "flight_time":
            return time_s
        assert isinstance(self.plan, FlightPlan)
        shaft_j, hover_w = (numbers(flights, n) for n in ("energy_propeller_j", "hover_shaft_w"))
        return np.asarray(shaft_j * self.plan.rotors_w / hover_w + self.plan.boards_w * time_s)


def side_by_side(
    told: Mapping[str, Any], flown: Mapping[Key, Beside], overheads: Mapping[str, ComputeOverhead]
) -> dict[str, Any]:
    """Unscaled properties, overheads, and one flat row per vehicle and scheme.

    Args:
        told: the model's report, with the overheads of the plans.
        overheads: overheads measured in these flights, by detector.
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
                    {**_scheme(row, flown[one["vehicle"], row["scheme"]]), **_over(one, row, flown)}
                    for row in one["schemes"]
                ],
            }
            for one in told["vehicles"]
        ],
    }


def _overhead(measured: ComputeOverhead) -> dict[str, Any]:
    return {
        "detector": measured.detector,
        "flights": measured.flights,
        "alarms": measured.alarms,
        "measured_percent": 100.0 * measured.share,
        "checks_percent": 100.0 * measured.checks_share,
        "checks_of_host_kernels_percent": 100.0 * measured.checks_host_share,
        "paper_percent": 100.0 * named(SCHEMES, measured.detector).overhead,
    }


def _scheme(row: Mapping[str, Any], beside: Beside) -> dict[str, Any]:
    plan = beside.plan
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
        "errors": list(beside.errors),
        **_success(beside.flights),
        **_numbers(row, beside),
    }


def _over(
    one: Mapping[str, Any], row: Mapping[str, Any], flown: Mapping[Key, Beside]
) -> dict[str, float]:
    """Ratios to one board without protection and, as in the paper, to detection and recovery."""
    rows = {each["scheme"]: each for each in one["schemes"]}
    told: dict[str, float] = {}
    for over, suffix, names in (
        (BASE, "", tuple(MODEL)),
        (REFERENCE, f"_over_{REFERENCE}", ("flight_time",)),
    ):
        sides = [flown[one["vehicle"], name] for name in (over, row["scheme"])]
        if any(isinstance(side.plan, str) for side in sides):
            continue
        pairs = paired(sides[0].flights, sides[1].flights, PLACE)
        both = pa.array(np.logical_and(*(flags(each, "succeeded") for each in pairs)))
        first, second = (pair.filter(both).sort_by([*_BY_PLACE]) for pair in pairs)
        for name in names:
            model = row[MODEL[name]] / rows[over][MODEL[name]]
            before, after = sides[0].measured(name, first), sides[1].measured(name, second)
            found = changed(range(len(before)), before.tolist(), after.tolist())
            told |= _beside(f"{name}{suffix}", "_ratio", model, found)
            told[f"pairs{suffix}"] = found.count
    return told


def _success(flights: pa.Table) -> dict[str, Any]:
    success = rate(int(flags(flights, "succeeded").sum()), flights.num_rows)
    return {
        "missions": success.total,
        "outcomes": dict(Counter(flights["outcome"].to_pylist()).most_common()),
        "success_percent": 100.0 * success.share,
        "success_low_percent": 100.0 * success.low,
        "success_high_percent": 100.0 * success.high,
    }


def _numbers(row: Mapping[str, Any], beside: Beside) -> dict[str, Any]:
    """Absolute numbers of the successful flights, and the model's for the same missions."""
    won = chosen(beside.flights, succeeded=True)
    straight_m = numbers(won, "straight_m")
    model_s = _mean(
        straight_m / row["velocity_mps"]
    ).value  # the straight distance at the model's velocity
    energy_j, top = beside.measured("energy", won), _mean(numbers(won, "max_speed_mps"))
    path = _mean(numbers(won, "distance_m") / straight_m)
    return {
        **_beside("velocity", "_mps", row["velocity_mps"], _mean(numbers(won, "mean_speed_mps"))),
        **_beside("top_velocity", "_mps", row["velocity_mps"], top),
        **_beside("flight_time", "_s", model_s, _mean(numbers(won, "flight_time_s"))),
        **_beside("path", "_ratio", 1.0, path),
        **_beside("energy", "_j", row["power_w"] * model_s, _mean(energy_j)),
        **_beside("response", "_s", 1.0 / row["throughput_hz"],
                  _mean(numbers(won, "response_median_s"))),
        "flight_shaft_energy_j": _mean(numbers(won, "energy_propeller_j")).value,
        "flight_hover_shaft_w": _mean(numbers(won, "hover_shaft_w")).value,
        "flight_replans": _mean(numbers(won, "replans")).value,
        "flight_alarms": _mean(numbers(won, "alarm_count")).value,
    }  # fmt: skip


def _mean(values: FloatArray) -> Interval:
    return interval(known(values))


def _beside(name: str, unit: str, model: float, flight: Interval) -> dict[str, float]:
    """The model's number, the flights' number with its interval, and the difference."""
    of = "_ratio" if unit == "_ratio" else ""
    return {
        f"model_{name}{unit}": model,
        f"flight_{name}{unit}": flight.value,
        f"flight_{name}_low{unit}": flight.low,
        f"flight_{name}_high{unit}": flight.high,
        f"{name}{of}_difference_percent": 100.0 * (flight.value / model - 1.0),
    }
