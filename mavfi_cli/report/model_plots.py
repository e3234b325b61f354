"""Plots of the performance model: rooflines, the cost of redundancy, model against flight."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from mavfi_cli.report.drawing import INK, NOTE, SCHEMES, new_figure, open_frame

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Roofline: safe velocity against action throughput -----------------------------------------------

_OF_COPIES = {1: "none", 2: "dmr", 3: "tmr"}
_MOST_HZ = 1000.0
_LABELS = {1: "one board", 2: "two boards (DMR)", 3: "three boards (TMR)"}


def draw_roofline_plot(report: Mapping[str, Any]) -> Figure:
    """Draw a figure with throughput in Hz and velocity in m/s on logarithmic axes."""
    vehicles = report["vehicles"]
    figure = new_figure(max(6.4, 4.9 * len(vehicles)), 4.9)
    panels = figure.subplots(1, len(vehicles), squeeze=False, sharey=True)[0]
    for axes, one in zip(panels, vehicles, strict=True):
        _roofline_panel(axes, one, report["knee_velocity_over_roof_ratio"])
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


def _roofline_panel(axes: Axes, one: Mapping[str, Any], share: float) -> None:
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
    _log_axes(axes, one)


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


def _log_axes(axes: Axes, one: Mapping[str, Any]) -> None:
    from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlim(one["curves"]["throughput_hz"][0], _MOST_HZ)
    axes.xaxis.set_major_formatter(FormatStrFormatter("%g"))
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(FormatStrFormatter("%g"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.grid(color="#e6e9ee", linewidth=0.6)
    open_frame(axes)
    tmr = next((row for row in one["schemes"] if row["boards"] == 3), None)
    heavy = "; TMR cannot be lifted" if tmr is not None and tmr["problem"] else ""
    bound = next(row["bound"] for row in one["schemes"] if row["boards"] == 1)
    axes.set_title(
        f"{one['vehicle']}, board {one['board']}: {bound} bound{heavy}", fontsize=9.5, color=INK
    )


# Cost of redundancy: flight time and energy over detection and recovery ---------------------------

_QUANTITIES = (("flight_time_ratio", "flight time"), ("energy_ratio", "energy"))
_COST_WIDTH = 0.15


def draw_redundancy_plot(report: Mapping[str, Any]) -> Figure:
    """Draw a figure with a panel per vehicle, a bar per scheme and ratios to the reference."""
    vehicles = report["vehicles"]
    figure = new_figure(max(6.8, 4.6 * len(vehicles)), 4.2)
    panels = figure.subplots(1, len(vehicles), squeeze=False)[0]
    for axes, one in zip(panels, vehicles, strict=True):
        _cost_panel(axes, one)
    panels[0].set_ylabel("times that with detection (autoencoder)")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside upper center", ncols=len(labels), frameon=False, fontsize=8
    )
    figure.supxlabel(_cost_caption(report), fontsize=7.5, color=NOTE)
    return figure


def _cost_panel(axes: Axes, one: Mapping[str, Any]) -> None:
    rows = one["schemes"]
    highest = max(row[key] or 0.0 for row in rows for key, _ in _QUANTITIES)
    for number, row in enumerate(rows):
        places = [k + (number - (len(rows) - 1) / 2) * _COST_WIDTH for k in range(len(_QUANTITIES))]
        heights = [row[key] for key, _ in _QUANTITIES]
        axes.bar(
            places, [height or 0.0 for height in heights], width=0.92 * _COST_WIDTH,
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
    open_frame(axes)
    axes.set_title(f"{one['vehicle']}, board {one['board']}", fontsize=9.5, color=INK)


def _cost_caption(report: Mapping[str, Any]) -> str:
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


# Model against flight: velocity, flight time and energy of every scheme ---------------------------

_FLOWN_RATIOS = (("velocity", "velocity"), ("flight_time", "flight time"), ("energy", "energy"))
_STEP = 0.17


def draw_flight_plot(report: Mapping[str, Any]) -> Figure:
    """Draw a figure with a row per vehicle: velocities left, ratios to the reference right.

    A diamond marks the model. A bar shows the flights with their 95 % interval over missions.
    """
    flights = report["flights"]
    vehicles = flights["vehicles"]
    figure = new_figure(9.6, 1.0 + 3.1 * len(vehicles))
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
    open_frame(axes)
    axes.set_title(f"{one['vehicle']}, board {one['board']}", fontsize=9.5, color=INK)


def _success(row: Mapping[str, Any]) -> str:
    return f"{row['success_percent']:.0f} % of {row['missions']} succeed"


def _ratios(axes: Axes, one: Mapping[str, Any], reference: str) -> None:
    rows = one["schemes"]
    for number, row in enumerate(rows):
        for place, (name, _) in enumerate(_FLOWN_RATIOS):
            at = place + (number - (len(rows) - 1) / 2) * _STEP
            if f"model_{name}_ratio" in row:
                _bar(axes, at, 0.9 * _STEP, row, name, "_ratio")
            else:
                _not_flown(axes, at)
    axes.axhline(1.0, color=INK, linewidth=0.7, linestyle=(0, (5, 3)))
    axes.set_xticks(range(len(_FLOWN_RATIOS)), [title for _, title in _FLOWN_RATIOS])
    axes.set_ylabel(f"times that with {reference}", fontsize=8.5)
    axes.set_ylim(bottom=0.0)
    axes.tick_params(labelsize=8)
    open_frame(axes)
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
