"""Top views: of one flight, and of all flights of one mission (paper, Fig. 13)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from mavfi_cli.mission.record.measures import FlightRecord
from mavfi_cli.mission.record.run_folder import Run
from mavfi_cli.report.drawing import DETECTORS, INK, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_OBSTACLE = "#c9ced6"
_OBSTACLE_EDGE = "#8b93a1"
_LOW = "#e3ead9"  # boxes that end below the flight, such as hedges
_PLAN = "#7a8699"
_GOOD = "#1b7f4b"
_BAD = "#c22f2f"
_MARKS: dict[str, dict[str, Any]] = {
    "replan": {"marker": "o", "s": 14, "facecolors": "white", "edgecolors": "#222831"},
    "slow": {"marker": "v", "s": 30, "facecolors": "#f2b134", "edgecolors": "#222831"},
    "stop": {"marker": "s", "s": 26, "facecolors": "#e4572e", "edgecolors": "#222831"},
}
_MARKS["fault"] = {"marker": "*", "s": 130, "facecolors": "#c22f2f", "edgecolors": "white"}
_MARKS["alarm"] = {"marker": "D", "s": 34, "facecolors": "#5b8def", "edgecolors": "white"}
_LABELS = {
    "fault": "fault",
    "alarm": "alarm",
    "replan": "new plan",
    "slow": "slows down",
    "stop": "stops",
}
# In the order of names: golden and faulty flights are blue and orange, as in the paper. Protected
# flights have their detector's colour, which is the paper's green for AAD.
_COLOURS = ("#3a7bd5", "#e8751a", "#b8860b", "#00838f", "#c2185b", "#5d4037")
_WIDEST, _STEP, _LEAST = 5.5, 1.7, 1.2  # line widths in points, so that equal paths stay visible
_COLUMNS = 3
_MARKED = {"fault": (-11.0, 8.0), "alarm": (11.0, -8.0)}  # offset from the position, points
_BESIDE = 11.0  # points between marks at the same position


# One flight: obstacles, path coloured by speed, plans and events ------------------------------


def draw_top_view(run: Run) -> Figure:
    """Draw a figure of the run in metres, with east to the right and north up."""
    figure = new_figure(6.4, 6.0)
    figure.get_layout_engine().set(h_pad=0.1, w_pad=0.08)  # type: ignore[union-attr, call-arg]
    axes = figure.add_subplot()
    flight = run.record
    world = flight.world
    positions, speeds = _path_of(run)
    _draw_obstacles(axes, world, positions)
    _draw_plans(axes, flight.plans)
    if len(positions) > 1:
        _draw_path(figure, axes, positions, speeds, flight.config["v_max_mps"])
    _draw_places(axes, flight, positions)
    _draw_end(axes, flight, positions)
    for kind in _MARKS:
        _draw_marks(axes, flight.events, kind)
    _frame(axes, world, positions)
    _caption(figure, axes, flight)
    return figure


def _path_of(run: Run) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (n, 3) m and speeds (n,) m/s of the flight, from the truth if known."""
    trace = run.trace
    if trace is None or trace.num_rows == 0:
        return np.empty((0, 3)), np.empty(0)
    prefix = "truth_" if "truth_x_m" in trace.column_names else ""

    def columns(names: tuple[str, ...]) -> np.ndarray:
        """Return columns of the trace (n, len(names)), from the truth if known."""
        return np.column_stack(
            [trace[f"{prefix}{n}"].to_numpy(zero_copy_only=False) for n in names]
        )

    positions = columns(("x_m", "y_m", "z_m"))
    speeds = np.linalg.norm(columns(("vx_mps", "vy_mps", "vz_mps")), axis=1)
    known = np.isfinite(positions).all(axis=1)
    return positions[known], speeds[known]


