"""Pictures of flights: one flight with its height, or all flights of a mission (Fig. 13)."""

from __future__ import annotations

import itertools
import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from mavfi_cli.analysis.trajectories import MissionPicture
from mavfi_cli.core.files import Json
from mavfi_cli.core.flight_record import Event, RecordedPlan
from mavfi_cli.mission.measures import FlightRecord
from mavfi_cli.mission.run_folder import Run, load_run
from mavfi_cli.report.drawing import (
    ALARM,
    DETECTORS,
    FAULT,
    FLIGHTS,
    GOAL,
    GRID,
    INK,
    OBSTACLE,
    PLAN,
    Look,
    new_figure,
    open_frame,
)
from mavfi_cli.spec.fault import FaultConfig, InstructionConfig

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_OBSTACLE_EDGE = "#8b93a1"
_LOW = "#e3ead9"  # boxes that end below the flight, such as hedges
# Events: label, marker and style.
_EVENT: Look = {"linewidths": 0.9, "zorder": 6, "edgecolors": "#222831"}
_MARKS: dict[str, tuple[str, str, Look]] = {
    "replan": ("new plan", "o", {"s": 14, "facecolors": "white"}),
    "slow": ("slows down", "v", {"s": 30, "facecolors": "#f2b134"}),
    "stop": ("stops", "s", {"s": 26, "facecolors": "#e4572e"}),
    "fault": ("fault", "*", {"s": 130, "facecolors": FAULT, "edgecolors": "white"}),
    "alarm": ("alarm", "D", {"s": 34, "facecolors": ALARM, "edgecolors": "white"}),
}
_WIDEST, _STEP, _LEAST = 5.5, 1.7, 1.2  # line widths in points; identical paths stay visible
_COLUMNS = 3
_TITLE = 66  # characters in a line of a title
_MARKED = {"fault": (-11.0, 8.0), "alarm": (11.0, -8.0)}  # offset from the position, points
_BESIDE = 11.0  # points between marks at the same position
_PLANS = 6  # number of plans that remain distinguishable; the newest are drawn
_FROM_ABOVE, _OVER_TIME = [1, 2], [0, 3]  # columns of stamp, x, y, z that axes show


# One flight: obstacles, path coloured by speed, plans and events ------------------------------


def draw_top_view(run: Run) -> Figure:
    """Draw the flight of a run from above, with east to the right and north up, and its height.

    Lengths are in metres. The height is drawn over time.
    """
    figure = new_figure(5.6, 7.0)
    figure.get_layout_engine().set(h_pad=0.1, w_pad=0.08)  # type: ignore[union-attr, call-arg]
    axes, beside = figure.subplots(2, height_ratios=[4.2, 1.0])
    flight, (path, speeds_mps) = run.record, _path_of(run)
    _draw_obstacles(axes, flight.world, path[:, 1:])
    _draw_plans(axes, flight.plans)
    for view, columns in ((axes, _FROM_ABOVE), (beside, _OVER_TIME)):
        lines = _draw_path(view, path, speeds_mps, columns, flight.config["v_max_mps"])
        if lines is not None and view is axes:
            bar = figure.colorbar(lines, ax=axes, shrink=0.6, pad=0.02, aspect=28)
            bar.set_label("speed, m/s", fontsize=9)
            bar.ax.tick_params(labelsize=8)
            bar.outline.set_linewidth(0.4)
        _draw_start(view, path, columns)
        _draw_end(view, flight, path, columns)
        for kind in _MARKS:
            _draw_marks(view, flight.events, kind, columns)
    _draw_goal(axes, flight)
    _frame(axes, flight.world, path[:, 1:])
    _frame_heights(beside, flight, path)
    _caption(figure, axes, flight)
    return figure


_Path = tuple[np.ndarray, np.ndarray]  # (n, 4) stamp in s and position in m; speeds in m/s, (n,)


def _path_of(run: Run) -> _Path:
    """Return the stamps, positions and speeds of a flight, from the true states if recorded."""
    trace = run.trace
    if trace is None or trace.num_rows == 0:
        return np.empty((0, 4)), np.empty(0)
    prefix = "truth_" if "truth_x_m" in trace.column_names else ""

    def columns(*names: str) -> np.ndarray:
        return np.column_stack([trace[name].to_numpy(zero_copy_only=False) for name in names])

    places = columns("stamp_s", *(f"{prefix}{axis}_m" for axis in "xyz"))
    speeds = np.linalg.norm(columns(*(f"{prefix}v{axis}_mps" for axis in "xyz")), axis=1)
    known = np.isfinite(places).all(axis=1)
    return places[known], speeds[known]


