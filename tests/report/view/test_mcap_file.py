"""MCAP files, read back by the mcap package."""

import json
import math

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from mavfi_cli.core.errors import RecordError
from mavfi_cli.core.frames import rotation_matrix
from mavfi_cli.link.tlog import EPOCH_UNIX_S
from mavfi_cli.report.view.entries import entries_of
from mavfi_cli.report.view.mcap_file import write_layout, write_mcap

SCHEMAS = {
    "camera/calibration": "foxglove.CameraCalibration", "camera/depth": "foxglove.RawImage",
    "camera/pose": "foxglove.FrameTransform", "cloud": "foxglove.PointCloud",
    "events": "foxglove.Log", "map": "foxglove.SceneUpdate", "path": "foxglove.SceneUpdate",
    "plan": "foxglove.SceneUpdate", "setpoint": "foxglove.SceneUpdate",
    "states": "mavfi.States", "vehicle": "foxglove.PoseInFrame",
}  # fmt: skip
KINDS = ("mission", "seeds", "versions")
MARKS = {"faulty/faults", "faulty/alarms", "world/obstacles", "world/goal"}


@pytest.fixture(scope="module")
def file(pair, tmp_path_factory):
    path = tmp_path_factory.mktemp("mcap") / "pair.mcap"
    write_mcap(pair, path)
    return path


@pytest.fixture(scope="module")
def messages(file):
    """Topic -> stamp in ns and decoded message, in the order of the file."""
    found = {}
    with file.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for schema, channel, message in reader.iter_messages():
            decoded = (
                json.loads(message.data)
                if channel.message_encoding == "json"
                else reader_decoded(schema, message)
            )
            found.setdefault(channel.topic, []).append((message.log_time, decoded))
    return found


def reader_decoded(schema, message):
    return DecoderFactory().decoder_for("protobuf", schema)(message.data)


@pytest.fixture(scope="module")
def entries(pair):
    """Path -> entries."""
    found = {}
    for entry in entries_of(pair):
        found.setdefault(entry.path, []).append(entry)
    return found


def test_topics_have_foxglove_s_own_schemas(file):
    with file.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    told = {c.topic: summary.schemas[c.schema_id].name for c in summary.channels.values()}
    expected = {f"/{f}/{name}": s for f in ("golden", "faulty") for name, s in SCHEMAS.items()}
    assert told == expected | {f"/{path}": "foxglove.SceneUpdate" for path in MARKS}
    assert len(summary.schemas) == len({*SCHEMAS.values()})


def test_every_entry_is_a_message_at_its_time(messages, entries):
    for path, told in entries.items():
        topic = f"/{path}/depth" if path.endswith("/camera") else f"/{path}"
        stamps = [round((ns - EPOCH_UNIX_S * 10**9) / 1e9, 9) for ns, _ in messages[topic]]
        assert stamps == [round(entry.stamp_s, 9) for entry in told]


def test_states_are_numbers_and_what_json_cannot_hold_is_null(messages, entries):
    for (_, told), entry in zip(messages["/faulty/states"], entries["faulty/states"], strict=True):
        for name, value in entry.data.items():
            number = value is not None and math.isfinite(value)
            assert told[name] == (value if number else None)
    assert any(math.isinf(e.data["time_to_collision"] or 0) for e in entries["golden/states"])


