"""A world: axis-aligned boxes on flat ground with a start and a goal, generated or from a file.

The paper's generator has two parameters (section VI-A). With probability `density`, a cell of
10 x 10 m contains a `size` x `size` m cuboid of unlimited height at its centre. Each cell draws
from its own random stream (seed, family, density, size, cell), so a larger area only adds obstacles
and never moves the others.

A world file is a fixed scene, shipped (`factory`, `farm`) or a user's own:

    name = "yard"                          # optional, default: the file's name
    bounds_enu_m = [-20, -20, 0, 40, 40, 50]
    start_enu_m = [0, 0, 0]                # optional
    goal_enu_m = [30, 30, 5]               # optional

    [[box]]
    min_enu_m = [10, 10, 0]
    max_enu_m = [12, 20, 8]

The seed chooses start and goal if they are not given. Both are at least 3 m horizontally from every
obstacle. The goal is at `flight_height_m` and within `goal_distance_m` of the start. Each seed
of a fixed scene thus gives a different mission.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mavfi_cli.core.config import load_toml, toml_text
from mavfi_cli.core.errors import PlaceError, UnknownName, WorldError
from mavfi_cli.core.files import write_json, writing
from mavfi_cli.core.frames import Vector
from mavfi_cli.core.seeds import Stream
from mavfi_cli.core.types import Briefing

CLEAR_RADIUS_M = 3.0  # minimum horizontal distance of an obstacle from start and goal
_START_CLEAR_M = 0.5  # minimum distance of a start from a box, so that the vehicle fits there
_CELL_M = 10.0
_MARGIN_M = 20.0
_UNLIMITED_HEIGHT_M = 1000.0  # a 300 s mission can climb 900 m at 3 m/s
_CEILING_M = 50.0
_MAX_SPAN_M = 1000.0
_TRIES = 2000

_SCENES = ("factory", "farm")
_DEFAULT_START_ENU_M = np.array([0.0, 0.0, 0.0])
_DEFAULT_GOAL_ENU_M = np.array([30.0, 40.0, 5.0])


def format_place(place: Vector) -> str:
    """Return a point as text, such as `(30, 40, 5)`."""
    return "(" + ", ".join(f"{float(c):g}" for c in place) + ")"


def distance_to_boxes(boxes_enu_m: Vector, place_enu_m: Vector, *, plan: bool = False) -> Vector:
    """Return the distance in metres from a point to each box, as an array of shape (n,).

    The boxes have shape (n, 6) and the point has shape (3,). The distance to a box that contains
    the point is zero. With `plan`, distances are horizontal.
    """
    apart = np.maximum(boxes_enu_m[:, :3] - place_enu_m, place_enu_m - boxes_enu_m[:, 3:])
    apart = np.maximum(0.0, apart)
    if plan:
        apart[:, 2] = 0.0
    gaps: Vector = np.linalg.norm(apart, axis=1)
    return gaps


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class World:
    """Boxes, bounds, start and goal in ENU. The ground is the plane z = 0.

    Raises:
        PlaceError: Start or goal is outside the bounds or blocked.
        WorldError: A box has no volume, or a coordinate that is not finite.
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
        if not np.isfinite(self.boxes_enu_m).all():
            raise WorldError(f"world {self.name!r}: a box has a coordinate that is not finite")
        flat = (self.boxes_enu_m[:, 3:] <= self.boxes_enu_m[:, :3]).any(axis=1)
        if flat.any():
            raise WorldError(
                f"world {self.name!r}: the maximum of box {int(flat.argmax())} must be above its "
                "minimum on every axis"
            )
        for what, place in (("start", self.start_enu_m), ("goal", self.goal_enu_m)):
            _refuse_bad_place(self.name, self.boxes_enu_m, self.bounds_enu_m, what, place)

    def as_dict(self) -> dict[str, Any]:
        """Return the world as a dict for a record in JSON, with lengths in metres."""
        keys = ("bounds", "start", "goal", "boxes")
        arrays = {key: getattr(self, f"{key}_enu_m").tolist() for key in keys}
        return {"name": self.name, "seed": self.seed, **arrays}

    def toml(self) -> str:
        """Return the text of a TOML file that describes this world, for `load_world` to read."""
        keys = ("bounds_enu_m", "start_enu_m", "goal_enu_m")
        places = {key: getattr(self, key).tolist() for key in keys}
        boxes = [{"min_enu_m": box[:3], "max_enu_m": box[3:]} for box in self.boxes_enu_m.tolist()]
        return toml_text({"name": self.name, **places, **({"box": boxes} if boxes else {})})

    def briefing(self, camera_mount_flu_m: Sequence[float]) -> Briefing:
        """Return the briefing, which the companion gets before its first message."""
        places = (self.start_enu_m, self.goal_enu_m, self.bounds_enu_m, camera_mount_flu_m)
        start, goal, bounds, mount = (np.array(place, np.float64) for place in places)
        return Briefing(
            start_enu_m=start, goal_enu_m=goal, bounds_enu_m=bounds, camera_offset_flu_m=mount
        )

    def write_briefing(self, camera_mount_flu_m: Sequence[float], folder: Path) -> None:
        """Write the briefing to `briefing.json` in a folder, which is created if necessary.

        Raises RecordError if the file cannot be written.
        """
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
        briefing = dataclasses.asdict(self.briefing(camera_mount_flu_m))
        del briefing["hfov_rad"]  # the camera reports its own
        write_json(folder / "briefing.json", briefing)


