"""Roofline plot of the performance model: safe velocity against action throughput."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavfi_cli.report.drawing import INK, NOTE, SCHEMES, write_svg

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_OF_COPIES = {1: "none", 2: "dmr", 3: "tmr"}
_MOST_HZ = 1000.0
_LABELS = {1: "one board", 2: "two boards (DMR)", 3: "three boards (TMR)"}


def write_roofline_plot(report: Mapping[str, Any], path: Path) -> None:
    """Write the plot of a model report as SVG, atomically. Equal reports give equal bytes."""
    write_svg(_draw_roofline_plot(report), path)


def _draw_roofline_plot(report: Mapping[str, Any]) -> Figure:
    """Draw a figure with throughput in Hz and velocity in m/s on logarithmic axes."""
    from matplotlib.figure import Figure

    vehicles = report["vehicles"]
    figure = Figure(figsize=(max(6.4, 4.9 * len(vehicles)), 4.9), layout="constrained")
    panels = figure.subplots(1, len(vehicles), squeeze=False, sharey=True)[0]
    for axes, one in zip(panels, vehicles, strict=True):
        _panel(axes, one, report["knee_velocity_over_roof_ratio"])
    panels[0].set_ylabel("safe velocity, m/s")
    panels[0].set_ylim(top=1.25 * max(row["roof_mps"] or 0.0 for one in vehicles
                                      for row in one["schemes"]))  # fmt: skip
    handles: dict[str, Any] = {}
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    figure.legend(
        handles.values(), handles, loc="outside upper center", ncols=4, frameon=False, fontsize=8
    )
    share = 100.0 * report["knee_velocity_over_roof_ratio"]
    figure.supxlabel(
        f"action throughput, Hz\n{report['model']}; knee: {share:g} % of the roof", fontsize=9
    )
    return figure


def _panel(axes: Axes, one: Mapping[str, Any], share: float) -> None:
    flying = {row["boards"]: row for row in reversed(one["schemes"]) if row["problem"] is None}
    for copies in sorted(flying):
        row, colour = flying[copies], SCHEMES[_OF_COPIES[copies]]
        curve = one["curves"]["velocity_mps"][str(copies)]
        axes.plot(
            one["curves"]["throughput_hz"], curve, color=colour, linewidth=1.8,
            label=_LABELS[copies],
        )  # fmt: skip
        axes.axhline(row["roof_mps"], color=colour, linewidth=0.8, linestyle=(0, (5, 3)))
        axes.plot(
            row["knee_hz"], share * row["roof_mps"], marker="D", markersize=5,
            color=colour, markeredgecolor=INK, linestyle="none", markeredgewidth=0.6,
        )  # fmt: skip
        axes.plot(
            row["throughput_hz"], row["velocity_mps"], marker="o", markersize=7, color=colour,
            markeredgecolor=INK, linestyle="none",
        )  # fmt: skip
    axes.plot([], [], "D", color="white", markeredgecolor=INK, markersize=5, label="knee")
    axes.plot([], [], "o", color="white", markeredgecolor=INK, markersize=7, label="flies here")
    axes.plot([], [], color=NOTE, linewidth=0.8, linestyle=(0, (5, 3)), label="roof")
    axes.plot([], [], color=INK, linewidth=1.0, linestyle=":", label="ceiling of one board")
    _ceilings(axes, one, flying[1])
    _axes(axes, one)


def _ceilings(axes: Axes, one: Mapping[str, Any], row: Mapping[str, Any]) -> None:
    """Draw the ceilings that the rates of sensor and computer set for one board."""
    sensor_hz = next(p["value"] for p in one["parameters"] if p["parameter"] == "sensor_hz")
    label = [f"one board\nroof {row['roof_mps']:.2f} m/s, knee {row['knee_hz']:.1f} Hz"]
    for name, at_hz, ceiling in (
        ("sensor", sensor_hz, row["sensor_ceiling_mps"]),
        ("compute", row["compute_hz"], row["compute_ceiling_mps"]),
    ):
        if at_hz < row["knee_hz"]:
            axes.hlines(ceiling, at_hz, _MOST_HZ, color=INK, linewidth=1.0, linestyle=":")
            label.append(f"{name} ceiling {ceiling:.2f} m/s at {at_hz:.3g} Hz")
    axes.text(
        0.98, 0.04, "\n".join(label), transform=axes.transAxes, ha="right", va="bottom",
        fontsize=8, color=NOTE,
    )  # fmt: skip


def _axes(axes: Axes, one: Mapping[str, Any]) -> None:
    from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlim(one["curves"]["throughput_hz"][0], _MOST_HZ)
    axes.xaxis.set_major_formatter(FormatStrFormatter("%g"))
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(FormatStrFormatter("%g"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.grid(color="#e6e9ee", linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    tmr = next((row for row in one["schemes"] if row["boards"] == 3), None)
    heavy = "; TMR cannot be lifted" if tmr is not None and tmr["problem"] else ""
    bound = next(row["bound"] for row in one["schemes"] if row["boards"] == 1)
    axes.set_title(
        f"{one['vehicle']}, board {one['board']}: {bound} bound{heavy}", fontsize=9.5, color=INK
    )
