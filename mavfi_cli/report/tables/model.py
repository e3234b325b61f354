"""The performance model as text and as CSV; every number with its unit."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from mavfi_cli.report.tables.columns import columns, csv_text, wrapped
from mavfi_cli.vpm.report import RATIOS


def model_lines(told: Mapping[str, Any]) -> list[str]:
    """The lines that are printed."""
    lines = [
        f"Model {told['model']}; knee: where velocity is "
        f"{100 * told['knee_velocity_over_roof_ratio']:g} % of the roof",
        f"Flights of {told['distance_m']:g} m at the safe velocity and hovering power; ratios "
        f"are over {told['ratios_over']}",
    ]
    lines += [f"Note: {note}" for note in told["notes"]]
    for one in told["vehicles"]:
        lines += ["", *_vehicle(one, told["ratios_over"])]
    return lines


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
