"""Flights in rerun: in its viewer, or as an .rrd file that it opens."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from matplotlib.colors import to_rgb

from mavfi_cli.core.files import write_atomically
from mavfi_cli.core.types import Stage
from mavfi_cli.report.view.entries import Entry, ViewedFlight, entries_of

_TIME = "simulated_time"
_BODY_M = (0.25, 0.25, 0.08)  # half sizes of the box that stands for the vehicle
_WIDTH, _FAULTY_WIDTH = 1.5, 4.0  # of lines in plots; golden ones are drawn on top
_VEHICLE = {  # plots of columns that are not states
    "position": ("x_m", "y_m", "z_m"),
    "velocity": ("vx_mps", "vy_mps", "vz_mps"),
    "clearance": ("truth_clearance_m",),
    "power": ("power_regression_w", "power_propeller_w"),
}


def write_rrd(flights: Sequence[ViewedFlight], path: Path | None) -> None:
    """Write flights to an .rrd file, atomically, or open them in rerun's viewer if `path` is None.

    Raises:
        RecordError: The file could not be written.
    """
    name = flights[-1].run.folder.path.resolve().name
    recording = rr.RecordingStream("mavfi", recording_id=name)
    if path is None:
        recording.spawn()
        _log(recording, flights)
        recording.flush()
        return
    stream = recording.binary_stream()
    try:
        _log(recording, flights)
    finally:  # otherwise rerun warns about unread data
        data = stream.read(flush=True) or b""
    write_atomically(path, lambda file: file.write(data))


def _log(recording: Any, flights: Sequence[ViewedFlight]) -> None:
    recording.send_blueprint(_blueprint(flights))
    recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for flight in flights:
        body = rr.Boxes3D(half_sizes=[_BODY_M], colors=[to_rgb(flight.colour)], fill_mode="solid")
        recording.log(f"{flight.name}/vehicle", body, static=True)
    _log_entries(
        recording, entries_of(flights), {f"{flight.name}/states": flight for flight in flights}
    )


def _log_entries(
    recording: Any, entries: Iterable[Entry], drawn: Mapping[str, ViewedFlight]
) -> None:
    """Log all entries one by one, except the numbers of ticks, which follow column by column.

    Args:
        drawn: The flight whose numbers are logged at each path. It determines the colour and the
            width of their lines.
    """
    numbers: dict[str, list[Entry]] = {}
    for entry in entries:
        if entry.kind == "values":
            numbers.setdefault(entry.path, []).append(entry)
            continue
        recording.set_time(_TIME, duration=entry.stamp_s)
        for path, archetype in _archetypes(entry):
            recording.log(path, archetype)
    for path, ticks in numbers.items():
        for name in ticks[0].data:
            cells = [(tick.stamp_s, tick.data[name]) for tick in ticks]
            known = [(stamp_s, float(value)) for stamp_s, value in cells if value is not None]
            if known:
                stamps, values = zip(*known, strict=True)
                flight = drawn[path]
                width = _FAULTY_WIDTH if flight.run.record.fault else _WIDTH
                line = rr.SeriesLines(
                    colors=[to_rgb(flight.colour)], widths=[width], names=[f"{flight.name} {name}"]
                )
                recording.log(f"{path}/{name}", line, static=True)
                time = rr.TimeColumn(_TIME, duration=stamps)
                recording.send_columns(f"{path}/{name}", [time], rr.Scalars.columns(scalars=values))


def _archetypes(entry: Entry) -> Iterator[tuple[str, Any]]:
    """Yield the rerun archetypes that show an entry, each with its path."""
    data, colours = entry.data, [to_rgb(entry.colour)] if entry.colour else None
    archetype: Any
    match entry.kind:
        case "boxes":
            archetype = rr.Boxes3D(
                centers=data, half_sizes=entry.size_m / 2.0, colors=colours, fill_mode="solid"
            )
        case "marks":
            archetype = rr.Points3D(data, radii=[entry.size_m], colors=colours)
        case "points":
            archetype = rr.Points3D(data, radii=[0.03], colors=colours)
        case "line":
            archetype = rr.LineStrips3D([data], radii=[entry.size_m / 2.0], colors=colours)
        case "pose":
            turn = rr.RotationAxisAngle(axis=(0.0, 0.0, 1.0), radians=data[1])
            archetype = rr.Transform3D(translation=data[0], rotation=turn)
        case "note":
            level = "WARN" if entry.urgent else "INFO"
            archetype = rr.TextLog(f"{data.kind}: {data.text}", level=level)
        case "depth":
            yield from _camera(entry)
            return
    yield entry.path, archetype


def _camera(entry: Entry) -> Iterator[tuple[str, Any]]:
    """Yield the camera's pose, its pinhole model, and the depth image, each with its path.

    Pixels without a measurement are 0.
    """
    frame = entry.data
    rows, columns = frame.depth_m.shape
    w, x, y, z = frame.quaternion
    depth_m = np.where(np.isfinite(frame.depth_m), frame.depth_m, 0.0).astype(np.float32)
    yield entry.path, rr.Transform3D(translation=frame.position_enu_m, quaternion=[x, y, z, w])
    yield (
        entry.path,
        rr.Pinhole(
            focal_length=columns / 2.0 / math.tan(frame.hfov_rad / 2.0),
            width=columns,
            height=rows,
            camera_xyz=rr.ViewCoordinates.FLU,
            image_plane_distance=1.0,
        ),
    )
    yield f"{entry.path}/depth", rr.DepthImage(depth_m, meter=1.0)


def _blueprint(flights: Sequence[ViewedFlight]) -> Any:
    """Return the layout of rerun's window.

    World, cameras and events are on the left. On the right is a tab of plots for each stage, and
    one for the vehicle.
    """
    names = [flight.name for flight in flights]

    def plots(groups: dict[str, Sequence[str]]) -> list[Any]:
        return [
            rrb.TimeSeriesView(
                name=group,
                contents=[f"/{name}/states/{state}" for name in names for state in states],
            )
            for group, states in groups.items()
        ]

    tabs = [rrb.Vertical(*plots(_groups(stage)), name=stage.value) for stage in Stage]
    cameras = [rrb.Spatial2DView(origin=f"/{name}/camera", name=f"{name}: depth") for name in names]
    events = rrb.TextLogView(contents=[f"/{name}/events" for name in names], name="events")
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                rrb.Spatial3DView(name="world", eye_controls=_eye(flights[0])),
                rrb.Horizontal(*cameras, events, column_shares=[1.0] * len(cameras) + [2.0]),
                row_shares=[3, 1],
            ),
            rrb.Tabs(*tabs, rrb.Vertical(*plots(dict(_VEHICLE)), name="vehicle")),
            column_shares=[3, 2],
        ),
        collapse_panels=True,
    )


def _eye(flight: ViewedFlight) -> Any:
    """Return a view from above and the south-west of the middle between start and goal.

    Return None if the start or the goal is unknown.
    """
    record = flight.run.record
    start, goal = record.world.get("start"), record.goal_enu_m
    if start is None or goal is None:
        return None
    middle, far_m = np.add(start, goal) / 2.0, math.dist(start, goal)
    away = far_m * np.array([-0.6, -0.8, 0.8])
    return rrb.EyeControls3D(position=middle + away, look_target=middle)


def _groups(stage: Stage) -> dict[str, Sequence[str]]:
    groups: dict[str, Sequence[str]] = {}
    for state in stage.states:
        groups[state.group] = (*groups.get(state.group, ()), state.name)
    return groups
