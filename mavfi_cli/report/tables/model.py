"""The performance model and its flights as text and as CSV; every number with its unit."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from mavfi_cli.mission.record.detection_cost import HOST_CHECKS
from mavfi_cli.report.tables.columns import columns, csv_text, wrapped
from mavfi_cli.vpm.report import RATIOS


def model_lines(told: Mapping[str, Any]) -> list[str]:
    """The lines that are printed: the model's, and below them those of its flights, if any."""
    lines = [
        f"Model {told['model']}; knee: where velocity is "
        f"{100 * told['knee_velocity_over_roof_ratio']:g} % of the roof",
        f"Flights of {told['distance_m']:g} m at the safe velocity and hovering power; ratios "
        f"are over {told['ratios_over']}",
    ]
    lines += [f"Note: {note}" for note in told["notes"]]
    for one in told["vehicles"]:
        lines += ["", *_vehicle(one, told["ratios_over"])]
    return [*lines, *(_flight_lines(told["flights"]) if "flights" in told else [])]


def model_csv(told: Mapping[str, Any]) -> str:
    """CSV text, one row per vehicle and scheme; the header names the units."""
    return csv_text(
        {"vehicle": one["vehicle"], "board": one["board"], "distance_m": told["distance_m"], **row}
        for one in told["vehicles"]
        for row in one["schemes"]
    )


def _vehicle(one: Mapping[str, Any], over: str) -> Iterator[str]:
    title = f": {one['description']}" if one["description"] else ""
    yield f"== {one['vehicle']}{title}; board {one['board']} =="
    yield from (f"Note: {note}" for note in one["notes"])
    flying = [row for row in one["schemes"] if row["problem"] is None]
    yield from columns([
        ["scheme", "boards", "compute", "mass", "thrust/weight", "acceleration", "roof", "knee"],
        *([row["scheme"], f"{row['boards']}", f"{row['compute_kg']:.3f} kg",
           f"{row['mass_kg']:.3f} kg", f"{row['thrust_to_weight']:.2f} N/N",
           f"{row['acceleration_mps2']:.2f} m/s²", f"{row['roof_mps']:.2f} m/s",
           f"{row['knee_hz']:.1f} Hz"]
          for row in flying),
    ])  # fmt: skip
    yield ""
    yield from columns([
        ["scheme", "overhead", "throughput", "velocity", "bound by", "sensor ceiling",
         "compute ceiling"],
        *([row["scheme"], f"{row['overhead_percent']:.4g} %", f"{row['throughput_hz']:.3f} Hz",
           f"{row['velocity_mps']:.3f} m/s", row["bound"], f"{row['sensor_ceiling_mps']:.2f} m/s",
           f"{row['compute_ceiling_mps']:.2f} m/s"]
          for row in flying),
    ])  # fmt: skip
    yield ""
    yield from columns([
        [f"over {over}", "velocity", "time", "energy", "missions", "flight time", "power",
         "energy", "a charge"],
        *([row["scheme"], *(f"x {row[name]:.4f}" for name in RATIOS),
           f"{row['flight_time_s']:.1f} s", f"{row['power_w']:.1f} W",
           f"{row['energy_j'] / 1000:.2f} kJ", f"{row['missions']:.1f} missions"]
          for row in flying),
    ])  # fmt: skip
    for row in one["schemes"]:
        if row["problem"] is not None:
            yield f"{row['scheme']}: {row['problem']}"
    yield from _sensitivity(one["sensitivity"])
    yield from _calibrations(one["calibrations"])
    yield from _sources(one)


def _sensitivity(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    yield ""
    yield "Sensitivity: velocity with detection and recovery; flight time with TMR over it"
    for row in rows:
        slopes = [row["velocity_elasticity_ratio"], row["tmr_time_elasticity_ratio"]]
        told = ["-" if slope is None else f"{slope:+.3f} %" for slope in slopes]
        yield (
            f"  {row['parameter']} {row['value']:.4g} {row['unit']}; 1 % more: velocity {told[0]}, "
            f"TMR's time ratio {told[1]}"
        )
        yield from columns(_point(point, row["unit"]) for point in row["points"])


def _point(point: Mapping[str, Any], unit: str) -> list[str]:
    velocity, ratio = point["velocity_mps"], point["tmr_flight_time_ratio"]
    return [
        f"    {point['value']:.4g} {unit}",
        "cannot lift it" if velocity is None else f"{velocity:.3f} m/s",
        "TMR cannot be lifted" if ratio is None else f"x {ratio:.4f}",
    ]


def _calibrations(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    if not rows:
        return
    yield ""
    yield "Paper, Fig. 15, flight time over detection and recovery; one number is calibrated:"
    yield from columns([
        ["  board", "a copy", "calibrated", "TMR", "paper's TMR", "DMR, predicted"],
        *([f"  {row['board']}", f"{1000 * row['board_kg']:.0f} g",
           f"{row['parameter']} = {row['value']:.4g} {row['unit']}", f"x {row['tmr_ratio']:.4f}",
           f"x {row['published_tmr_ratio']:g}", f"x {row['predicted_dmr_ratio']:.4f}"]
          for row in rows),
    ])  # fmt: skip


def _sources(one: Mapping[str, Any]) -> Iterator[str]:
    yield ""
    rows = [["number", "value", "source"]]
    rows += [
        [row["parameter"], f"{row['value']:.5g} {row['unit']}", row["source"]]
        for row in one["parameters"]
    ]
    rows += [
        [f"scheme {row['scheme']}", f"{row['overhead_percent']:.4g} %", row["source"]]
        for row in one["schemes"]
    ]
    yield from wrapped(rows)


# Beside flights -----------------------------------------------------------------------------------

_MANY_ALARMS = 10.0  # alarms of an error-free flight; more is not the detector's usual rate
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


def _flight_lines(flights: Mapping[str, Any]) -> list[str]:
    lines = [
        "",
        f"Flights in {', '.join(flights['worlds'])}: {flights['missions_each']} missions a scheme "
        f"and world, seeds from {flights['first_seed']}, stack {flights['stack']}",
        "Numbers are of successful flights, (low to high) are 95 % intervals over missions",
        f"Detectors: {flights['detectors']}",
    ]
    for one in flights["vehicles"]:
        lines += ["", *_flown(one, flights)]
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


def _flown(one: Mapping[str, Any], flights: Mapping[str, Any]) -> Iterator[str]:
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
        told = (_beside(row, name, key, unit, factor, digits) for row in rows)
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


def _beside(
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
    if row["flight_alarms"] >= _MANY_ALARMS:
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
