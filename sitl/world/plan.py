"""Checks that a world can be flown, and draws it from above as SVG.

The path is searched on an 8-connected flat grid at the goal's height. A cell is free if its centre
keeps the clearance from every box, including those above and below. The result has the grid's
resolution and ignores paths over or under an obstacle.
"""

from __future__ import annotations

import heapq
import io
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.errors import WorldError
from mavfi_cli.core.files import plain
from mavfi_cli.core.frames import Vector
from sitl.world.world import World, distance_to_boxes

if TYPE_CHECKING:
    from matplotlib.axes import Axes


Mask = NDArray[np.bool_]
Cell = tuple[int, int]

# Half-width of the planner's drone box in the released code (MAVBench/MAV_apps, branch mavfi).
DEFAULT_CLEARANCE_M = 2.0
_CELL_M = 0.5
_MOST_CELLS = 1e8  # maximum size of the grid, 5 km square
_STEPS = [(i, j, math.hypot(i, j)) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]


@dataclass(frozen=True, slots=True, kw_only=True)
class _WorldCheck:
    """The result of `check_world`. All lengths are in metres."""

    clearance_m: float  # requested clearance
    start_clearance_m: float  # horizontal distance to the nearest box; inf without boxes
    goal_clearance_m: float  # distance in space to the nearest box; inf without boxes
    straight_m: float  # horizontal distance from start to goal
    path_m: float | None  # length of a shortest path on the grid, straightened; None if none exists
    path_enu_m: Vector  # (n, 3) its corners at flight height; empty if none exists

    @property
    def path_exists(self) -> bool:
        """True if a path with the requested clearance exists."""
        return self.path_m is not None

    def as_dict(self) -> dict[str, Any]:
        """Return the result as a dict for JSON, without the corners of the path.

        The clearances of start and goal are None if the world has no boxes.
        """
        keys = ("clearance_m", "path_m", "straight_m", "start_clearance_m", "goal_clearance_m")
        return {"path_exists": self.path_exists, **plain({key: getattr(self, key) for key in keys})}


def check_world(world: World, *, clearance_m: float = DEFAULT_CLEARANCE_M) -> _WorldCheck:
    """Search for a path from start to goal that keeps `clearance_m` from every box.

    Raises WorldError if the world is too large for the grid.
    """
    height = float(world.goal_enu_m[2])
    free, origin = _free_grid(world, height, clearance_m)
    ends = np.array([world.start_enu_m[:2], world.goal_enu_m[:2]])
    cells = np.minimum(np.floor((ends - origin) / _CELL_M).astype(int), np.array(free.shape) - 1)
    start, goal = map(tuple, cells.tolist())
    path_cells = _shortest(free, start, goal)
    path, path_m = np.zeros((0, 3)), None
    if path_cells:
        corners = origin + (np.array(_straighten(free, path_cells)) + 0.5) * _CELL_M
        path = np.column_stack([corners, np.full(len(corners), height)])
        path_m = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
    start_gaps = distance_to_boxes(world.boxes_enu_m, world.start_enu_m, plan=True)
    goal_gaps = distance_to_boxes(world.boxes_enu_m, world.goal_enu_m)
    return _WorldCheck(
        clearance_m=clearance_m,
        start_clearance_m=float(start_gaps.min(initial=math.inf)),
        goal_clearance_m=float(goal_gaps.min(initial=math.inf)),
        straight_m=float(np.hypot(*(world.goal_enu_m - world.start_enu_m)[:2])),
        path_m=path_m,
        path_enu_m=path,
    )


