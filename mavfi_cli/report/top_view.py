"""Top view of a flight: obstacles, path coloured by speed, plans and events."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from mavfi_cli.mission.record.measures import FlightRecord
from mavfi_cli.mission.record.run_folder import Run
from mavfi_cli.report.drawing import new_figure

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


def draw_top_view(run: Run) -> Figure:
    """Draw a figure of the run in metres, with east to the right and north up."""
    figure = new_figure(6.4, 6.0)
    figure.get_layout_engine().set(h_pad=0.1, w_pad=0.08)  # type: ignore[union-attr, call-arg]
    axes = figure.add_subplot()
    flight = run.record
    world = flight.world
    positions, speeds = path_of(run)
    draw_obstacles(axes, world, positions)
    _draw_plans(axes, flight.plans)
    if len(positions) > 1:
        _draw_path(figure, axes, positions, speeds, flight.config["v_max_mps"])
    draw_places(axes, flight, positions)
    draw_end(axes, flight, positions)
    for kind in _MARKS:
        draw_marks(axes, flight.events, kind)
    frame(axes, world, positions)
    _caption(figure, axes, flight)
    return figure


def path_of(run: Run) -> tuple[np.ndarray, np.ndarray]:
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


def draw_obstacles(axes: Axes, world: Mapping[str, Any], positions: np.ndarray) -> None:
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


def draw_places(axes: Axes, flight: FlightRecord, positions: np.ndarray) -> None:
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


def draw_end(axes: Axes, flight: FlightRecord, positions: np.ndarray, colour: str = _BAD) -> None:
    """Mark the end of a failed flight with positions (n, 3) m."""
    if len(positions) and not flight.succeeded:
        axes.scatter(
            [positions[-1, 0]], [positions[-1, 1]], marker="X", s=90, color=colour,
            edgecolors="white", linewidths=0.8, zorder=7, label=flight.outcome,
        )  # fmt: skip


def draw_marks(axes: Axes, events: Iterable[dict[str, Any]], kind: str, **style: Any) -> np.ndarray:
    """Mark events of a kind and return their positions (n, 2) m. `style` overrides the mark."""
    found = [e["position_enu_m"] for e in events if e["kind"] == kind and e["position_enu_m"]]
    places = np.array(found, dtype=float).reshape(-1, 3)[:, :2]
    if found:
        look = {"linewidths": 0.9, "zorder": 6, "label": _LABELS[kind], **_MARKS[kind], **style}
        axes.scatter(places[:, 0], places[:, 1], **look)
    return places


def frame(axes: Axes, world: Mapping[str, Any], positions: np.ndarray) -> None:
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


def place_of(flight: FlightRecord) -> str:
    """Return world and seed of a flight as text."""
    config = flight.config
    world = config["link"] or config["world"].removesuffix(".toml").rpartition("/")[2]
    return f"{world}, seed {config['seed']}"


def _caption(figure: Figure, axes: Axes, flight: FlightRecord) -> None:
    qof = flight.quality_of_flight
    time_s, distance_m = qof["flight_time_s"], qof["distance_m"]
    figures = "" if time_s is None else f", {time_s:.1f} s, {distance_m:.1f} m"
    axes.set_title(
        f"{place_of(flight)}: {flight.outcome.replace('_', ' ')}{figures}",
        fontsize=10, loc="left",
    )  # fmt: skip
    figure.legend(
        loc="outside lower center", ncols=8, frameon=False, fontsize=8,
        handletextpad=0.3, columnspacing=0.9,
    )  # fmt: skip
