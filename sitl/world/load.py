"""Loads a world by name, generator spec or file.

A world file is a fixed scene, shipped (`factory`, `farm`) or a user's own:

    name = "yard"                          # optional, default: the file's name
    bounds_enu_m = [-20, -20, 0, 40, 40, 50]
    start_enu_m = [0, 0, 0]                # optional
    goal_enu_m = [30, 30, 5]               # optional

    [[box]]
    min_enu_m = [10, 10, 0]
    max_enu_m = [12, 20, 8]

The seed chooses start and goal if they are not given. They have no obstacle within 3 m
horizontally. The goal is at `flight_height_m` and within `goal_distance_m` of the start. Each seed
of a fixed scene thus gives a different mission.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mavfi_cli.core.config import load_toml, toml_text
from mavfi_cli.core.errors import UnknownName, WorldError
from mavfi_cli.core.frames import Vector
from mavfi_cli.core.seeds import Stream, generator
from sitl.world.world import (
    CLEAR_RADIUS_M,
    DEFAULT_GOAL_ENU_M,
    DEFAULT_START_ENU_M,
    GeneratorParams,
    World,
    generate,
    inside,
    plan_distance_to_boxes,
    refuse_bad_place,
)

SCENE_FOLDER = Path(__file__).parent / "scenes"

GENERATED: dict[str, GeneratorParams] = {
    "sparse": GeneratorParams(density=0.05, size_m=3.0),
    "dense": GeneratorParams(density=0.2, size_m=5.0),
    **{
        f"train-{density:g}-{size:g}": GeneratorParams(
            density=density, size_m=size, family="training"
        )
        for density in (0.05, 0.2)
        for size in (3.0, 5.0)
    },
}
"""Pairs of the paper (section VI-A): two for evaluation, four for training."""

SCENES: tuple[str, ...] = ("factory", "farm")

_TRIES = 2000


def world_names() -> list[str]:
    """Return the names of all worlds, evaluation worlds first."""
    trained = [name for name in GENERATED if name.startswith("train-")]
    return [*(name for name in GENERATED if name not in trained), *SCENES, *trained]


def load_world(
    name_or_path: str,
    *,
    seed: int,
    start_enu_m: Sequence[float] | Vector | None = None,
    goal_enu_m: Sequence[float] | Vector | None = None,
) -> World:
    """Load a world by name, `gen:density,size` or TOML file for one seed.

    Args:
        name_or_path: One of `world_names()`, a generator spec, or a path ending in `.toml`.
        seed: Non-negative seed. The same seed always gives the same world.
        start_enu_m: Start of the flight (3,), m; default: the world's own.
        goal_enu_m: Goal of the flight (3,), m; default: the world's own.

    Raises:
        UnknownName: No world has this name. Suggests the nearest.
        WorldError: Start or goal is outside or blocked, or the generator spec is invalid.
        ConfigError: The file cannot be used. Names file, line and key.
    """
    if seed < 0:
        raise WorldError(f"seed {seed} is negative")
    start, goal = _place("start", start_enu_m), _place("goal", goal_enu_m)
    pair = GENERATED.get(name_or_path) or _pair_of_spec(name_or_path)
    if pair is not None:
        start = np.array(DEFAULT_START_ENU_M) if start is None else start
        goal = np.array(DEFAULT_GOAL_ENU_M) if goal is None else goal
        return generate(name_or_path, pair, seed, start, goal)
    if name_or_path in SCENES:
        scene = read_scene(SCENE_FOLDER / f"{name_or_path}.toml")
        return _world_of_scene(scene, name_or_path, seed, start, goal)
    if not _is_path(name_or_path):
        raise UnknownName("world", name_or_path, world_names())
    scene = read_scene(Path(name_or_path))
    return _world_of_scene(scene, scene.name or Path(name_or_path).stem, seed, start, goal)


def _place(what: str, place: Sequence[float] | Vector | None) -> Vector | None:
    if place is None:
        return None
    array = np.asarray(place, dtype=np.float64)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise WorldError(f"{what} must be three finite numbers (east, north, up in m)")
    return array


def _is_path(text: str) -> bool:
    return text.endswith(".toml") or "/" in text


def _pair_of_spec(text: str) -> GeneratorParams | None:
    """Parse `gen:density,size`. Return None if the text is not such a spec."""
    if not text.startswith("gen:"):
        return None
    try:
        density, size = (float(part) for part in text.removeprefix("gen:").split(","))
    except ValueError:
        raise WorldError(f"{text!r}: expected gen:density,size, such as gen:0.2,5") from None
    return GeneratorParams(density=density, size_m=size)


_Triple = tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Box:
    """One obstacle with its corners in ENU, m."""

    min_enu_m: _Triple
    max_enu_m: _Triple

    def __post_init__(self) -> None:
        if any(high <= low for low, high in zip(self.min_enu_m, self.max_enu_m, strict=True)):
            raise ValueError("max_enu_m must be beyond min_enu_m along each axis")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Scene:
    bounds_enu_m: tuple[float, float, float, float, float, float]
    name: str = ""
    description: str = ""
    start_enu_m: _Triple | None = None
    goal_enu_m: _Triple | None = None
    flight_height_m: float = 5.0
    goal_distance_m: tuple[float, float] = (45.0, 55.0)  # horizontal limits, start to goal
    box: list[_Box] = field(default_factory=list)


def read_scene(path: Path) -> _Scene:
    """Read a world file.

    Raises:
        ConfigError: The file is unreadable or malformed, a key is missing or unknown, the number
            of coordinates is wrong, or the max of a box is not beyond its min. Names file, line and
            key.
    """
    return load_toml(path, _Scene)


def _world_of_scene(
    scene: _Scene, name: str, seed: int, start_enu_m: Vector | None, goal_enu_m: Vector | None
) -> World:
    """Return the world of a scene. A given start or goal replaces the scene's own.

    Raises:
        WorldError: Start or goal is unusable, or the seed finds no clear position for it.
    """
    boxes = np.array([[*b.min_enu_m, *b.max_enu_m] for b in scene.box]).reshape(-1, 6)
    bounds = np.array(scene.bounds_enu_m, dtype=np.float64)
    if (bounds[3:] <= bounds[:3]).any():
        raise WorldError(f"world {name!r}: bounds_enu_m has max <= min")
    start = _place("start", scene.start_enu_m) if start_enu_m is None else start_enu_m
    goal = _place("goal", scene.goal_enu_m) if goal_enu_m is None else goal_enu_m
    if start is None or goal is None:
        for what, place in (("start", start), ("goal", goal)):
            if place is not None:
                refuse_bad_place(name, boxes, bounds, what, place)
        start, goal = _choose(scene, name, seed, boxes, bounds, start, goal)
    return World(
        name=name,
        seed=seed,
        boxes_enu_m=boxes,
        bounds_enu_m=bounds,
        start_enu_m=start,
        goal_enu_m=goal,
    )


def _choose(
    scene: _Scene,
    name: str,
    seed: int,
    boxes: Vector,
    bounds: Vector,
    start: Vector | None,
    goal: Vector | None,
) -> tuple[Vector, Vector]:
    """Draw missing start and goal until they are clear and at the scene's distance."""
    stream = generator(seed, Stream.WORLD, "places", scene.name)
    least, most = scene.goal_distance_m
    low, high = bounds[:2] + CLEAR_RADIUS_M, bounds[3:5] - CLEAR_RADIUS_M
    for _ in range(_TRIES):
        plan = np.round(stream.uniform(low, np.maximum(low, high), size=(2, 2)), 1)
        from_ = start if start is not None else np.array([*plan[0], bounds[2]])
        to = goal if goal is not None else np.array([*plan[1], scene.flight_height_m])
        drawn = [p for p, known in ((from_, start), (to, goal)) if known is None]
        if least <= float(np.hypot(*(to - from_)[:2])) <= most and all(
            _is_clear(boxes, bounds, place) for place in drawn
        ):
            return from_, to
    raise WorldError(
        f"world {name!r}, seed {seed}: no clear start and goal {least:g} to {most:g} m apart; "
        "give start_enu_m and goal_enu_m"
    )


def _is_clear(boxes: Vector, bounds: Vector, place: Vector) -> bool:
    gaps = plan_distance_to_boxes(boxes, place)
    return inside(bounds, place) and bool((gaps >= CLEAR_RADIUS_M).all())


def scene_toml(world: World) -> str:
    """Return a world as the text of a world file, which reads back as the same world."""
    boxes = [
        {"min_enu_m": box[:3].tolist(), "max_enu_m": box[3:].tolist()} for box in world.boxes_enu_m
    ]
    values = {
        "name": world.name,
        "bounds_enu_m": world.bounds_enu_m.tolist(),
        "start_enu_m": world.start_enu_m.tolist(),
        "goal_enu_m": world.goal_enu_m.tolist(),
    }
    return toml_text({**values, "box": boxes} if boxes else values)
