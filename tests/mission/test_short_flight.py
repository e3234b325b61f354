"""One whole flight over the socket pair: what its record says, checked against itself."""

import json
from dataclasses import replace

import numpy as np
import pytest
from missions import RECORD

from mavfi_cli.core.types import STATES
from mavfi_cli.mission.run_folder import load_run


@pytest.fixture(scope="module")
def run(short_flight):
    return load_run(short_flight.path)


def columns(run, *names):
    return np.column_stack([run.trace[name].to_numpy(zero_copy_only=False) for name in names])


def truth(run):
    return columns(run, "truth_x_m", "truth_y_m", "truth_z_m")


def test_the_folder_is_complete_and_nothing_else_lies_in_it(short_flight):
    assert {path.name for path in short_flight.path.iterdir()} == RECORD


def test_it_succeeds_and_says_so_once(run):
    assert (run.result["outcome"], run.result["reason"]) == ("success", "")
    kinds = [event["kind"] for event in run.result["events"]]
    assert kinds.count("outcome") == 1
    assert kinds[-1] == "outcome"
    stamps = [event["stamp_s"] for event in run.result["events"]]
    assert stamps == sorted(stamps)


def test_result_is_strict_json_and_the_configuration_repeats_the_flight(run, short_config):
    json.loads(run.folder.result.read_text(), parse_constant=pytest.fail)
    config = {k: tuple(v) if isinstance(v, list) else v for k, v in run.result["config"].items()}
    resolved = replace(short_config, goal_tolerance_m=1.0)  # the stack's own
    assert type(short_config)(**config) == resolved


def test_a_row_for_every_tick_between_takeover_and_end(run):
    stamps = columns(run, "stamp_s")[:, 0]
    np.testing.assert_allclose(np.diff(stamps), 0.02, atol=1e-9)
    assert stamps[-1] == run.result["simulated_s"]
    flown_s = run.result["quality_of_flight"]["flight_time_s"]
    assert flown_s == pytest.approx(stamps[-1] - stamps[0], abs=1e-9)


def test_every_monitored_state_has_a_column_of_its_type(run):
    kinds = {"float64": "double", "int32": "int32", "bool": "bool"}
    for state in STATES:
        assert str(run.trace.schema.field(state.name).type) == kinds[state.dtype.value]


def test_truth_is_joined_at_its_own_tick(run):
    """The state comes as float32 of the same truth; one tick off would be 0.05 m at speed."""
    heard = columns(run, "x_m", "y_m", "z_m")
    assert np.abs(heard - truth(run)).max() < 1e-4
    speeds = columns(run, "vx_mps", "vy_mps", "vz_mps")
    true_speeds = columns(run, "truth_vx_mps", "truth_vy_mps", "truth_vz_mps")
    assert np.abs(speeds - true_speeds).max() < 1e-4
    assert np.linalg.norm(true_speeds, axis=1).max() > 2.0


def test_quality_of_flight_follows_from_the_trace(run):
    quality = run.result["quality_of_flight"]
    positions = truth(run)
    speeds = np.linalg.norm(columns(run, "truth_vx_mps", "truth_vy_mps", "truth_vz_mps"), axis=1)
    distance_m = np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()
    stamps = columns(run, "stamp_s")[:, 0]
    assert quality["distance_m"] == pytest.approx(distance_m, rel=1e-12)
    assert quality["max_speed_mps"] == pytest.approx(speeds.max(), rel=1e-12)
    assert quality["mean_speed_mps"] == pytest.approx(distance_m / np.ptp(stamps), rel=1e-12)
    goal_m = np.linalg.norm(positions[-1] - run.result["goal_enu_m"])
    assert quality["goal_distance_m"] == pytest.approx(goal_m, rel=1e-12)
    assert goal_m <= run.result["config"]["goal_tolerance_m"] + 0.1
    for kind in ("regression", "propeller"):
        power = columns(run, f"power_{kind}_w")[:, 0]
        energy_j = np.trapezoid(power, stamps)
        assert quality[f"energy_{kind}_j"] == pytest.approx(energy_j, rel=1e-12)
        assert energy_j > 0.0


def test_speed_stays_within_its_limit(run):
    limit = run.result["config"]["v_max_mps"]
    assert run.result["quality_of_flight"]["max_speed_mps"] <= 1.1 * limit
    command = columns(run, "command_vx", "command_vy", "command_vz")
    assert np.nanmax(np.linalg.norm(command, axis=1)) <= limit + 1e-9