def _refuse_bad_place(name: str, boxes: Vector, bounds: Vector, what: str, place: Vector) -> None:
    """Raise PlaceError if a place (3,) is outside the bounds (6,) or blocked by a box (n, 6).

    `what` is "start" or "goal". A start is blocked if a box is too close for the vehicle to stand
    there, and a goal is blocked if it is inside a box.
    """
    subject = f"world {name!r}: {what} {format_place(place)}"
    if not _inside(bounds, place):
        raise PlaceError(
            f"{subject} is outside the world, which reaches "
            f"from {format_place(bounds[:3])} to {format_place(bounds[3:])} m"
        )
    gaps = distance_to_boxes(boxes, place)
    if not gaps.size:
        return
    gap_m, box = gaps.min(), int(gaps.argmin())
    if what == "start" and gap_m < _START_CLEAR_M:
        raise PlaceError(
            f"{subject} is blocked: its distance from box {box} must be at least "
            f"{_START_CLEAR_M:g} m, got {gap_m:.2f} m"
        )
    if what == "goal" and gap_m <= 0.0:
        raise PlaceError(f"{subject} is inside an obstacle (box {box})")


def _inside(bounds_enu_m: Vector, place_enu_m: Vector) -> bool:
    """Return True if a point (3,) is within the bounds (6,) or on one of their faces.

    A point that contains NaN is outside.
    """
    return bool((place_enu_m >= bounds_enu_m[:3]).all() and (place_enu_m <= bounds_enu_m[3:]).all())


def load_world(
    name_or_path: str,
    *,
    seed: int,
    start_enu_m: Sequence[float] | Vector | None = None,
    goal_enu_m: Sequence[float] | Vector | None = None,
) -> World:
    """Load a world from its name, `gen:density,size` or the path of a TOML file, for one seed.

    The same seed always gives the same world. `start_enu_m` and `goal_enu_m`, of shape (3,),
    replace the world's own start and goal.

    Raises:
        UnknownName: No world has this name. The message suggests the nearest name.
        PlaceError: Start or goal is outside the world or blocked.
        WorldError: The seed or the generator's parameters are invalid, or the seed gives no start
            and goal in a fixed scene.
        ConfigError: The file cannot be used. The message names file, line and key.
    """
    if seed < 0:
        raise WorldError(f"seed must be at least 0, got {seed}")
    start, goal = _place("start", start_enu_m), _place("goal", goal_enu_m)
    pair = _GENERATED.get(name_or_path) or _pair_of_spec(name_or_path)
    if pair is not None:
        start = _DEFAULT_START_ENU_M if start is None else start
        goal = _DEFAULT_GOAL_ENU_M if goal is None else goal
        return _generate(name_or_path, pair, seed, start, goal)
    if name_or_path in _SCENES:
        return _world_of_scene(_shipped(name_or_path), name_or_path, seed, start, goal)
    if not (name_or_path.endswith(".toml") or "/" in name_or_path):
        raise UnknownName("world", name_or_path, named_worlds())
    scene = load_toml(Path(name_or_path), _Scene)
    return _world_of_scene(scene, scene.name or Path(name_or_path).stem, seed, start, goal)


