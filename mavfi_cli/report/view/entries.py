"""A flight as a stream of typed, timed entries, which are written for two viewers.

Lengths are in m and angles in rad; positions are in the world frame (ENU). The path of an entry is
its place in the tree that the viewers show, such as `faulty/map`. A newer entry replaces an older
one with the same path.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter, itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from mavfi_cli.autonomy.octree import occupied_leaves
from mavfi_cli.core.types import FloatArray
from mavfi_cli.mission.measures import FlightRecord
from mavfi_cli.mission.progress import Recorder
from mavfi_cli.mission.run_folder import Run
from mavfi_cli.report.drawing import ALARM, FAULT, FLIGHTS, GOAL, OBSTACLE, PLAN

if TYPE_CHECKING:
    import pyarrow as pa


Orders = Mapping[str, Sequence[tuple[Any, float]]]  # input and start stamp of each invocation

_MARKED = {"fault": FAULT, "alarm": ALARM}  # events with a mark at their position
_MAP = "#8b93a1"
_FARTHEST_M = 1e5  # a corrupted position can be anywhere; viewers compute in single precision
_MAP_EVERY_S = 1.0
_PATH_EVERY_TICKS, _PATH_STEP_TICKS = 50, 10  # a path every second, with a point every 0.2 s
_SETPOINT_S = 1.0  # a setpoint is drawn as the motion that it commands in this time
_MARK_M = 0.35
_TALLEST_M = 15.0  # towers of generated worlds are 1000 m high, flights at most 10 m


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """An item that a viewer shows from its stamp until the next entry with the same path.

    Attributes:
        kind, data: type and content of the item.
            `boxes`: centres (n, 3) of solid boxes along the axes: obstacles, voxels of a map.
            `marks`: centres (n, 3) of spheres: the goal, or where something happened.
            `points`: a point cloud (n, 3).
            `line`: a path, a plan or a setpoint through points (n, 3).
            `depth`: a depth frame with the pose of its camera.
            `pose`: position (3,) and yaw of the vehicle, which is level.
            `note`: an event of the flight.
            `values`: the numbers of a control tick by the trace's column names; a number that does
            not exist yet is None.
        size_m: sizes of boxes (n, 3), radius of marks, or width of a line.
    """

    path: str
    stamp_s: float
    kind: str
    data: Any
    colour: str = ""
    size_m: Any = None

    @property
    def urgent(self) -> bool:
        """Whether a `note` reports a fault, an alarm or the end of a node."""
        return self.data.kind in ("fault", "alarm", "node")


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewedFlight:
    """A flight to show in a viewer.

    Attributes:
        name: First part of the paths of its entries, such as "golden".
        recorder: The inputs that its nodes received; None leaves out depth frames, clouds and maps.
    """

    name: str
    run: Run
    recorder: Recorder | None

    @property
    def colour(self) -> str:
        """Colour of the flight's vehicle, path and setpoints, as in all pictures."""
        return FLIGHTS[0 if self.run.record.fault is None else 1]

    def entry(self, name: str, stamp_s: float, kind: str, data: Any, **look: Any) -> Entry:
        """Return an entry of the flight, with the path `name` below the flight's own name."""
        return Entry(path=f"{self.name}/{name}", stamp_s=stamp_s, kind=kind, data=data, **look)

    def line(self, name: str, stamp_s: float, points: FloatArray, **look: Any) -> Entry:
        """Return an entry with a line through points (n, 3), by default in the flight's colour."""
        look = {"colour": self.colour, **look}
        return self.entry(name, stamp_s, "line", _drawable(points), **look)


def entries_of(flights: Sequence[ViewedFlight]) -> Iterator[Entry]:
    """Yield the entries of one or more flights and of their common world, in order of stamps."""
    streams: list[Iterable[Entry]] = [_world(flights[0].run.record)]
    for flight in flights:
        streams += [_plans(flight), _notes(flight), *(_marks(flight, kind) for kind in _MARKED)]
        if flight.run.trace is not None:
            streams += [_ticks(flight, flight.run.trace), _path(flight, flight.run.trace)]
        if flight.recorder is not None:
            orders = flight.recorder.orders
            streams += [_frames(flight, orders), _clouds(flight, orders), _maps(flight, orders)]
    return heapq.merge(*streams, key=attrgetter("stamp_s"))


