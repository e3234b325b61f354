"""Comparison of model and flights as text and as CSV; every number with its unit."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from mavfi_cli.mission.record.detection_cost import HOST_CHECKS
from mavfi_cli.report.tables.columns import columns, csv_text, wrapped

MANY_ALARMS = 10.0  # alarms of an error-free flight; more is not the detector's usual rate
_NUMBERS = (
    # heading, name, unit in the key, unit as printed, factor, digits
    ("Mean velocity against the model's safe velocity", "velocity", "_mps", "m/s", 1.0, 2),
    ("Top velocity against it", "top_velocity", "_mps", "m/s", 1.0, 2),
    ("Flight time", "flight_time", "_s", "s", 1.0, 1),
    ("Energy of rotors and boards", "energy", "_j", "kJ", 1.0e-3, 2),
    ("Response time, median", "response", "_s", "s", 1.0, 3),
)
_HEAD = ["scheme", "model", "flight", "", "flight against model"]
_RATIOS = (("velocity", "Velocity"), ("flight_time", "Flight time"), ("energy", "Energy"))


def redundancy_lines(flights: Mapping[str, Any]) -> list[str]:
    """The lines that are printed below the model's."""
    lines = [
        "",
        f"Flights in {', '.join(flights['worlds'])}: {flights['missions_each']} missions a scheme "
        f"and world, seeds from {flights['first_seed']}, stack {flights['stack']}",
        "Numbers are of successful flights, (low to high) are 95 % intervals over missions",
        f"Detectors: {flights['detectors']}",
    ]
    for one in flights["vehicles"]:
        lines += ["", *_vehicle(one, flights)]
    lines += ["", *_overheads(flights["overheads"]), "", "What the flights do not scale:"]
    return [*lines, *wrapped(["", text] for text in flights["not_scaled"])]


def redundancy_csv(flights: Mapping[str, Any]) -> str:
    """CSV text, one row per vehicle and scheme; the header names the units."""
    rows = [
        {
            "vehicle": one["vehicle"],
            "board": one["board"],
            **{
                key: "; ".join(value) if isinstance(value, list) else value
                for key, value in row.items()
                if key != "outcomes"
            },
        }
        for one in flights["vehicles"]
        for row in one["schemes"]
    ]
    return csv_text(rows)


def _vehicle(one: Mapping[str, Any], flights: Mapping[str, Any]) -> Iterator[str]:
    yield f"== {one['vehicle']} flown, board {one['board']} =="
    rows = [row for row in one["schemes"] if row["problem"] is None]
    yield from columns([
        ["scheme", "mass", "v-max", "a-max", "safe, braking", "success", "ends"],
        *([row["scheme"], f"{row['mass_kg']:.3f} kg", f"{row['v_max_mps']:.3f} m/s",
           f"{row['a_max_mps2']:.2f} m/s²", f"{row['braking_velocity_mps']:.3f} m/s",
           _success(row), ", ".join(f"{count} {name}" for name, count in row["outcomes"].items())]
          for row in rows),
    ])  # fmt: skip
    for heading, name, key, unit, factor, digits in _NUMBERS:
        yield ""
        yield f"{heading}:"
        told = (_number(row, name, key, unit, factor, digits) for row in rows)
        yield from columns([_HEAD, *told])
    yield ""
    yield "Why flights take longer than the model says:"
    yield from columns([["scheme", "path", "pace", "replans", "alarms"], *(_why(r) for r in rows)])
    over, paper = flights["ratios_over"], flights["paper_ratios_over"]
    for name, title, suffix in (
        *((name, f"{title} over {over}", "") for name, title in _RATIOS),
        ("flight_time", f"Flight time over {paper}, as the paper's Fig. 15", f"_over_{paper}"),
    ):
        yield ""
        yield f"{title}:"
        told = (_ratio(row, name, suffix) for row in rows if f"pairs{suffix}" in row)
        yield from columns([_HEAD, *told])
    for row in one["schemes"]:
        yield from _remarks(row)


