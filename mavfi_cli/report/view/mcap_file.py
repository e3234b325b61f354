"""Flights as an MCAP file for Foxglove, in Foxglove's own schemas.

The states of a tick are one JSON object, because Foxglove has no schema for them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import repeat
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CubePrimitive_pb2 import CubePrimitive
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.Point3_pb2 import Point3
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.Pose_pb2 import Pose as PoseMessage
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.SpherePrimitive_pb2 import SpherePrimitive
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.message import Message
from google.protobuf.timestamp_pb2 import Timestamp
from matplotlib.colors import to_rgb
from mcap.writer import Writer
from mcap_protobuf.schema import register_schema

from mavfi_cli.core.files import plain, write_atomically, write_json
from mavfi_cli.core.types import FloatArray
from mavfi_cli.link.tlog import EPOCH_UNIX_S, unix_time_of_stamp_0
from mavfi_cli.report.view.entries import Entry, ViewedFlight, entries_of

_STATES = "mavfi.States"  # schema of the states of a tick
_WORLD = "world"  # the frame of all positions
_SHOWN = ("path", "plan", "setpoint", "vehicle", "map", "faults", "alarms")
_PLOTS = {
    "position": ("x_m", "y_m", "z_m"),
    "waypoint": ("waypoint_x", "waypoint_y", "waypoint_z"),
    "command": ("command_vx", "command_vy", "command_vz"),
}
_AXES = [
    PackedElementField(name=name, offset=4 * place, type=PackedElementField.FLOAT32)
    for place, name in enumerate("xyz")
]


def write_mcap(flights: Sequence[ViewedFlight], path: Path) -> None:
    """Write flights as an MCAP file, atomically. Equal flights give equal bytes.

    Times are the same as in the first flight's tlog: stamp 0 is EPOCH_UNIX_S or, for a foreign
    autopilot, the Unix time at which its clock was 0.

    Raises:
        RecordError: The file could not be written, or the tlog of a foreign flight could not be
            read.
    """
    run, entries = flights[0].run, entries_of(flights)
    if run.record.config.get("link") is not None:
        later_s = unix_time_of_stamp_0(run.folder.tlog) - EPOCH_UNIX_S
        entries = (replace(entry, stamp_s=entry.stamp_s + later_s) for entry in entries)
    write_atomically(path, lambda file: _write(entries, _metadata(flights), file))


def _write(
    entries: Iterable[Entry], metadata: Mapping[str, Mapping[str, object]], file: BinaryIO
) -> None:
    writer = Writer(file)
    writer.start(library="mavfi")
    schemas: dict[str, int] = {}
    channels: dict[str, int] = {}
    for entry in entries:
        time_ns = _time_ns(entry)
        for topic, message in _messages(entry):
            if topic not in channels:
                channels[topic] = _channel(writer, schemas, topic, message)
            writer.add_message(channels[topic], time_ns, _encoded(message), time_ns)
    for name, values in metadata.items():
        texts = {
            key: value if isinstance(value, str) else _json(value) for key, value in values.items()
        }
        writer.add_metadata(name, texts)
    writer.finish()


def _metadata(flights: Sequence[ViewedFlight]) -> dict[str, Mapping[str, object]]:
    """Return the missions, seeds, versions and faults of flights as metadata records, by name."""
    records: dict[str, Mapping[str, object]] = {}
    for flight in flights:
        record = flight.run.record
        end = {"outcome": record.outcome, "reason": record.reason}
        records[f"{flight.name}/mission"] = {**record.config, **end}
        records[f"{flight.name}/seeds"] = record.seeds
        records[f"{flight.name}/versions"] = record.versions
        if (fault := record.recorded_fault) is not None:
            records[f"{flight.name}/fault"] = fault
    return records


def write_layout(flights: Sequence[ViewedFlight], path: Path) -> None:
    """Write a Foxglove layout that shows the MCAP file of these flights.

    Its panels show the world, the camera of the last flight, its events, and three plots of states.

    Raises:
        RecordError: The file could not be written.
    """
    names = [flight.name for flight in flights]
    topics = ["/world/obstacles", "/world/goal"]
    topics += [f"/{name}/{topic}" for name in names for topic in _SHOWN]
    panels: dict[str, Any] = {
        "3D!world": {
            "followTf": _WORLD,
            "followMode": "follow-none",
            "topics": {topic: {"visible": True} for topic in topics},
        },
        "Image!camera": {
            "imageMode": {
                "imageTopic": f"/{names[-1]}/camera/depth",
                "calibrationTopic": f"/{names[-1]}/camera/calibration",
            }
        },
        "RosOut!events": {"topicToRender": f"/{names[-1]}/events"},
    }
    for title, columns in _PLOTS.items():
        paths = [f"/{name}/states.{column}" for column in columns for name in names]
        panels[f"Plot!{title}"] = {
            "title": title,
            "xAxisVal": "timestamp",
            "isSynced": True,
            "paths": [
                {"value": path, "enabled": True, "timestampMethod": "receiveTime"} for path in paths
            ],
        }
    places = [*panels]
    layout = {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _halves(
            "row", 60,
            _halves("column", 65, places[0], _halves("row", 50, *places[1:3])),
            _halves("column", 33, places[3], _halves("column", 50, *places[4:6])),
        ),
    }  # fmt: skip
    write_json(path, layout)


def _halves(direction: str, percent: int, first: Any, second: Any) -> dict[str, Any]:
    return {
        "direction": direction, "splitPercentage": percent, "first": first, "second": second,
    }  # fmt: skip


def _time_ns(entry: Entry) -> int:
    return EPOCH_UNIX_S * 10**9 + round(entry.stamp_s * 1e9)


def _encoded(message: Message | dict[str, Any]) -> bytes:
    if isinstance(message, Message):
        data: bytes = message.SerializeToString(deterministic=True)
        return data
    return _json(message).encode()


def _json(value: Any) -> str:
    return json.dumps(plain(value), allow_nan=False)


def _channel(
    writer: Writer, schemas: dict[str, int], topic: str, message: Message | dict[str, Any]
) -> int:
    if isinstance(message, Message):
        encoding, name = "protobuf", message.DESCRIPTOR.full_name
        if name not in schemas:
            schemas[name] = register_schema(writer, type(message))
    else:
        encoding, name = "json", _STATES
        if name not in schemas:
            schemas[name] = writer.register_schema(name, "jsonschema", _schema(message))
    channel: int = writer.register_channel(topic, encoding, schemas[name])
    return channel


def _schema(message: dict[str, Any]) -> bytes:
    properties = {name: {"type": ["number", "boolean", "null"]} for name in message}
    return json.dumps({"type": "object", "properties": properties}).encode()


def _messages(entry: Entry) -> Iterator[tuple[str, Message | dict[str, Any]]]:
    """Yield the Foxglove messages that show an entry, each with its topic."""
    topic, data, stamp = f"/{entry.path}", entry.data, _timestamp(entry)
    match entry.kind:
        case "boxes":
            cubes = _solids(CubePrimitive, entry, map(_vector, entry.size_m))
            yield topic, _scene(entry, cubes=cubes)
        case "marks":
            size = Vector3(**dict.fromkeys("xyz", 2.0 * entry.size_m))
            yield topic, _scene(entry, spheres=_solids(SpherePrimitive, entry, repeat(size)))
        case "line":
            yield topic, _scene(entry, lines=[_strip(entry)])
        case "points":
            yield topic, _cloud(entry)
        case "pose":
            position, half = data[0], data[1] / 2.0
            pose = _pose(position, (math.cos(half), 0.0, 0.0, math.sin(half)))
            yield topic, PoseInFrame(timestamp=stamp, frame_id=_WORLD, pose=pose)
        case "note":
            level = Log.WARNING if entry.urgent else Log.INFO
            log = Log(timestamp=stamp, level=level, message=data.text, name=data.kind)
            yield topic, log
        case "values":
            yield topic, data
        case "depth":
            yield from _camera(entry)


# Messages ----------------------------------------------------------------------------------------


def _timestamp(entry: Entry) -> Timestamp:
    seconds, nanos = divmod(_time_ns(entry), 10**9)
    return Timestamp(seconds=seconds, nanos=nanos)


def _colour(colour: str) -> Color:
    red, green, blue = to_rgb(colour)
    return Color(r=red, g=green, b=blue, a=1.0)


def _pose(position: FloatArray, quaternion: Sequence[float] = (1.0, 0.0, 0.0, 0.0)) -> PoseMessage:
    return PoseMessage(position=_vector(position), orientation=_turn(quaternion))


def _vector(vector: FloatArray) -> Vector3:
    x, y, z = vector.tolist()
    return Vector3(x=x, y=y, z=z)


def _turn(quaternion: Sequence[float]) -> Quaternion:
    w, x, y, z = quaternion
    return Quaternion(w=w, x=x, y=y, z=z)


def _optical(quaternion: FloatArray) -> tuple[float, float, float, float]:
    """Convert a camera's attitude to the axes of an optical frame: z forward and x right.

    Args:
        quaternion: w, x, y, z of a frame with x forward and y left, (4,).
    """
    w, x, y, z = (quaternion / 2.0).tolist()
    return w + x - y + z, x - w - y - z, w + x + y - z, x - w + y + z


def _scene(entry: Entry, **primitives: Any) -> SceneUpdate:
    """Return a scene with an entry's primitives, which replaces the last scene at the same path."""
    entity = SceneEntity(timestamp=_timestamp(entry), frame_id=_WORLD, id=entry.path, **primitives)
    return SceneUpdate(entities=[entity])


