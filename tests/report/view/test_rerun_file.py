"""Files of rerun, read back by rerun."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest
from rerun.chunk import RrdReader

from mavfi_cli.core.errors import RecordError
from mavfi_cli.report.view.entries import entries_of
from mavfi_cli.report.view.rerun_file import write_rrd


@pytest.fixture(scope="module")
def file(pair, tmp_path_factory):
    path = tmp_path_factory.mktemp("rrd") / "pair.rrd"
    write_rrd(pair, path)
    return path


@pytest.fixture(scope="module")
def columns(file):
    """Path -> column -> its values, in the order of time."""
    found = {}
    for chunk in RrdReader(file).stream():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            found.setdefault(chunk.entity_path, {}).setdefault(name, []).extend(
                batch[name].to_pylist()
            )
    return found


def stamps_of(column):
    return [round(each.total_seconds(), 6) for each in column["simulated_time"]]


def test_every_entry_is_there_at_its_time(columns, pair):
    expected = {}
    for entry in entries_of(pair):
        names = entry.data if entry.kind == "values" else [""]
        for name in names:
            if name == "" or entry.data[name] is not None:
                path = f"/{entry.path}/{name}".rstrip("/")
                expected.setdefault(path, []).append(round(entry.stamp_s, 6))
    for path, stamps in expected.items():
        told = stamps_of(columns[path])
        if path.endswith("/camera"):
            told = sorted(set(told))  # pose and lens are logged one after the other
        assert told == stamps, path


def test_states_are_those_of_the_trace_infinities_too(columns, pair):
    for flight in pair:
        for name in ("time_to_collision", "collision", "plan_trajectory_seq", "command_yaw"):
            (scalars,) = zip(
                *columns[f"/{flight.name}/states/{name}"]["Scalars:scalars"], strict=True
            )
            told = [v for v in flight.run.trace[name].to_pylist() if v is not None]
            np.testing.assert_array_equal(scalars, np.array(told, float))


def test_lines_in_plots_have_the_colours_and_names_of_the_flights(columns, pair):
    told = [columns[f"/{flight.name}/states/collision"] for flight in pair]
    golden, faulty = (each["SeriesLines:colors"] for each in told)
    assert golden != faulty
    assert golden == columns["/golden/states/command_yaw"]["SeriesLines:colors"]
    assert [each["SeriesLines:names"] for each in told] == [
        [["golden collision"]],
        [["faulty collision"]],
    ]
    assert told[0]["SeriesLines:widths"] < told[1]["SeriesLines:widths"]  # equal lines both show


def test_depth_frames_are_in_metres_and_what_is_out_of_range_has_no_depth(columns, pair):
    frames = pair[0].recorder.orders["point_cloud"]
    path = columns["/golden/camera/depth"]
    buffers = path["DepthImage:buffer"]
    assert len(buffers) == len(frames)
    last, (frame, _) = np.array(buffers[-1][0], np.uint8).view(np.float32), frames[-1]
    depth_m = np.where(np.isfinite(frame.depth_m), frame.depth_m, 0.0)
    np.testing.assert_array_equal(last, depth_m.astype(np.float32).ravel())
    assert path["DepthImage:meter"][-1] == [1.0]


def test_a_flight_without_a_plan_has_no_waypoints(pair, tmp_path):
    run = pair[0].run
    place = run.trace.column_names.index("waypoint_x")
    none = pa.nulls(run.trace.num_rows, pa.float64())
    odd = replace(run, trace=run.trace.set_column(place, "waypoint_x", none))
    write_rrd([replace(pair[0], run=odd, recorder=None)], tmp_path / "odd.rrd")
    paths = {chunk.entity_path for chunk in RrdReader(tmp_path / "odd.rrd").stream()}
    assert "/golden/states/x_m" in paths
    assert "/golden/states/waypoint_x" not in paths


def test_a_layout_comes_with_it(file):
    assert [each.kind for each in RrdReader(file).blueprints()] == ["blueprint"]


def test_a_file_that_cannot_be_written_is_one_line(pair, tmp_path):
    with pytest.raises(RecordError, match="No such file"):
        write_rrd(pair, tmp_path / "none" / "pair.rrd")
