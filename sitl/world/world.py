"""A world: axis-aligned boxes on flat ground with a start and a goal."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.errors import WorldError

Vector = NDArray[np.float64]

START_CLEAR_M = 0.5
"""Minimum distance of a start from a box, as the vehicle must be able to stand there."""


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
        _refuse_bad_places(self)


def _refuse_bad_boxes(world: World) -> None:
    if not np.isfinite(world.boxes_enu_m).all():
        raise WorldError(f"world {world.name!r}: a box has a coordinate that is not finite")
    flat = (world.boxes_enu_m[:, 3:] <= world.boxes_enu_m[:, :3]).any(axis=1)
    if flat.any():
        raise WorldError(f"world {world.name!r}: box {int(flat.argmax())} has max <= min")


def _refuse_bad_places(world: World) -> None:
    refuse_bad_start(world.name, world.boxes_enu_m, world.bounds_enu_m, world.start_enu_m)
    refuse_bad_goal(world.name, world.boxes_enu_m, world.bounds_enu_m, world.goal_enu_m)


def refuse_bad_start(name: str, boxes: Vector, bounds: Vector, start: Vector) -> None:
    """Raise WorldError if a start (3,) is outside the bounds (6,) or too near a box (n, 6)."""
    _refuse_outside(name, bounds, "start", start)
    gaps = distance_to_boxes(boxes, start)
    if gaps.size and gaps.min() < START_CLEAR_M:
        raise WorldError(
            f"world {name!r}: start {show(start)} is blocked: box {int(gaps.argmin())} is "
            f"{gaps.min():.2f} m away, {START_CLEAR_M:g} m needed"
        )


def refuse_bad_goal(name: str, boxes: Vector, bounds: Vector, goal: Vector) -> None:
    """Raise WorldError if a goal (3,) is outside the bounds (6,) or inside a box (n, 6)."""
    _refuse_outside(name, bounds, "goal", goal)
    gaps = distance_to_boxes(boxes, goal)
    if gaps.size and gaps.min() <= 0.0:
        raise WorldError(
            f"world {name!r}: goal {show(goal)} is inside an obstacle (box {int(gaps.argmin())})"
        )


def _refuse_outside(name: str, bounds: Vector, what: str, place: Vector) -> None:
    if not inside(bounds, place):
        raise WorldError(
            f"world {name!r}: {what} {show(place)} is outside the world, which reaches "
            f"from {show(bounds[:3])} to {show(bounds[3:])} m"
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
