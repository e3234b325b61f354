"""Loads a world by name, generator spec or file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mavfi_cli.core.errors import UnknownName, WorldError
from sitl.world.generate import DEFAULT_GOAL_ENU_M, DEFAULT_START_ENU_M, GeneratorParams, generate
from sitl.world.scene import read_scene, world_of_scene
from sitl.world.world import Vector, World

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
        return world_of_scene(scene, name_or_path, seed, start, goal)
    if not _is_path(name_or_path):
        raise UnknownName("world", name_or_path, world_names())
    scene = read_scene(Path(name_or_path))
    return world_of_scene(scene, scene.name or Path(name_or_path).stem, seed, start, goal)


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
