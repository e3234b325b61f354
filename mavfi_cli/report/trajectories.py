"""Top views of flights of one mission: golden, with a fault, protected (paper, Fig. 13)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from mavfi_cli.mission.record.measures import FlightRecord
from mavfi_cli.mission.record.run_folder import Run
from mavfi_cli.report.drawing import DETECTORS, INK, new_figure
from mavfi_cli.report.top_view import (
    draw_end,
    draw_marks,
    draw_obstacles,
    draw_places,
    frame,
    path_of,
    place_of,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# In the order of names: golden and faulty flights are blue and orange, as in the paper. Protected
# flights have their detector's colour, which is the paper's green for AAD.
_COLOURS = ("#3a7bd5", "#e8751a", "#b8860b", "#00838f", "#c2185b", "#5d4037")
_WIDEST, _STEP, _LEAST = 5.5, 1.7, 1.2  # line widths in points, so that equal paths stay visible
_COLUMNS = 3
_MARKED = {"fault": (-11.0, 8.0), "alarm": (11.0, -8.0)}  # offset from the position, points
_BESIDE = 11.0  # points between marks at the same position


@dataclass(frozen=True, slots=True, kw_only=True)
class Panel:
    """Superposed flights. Equal names have equal colours in all panels."""

    title: str
    flights: Sequence[tuple[str, Run]]


def draw_trajectories(panels: Sequence[Panel]) -> Figure:
    """Draw a figure with a top view per panel, in metres, east to the right and north up.

    Args:
        panels: At least one panel, each with at least one flight. The first flight without fault
            and detector is the reference for the flight times of the others.
    """
    columns = min(_COLUMNS, len(panels))
    rows = -(-len(panels) // columns)
    most = max(len(panel.flights) for panel in panels)
    figure = new_figure(5.2 * columns, (5.3 + 0.19 * most) * rows)
    figure.get_layout_engine().set(h_pad=0.1, w_pad=0.08)  # type: ignore[union-attr, call-arg]
    colours = _colours(panels)
    grid = figure.subplots(rows, columns, squeeze=False)
    for number, axes in enumerate(grid.flat):
        if number < len(panels):
            _draw_panel(figure, axes, panels[number], number, colours)
        else:
            axes.set_axis_off()
    _explain_marks(figure)
    figure.suptitle(place_of(panels[0].flights[0][1].record), fontsize=11)
    return figure


def _colours(panels: Sequence[Panel]) -> dict[str, str]:
    """Return a colour per name: its detector's if still unused, else the next free one."""
    colours: dict[str, str] = {}
    turn = itertools.cycle(_COLOURS)
    for name, run in (flight for panel in panels for flight in panel.flights):
        if name not in colours:
            detector = run.record.detection.get("detector")
            own = DETECTORS.get(detector) if detector else None
            colours[name] = own if own and own not in colours.values() else next(turn)
    return colours


def lines(panels: Sequence[Panel]) -> list[str]:
    """Describe the picture: world and seed, and outcome, time and folder of every flight."""
    text = [place_of(panels[0].flights[0][1].record)]
    for panel in panels:
        text += [f"fault: {panel.title}"] if panel.title else []
        golden_s = _golden_s([run for _, run in panel.flights])
        text += [
            f"  {_legend_entry(name, run.record, golden_s)}  {run.folder.path}"
            for name, run in panel.flights
        ]
    return text


def _draw_panel(
    figure: Figure, axes: Axes, panel: Panel, number: int, colours: Mapping[str, str]
) -> None:
    runs = [run for _, run in panel.flights]
    paths = [path_of(run)[0] for run in runs]
    everywhere = np.concatenate(paths)
    first = runs[0].record
    golden_s = _golden_s(runs)
    draw_obstacles(axes, first.world, everywhere)
    handles = []
    for place, ((name, run), positions) in enumerate(zip(panel.flights, paths, strict=True)):
        handles += axes.plot(
            positions[:, 0], positions[:, 1], color=colours[name], zorder=4.0 + 0.01 * place,
            linewidth=max(_LEAST, _WIDEST - _STEP * place), alpha=0.5 if place == 0 else 1.0,
            solid_capstyle="round", solid_joinstyle="round", gid=f"flight-{number}-{place}",
            label=_legend_entry(name, run.record, golden_s),
        )  # fmt: skip
        draw_end(axes, run.record, positions, colours[name])
    draw_places(axes, first, paths[0])
    _draw_marks(figure, axes, panel, colours)
    frame(axes, first.world, everywhere)
    if panel.title:
        axes.set_title(f"fault: {panel.title}", fontsize=9.5, loc="left")
    axes.legend(
        handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.1), frameon=False, fontsize=8
    )
    for handle in handles:
        handle.set_label(None)  # the remaining labels are the same in all panels


def _draw_marks(figure: Figure, axes: Axes, panel: Panel, colours: Mapping[str, str]) -> None:
    """Mark faults and alarms beside the path in the colours of their flights."""
    from matplotlib.transforms import offset_copy

    for kind, (right, up) in _MARKED.items():
        for name, run in panel.flights:
            beside = offset_copy(axes.transData, figure, right, up, units="points")
            places = draw_marks(
                axes, run.record.events, kind, facecolors=colours[name], edgecolors=INK,
                linewidths=0.6, transform=beside,
            )  # fmt: skip
            for place in places:
                axes.annotate(
                    "", place, (right, up), textcoords="offset points", zorder=5.8,
                    arrowprops={"arrowstyle": "-", "color": INK, "linewidth": 0.6},
                )  # fmt: skip
            right += math.copysign(_BESIDE, right) if len(places) else 0.0


def _explain_marks(figure: Figure) -> None:
    """Draw one legend for all marks."""
    marks: dict[str, Any] = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            marks.setdefault(label.replace("_", " "), handle)
    legend = figure.legend(
        handles=list(marks.values()), labels=list(marks), loc="outside lower center", ncols=8,
        frameon=False, fontsize=8, handletextpad=0.3, columnspacing=0.9,
    )  # fmt: skip
    for shown, label in zip(legend.legend_handles, marks, strict=True):
        if label in _MARKED and shown is not None:  # the legend entry covers all colours
            shown.set(facecolor="white", edgecolor=INK)


def _golden_s(runs: Sequence[Run]) -> float | None:
    """Return the flight time of the golden flight if it succeeded, else None."""
    for run in runs:
        if (flight := run.record).golden:
            time_s: float | None = flight.quality_of_flight["flight_time_s"]
            return time_s if flight.succeeded else None
    return None


def _legend_entry(name: str, flight: FlightRecord, golden_s: float | None) -> str:
    """Return the legend entry of a flight: setting, outcome and flight time."""
    time_s = flight.quality_of_flight["flight_time_s"]
    entry = f"{name}: {flight.outcome.replace('_', ' ')}"
    if time_s is None:
        return entry
    entry += f", {time_s:.1f} s"
    if flight.golden or golden_s is None or not flight.succeeded:
        return entry
    return f"{entry} ({100.0 * (time_s / golden_s - 1.0):+.1f} %)"
