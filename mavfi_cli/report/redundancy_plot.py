"""Plot of the cost of redundancy: flight time and energy over detection and recovery."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavfi_cli.report.drawing import INK, NOTE, SCHEMES, write_svg

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_QUANTITIES = (("flight_time_ratio", "flight time"), ("energy_ratio", "energy"))
_WIDTH = 0.15


def write_redundancy_plot(report: Mapping[str, Any], path: Path) -> None:
    """Write the plot of a model report as SVG, atomically. Equal reports give equal bytes."""
    write_svg(draw_redundancy_plot(report), path)


def draw_redundancy_plot(report: Mapping[str, Any]) -> Figure:
    """Draw a figure with a panel per vehicle, a bar per scheme and ratios to the reference."""
    from matplotlib.figure import Figure

    vehicles = report["vehicles"]
    figure = Figure(figsize=(max(6.8, 4.6 * len(vehicles)), 4.2), layout="constrained")
    panels = figure.subplots(1, len(vehicles), squeeze=False)[0]
    for axes, one in zip(panels, vehicles, strict=True):
        _panel(axes, one)
    panels[0].set_ylabel("times that with detection (autoencoder)")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside upper center", ncols=len(labels), frameon=False, fontsize=8
    )
    figure.supxlabel(_caption(report), fontsize=7.5, color=NOTE)
    return figure


def _panel(axes: Axes, one: Mapping[str, Any]) -> None:
    rows = one["schemes"]
    highest = max(row[key] or 0.0 for row in rows for key, _ in _QUANTITIES)
    for number, row in enumerate(rows):
        places = [k + (number - (len(rows) - 1) / 2) * _WIDTH for k in range(len(_QUANTITIES))]
        heights = [row[key] for key, _ in _QUANTITIES]
        axes.bar(
            places, [height or 0.0 for height in heights], width=0.92 * _WIDTH,
            color=SCHEMES[row["scheme"]], label=row["title"],
        )  # fmt: skip
        for place, height in zip(places, heights, strict=True):
            axes.annotate(
                "cannot be lifted" if height is None else f"{height:.2f}", (place, height or 0.0),
                xytext=(0, 2), textcoords="offset points", ha="center", va="bottom", fontsize=7.5,
                color=INK, rotation=90.0 if height is None else 0.0,
            )  # fmt: skip
    axes.axhline(1.0, color=INK, linewidth=0.7, linestyle=(0, (5, 3)))
    axes.set_xticks(range(len(_QUANTITIES)), [title for _, title in _QUANTITIES])
    axes.set_ylim(0.0, 1.12 * highest)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_title(f"{one['vehicle']}, board {one['board']}", fontsize=9.5, color=INK)


def _caption(report: Mapping[str, Any]) -> str:
    """Return the caption, which lists the calibrated numbers and their sources."""
    lines = [f"{report['model']}; flights of {report['distance_m']:g} m at the safe velocity"]
    for one in report["vehicles"]:
        if any(row["calibrated"] for row in one["parameters"]):
            found = one["calibrations"][0]
            lines.append(
                f"{one['vehicle']}: {found['parameter']} = {found['value']:.4g} {found['unit']} is "
                f"calibrated on the paper's TMR flight time x {found['published_tmr_ratio']:g}"
            )
    return "\n".join(lines)
