"""The stream of entries, beside the record of the flight and what its nodes received."""

from dataclasses import replace

import numpy as np
import pytest

from mavfi_cli.autonomy.occupancy import MapSnapshot
from mavfi_cli.mission.progress import Recorder, Watcher
from mavfi_cli.mission.run import fly_mission, watch_again
from mavfi_cli.mission.run_folder import load_run
from mavfi_cli.report.view.entries import ViewedFlight, entries_of
from mavfi_cli.spec.fault import FaultConfig


@pytest.fixture(scope="module")
def entries(pair):
    return list(entries_of(pair))


def at(entries, path):
    return [entry for entry in entries if entry.path == path]


def test_everything_is_there_in_the_order_of_time(entries):
    kinds = {
        "camera": "depth", "cloud": "points", "map": "boxes", "plan": "line", "path": "line",
        "setpoint": "line", "vehicle": "pose", "states": "values", "events": "note",
    }  # fmt: skip
    stamps = [entry.stamp_s for entry in entries]
    assert stamps == sorted(stamps)
    for flight in ("golden", "faulty"):
        for name, kind in kinds.items():
            found = at(entries, f"{flight}/{name}")
            assert found, name
            assert {entry.kind for entry in found} == {kind}
    assert {entry.kind for entry in at(entries, "faulty/faults")} == {"marks"}
    assert {entry.kind for entry in at(entries, "faulty/alarms")} == {"marks"}
    assert at(entries, "golden/faults") == at(entries, "golden/alarms") == []


def test_states_are_the_trace(entries, pair):
    trace = pair[1].run.trace
    told = at(entries, "faulty/states")
    assert [entry.stamp_s for entry in told] == trace["stamp_s"].to_pylist()
    for name in set(trace.column_names) - {"stamp_s", "phase"}:
        assert [entry.data[name] for entry in told] == trace[name].to_pylist()


def test_vehicle_setpoint_and_path_are_those_of_the_trace(entries, pair):
    rows = pair[0].run.trace.to_pylist()
    poses = at(entries, "golden/vehicle")
    assert len(poses) == len(rows)
    assert poses[-1].data[0].tolist() == [rows[-1][name] for name in ("x_m", "y_m", "z_m")]
    last = at(entries, "golden/setpoint")[-1]
    way = last.data[1] - last.data[0]
    np.testing.assert_allclose(way, [rows[-1][f"command_v{axis}"] for axis in "xyz"], atol=1e-12)
    whole = at(entries, "golden/path")[-1].data
    assert whole[0].tolist() == poses[0].data[0].tolist()
    assert whole[-1].tolist() == poses[-1].data[0].tolist()


def test_the_cloud_lies_where_the_depth_frame_says(entries):
    """At the first frame: the points of a flat hedge world are as far as the frame's pixels."""
    frame = at(entries, "golden/camera")[0].data
    cloud = next(entry for entry in at(entries, "golden/cloud") if len(entry.data))
    distances = np.linalg.norm(cloud.data - frame.position_enu_m, axis=1)
    assert distances.min() >= frame.depth_m[np.isfinite(frame.depth_m)].min() - 1e-9


def test_a_map_is_drawn_voxel_by_voxel(pair):
    """Of one voxel and of a full cube of eight, which is one leaf."""
    cube = np.array([[x, y, z] for x in (4.1, 4.3) for y in (8.1, 8.3) for z in (0.1, 0.3)])
    recorder = Recorder()
    snapshot = MapSnapshot.of_points(np.array([[-3.1, 2.5, 1.1], *cube]), 0.2)
    recorder.on_start("planner", (None, snapshot), 1.0)
    watched = ViewedFlight(name="flight", run=pair[0].run, recorder=recorder)
    (found,) = at(entries_of([watched]), "flight/map")
    drawn = {
        (*centre.round(6), *size.round(6))
        for centre, size in zip(found.data, found.size_m, strict=True)
    }
    assert drawn == {(-3.1, 2.5, 1.1, 0.2, 0.2, 0.2), (4.2, 8.2, 0.2, 0.4, 0.4, 0.4)}


def test_world_and_marks_are_where_the_record_has_them(entries, pair):
    record = pair[1].run.record
    (obstacles,) = at(entries, "world/obstacles")
    low = obstacles.data - obstacles.size_m / 2.0
    high = obstacles.data + obstacles.size_m / 2.0
    np.testing.assert_allclose(low, [box[:3] for box in record.world["boxes"]])
    np.testing.assert_allclose(high, [box[3:] for box in record.world["boxes"]])
    (goal,) = at(entries, "world/goal")
    assert goal.data.tolist() == [list(record.goal_enu_m)]
    faults = [list(e.position_enu_m) for e in record.events if e.kind == "fault"]
    assert at(entries, "faulty/faults")[-1].data.tolist() == faults


def test_a_plan_that_a_fault_has_spoilt_is_drawn_as_far_as_it_can_be(pair):
    run = pair[0].run
    spoilt = {"stamp_s": 1.0, "points_enu_m": [[0, 0, 1], [float("nan"), 0, 1], [1e300, 0, 1]]}
    odd = replace(run, result={**run.result, "plans": [spoilt]})
    watched = ViewedFlight(name="flight", run=odd, recorder=None)
    (plan,) = at(entries_of([watched]), "flight/plan")
    assert plan.data.tolist() == [[0.0, 0.0, 1.0], [1e5, 0.0, 1.0]]


def test_without_trace_recorder_or_world_the_events_are_left(pair):
    run = replace(pair[0].run, trace=None)
    odd = replace(run, result={**run.result, "world": None, "plans": [], "goal_enu_m": None})
    found = list(entries_of([ViewedFlight(name="flight", run=odd, recorder=None)]))
    assert {entry.path for entry in found} == {"world/obstacles", "flight/events"}


def test_flown_again_a_flight_is_the_same(pair):
    for watched in pair:
        recorder, same = watch_again(watched.run)
        assert same
        assert {node: len(orders) for node, orders in recorder.orders.items()} == {
            node: len(orders) for node, orders in watched.recorder.orders.items()
        }


def test_a_watched_node_still_tells_that_it_has_read_a_fault(short_config, tmp_path):
    fault = FaultConfig(target="waypoint_z", field="mantissa", at="time=2")
    told = []
    for recorder in (None, Recorder()):
        config = replace(short_config, fault=fault)
        run = load_run(fly_mission(config, tmp_path, Watcher(), recorder=recorder).path)
        told.append(run.result["fault"]["activation"])
    assert told[0] == told[1]
    assert told[0]["first_reader"]["name"] == "collision_check"


def test_towers_are_cut_at_15_m(pair):
    run = pair[0].run
    world = {**run.result["world"], "boxes": [[1.0, 2.0, 0.0, 4.0, 5.0, 1000.0]]}
    odd = replace(run, result={**run.result, "world": world})
    (obstacles,) = at(
        entries_of([ViewedFlight(name="flight", run=odd, recorder=None)]), "world/obstacles"
    )
    assert obstacles.data.tolist() == [[2.5, 3.5, 7.5]]
    assert obstacles.size_m.tolist() == [[3.0, 3.0, 15.0]]
