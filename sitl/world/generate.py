"""The paper's environment generator: each 10 x 10 m cell contains one cuboid or none.

The generator has two numbers (paper, section VI-A). With probability `density`, a cell contains a
`size` x `size` m cuboid of unlimited height at its centre.

Each cell draws from its own random stream (seed, family, density, size, cell), so a larger area
only adds obstacles and never moves the others.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.errors import WorldError
from mavfi_cli.core.seeds import Stream, generator
from sitl.world.world import World, plan_distance_to_boxes, show

Vector = NDArray[np.float64]

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