def test_a_depth_frame_is_whole_and_its_camera_looks_where_it_looked(messages, entries):
    entry = entries["golden/camera"][-1]
    (_, image), (_, lens), (_, pose) = (
        messages[f"/golden/camera/{name}"][-1] for name in ("depth", "calibration", "pose")
    )
    depth_m = np.frombuffer(image.data, "<f4").reshape(image.height, image.width)
    np.testing.assert_array_equal(depth_m, entry.data.depth_m.astype(np.float32))
    assert image.encoding == "32FC1"
    assert lens.K[0] == pytest.approx(image.width / 2.0)  # 90 degrees wide
    turn = pose.rotation
    optical = rotation_matrix(np.array([turn.w, turn.x, turn.y, turn.z]))
    body = rotation_matrix(entry.data.quaternion)
    np.testing.assert_allclose(optical[:, 2], body[:, 0], atol=1e-12)  # depth goes forward
    np.testing.assert_allclose(optical[:, 0], -body[:, 1], atol=1e-12)  # columns go right
    np.testing.assert_allclose(optical[:, 1], -body[:, 2], atol=1e-12)  # rows go down
    assert pose.child_frame_id == image.frame_id == lens.frame_id
    place = [pose.translation.x, pose.translation.y, pose.translation.z]
    assert place == entry.data.position_enu_m.tolist()


def test_clouds_boxes_lines_and_events_are_those_of_the_entries(messages, entries):
    (_, cloud), entry = messages["/faulty/cloud"][-1], entries["faulty/cloud"][-1]
    points = np.frombuffer(cloud.data, "<f4").reshape(-1, 3)
    np.testing.assert_array_equal(points, entry.data.astype(np.float32))
    ((_, world),), (entry,) = messages["/world/obstacles"], entries["world/obstacles"]
    cubes = world.entities[0].cubes
    assert [[c.size.x, c.size.y, c.size.z] for c in cubes] == entry.size_m.tolist()
    (_, plan), entry = messages["/faulty/plan"][0], entries["faulty/plan"][0]
    (line,) = plan.entities[0].lines
    assert [[p.x, p.y, p.z] for p in line.points] == entry.data.tolist()
    texts = [(told.name, told.message) for _, told in messages["/faulty/events"]]
    assert texts == [(entry.data.kind, entry.data.text) for entry in entries["faulty/events"]]


def test_equal_flights_give_equal_bytes(pair, file, tmp_path):
    write_mcap(pair, tmp_path / "again.mcap")
    assert (tmp_path / "again.mcap").read_bytes() == file.read_bytes()


def test_a_file_that_cannot_be_written_is_one_line(pair, tmp_path):
    with pytest.raises(RecordError, match="No such file"):
        write_mcap(pair, tmp_path / "none" / "pair.mcap")


def test_metadata_say_what_was_flown(file, pair):
    with file.open("rb") as stream:
        records = {each.name: each.metadata for each in make_reader(stream).iter_metadata()}
    both = [f"{flight}/{kind}" for flight in ("golden", "faulty") for kind in KINDS]
    assert set(records) == {*both, "faulty/fault"}
    for flight in pair:
        result = flight.run.result
        mission, seeds, versions = (records[f"{flight.name}/{kind}"] for kind in KINDS)
        assert mission["outcome"] == result["outcome"]
        assert mission["world"] == result["config"]["world"]
        assert json.loads(mission["v_max_mps"]) == result["config"]["v_max_mps"]
        assert {name: json.loads(each) for name, each in seeds.items()} == result["seeds"]
        assert versions == result["versions"]
    struck = json.loads(records["faulty/fault"]["strikes"])
    assert struck == pair[1].run.result["fault"]["strikes"]


def test_a_layout_shows_topics_and_columns_of_the_file(messages, pair, tmp_path):
    write_layout(pair, tmp_path / "layout.json")
    layout = json.loads((tmp_path / "layout.json").read_text())
    panels = layout["configById"]
    assert sorted(leaves(layout["layout"])) == sorted(panels)
    assert {*panels["3D!world"]["topics"]} - {*messages} == {"/golden/faults", "/golden/alarms"}
    assert {*panels["Image!camera"]["imageMode"].values()} <= {*messages}
    assert panels["RosOut!events"]["topicToRender"] in messages
    paths = [p["value"] for each in panels.values() for p in each.get("paths", ())]
    assert len(paths) == 18
    for path in paths:
        topic, _, column = path.partition(".")
        assert column in messages[topic][0][1]


def leaves(place):
    """The panels of a layout's tree."""
    return [place] if isinstance(place, str) else leaves(place["first"]) + leaves(place["second"])
