"""A world: axis-aligned boxes on flat ground with a start and a goal; and the paper's generator.

The generator has two numbers (paper, section VI-A). With probability `density`, a cell of
10 x 10 m contains a `size` x `size` m cuboid of unlimited height at its centre. Each cell draws
from its own random stream (seed, family, density, size, cell), so a larger area only adds obstacles
and never moves the others.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mavfi_cli.core.errors import RecordError, WorldError
from mavfi_cli.core.files import write_json
from mavfi_cli.core.frames import Vector
from mavfi_cli.core.seeds import Stream, generator

START_CLEAR_M = 0.5
"""Minimum distance of a start from a box, as the vehicle must be able to stand there."""

CELL_M = 10.0
MARGIN_M = 20.0
CLEAR_RADIUS_M = 3.0
"""Minimum horizontal distance of an obstacle from start and goal."""

UNLIMITED_HEIGHT_M = 1000.0
"""Height of an unlimited obstacle; a 300 s mission can climb 900 m at 3 m/s."""

CEILING_M = 50.0
MAX_SPAN_M = 1000.0

DEFAULT_START_ENU_M = (0.0, 0.0, 0.0)
DEFAULT_GOAL_ENU_M = (30.0, 40.0, 5.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class World:
    """Boxes, bounds, start and goal in ENU. The ground is the plane z = 0.

    Raises:
        WorldError: Start or goal is outside the bounds or blocked, or a box has no volume.
    """

    name: str
    seed: int
    boxes_enu_m: Vector  # (n, 6) xmin ymin zmin xmax ymax zmax
    bounds_enu_m: Vector  # (6,) xmin ymin zmin xmax ymax zmax
    start_enu_m: Vector  # (3,) on the ground
    goal_enu_m: Vector  # (3,)

    def __post_init__(self) -> None:
        shapes = {"boxes_enu_m": (-1, 6), "bounds_enu_m": (6,), "start_enu_m": (3,)}
        for field, shape in {**shapes, "goal_enu_m": (3,)}.items():
            array = np.array(getattr(self, field), dtype=np.float64).reshape(shape)
            array.flags.writeable = False
            object.__setattr__(self, field, array)
        _refuse_bad_boxes(self)
        for what, place in (("start", self.start_enu_m), ("goal", self.goal_enu_m)):
            refuse_bad_place(self.name, self.boxes_enu_m, self.bounds_enu_m, what, place)

    def as_json(self) -> dict[str, Any]:
        """Return the world for a record, lengths in m."""
        return {
            "name": self.name,
            "seed": self.seed,
            "bounds": self.bounds_enu_m.tolist(),
            "start": self.start_enu_m.tolist(),
            "goal": self.goal_enu_m.tolist(),
            "boxes": self.boxes_enu_m.tolist(),
        }

    def write_briefing(self, camera_mount_flu_m: Sequence[float], folder: Path) -> None:
        """Write what a companion knows before the first message: start, goal, bounds and camera.

        Args:
            camera_mount_flu_m: Offset of the camera from the vehicle's position (3,).
            folder: Where `briefing.json` is written.

        Raises:
            RecordError: The file cannot be written.
        """
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RecordError(f"{folder}: {error.strerror or error}") from None
        briefing = {
            "start_enu_m": self.start_enu_m.tolist(),
            "goal_enu_m": self.goal_enu_m.tolist(),
            "bounds_enu_m": self.bounds_enu_m.tolist(),
            "camera_offset_flu_m": list(camera_mount_flu_m),
        }
        write_json(folder / "briefing.json", briefing)


def _refuse_bad_boxes(world: World) -> None:
    if not np.isfinite(world.boxes_enu_m).all():
        raise WorldError(f"world {world.name!r}: a box has a coordinate that is not finite")
    flat = (world.boxes_enu_m[:, 3:] <= world.boxes_enu_m[:, :3]).any(axis=1)
    if flat.any():
        raise WorldError(f"world {world.name!r}: box {int(flat.argmax())} has max <= min")


def refuse_bad_place(name: str, boxes: Vector, bounds: Vector, what: str, place: Vector) -> None:
    """Raise WorldError if a "start" or "goal" (3,) is outside the bounds (6,) or blocked.

    A start is blocked if a box (n, 6) is too near to stand there, a goal if it is inside a box.
    """
    if not inside(bounds, place):
        raise WorldError(
            f"world {name!r}: {what} {show(place)} is outside the world, which reaches "
            f"from {show(bounds[:3])} to {show(bounds[3:])} m"
        )
    gaps = distance_to_boxes(boxes, place)
    if not gaps.size:
        return
    if what == "start" and gaps.min() < START_CLEAR_M:
        raise WorldError(
            f"world {name!r}: start {show(place)} is blocked: box {int(gaps.argmin())} is "
            f"{gaps.min():.2f} m away, {START_CLEAR_M:g} m needed"
        )
    if what == "goal" and gaps.min() <= 0.0:
        raise WorldError(
            f"world {name!r}: goal {show(place)} is inside an obstacle (box {int(gaps.argmin())})"
        )


def show(place: Vector) -> str:
    """Format a point like (30, 40, 5)."""
    return "(" + ", ".join(f"{float(c):g}" for c in place) + ")"


def inside(bounds_enu_m: Vector, place_enu_m: Vector) -> bool:
    """Return True if a point (3,) is within the bounds (6,) or on a face; NaN is outside."""
    return bool((place_enu_m >= bounds_enu_m[:3]).all() and (place_enu_m <= bounds_enu_m[3:]).all())


def distance_to_boxes(boxes_enu_m: Vector, place_enu_m: Vector) -> Vector:
    """Return the distance (n,), m, from a point (3,) to each box (n, 6); zero inside."""
    below = boxes_enu_m[:, :3] - place_enu_m
    above = place_enu_m - boxes_enu_m[:, 3:]
    gaps: Vector = np.linalg.norm(np.maximum(0.0, np.maximum(below, above)), axis=1)
    return gaps


def plan_distance_to_boxes(boxes_enu_m: Vector, place_enu_m: Vector) -> Vector:
    """Return the horizontal distance (n,), m, from a point to each box; zero above or inside."""
    flat = boxes_enu_m.copy()
    flat[:, 2], flat[:, 5] = -np.inf, np.inf
    place = np.array([place_enu_m[0], place_enu_m[1], 0.0])
    return distance_to_boxes(flat, place)


@dataclass(frozen=True, slots=True, kw_only=True)
class GeneratorParams:
    """The generator's two numbers and the family of the random streams."""

    density: float  # probability that a cell contains an obstacle
    size_m: float  # side of the cuboid
    family: str = "evaluation"  # or "training"; the families have no world in common

    def __post_init__(self) -> None:
        if not 0.0 <= self.density <= 1.0:
            raise WorldError(f"density {self.density:g} is not a probability (0 to 1)")
        if not 0.0 < self.size_m <= CELL_M:
            raise WorldError(f"size {self.size_m:g} m does not fit a cell (above 0, to {CELL_M:g})")