def test_clearance_agrees_with_plain_geometry(run):
    """The body reaches at most its half diagonal from its centre, and covers the centre."""
    boxes = np.array(run.result["world"]["boxes"])
    centre = truth(run)[:, None, :]
    gap = np.maximum(np.maximum(boxes[:, :3] - centre, centre - boxes[:, 3:]), 0.0)
    far = np.linalg.norm(gap, axis=2).min(axis=1)
    clearance = columns(run, "truth_clearance_m")[:, 0]
    assert (clearance >= 0.0).all()
    assert (clearance <= far + 1e-9).all()
    assert (clearance >= far - 0.5).all()
    assert run.result["quality_of_flight"]["min_clearance_m"] == clearance.min()


def test_states_are_null_until_a_message_carries_them(run):
    times = run.trace["time_to_collision"].to_pylist()
    first = next(i for i, value in enumerate(times) if value is not None)
    assert first > 0
    assert None not in times[first:]
    planned = run.trace["waypoint_x"].to_pylist()
    assert planned.index(next(x for x in planned if x is not None)) <= first


def test_counters_agree_with_each_other(run):
    pilot, kernels = run.result["pilot"], run.result["kernels"]
    assert len(run.result["plans"]) + pilot["plans_failed"] <= pilot["plans_requested"]
    assert kernels["planner"]["invocations"] == pilot["plans_requested"]
    assert kernels["point_cloud"]["invocations"] <= run.result["images"]["received"]
    assert run.result["images"]["lost"] == 0
    assert 0 < run.result["response_time_s"]["count"] <= kernels["collision_check"]["invocations"]


def test_response_is_at_least_the_latencies_on_its_way(run):
    """Point cloud 2 ms, OctoMap 289 ms, check 16 ms (medians of x86), then the next tick."""
    response = run.result["response_time_s"]
    assert 0.289 < response["median"] <= response["p95"] < 1.0


def test_a_flight_with_obstacles_replans_and_tells_where(troubled_flight):
    result = load_run(troubled_flight.path).result
    assert result["outcome"] == "success"
    assert result["pilot"]["collisions_foreseen"] >= 1
    assert result["pilot"]["replans"] >= 1
    pilot = result["pilot"]
    assert pilot["replans"] + 1 <= len(result["plans"]) <= pilot["plans_requested"]
    told = [event for event in result["events"] if event["kind"] == "replan"]
    assert told
    assert all(len(event["position_enu_m"]) == 3 for event in told)
    assert result["quality_of_flight"]["min_clearance_m"] > 0.0


def test_a_time_limit_is_kept_to_the_tick(fly_short):
    result = load_run(fly_short(time_limit_s=2.0).path).result
    assert (result["outcome"], result["reason"]) == ("timeout", "2 s")
    assert result["quality_of_flight"]["flight_time_s"] == pytest.approx(2.0, abs=0.021)


def test_landing_comes_after_the_outcome_and_is_not_part_of_the_flight(fly_short, short_flight):
    landed = load_run(fly_short(land=True).path)
    plain = load_run(short_flight.path)
    assert landed.result["outcome"] == "success"
    assert landed.result["quality_of_flight"] == plain.result["quality_of_flight"]
    assert landed.trace.equals(plain.trace)
    phases = [e["text"] for e in landed.result["events"] if e["kind"] == "phase"]
    assert phases[-2:] == ["landing", "done"]


def test_a_collision_is_an_outcome_with_place_and_obstacle(tmp_path, fly_short):
    """A wall right above the start is met during take-off, before anybody could see it."""
    world = tmp_path / "roof.toml"
    world.write_text(
        'name = "roof"\nbounds_enu_m = [-20.0, -20.0, 0.0, 40.0, 20.0, 20.0]\n'
        "start_enu_m = [0.0, 0.0, 0.0]\ngoal_enu_m = [20.0, 0.0, 5.0]\n"
        "[[box]]\nmin_enu_m = [-3.0, -3.0, 4.0]\nmax_enu_m = [3.0, 3.0, 4.5]\n"
    )
    result = load_run(fly_short(world=str(world), start=None, goal=None).path).result
    assert result["outcome"] == "collision"
    assert result["referee"]["collision"] is not None
    assert "box 0" in result["reason"]


def test_the_plans_are_kept_whole(run):
    plans = run.folder.read_plans()
    assert [plan.stamp_s for plan in plans] == [plan["stamp_s"] for plan in run.result["plans"]]
    for plan, line in zip(plans, run.result["plans"], strict=True):
        np.testing.assert_allclose(plan.waypoints[:, 0:3], line["points_enu_m"], atol=5e-4)
        assert plan.durations_s.shape == (len(plan.waypoints),)
    columns = run.trace.to_pydict()
    flown = {(plan.stamp_s, i): row for plan in plans for i, row in enumerate(plan.waypoints)}
    for stamp_s, index, x, ax in zip(
        columns["trajectory_stamp_s"], columns["waypoint_index"], columns["waypoint_x"],
        columns["waypoint_ax"], strict=True,
    ):  # fmt: skip
        if stamp_s is not None:
            assert flown[stamp_s, index][[0, 7]].tolist() == [x, ax]
