"""The numbers of the performance model beside those of its flights."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from mavfi_cli.analysis.flights import changed, chosen, errors, flags, flown, known, numbers
from mavfi_cli.analysis.overhead import ComputeOverhead
from mavfi_cli.analysis.pairs import paired
from mavfi_cli.companion.pipeline import BRAKE_SHARE
from mavfi_cli.core.types import FloatArray
from mavfi_cli.stats.bootstrap import interval
from mavfi_cli.stats.shares import Interval, rate
from mavfi_cli.vpm.model import (
    REFERENCE,
    SCHEMES,
)

BASE = "none"  # reference of ratios: one board without protection
MODEL = {"velocity": "velocity_mps", "flight_time": "flight_time_s", "energy": "energy_j"}
PLACE = ("world", "seed")  # columns that identify a mission in all schemes
_BY_PLACE = [(name, "ascending") for name in PLACE]
Key = tuple[str, str]  # vehicle and scheme
# Parts of the model that the simulation omits; printed with every report of flights.
NOT_SCALED = (
    "size, propellers and drag are those of the simulated vehicle; boards weigh, but have no "
    "size: inertia and drag do not grow with them",
    "the model's acceleration is pull / mass - g; here it is the companion's limit, of which "
    f"planning uses {100.0 * BRAKE_SHARE:g} % to speed up and to brake",
    "the simulated companion plans with 90 % of the safe velocity, flies round obstacles, stops to "
    "plan, and speeds up and slows down; the model flies straight at one velocity",
    "flights begin at take-off height and end within the goal's tolerance; climbing there is not "
    "counted, as in the model; a turn before departure, where the stack has one, is counted",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightSetup:
    """What a vehicle flies with under a scheme, as far as its flights are compared with the model.

    Attributes:
        braking_velocity_mps: safe velocity with the deceleration that the companion assumes.
        rotors_w: electrical hover power with all boards.
        boards_w: power of all boards.
        cut: values of the model that exceed the limits of a mission, in words.
    """

    v_max_mps: float
    a_max_mps2: float
    braking_velocity_mps: float
    rotors_w: float
    boards_w: float
    cut: tuple[str, ...] = ()

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
        shaft_j, hover_w = (numbers(flights, n) for n in ("energy_propeller_j", "hover_shaft_w"))
        return np.asarray(shaft_j * self.rotors_w / hover_w + self.boards_w * time_s)


# Beside the model ------------------------------------------------------------------------------


def _arm(table: pa.Table, key: Key) -> pa.Table:
    """The flights of a vehicle with a scheme."""
    return chosen(table, label_group=key[0], label_arm=key[1])


def side_by_side(
    told: Mapping[str, Any],
    plans: Mapping[Key, FlightSetup | str],
    flights: pa.Table,
    overheads: Mapping[str, ComputeOverhead],
) -> dict[str, Any]:
    """Unscaled properties, overheads, and one flat row per vehicle and scheme.

    Args:
        told: the model's report, with the overheads of the plans.
        plans: of each vehicle and scheme, or the reason why they cannot be flown.
        flights: of the missions of `RedundancyPlan.list_of`, as in `analysis.flights`.
        overheads: overheads measured in these flights, by detector.
    """
    return {
        "ratios_over": BASE,
        "paper_ratios_over": REFERENCE,
        "not_scaled": list(NOT_SCALED),
        "overheads": [
            {
                "detector": each.detector,
                "flights": each.flights,
                "alarms": each.alarms,
                "measured_percent": 100.0 * each.share,
                "checks_percent": 100.0 * each.checks_share,
                "checks_of_host_kernels_percent": 100.0 * each.checks_host_share,
                "paper_percent": 100.0 * SCHEMES[each.detector].overhead,
            }
            for each in overheads.values()
        ],
        "vehicles": [
            {
                "vehicle": one["vehicle"],
                "board": one["board"],
                "schemes": [
                    _scheme(row, plans[one["vehicle"], row["scheme"]], flights, one["vehicle"])
                    | _over(one, row, plans, flights)
                    for row in one["schemes"]
                ],
            }
            for one in told["vehicles"]
        ],
    }


def _scheme(
    row: Mapping[str, Any], plan: FlightSetup | str, flights: pa.Table, vehicle: str
) -> dict[str, Any]:
    told: dict[str, Any] = {
        "scheme": row["scheme"], "title": row["title"], "boards": row["boards"],
        "overhead_percent": row["overhead_percent"], "mass_kg": row["mass_kg"], "problem": None,
        "errors": [], "cut": [],
    }  # fmt: skip
    if isinstance(plan, str):
        return {**told, "problem": plan}
    mine = _arm(flights, (vehicle, row["scheme"]))
    return {
        **told,
        "v_max_mps": plan.v_max_mps,
        "a_max_mps2": plan.a_max_mps2,
        "braking_velocity_mps": plan.braking_velocity_mps,
        "cut": list(plan.cut),
        "errors": errors(mine, "{reason}"),
        **_success(flown(mine)),
        **_numbers(row, plan, flown(mine)),
    }


def _over(
    one: Mapping[str, Any],
    row: Mapping[str, Any],
    plans: Mapping[Key, FlightSetup | str],
    flights: pa.Table,
) -> dict[str, float]:
    """Ratios to one board without protection and, as in the paper, to detection and recovery."""
    rows = {each["scheme"]: each for each in one["schemes"]}
    told: dict[str, float] = {}
    for over, suffix, names in (
        (BASE, "", tuple(MODEL)),
        (REFERENCE, f"_over_{REFERENCE}", ("flight_time",)),
    ):
        keys = [(one["vehicle"], name) for name in (over, row["scheme"])]
        base, own = (plans[key] for key in keys)
        if isinstance(base, str) or isinstance(own, str):
            continue
        sides = [flown(_arm(flights, key)) for key in keys]
        pairs = paired(sides[1], sides[0], PLACE)[::-1]
        both = pa.array(np.logical_and(*(flags(each, "succeeded") for each in pairs)))
        first, second = (pair.filter(both).sort_by([*_BY_PLACE]) for pair in pairs)
        for name in names:
            model = row[MODEL[name]] / rows[over][MODEL[name]]
            before, after = base.measured(name, first), own.measured(name, second)
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


def _numbers(row: Mapping[str, Any], plan: FlightSetup, flights: pa.Table) -> dict[str, Any]:
    """Absolute numbers of the successful flights, and the model's for the same missions."""
    won = chosen(flights, succeeded=True)
    straight_m = numbers(won, "straight_m")
    # The straight distance at the model's velocity.
    model_s = _mean(straight_m / row["velocity_mps"]).value
    energy_j, top = plan.measured("energy", won), _mean(numbers(won, "max_speed_mps"))
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