def generate(
    name: str, pair: GeneratorParams, seed: int, start_enu_m: Vector, goal_enu_m: Vector
) -> World:
    """Generate the world of a pair and a seed between a start (3,) and a goal (3,), ENU m.

    The area contains start and goal with a margin of at least 20 m, in whole cells.

    Raises:
        WorldError: Start and goal are more than 1000 m apart along an axis, or unusable.
    """
    bounds = _area(start_enu_m, goal_enu_m)
    boxes = np.array(
        [
            _cuboid(i, j, pair.size_m)
            for i in _cells(bounds[0], bounds[3])
            for j in _cells(bounds[1], bounds[4])
            if _occupied(pair, seed, i, j)
        ]
    ).reshape(-1, 6)
    for place in (start_enu_m, goal_enu_m):
        boxes = boxes[plan_distance_to_boxes(boxes, place) >= CLEAR_RADIUS_M]
    return World(
        name=name,
        seed=seed,
        boxes_enu_m=boxes,
        bounds_enu_m=bounds,
        start_enu_m=start_enu_m,
        goal_enu_m=goal_enu_m,
    )


def _area(start_enu_m: Vector, goal_enu_m: Vector) -> Vector:
    places = np.array([start_enu_m, goal_enu_m])
    if not np.isfinite(places).all() or (np.ptp(places, axis=0) > MAX_SPAN_M).any():
        raise WorldError(
            f"start {show(start_enu_m)} and goal {show(goal_enu_m)} must be at most "
            f"{MAX_SPAN_M:g} m apart along each axis"
        )
    low = np.floor((places.min(axis=0) - MARGIN_M) / CELL_M) * CELL_M
    high = np.ceil((places.max(axis=0) + MARGIN_M) / CELL_M) * CELL_M
    return np.array([low[0], low[1], 0.0, high[0], high[1], CEILING_M])


def _cells(low_m: float, high_m: float) -> range:
    return range(math.floor(low_m / CELL_M), math.ceil(high_m / CELL_M))


def _occupied(pair: GeneratorParams, seed: int, i: int, j: int) -> bool:
    stream = generator(
        seed, Stream.WORLD, pair.family, f"{pair.density:g}", f"{pair.size_m:g}", i, j
    )
    return bool(stream.random() < pair.density)


def _cuboid(i: int, j: int, size_m: float) -> list[float]:
    x, y, half = (i + 0.5) * CELL_M, (j + 0.5) * CELL_M, size_m / 2.0
    return [x - half, y - half, 0.0, x + half, y + half, UNLIMITED_HEIGHT_M]