def _success(row: Mapping[str, Any]) -> str:
    return (
        f"{row['success_percent']:.0f} % ({row['success_low_percent']:.0f} to "
        f"{row['success_high_percent']:.0f} %)"
    )


def _number(
    row: Mapping[str, Any], name: str, key: str, unit: str, factor: float, digits: int
) -> list[str]:
    model, flight, low, high = (
        factor * row[f"{which}{key}"]
        for which in (f"model_{name}", f"flight_{name}", f"flight_{name}_low",
                      f"flight_{name}_high")
    )  # fmt: skip
    return [
        row["scheme"],
        _known(f"{model:.{digits}f} {unit}", model),
        _known(f"{flight:.{digits}f} {unit}", flight),
        _known(f"({low:.{digits}f} to {high:.{digits}f} {unit})", low, ""),
        _known(f"{row[f'{name}_difference_percent']:+.1f} %", flight),
    ]


def _why(row: Mapping[str, Any]) -> list[str]:
    pace = row["model_velocity_mps"] / row["flight_velocity_mps"]
    alarms = row["flight_alarms"]
    return [
        row["scheme"],
        _known(f"x {row['flight_path_ratio']:.3f} longer", row["flight_path_ratio"]),
        _known(f"x {pace:.3f} slower", pace),
        _known(f"{row['flight_replans']:.1f} a flight", row["flight_replans"]),
        "no detector" if alarms != alarms else f"{alarms:.1f} a flight",
    ]


def _ratio(row: Mapping[str, Any], name: str, suffix: str) -> list[str]:
    key = f"{name}{suffix}"
    flight, low, high = (row[f"flight_{key}{end}_ratio"] for end in ("", "_low", "_high"))
    ends = _known(f"x {low:.4f} to x {high:.4f}, ", low, "")
    return [
        row["scheme"],
        f"x {row[f'model_{key}_ratio']:.4f}",
        _known(f"x {flight:.4f}", flight),
        f"({ends}{row[f'pairs{suffix}']} pairs)",
        _known(f"{row[f'{key}_ratio_difference_percent']:+.1f} %", flight),
    ]


def _known(text: str, value: float, otherwise: str = "-") -> str:
    """The text of a value, if it has one: without successful flights there is none."""
    return otherwise if math.isnan(value) else text


def _remarks(row: Mapping[str, Any]) -> Iterator[str]:
    if row["problem"] is not None:
        yield f"{row['scheme']}: not flown: {row['problem']}"
        return
    if row["overhead_percent"]:
        yield (
            f"{row['scheme']}: an overhead of {row['overhead_percent']:.4g} % in its flights and "
            "in the model beside them"
        )
    if row["flight_alarms"] >= MANY_ALARMS:
        yield (
            f"{row['scheme']}: {row['flight_alarms']:.0f} alarms in a flight without a fault: its "
            "model was fitted to other flights; --train fits one to these"
        )
    if row["cut"]:
        yield f"{row['scheme']}: flown with {', '.join(row['cut'])}"
    if row["errors"]:
        many = len(row["errors"])
        yield f"{row['scheme']}: {many} could not begin, the first: {row['errors'][0]}"


def _overheads(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    if not rows:
        yield "Overhead of detection and recovery: no flight with a detector"
        return
    yield "Overhead of detection and recovery, of the kernels' time on the flights' platform:"
    yield from columns([
        ["detector", "measured", "of it checks", "paper", "recomputations",
         "checks of this host's kernel time"],
        *([row["detector"], f"{row['measured_percent']:.4g} %", f"{row['checks_percent']:.4g} %",
           f"{row['paper_percent']:.4g} %", f"{row['alarms']} in {row['flights']} flights",
           f"{row['checks_of_host_kernels_percent']:.4g} %"]
          for row in rows),
    ])  # fmt: skip
    yield f"({HOST_CHECKS})"