def _draw_obstacles(axes: Axes, world: Json, positions: np.ndarray) -> None:
    """Draw the boxes of a world from above. Boxes that end below the flight are pale.

    Args:
        positions: positions of the vehicle, (n, 3), m.
    """
    from matplotlib.patches import Rectangle

    flight_height_m = float(np.median(positions[:, 2])) if len(positions) else 5.0
    for box in world.get("boxes", []):
        low = box[5] < flight_height_m - 1.0
        axes.add_patch(
            Rectangle(
                (box[0], box[1]), box[3] - box[0], box[4] - box[1], zorder=1, linewidth=0.6,
                facecolor=_LOW if low else OBSTACLE, edgecolor=_OBSTACLE_EDGE,
            )
        )  # fmt: skip


def _draw_plans(axes: Axes, plans: Sequence[RecordedPlan]) -> None:
    drawn = [plan for plan in plans if len(plan.points_enu_m)]
    label = "planned" if len(drawn) <= _PLANS else f"planned (newest {_PLANS} of {len(drawn)})"
    newest = drawn[-_PLANS:]
    for number, plan in enumerate(newest, 1):
        points = np.array(plan.points_enu_m, dtype=float)
        axes.plot(
            points[:, 0], points[:, 1], color=PLAN, linewidth=0.9, linestyle=(0, (4, 3)), zorder=2,
            alpha=0.25 + 0.75 * number / len(newest), label=label if plan is newest[-1] else None,
        )  # fmt: skip


