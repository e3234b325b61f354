"""Top view of a world as SVG: obstacles, start, goal and scale."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np

from mavfi_cli.core.frames import Vector
from sitl.world.world import World

if TYPE_CHECKING:
    from matplotlib.axes import Axes


_GROUND, _INK = "#fbfbf9", "#222831"
_TALL, _TALL_EDGE = "#c9ced6", "#8b93a1"
_LOW, _LOW_EDGE = "#cfe0bd", "#8aa573"
_START, _GOAL, _PATH = "#1f5fa8", "#1b7f4b", "#b5651d"
_WIDTH_IN = 5.2


def world_svg(world: World, path_enu_m: Vector | None = None) -> bytes:
    """Return the SVG of a world from above, east to the right and north up, axes in m.

    Boxes that end 1 m or more below the goal's height are green, because the flight passes over
    them. The same world gives the same bytes.

    Args:
        world: World to draw.
        path_enu_m: Path (n, 3) from start to goal to draw, or None.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    west, south, _, east, north, _ = (float(v) for v in world.bounds_enu_m)
    height_in = min(2.0 * _WIDTH_IN, max(2.4, _WIDTH_IN * (north - south) / (east - west)))
    with mpl.rc_context(
        {"svg.hashsalt": "mavfi", "svg.fonttype": "none", "font.size": 9, "axes.linewidth": 0.6}
    ):
        figure = Figure(figsize=(_WIDTH_IN, height_in + 0.5), layout="constrained")
        axes = figure.add_subplot()
        axes.set_facecolor(_GROUND)
        _draw_boxes(axes, world)
        if path_enu_m is not None and len(path_enu_m):
            axes.plot(
                path_enu_m[:, 0], path_enu_m[:, 1], color=_PATH, linewidth=1.0,
                linestyle=(0, (4, 2)), label="way with clearance", zorder=3,
            )  # fmt: skip
        _draw_places(axes, world)
        _draw_scale(axes, world)
        axes.set_xlim(west, east)
        axes.set_ylim(south, north)
        axes.set_aspect("equal")
        axes.set_xlabel("east, m")
        axes.set_ylabel("north, m")
        axes.tick_params(width=0.6, length=3)
        title = f"{world.name}, seed {world.seed}"
        axes.set_title(title, fontsize=10, loc="left")
        figure.legend(
            loc="outside lower center", ncols=4, frameon=False, fontsize=8, handletextpad=0.5
        )
        buffer = io.BytesIO()
        metadata = {"Date": None, "Creator": "mavfi", "Title": title}
        figure.savefig(buffer, format="svg", metadata=metadata)
    return buffer.getvalue()


def _draw_boxes(axes: Axes, world: World) -> None:
    from matplotlib.patches import Rectangle

    named: set[str] = set()
    # Tall boxes last, so that a hedge never hides a wall.
    for box in sorted(world.boxes_enu_m.tolist(), key=lambda b: b[5]):
        low = box[5] <= float(world.goal_enu_m[2]) - 1.0
        label = "low obstacle" if low else "obstacle"
        axes.add_patch(
            Rectangle(
                (box[0], box[1]), box[3] - box[0], box[4] - box[1], linewidth=0.6, zorder=2,
                facecolor=_LOW if low else _TALL, edgecolor=_LOW_EDGE if low else _TALL_EDGE,
                label=None if label in named else label,
            )
        )  # fmt: skip
        named.add(label)


def _draw_places(axes: Axes, world: World) -> None:
    start, goal = world.start_enu_m, world.goal_enu_m
    axes.scatter(
        [start[0]], [start[1]], s=34, marker="o", facecolor=_START, edgecolor="white",
        linewidth=0.8, label="start", zorder=5,
    )  # fmt: skip
    axes.scatter(
        [goal[0]], [goal[1]], s=110, marker="*", facecolor=_GOAL, edgecolor="white",
        linewidth=0.8, label=f"goal, {goal[2]:g} m up", zorder=5,
    )  # fmt: skip


def _draw_scale(axes: Axes, world: World) -> None:
    """Draw a bar of 1, 2 or 5 times a power of ten, about 1/6 of the width, in a free corner."""
    west, south, _, east, north, _ = (float(v) for v in world.bounds_enu_m)
    width = east - west
    power = 10.0 ** np.floor(np.log10(width / 6.0))
    length = float(power * max(f for f in (1.0, 2.0, 5.0) if f * power <= width / 6.0))
    margin, room = 0.04 * width, 0.07 * width
    corners = [
        (x, y)
        for y in (south + margin, north - margin - room)
        for x in (west + margin, east - margin - length)
    ]
    free = [corner for corner in corners if _is_empty(world, corner, length, room)]
    x, y = (free or corners)[0]
    axes.plot([x, x + length], [y, y], color=_INK, linewidth=2.0, solid_capstyle="butt", zorder=6)
    axes.text(
        x + length / 2.0, y + 0.012 * width, f"{length:g} m", ha="center", va="bottom",
        fontsize=8, color=_INK, zorder=6,
    )  # fmt: skip


def _is_empty(world: World, corner: tuple[float, float], width: float, height: float) -> bool:
    """Return True if no box, start or goal lies in a rectangle of the plan."""
    boxes = world.boxes_enu_m
    places = np.array([world.start_enu_m, world.goal_enu_m])
    footprints = np.vstack([boxes[:, [0, 1, 3, 4]], np.hstack([places[:, :2], places[:, :2]])])
    apart = (
        (footprints[:, 0] > corner[0] + width)
        | (footprints[:, 2] < corner[0])
        | (footprints[:, 1] > corner[1] + height)
        | (footprints[:, 3] < corner[1])
    )
    return bool(apart.all())
