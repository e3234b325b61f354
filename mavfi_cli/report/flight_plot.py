"""Plot of model against flight: velocity, flight time and energy of every scheme."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavfi_cli.report.drawing import INK, NOTE, SCHEMES, write_svg

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_RATIOS = (("velocity", "velocity"), ("flight_time", "flight time"), ("energy", "energy"))
_STEP = 0.17


def write_flight_plot(report: Mapping[str, Any], path: Path) -> None:
    """Write the plot of a report's flights as SVG, atomically. Equal reports give equal bytes."""
    write_svg(draw_flight_plot(report), path)


def draw_flight_plot(report: Mapping[str, Any]) -> Figure:
    """Draw a figure with a row per vehicle: velocities left, ratios to the reference right.

    A diamond marks the model. A bar shows the flights with their 95 % interval over missions.
    """
    from matplotlib.figure import Figure

    flights = report["flights"]
    vehicles = flights["vehicles"]
    figure = Figure(figsize=(9.6, 1.0 + 3.1 * len(vehicles)), layout="constrained")
    panels = figure.subplots(
        len(vehicles), 2, squeeze=False, gridspec_kw={"width_ratios": (1.0, 1.7)}
    )
    for (left, right), one in zip(panels, vehicles, strict=True):
        _velocities(left, one)
        _ratios(right, one, flights["ratios_over"])
    handles = [
        panels[0][0].bar(0, 0, color=SCHEMES[row["scheme"]], label=row["title"])
        for row in vehicles[0]["schemes"]
    ]
    handles += panels[0][0].plot([], [], "D", color="white", markeredgecolor=INK, markersize=5,
                                 label="model")  # fmt: skip
    handles += panels[0][0].plot([], [], "_", color=INK, markersize=9, label="top of a flight")
    figure.legend(handles=handles, loc="outside upper center", ncols=4, frameon=False, fontsize=8)
    figure.supxlabel(
        f"bars: means of successful flights in {', '.join(flights['worlds'])}, "
        f"{flights['missions_each']} missions each; whiskers: 95 % intervals over missions; "
        "ratios: over the same missions",
        fontsize=7.5, color=NOTE,
    )  # fmt: skip
    return figure


def _velocities(axes: Axes, one: Mapping[str, Any]) -> None:
    highest = 0.0
    for place, row in enumerate(one["schemes"]):
        if row["problem"] is not None:
            _not_flown(axes, place)
            continue
        _bar(axes, place, 0.7, row, "velocity", "_mps")
        model, top = row["model_velocity_mps"], row["flight_top_velocity_mps"]
        axes.plot(place, top, "_", color=INK, markersize=12)
        highest = max(highest, model, 0.0 if math.isnan(top) else top)
        axes.annotate(
            _success(row), (place, 0.0), xytext=(0, 3), textcoords="offset points", ha="center",
            va="bottom", fontsize=7, color=INK, rotation=90.0,
        )  # fmt: skip
    axes.set_xticks(range(len(one["schemes"])), [row["scheme"] for row in one["schemes"]])
    axes.set_ylim(0.0, 1.12 * highest or 1.0)
    axes.set_ylabel("mean velocity, m/s", fontsize=8.5)
    axes.tick_params(labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_title(f"{one['vehicle']}, board {one['board']}", fontsize=9.5, color=INK)


def _success(row: Mapping[str, Any]) -> str:
    return f"{row['success_percent']:.0f} % of {row['missions']} succeed"


def _ratios(axes: Axes, one: Mapping[str, Any], reference: str) -> None:
    rows = one["schemes"]
    for number, row in enumerate(rows):
        for place, (name, _) in enumerate(_RATIOS):
            at = place + (number - (len(rows) - 1) / 2) * _STEP
            if f"model_{name}_ratio" in row:
                _bar(axes, at, 0.9 * _STEP, row, name, "_ratio")
            else:
                _not_flown(axes, at)
    axes.axhline(1.0, color=INK, linewidth=0.7, linestyle=(0, (5, 3)))
    axes.set_xticks(range(len(_RATIOS)), [title for _, title in _RATIOS])
    axes.set_ylabel(f"times that with {reference}", fontsize=8.5)
    axes.set_ylim(bottom=0.0)
    axes.tick_params(labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_title(f"{one['vehicle']}: ratios, model and flight", fontsize=9.5, color=INK)


def _bar(
    axes: Axes, place: float, width: float, row: Mapping[str, Any], name: str, unit: str
) -> None:
    flight, low, high = (row[f"flight_{name}{end}{unit}"] for end in ("", "_low", "_high"))
    if not math.isnan(flight):
        axes.bar(place, flight, width=width, color=SCHEMES[row["scheme"]])
        if not (math.isnan(low) or math.isnan(high)):
            axes.errorbar(
                place, flight, yerr=[[max(0.0, flight - low)], [max(0.0, high - flight)]],
                fmt="none", ecolor=NOTE, elinewidth=1.0, capsize=2.0,
            )  # fmt: skip
    axes.plot(
        place, row[f"model_{name}{unit}"], "D", color="white", markeredgecolor=INK, markersize=5
    )


def _not_flown(axes: Axes, place: float) -> None:
    axes.annotate(
        "not flown", (place, 0.0), xytext=(0, 3), textcoords="offset points", ha="center",
        va="bottom", fontsize=7, color=NOTE, rotation=90.0,
    )  # fmt: skip