def _solids(kind: Any, entry: Entry, sizes: Iterable[Vector3]) -> list[Any]:
    colour = _colour(entry.colour)
    return [
        kind(pose=_pose(centre), size=size, color=colour)
        for centre, size in zip(entry.data, sizes, strict=False)
    ]


def _strip(entry: Entry) -> LinePrimitive:
    return LinePrimitive(
        type=LinePrimitive.LINE_STRIP,
        pose=_pose(np.zeros(3)),
        thickness=entry.size_m,
        points=[Point3(x=x, y=y, z=z) for x, y, z in entry.data.tolist()],
        color=_colour(entry.colour),
    )


def _cloud(entry: Entry) -> PointCloud:
    return PointCloud(
        timestamp=_timestamp(entry),
        frame_id=_WORLD,
        pose=_pose(np.zeros(3)),
        point_stride=12,
        fields=_AXES,
        data=entry.data.astype("<f4").tobytes(),
    )


def _camera(entry: Entry) -> Iterator[tuple[str, Message]]:
    """Yield messages with the camera's optical frame, its calibration, and the depth image in m."""
    frame, stamp = entry.data, _timestamp(entry)
    name = entry.path
    rows, columns = frame.depth_m.shape
    focal = columns / 2.0 / math.tan(frame.hfov_rad / 2.0)
    across, down = columns / 2.0, rows / 2.0
    yield (
        f"/{name}/pose",
        FrameTransform(
            timestamp=stamp,
            parent_frame_id=_WORLD,
            child_frame_id=name,
            translation=_vector(frame.position_enu_m),
            rotation=_turn(_optical(frame.quaternion)),
        ),
    )
    yield (
        f"/{name}/calibration",
        CameraCalibration(
            timestamp=stamp,
            frame_id=name,
            width=columns,
            height=rows,
            K=[focal, 0.0, across, 0.0, focal, down, 0.0, 0.0, 1.0],
            P=[focal, 0.0, across, 0.0, 0.0, focal, down, 0.0, 0.0, 0.0, 1.0, 0.0],
        ),
    )
    yield (
        f"/{name}/depth",
        RawImage(
            timestamp=stamp,
            frame_id=name,
            width=columns,
            height=rows,
            encoding="32FC1",
            step=4 * columns,
            data=frame.depth_m.astype("<f4").tobytes(),
        ),
    )