def _draw_obstacles(axes: Axes, world: Mapping[str, Any], positions: np.ndarray) -> None:
    """Draw the boxes of a world, pale if they end below the positions (n, 3) m of the flight."""
    from matplotlib.patches import Rectangle

    flight_height_m = float(np.median(positions[:, 2])) if len(positions) else 5.0
    for box in world.get("boxes", []):
        low = box[5] < flight_height_m - 1.0
        axes.add_patch(
            Rectangle(
                (box[0], box[1]), box[3] - box[0], box[4] - box[1], zorder=1, linewidth=0.6,
                facecolor=_LOW if low else _OBSTACLE, edgecolor=_OBSTACLE_EDGE,
            )
        )  # fmt: skip


def _draw_plans(axes: Axes, plans: Sequence[Mapping[str, Any]]) -> None:
    for number, plan in enumerate(plans):
        points = np.array(plan["points_enu_m"], dtype=float)
        if len(points):
            axes.plot(
                points[:, 0], points[:, 1], color=_PLAN, linewidth=0.6, alpha=0.7,
                linestyle=(0, (4, 3)), zorder=2, label="planned" if number == 0 else None,
            )  # fmt: skip


def _draw_path(
    figure: Figure, axes: Axes, positions: np.ndarray, speeds: np.ndarray, v_max: float
) -> None:
    from matplotlib.collections import LineCollection

    step = max(1, len(positions) // 400)
    points, shown = positions[::step, :2], speeds[::step]
    if len(points) < 2:
        return
    segments = np.stack([points[:-1], points[1:]], axis=1)
    lines = LineCollection(
        list(segments), array=shown[1:], cmap="viridis", linewidths=2.2, zorder=4, capstyle="round"
    )
    lines.set_clim(0.0, v_max)
    axes.add_collection(lines)
    bar = figure.colorbar(lines, ax=axes, shrink=0.6, pad=0.02, aspect=28)
    bar.set_label("speed, m/s")
    bar.outline.set_linewidth(0.4)


def _draw_places(axes: Axes, flight: FlightRecord, positions: np.ndarray) -> None:
    """Mark start and goal of a flight with positions (n, 3) m."""
    from matplotlib.patches import Circle

    goal = flight.goal_enu_m or flight.world.get("goal")
    if goal:
        tolerance = flight.config["goal_tolerance_m"]
        axes.add_patch(
            Circle((goal[0], goal[1]), tolerance, fill=False, color=_GOOD, linewidth=1.0, zorder=3)
        )
        axes.scatter([goal[0]], [goal[1]], marker="*", s=120, color=_GOOD, zorder=5, label="goal")
    if len(positions):
        axes.scatter(
            [positions[0, 0]], [positions[0, 1]], marker="^", s=55, color="#222831",
            edgecolors="white", linewidths=0.8, zorder=6.5,  # above the mark of a fault
            label="start",
        )  # fmt: skip


def _draw_end(axes: Axes, flight: FlightRecord, positions: np.ndarray, colour: str = _BAD) -> None:
    """Mark the end of a failed flight with positions (n, 3) m."""
    if len(positions) and not flight.succeeded:
        axes.scatter(
            [positions[-1, 0]], [positions[-1, 1]], marker="X", s=90, color=colour,
            edgecolors="white", linewidths=0.8, zorder=7, label=flight.outcome,
        )  # fmt: skip


def _draw_marks(
    axes: Axes, events: Iterable[dict[str, Any]], kind: str, **style: Any
) -> np.ndarray:
    """Mark events of a kind and return their positions (n, 2) m. `style` overrides the mark."""
    found = [e["position_enu_m"] for e in events if e["kind"] == kind and e["position_enu_m"]]
    places = np.array(found, dtype=float).reshape(-1, 3)[:, :2]
    if found:
        look = {"linewidths": 0.9, "zorder": 6, "label": _LABELS[kind], **_MARKS[kind], **style}
        axes.scatter(places[:, 0], places[:, 1], **look)
    return places


def _frame(axes: Axes, world: Mapping[str, Any], positions: np.ndarray) -> None:
    """Set the limits round world and positions (n, 3) m, equal scales and plain axes."""
    places = [positions[:, :2]] if len(positions) else []
    places += [np.array([world[key][:2]], dtype=float) for key in ("start", "goal") if key in world]
    if places:
        joined = np.concatenate(places)
        low, high = joined.min(axis=0) - 8.0, joined.max(axis=0) + 8.0
        side = max(high - low)
        middle = (low + high) / 2.0
        axes.set_xlim(middle[0] - side / 2.0, middle[0] + side / 2.0)
        axes.set_ylim(middle[1] - side / 2.0, middle[1] + side / 2.0)
    axes.set_aspect("equal")
    axes.set_xlabel("east, m")
    axes.set_ylabel("north, m")
    axes.grid(visible=True, color="#edf0f4", linewidth=0.6, zorder=0)
    axes.set_axisbelow(True)
    for spine in axes.spines.values():
        spine.set_color("#aab1bd")
    axes.tick_params(color="#aab1bd", labelsize=8)


def _place_of(flight: FlightRecord) -> str:
    """Return world and seed of a flight as text."""
    config = flight.config
    world = config["link"] or config["world"].removesuffix(".toml").rpartition("/")[2]
    return f"{world}, seed {config['seed']}"


def _caption(figure: Figure, axes: Axes, flight: FlightRecord) -> None:
    qof = flight.quality_of_flight
    time_s, distance_m = qof["flight_time_s"], qof["distance_m"]
    figures = "" if time_s is None else f", {time_s:.1f} s, {distance_m:.1f} m"
    axes.set_title(
        f"{_place_of(flight)}: {flight.outcome.replace('_', ' ')}{figures}",
        fontsize=10, loc="left",
    )  # fmt: skip
    figure.legend(
        loc="outside lower center", ncols=8, frameon=False, fontsize=8,
        handletextpad=0.3, columnspacing=0.9,
    )  # fmt: skip


# Flights of one mission: golden, with a fault, protected ---------------------------------------


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
    figure.suptitle(_place_of(panels[0].flights[0][1].record), fontsize=11)
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
    text = [_place_of(panels[0].flights[0][1].record)]
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
    paths = [_path_of(run)[0] for run in runs]
    everywhere = np.concatenate(paths)
    first = runs[0].record
    golden_s = _golden_s(runs)
    _draw_obstacles(axes, first.world, everywhere)
    handles = []
    for place, ((name, run), positions) in enumerate(zip(panel.flights, paths, strict=True)):
        handles += axes.plot(
            positions[:, 0], positions[:, 1], color=colours[name], zorder=4.0 + 0.01 * place,
            linewidth=max(_LEAST, _WIDEST - _STEP * place), alpha=0.5 if place == 0 else 1.0,
            solid_capstyle="round", solid_joinstyle="round", gid=f"flight-{number}-{place}",
            label=_legend_entry(name, run.record, golden_s),
        )  # fmt: skip
        _draw_end(axes, run.record, positions, colours[name])
    _draw_places(axes, first, paths[0])
    _draw_panel_marks(figure, axes, panel, colours)
    _frame(axes, first.world, everywhere)
    if panel.title:
        axes.set_title(f"fault: {panel.title}", fontsize=9.5, loc="left")
    axes.legend(
        handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.1), frameon=False, fontsize=8
    )
    for handle in handles:
        handle.set_label(None)  # the remaining labels are the same in all panels


def _draw_panel_marks(figure: Figure, axes: Axes, panel: Panel, colours: Mapping[str, str]) -> None:
    """Mark faults and alarms beside the path in the colours of their flights."""
    from matplotlib.transforms import offset_copy

    for kind, (right, up) in _MARKED.items():
        for name, run in panel.flights:
            beside = offset_copy(axes.transData, figure, right, up, units="points")
            places = _draw_marks(
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