def named_worlds() -> dict[str, str]:
    """Return the descriptions of all named worlds, keyed by name. Evaluation worlds come first."""
    towers = {
        name: f"towers of {pair.size_m:g} x {pair.size_m:g} m in {100 * pair.density:g} % "
        "of the 10 x 10 m cells"
        for name, pair in _GENERATED.items()
    }
    trained = {name: text for name, text in towers.items() if name.startswith("train-")}
    return {
        **{name: text for name, text in towers.items() if name not in trained},
        **{name: f"fixed scene: {_shipped(name).description}" for name in _SCENES},
        **{name: f"to train detectors on: {text}" for name, text in trained.items()},
    }


def _place(what: str, place: Sequence[float] | Vector | None) -> Vector | None:
    if place is None:
        return None
    array = np.asarray(place, dtype=np.float64)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise PlaceError(f"{what} must be three finite numbers (east, north, up in m), got {place}")
    return array


# Generated worlds ---------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class _Pair:
    """The two parameters of the world generator, and the family of its random streams."""

    density: float  # probability that a cell contains an obstacle
    size_m: float  # side of the cuboid
    family: str = "evaluation"  # or "training"; the families have no world in common

    def __post_init__(self) -> None:
        if not 0.0 <= self.density <= 1.0:
            problem = f"density must be between 0 and 1, got {self.density:g}"
            raise WorldError(problem).as_usage()
        if not 0.0 < self.size_m <= _CELL_M:
            limits = f"above 0 and at most {_CELL_M:g} m"
            raise WorldError(f"size must be {limits}, got {self.size_m:g}").as_usage()


# Pairs of the paper (section VI-A): two for evaluation, four for training.
_GENERATED = {
    "sparse": _Pair(density=0.05, size_m=3.0),
    "dense": _Pair(density=0.2, size_m=5.0),
    **{
        f"train-{density:g}-{size:g}": _Pair(density=density, size_m=size, family="training")
        for density in (0.05, 0.2)
        for size in (3.0, 5.0)
    },
}


def _pair_of_spec(text: str) -> _Pair | None:
    if not text.startswith("gen:"):
        return None
    try:
        density, size = (float(part) for part in text.removeprefix("gen:").split(","))
    except ValueError:
        problem = f"world must be gen:density,size, such as gen:0.2,5, got {text!r}"
        raise WorldError(problem).as_usage() from None
    return _Pair(density=density, size_m=size)


def _generate(name: str, pair: _Pair, seed: int, start: Vector, goal: Vector) -> World:
    """Generate a world around a start (3,) and a goal (3,), in ENU m.

    The area consists of whole cells, and extends at least 20 m beyond start and goal.
    """
    places = np.array([start, goal])
    if (np.ptp(places, axis=0) > _MAX_SPAN_M).any():
        raise PlaceError(
            f"start {format_place(start)} and goal {format_place(goal)} must be at most "
            f"{_MAX_SPAN_M:g} m apart along each axis"
        )
    low = np.floor((places.min(axis=0) - _MARGIN_M) / _CELL_M)[:2]
    high = np.ceil((places.max(axis=0) + _MARGIN_M) / _CELL_M)[:2]
    cells = itertools.product(*(range(int(a), int(b)) for a, b in zip(low, high, strict=True)))
    cuboids = [_cuboid(i, j, pair.size_m) for i, j in cells if _occupied(pair, seed, i, j)]
    boxes = np.array(cuboids).reshape(-1, 6)
    for place in (start, goal):
        boxes = boxes[distance_to_boxes(boxes, place, plan=True) >= CLEAR_RADIUS_M]
    return World(
        name=name, seed=seed, boxes_enu_m=boxes, start_enu_m=start, goal_enu_m=goal,
        bounds_enu_m=np.array([*low * _CELL_M, 0.0, *high * _CELL_M, _CEILING_M]),
    )  # fmt: skip