def _draw_path(
    axes: Axes, path: np.ndarray, speeds_mps: np.ndarray, columns: list[int], v_max_mps: float
) -> Any:
    """Draw a path coloured by speed. Return its lines, or None if it has fewer than two points."""
    from matplotlib.collections import LineCollection

    step = max(1, len(path) // 400)
    points, colours = path[::step, columns], speeds_mps[::step]
    if len(points) < 2:
        return None
    segments = np.stack([points[:-1], points[1:]], axis=1)
    lines = LineCollection(
        list(segments),
        array=colours[1:],
        cmap="viridis",
        linewidths=2.2,
        zorder=4,
        capstyle="round",
    )
    lines.set_clim(0.0, v_max_mps)
    axes.add_collection(lines)
    return lines


def _draw_goal(axes: Axes, flight: FlightRecord) -> None:
    from matplotlib.patches import Circle

    goal = flight.goal_enu_m or flight.world.get("goal")
    if goal:
        tolerance = flight.config["goal_tolerance_m"]
        axes.add_patch(
            Circle((goal[0], goal[1]), tolerance, fill=False, color=GOAL, linewidth=1.0, zorder=3)
        )
        axes.scatter([goal[0]], [goal[1]], marker="*", s=120, color=GOAL, zorder=5, label="goal")


def _draw_end(
    axes: Axes,
    flight: FlightRecord,
    path: np.ndarray,
    columns: list[int] = _FROM_ABOVE,
    colour: str = FAULT,
) -> None:
    """Mark the end of a flight with its outcome if it failed."""
    if not flight.succeeded:
        _mark(axes, path[-1:], columns, flight.outcome, "X", s=90, color=colour, zorder=7)


def _draw_start(axes: Axes, path: np.ndarray, columns: list[int] = _FROM_ABOVE) -> None:
    above = 6.5  # above the mark of a fault
    _mark(axes, path[:1], columns, "start", "^", s=55, color="#222831", zorder=above)


def _mark(
    axes: Axes, places: np.ndarray, columns: list[int], label: str, marker: str, **look: Any
) -> np.ndarray:
    """Draw a mark at each place, and return the coordinates of the marks on the axes, (n, 2).

    Args:
        places: stamp in s and position in m, (n, 4).
        columns: the two columns of `places` that the axes show.
    """
    projected: np.ndarray = places[:, columns]
    if len(places):
        style = {"edgecolors": "white", "linewidths": 0.8, "marker": marker, **look}
        axes.scatter(*projected.T, label=label if columns is _FROM_ABOVE else None, **style)
    return projected


def _draw_marks(
    axes: Axes,
    events: Iterable[Event],
    kind: str,
    columns: list[int] = _FROM_ABOVE,
    **style: Any,
) -> np.ndarray:
    """Mark the events of one kind, and return the coordinates of the marks on the axes, (n, 2).

    Events without a position are omitted. `style` overrides the usual style of the mark.
    """
    stamped = [
        (event.stamp_s, *event.position_enu_m)
        for event in events
        if event.kind == kind and event.position_enu_m
    ]
    places = np.array(stamped, dtype=float).reshape(-1, 4)
    label, marker, look = _MARKS[kind]
    return _mark(axes, places, columns, label, marker, **{**_EVENT, **look, **style})


def _frame(axes: Axes, world: Json, positions: np.ndarray) -> None:
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
    axes.set_xlabel("east, m", fontsize=9)
    axes.set_ylabel("north, m", fontsize=9)
    _plain(axes)


def _frame_heights(axes: Axes, flight: FlightRecord, path: np.ndarray) -> None:
    goal = flight.goal_enu_m or flight.world.get("goal")
    heights_m = [0.0, *path[:, 3], *(goal[2:] if goal else ())]
    if goal:
        axes.axhline(goal[2], color=GOAL, linewidth=0.9, linestyle=(0, (2, 2)), zorder=3)
    axes.margins(x=0.02)
    axes.set_ylim(min(heights_m), max(1.0, 1.2 * max(heights_m)))
    axes.set_xlabel("simulated time, s", fontsize=9)
    axes.set_ylabel("height, m", fontsize=9)
    _plain(axes)
    open_frame(axes)


def _plain(axes: Axes) -> None:
    axes.grid(visible=True, color=GRID, linewidth=0.6, zorder=0)
    axes.set_axisbelow(True)
    for spine in axes.spines.values():
        spine.set_color("#aab1bd")
    axes.tick_params(color="#aab1bd", labelsize=8)


def _place_of(flight: FlightRecord) -> str:
    config = flight.config
    world = config["link"] or config["world"].removesuffix(".toml").rpartition("/")[2]
    return f"{world}, seed {config['seed']}"


def _caption(figure: Figure, axes: Axes, flight: FlightRecord) -> None:
    qof = flight.quality_of_flight
    figures = ""
    if qof.flight_time_s is not None and qof.distance_m is not None:
        figures = f", {qof.flight_time_s:.1f} s, {qof.distance_m:.1f} m"
    title = f"{_place_of(flight)}: {flight.outcome.replace('_', ' ')}{figures}"
    axes.set_title("\n".join([title, *_treatment(flight)]), fontsize=9.5, loc="left")
    figure.legend(
        loc="outside lower center", ncols=4, frameon=False, fontsize=8,
        handletextpad=0.3, columnspacing=1.5,
    )  # fmt: skip


def _treatment(flight: FlightRecord) -> list[str]:
    """Return lines that describe the fault and the detector of a flight, if it has any."""
    parts = []
    if (fault := flight.fault) is not None:
        missed = " (not injected)" if fault.state == "not_injected" else ""
        parts.append(f"fault: {_struck(flight)}{missed}")
    if (detection := flight.detection) is not None:
        count = detection.alarm_count
        parts.append(f"detector: {detection.detector}, {count or 'no'} alarm{'s'[count == 1 :]}")
    return textwrap.wrap("; ".join(parts), _TITLE)


def _struck(flight: FlightRecord) -> str:
    """Describe the fault of a flight in words, with the state or the node that was drawn for it."""
    if (instruction := flight.instruction_fault) is not None:
        return InstructionConfig(**instruction.request).describe(instruction.node)
    assert flight.state_fault is not None
    request, states = flight.state_fault.request, flight.state_fault.states
    return FaultConfig(**request).describe(states[0] if len(states) == 1 else None)


# Flights of one mission: golden, with a fault, protected ---------------------------------------


_Flights = Sequence[tuple[str, Run]]


@dataclass(frozen=True, slots=True)
class Trajectories:
    """A picture of the flights of one mission, superimposed in one or more panels.

    Flights with the same name have the same colour in all panels. The first flight in a panel that
    has no fault and no detector is the reference for the times of the others.

    Attributes:
        panels: At least one panel, each with its title and at least one named flight.
    """

    panels: Sequence[tuple[str, _Flights]]

    @classmethod
    def of(cls, picture: MissionPicture) -> Trajectories:
        """Load the runs of a picture from their run folders.

        Raises:
            RecordError: A run folder cannot be read.
        """
        return cls([
            (panel.title, [(flight.name, load_run(flight.path)) for flight in panel.flights])
            for panel in picture.panels
        ])  # fmt: skip

    def draw(self, across: int = _COLUMNS) -> Figure:
        """Draw a top view per panel, in metres, with east to the right and north up.

        Args:
            across: Maximum number of panels side by side.
        """
        columns = min(across, len(self.panels))
        rows = -(-len(self.panels) // columns)
        most = max(len(flights) for _, flights in self.panels)
        figure = new_figure(5.2 * columns, (5.3 + 0.19 * most) * rows)
        figure.get_layout_engine().set(h_pad=0.1, w_pad=0.08)  # type: ignore[union-attr, call-arg]
        colours = _colours(flight for _, flights in self.panels for flight in flights)
        grid = figure.subplots(rows, columns, squeeze=False)
        for number, (title, flights) in enumerate(self.panels):
            axes = grid.flat[number]
            _draw_panel(figure, axes, flights, number, colours)
            if title:
                caption = textwrap.fill(f"fault: {title}", _TITLE)
                axes.set_title(caption, fontsize=9.5, loc="left")
        for axes in grid.flat[len(self.panels) :]:
            axes.set_axis_off()
        _explain_marks(figure)
        figure.suptitle(self._place, fontsize=11)
        return figure

    def lines(self) -> list[str]:
        """Return lines with world and seed, and with outcome, time and folder of every flight."""
        text = [self._place]
        for title, flights in self.panels:
            text += [f"fault: {title}"] if title else []
            golden_s = _golden_s(flights)
            text += [
                f"  {_legend_entry(name, run.record, golden_s)}  {run.folder.path}"
                for name, run in flights
            ]
        return text

    @property
    def _place(self) -> str:
        return _place_of(self.panels[0][1][0][1].record)


def _colours(flights: Iterable[tuple[str, Run]]) -> dict[str, str]:
    """Return the colour of each flight, keyed by name.

    It is the colour of the flight's detector if no other name has it yet; otherwise it is the next
    one of FLIGHTS.
    """
    colours: dict[str, str] = {}
    turn = itertools.cycle(FLIGHTS)
    for name, run in flights:
        if name not in colours:
            detection = run.record.detection
            own = None if detection is None else DETECTORS.get(detection.detector)
            colours[name] = own if own and own not in colours.values() else next(turn)
    return colours


def _draw_panel(
    figure: Figure, axes: Axes, flights: _Flights, number: int, colours: Mapping[str, str]
) -> None:
    paths = [_path_of(run)[0] for _, run in flights]
    everywhere = np.concatenate([path[:, 1:] for path in paths])
    first, golden_s = flights[0][1].record, _golden_s(flights)
    _draw_obstacles(axes, first.world, everywhere)
    handles = []
    for place, ((name, run), path) in enumerate(zip(flights, paths, strict=True)):
        handles += axes.plot(
            *path[:, _FROM_ABOVE].T, color=colours[name], zorder=4.0 + 0.01 * place,
            linewidth=max(_LEAST, _WIDEST - _STEP * place), alpha=0.5 if place == 0 else 1.0,
            solid_capstyle="round", solid_joinstyle="round", gid=f"flight-{number}-{place}",
            label=_legend_entry(name, run.record, golden_s),
        )  # fmt: skip
        _draw_end(axes, run.record, path, colour=colours[name])
    _draw_goal(axes, first)
    _draw_start(axes, paths[0])
    _draw_panel_marks(figure, axes, flights, colours)
    _frame(axes, first.world, everywhere)
    axes.legend(
        handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.1), frameon=False, fontsize=8
    )
    for handle in handles:
        handle.set_label(None)  # the remaining labels are the same in all panels


def _draw_panel_marks(
    figure: Figure, axes: Axes, flights: _Flights, colours: Mapping[str, str]
) -> None:
    """Mark faults and alarms next to the path in the colours of their flights."""
    from matplotlib.transforms import offset_copy

    for kind, (right, up) in _MARKED.items():
        for name, run in flights:
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
    marks: dict[str, Any] = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            marks.setdefault(label.replace("_", " "), handle)
    legend = figure.legend(
        handles=list(marks.values()), labels=list(marks), loc="outside lower center", ncols=8,
        frameon=False, fontsize=8, handletextpad=0.3, columnspacing=0.9,
    )  # fmt: skip
    for entry, label in zip(legend.legend_handles, marks, strict=True):
        if label in _MARKED and entry is not None:  # the legend entry covers all colours
            entry.set(facecolor="white", edgecolor=INK)


def _golden_s(flights: _Flights) -> float | None:
    for _, run in flights:
        if (flight := run.record).golden and not flight.config.get("companion"):
            return flight.quality_of_flight.flight_time_s if flight.succeeded else None
    return None


def _legend_entry(name: str, flight: FlightRecord, golden_s: float | None) -> str:
    time_s = flight.quality_of_flight.flight_time_s
    entry = f"{name}: {flight.outcome.replace('_', ' ')}"
    if time_s is None:
        return entry
    entry += f", {time_s:.1f} s"
    if flight.golden or golden_s is None or not flight.succeeded:
        return entry
    return f"{entry} ({100.0 * (time_s / golden_s - 1.0):+.1f} %)"