def _world(record: FlightRecord) -> Iterator[Entry]:
    stamp_s = record.events[0].stamp_s if record.events else 0.0
    boxes = np.array(record.world.get("boxes", ()), dtype=np.float64).reshape(-1, 6)
    low, high = np.split(boxes.clip(max=[math.inf] * 5 + [_TALLEST_M]), 2, axis=1)
    yield Entry(
        path="world/obstacles", stamp_s=stamp_s, kind="boxes", data=(low + high) / 2.0,
        size_m=high - low, colour=OBSTACLE,
    )  # fmt: skip
    if record.goal_enu_m is not None:
        yield Entry(
            path="world/goal", stamp_s=stamp_s, kind="marks", data=np.array([record.goal_enu_m]),
            size_m=_MARK_M, colour=GOAL,
        )  # fmt: skip


# From the record -------------------------------------------------------------------------------


def _plans(flight: ViewedFlight) -> Iterator[Entry]:
    for plan in flight.run.record.plans:
        yield flight.line(
            "plan", plan.stamp_s, np.array(plan.points_enu_m, dtype=float), colour=PLAN, size_m=0.08
        )


def _notes(flight: ViewedFlight) -> Iterator[Entry]:
    for event in flight.run.record.events:
        yield flight.entry("events", event.stamp_s, "note", event)


def _marks(flight: ViewedFlight, kind: str) -> Iterator[Entry]:
    places: list[Sequence[float]] = []
    for event in flight.run.record.events:
        if event.kind == kind and event.position_enu_m:
            places.append(event.position_enu_m)
            look = {"colour": _MARKED[kind], "size_m": _MARK_M}
            yield flight.entry(f"{kind}s", event.stamp_s, "marks", np.array(places), **look)


def _ticks(flight: ViewedFlight, trace: pa.Table) -> Iterator[Entry]:
    """Yield entries with the pose, the setpoint and all states of each control tick."""
    for row in trace.drop_columns(["phase"]).to_pylist():
        stamp_s = row.pop("stamp_s")
        position = np.array([row["x_m"], row["y_m"], row["z_m"]])
        yield flight.entry("vehicle", stamp_s, "pose", (position, row["yaw_rad"]))
        if row["command_vx"] is not None:
            velocity = np.array([row[f"command_v{axis}"] for axis in "xyz"])
            way = np.stack([position, position + _SETPOINT_S * velocity])
            yield flight.line("setpoint", stamp_s, way, size_m=0.1)
        yield flight.entry("states", stamp_s, "values", row)


def _path(flight: ViewedFlight, trace: pa.Table) -> Iterator[Entry]:
    stamps = trace["stamp_s"].to_numpy()
    places = np.column_stack([trace[name].to_numpy() for name in ("x_m", "y_m", "z_m")])
    last = len(stamps) - 1
    for row in sorted({*range(0, last, _PATH_EVERY_TICKS), last} - {-1}):
        points = np.concatenate([places[:row:_PATH_STEP_TICKS], places[row : row + 1]])
        yield flight.line("path", float(stamps[row]), points, size_m=0.15)


def _drawable(points: FloatArray) -> FloatArray:
    """Return the finite ones of the points (n, 3), with coordinates clipped to _FARTHEST_M."""
    points = points.reshape(-1, 3)
    return points[np.isfinite(points).all(axis=1)].clip(-_FARTHEST_M, _FARTHEST_M)


# From what the nodes received --------------------------------------------------------------------


def _frames(flight: ViewedFlight, orders: Orders) -> Iterator[Entry]:
    for frame, start_s in orders.get("point_cloud", ()):
        yield flight.entry("camera", start_s, "depth", frame)


def _clouds(flight: ViewedFlight, orders: Orders) -> Iterator[Entry]:
    for cloud, start_s in orders.get("octomap", ()):
        points = _drawable(cloud.points_enu_m)
        yield flight.entry("cloud", start_s, "points", points, colour=flight.colour)


def _maps(flight: ViewedFlight, orders: Orders) -> Iterator[Entry]:
    """Yield each map used for planning, and the maps that were checked for collisions in between.

    Of the checked maps, at most one is shown per second.
    """
    planned = [(start_s, job[1], True) for job, start_s in orders.get("planner", ())]
    checked = [(at_s, job.snapshot, False) for job, at_s in orders.get("collision_check", ())]
    shown_s = -math.inf
    for start_s, snapshot, wanted in sorted(planned + checked, key=itemgetter(0)):
        if wanted or start_s >= shown_s + _MAP_EVERY_S:
            shown_s = start_s
            leaves = occupied_leaves(snapshot.payload) * snapshot.resolution_m
            sizes = np.repeat(leaves[:, 3:], 3, axis=1)
            look = {"colour": _MAP, "size_m": sizes}
            yield flight.entry("map", start_s, "boxes", leaves[:, :3] + sizes / 2.0, **look)