def _occupied(pair: _Pair, seed: int, i: int, j: int) -> bool:
    numbers = f"{pair.density:g}", f"{pair.size_m:g}"
    stream = Stream.WORLD.generator(seed, pair.family, *numbers, i, j)
    return bool(stream.random() < pair.density)


def _cuboid(i: int, j: int, size_m: float) -> list[float]:
    x, y, half = (i + 0.5) * _CELL_M, (j + 0.5) * _CELL_M, size_m / 2.0
    return [x - half, y - half, 0.0, x + half, y + half, _UNLIMITED_HEIGHT_M]


# Fixed scenes -------------------------------------------------------------------------------------

_Triple = tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Box:
    """One obstacle: a box, given by its lowest and its highest corner in ENU m."""

    min_enu_m: _Triple
    max_enu_m: _Triple

    def __post_init__(self) -> None:
        if any(high <= low for low, high in zip(self.min_enu_m, self.max_enu_m, strict=True)):
            raise ValueError(
                f"max_enu_m must be above min_enu_m {self.min_enu_m} on every axis, "
                f"got {self.max_enu_m}"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Scene:
    bounds_enu_m: tuple[float, float, float, float, float, float]
    name: str = ""
    description: str = ""
    start_enu_m: _Triple | None = None
    goal_enu_m: _Triple | None = None
    flight_height_m: float = 5.0
    goal_distance_m: tuple[float, float] = (45.0, 55.0)  # horizontal limits, start to goal
    box: list[_Box] = dataclasses.field(default_factory=list)


def _shipped(name: str) -> _Scene:
    return load_toml(Path(__file__).parent / "scenes" / f"{name}.toml", _Scene)


def _world_of_scene(
    scene: _Scene, name: str, seed: int, start: Vector | None, goal: Vector | None
) -> World:
    """Return the world of a scene. A given start or goal (3,) replaces the scene's own."""
    boxes = np.array([[*b.min_enu_m, *b.max_enu_m] for b in scene.box]).reshape(-1, 6)
    bounds = np.array(scene.bounds_enu_m, dtype=np.float64)
    if (bounds[3:] <= bounds[:3]).any():
        raise WorldError(
            f"world {name!r}: the maximum of bounds_enu_m must be above its minimum on every axis, "
            f"got {bounds.tolist()}"
        )
    start = _place("start", scene.start_enu_m) if start is None else start
    goal = _place("goal", scene.goal_enu_m) if goal is None else goal
    if start is None or goal is None:
        for what, place in (("start", start), ("goal", goal)):
            if place is not None:
                _refuse_bad_place(name, boxes, bounds, what, place)
        start, goal = _choose(scene, name, seed, boxes, bounds, start, goal)
    return World(
        name=name, seed=seed, boxes_enu_m=boxes, bounds_enu_m=bounds, start_enu_m=start,
        goal_enu_m=goal,
    )  # fmt: skip


def _choose(
    scene: _Scene,
    name: str,
    seed: int,
    boxes: Vector,
    bounds: Vector,
    start: Vector | None,
    goal: Vector | None,
) -> tuple[Vector, Vector]:
    stream = Stream.WORLD.generator(seed, "places", scene.name)
    least, most = scene.goal_distance_m
    low, high = bounds[:2] + CLEAR_RADIUS_M, bounds[3:5] - CLEAR_RADIUS_M
    for _ in range(_TRIES):
        plan = np.round(stream.uniform(low, np.maximum(low, high), size=(2, 2)), 1)
        from_ = start if start is not None else np.array([*plan[0], bounds[2]])
        to = goal if goal is not None else np.array([*plan[1], scene.flight_height_m])
        drawn = [p for p, known in ((from_, start), (to, goal)) if known is None]
        if least <= float(np.hypot(*(to - from_)[:2])) <= most and all(
            _inside(bounds, place)
            and (distance_to_boxes(boxes, place, plan=True) >= CLEAR_RADIUS_M).all()
            for place in drawn
        ):
            return from_, to
    raise WorldError(
        f"world {name!r}, seed {seed}: found no start and goal that are {least:g} to {most:g} m "
        "apart and clear of obstacles; set start_enu_m and goal_enu_m"
    )