def _free_grid(world: World, height_m: float, clearance_m: float) -> tuple[Mask, Vector]:
    """Return which grid cells are free at a height, and the position of the grid's lower corner.

    The cells are a mask of shape (columns, rows). The corner has shape (2,), in ENU m. Raises
    WorldError if the grid would have too many cells.
    """
    origin = world.bounds_enu_m[:2]
    cells = np.maximum(1.0, np.ceil((world.bounds_enu_m[3:5] - origin) / _CELL_M))
    if math.prod(cells.tolist()) > _MOST_CELLS:
        raise WorldError(
            f"world {world.name!r} is too large to check: its grid must have at most "
            f"{_MOST_CELLS:g} cells, got {cells[0]:g} x {cells[1]:g}"
        )
    x, y = (at + (np.arange(int(n)) + 0.5) * _CELL_M for at, n in zip(origin, cells, strict=True))
    free = np.ones((len(x), len(y)), dtype=np.bool_)
    for box in world.boxes_enu_m:
        dz = max(box[2] - height_m, height_m - box[5], 0.0)
        dx = np.maximum(0.0, np.maximum(box[0] - x, x - box[3]))[:, None]
        dy = np.maximum(0.0, np.maximum(box[1] - y, y - box[4]))[None, :]
        gap = np.sqrt(dx * dx + dy * dy + dz * dz)
        free &= (gap > 0.0) & (gap >= clearance_m)
    return free, origin


def _shortest(free: Mask, start: Cell, goal: Cell) -> list[Cell]:
    """Return the cells of a shortest path, by A* with the straight-line distance as heuristic.

    The list is empty if no path exists.
    """
    shape = free.shape
    if not (free[start] and free[goal]):
        return []
    best, parent, closed = {start: 0.0}, dict[Cell, Cell](), set[Cell]()
    queue = [(math.dist(start, goal), start)]
    while queue:
        _, here = heapq.heappop(queue)
        if here == goal:
            cells = [goal]
            while cells[-1] in parent:
                cells.append(parent[cells[-1]])
            return cells[::-1]
        if here in closed:
            continue
        closed.add(here)
        for i, j, length in _STEPS:
            there = (here[0] + i, here[1] + j)
            if not (0 <= there[0] < shape[0] and 0 <= there[1] < shape[1] and free[there]):
                continue
            cost = best[here] + length
            if cost < best.get(there, math.inf):
                best[there] = cost
                parent[there] = here
                heapq.heappush(queue, (cost + math.dist(there, goal), there))
    return []


def _straighten(free: Mask, cells: list[Cell]) -> list[Cell]:
    """Return the cells at which a straightened path turns, with the path's first and last cell.

    Each of them is the last cell of the original path that is visible from the one before it.
    """
    corners, at, last = [cells[0]], 0, len(cells) - 1
    while at < last:
        ahead = (place for place in range(last, at, -1) if _sees(free, cells[at], cells[place]))
        at = next(ahead, at + 1)
        corners.append(cells[at])
    return corners


def _sees(free: Mask, a: Cell, b: Cell) -> bool:
    count = 4 * max(abs(b[0] - a[0]), abs(b[1] - a[1])) + 1
    line = np.rint(np.linspace(a, b, count)).astype(int)
    return bool(free[line[:, 0], line[:, 1]].all())


_GROUND = "#fbfbf9"
_TALL, _TALL_EDGE = "#c9ced6", "#8b93a1"
_LOW, _LOW_EDGE = "#cfe0bd", "#8aa573"
_START, _GOAL, _PATH = "#1f5fa8", "#1b7f4b", "#b5651d"
_WIDTH_IN = 5.2


def world_svg(world: World, path_enu_m: Vector | None = None) -> bytes:
    """Return an SVG picture of a world from above, with axes in metres.

    A given path, of shape (n, 3), is drawn as well. Boxes that end 1 m or more below the goal's
    height are green, because the flight passes over them. The same world gives the same bytes.
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
                linestyle=(0, (4, 2)), label="path with clearance", zorder=3,
            )  # fmt: skip
        _draw_places(axes, world)
        title = f"{world.name}, seed {world.seed}"
        axes.set(
            xlim=(west, east), ylim=(south, north), aspect="equal", xlabel="east, m",
            ylabel="north, m",
        )  # fmt: skip
        axes.tick_params(width=0.6, length=3)
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
    for place, size, marker, colour, label in (
        (start, 34, "o", _START, "start"),
        (goal, 110, "*", _GOAL, f"goal, {goal[2]:g} m up"),
    ):
        axes.scatter(
            [place[0]], [place[1]], s=size, marker=marker, facecolor=colour, edgecolor="white",
            linewidth=0.8, label=label, zorder=5,
        )  # fmt: skip
