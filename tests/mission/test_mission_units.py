"""The mission's small parts, each by itself."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavfi_cli.core.errors import ConfigError, RecordError, UnknownName, VehicleProcessError
from mavfi_cli.core.files import (
    plain,
    read_parquet,
    write_atomically,
    write_json,
    write_parquet,
    write_text,
)
from mavfi_cli.core.flight_record import QualityOfFlight, ResponseTime
from mavfi_cli.core.types import (
    KERNELS,
    STATES,
    CollisionReport,
    Command,
    Reaction,
    Trajectory,
    VehicleState,
)
from mavfi_cli.mission.measures import quality_of
from mavfi_cli.mission.run import response_times
from mavfi_cli.mission.run_folder import RunFolder, Trace, load_run
from mavfi_cli.mission.vehicle import Vehicle
from mavfi_cli.spec.mission import HIGHEST_M, LOWEST_M, MARGIN_M, OF_THE_WORLD, MissionConfig

# Configuration -------------------------------------------------------------------------------


def test_a_configuration_survives_its_record():
    config = MissionConfig(world="farm", seed=9, goal=(1.0, 2.0, 3.0), isolate=("planner",))
    record = json.loads(json.dumps(config.to_dict()))
    assert "isolate" not in record
    record["goal"] = tuple(record["goal"])
    assert MissionConfig(**record) == replace(config, isolate=())


LIMITED = {
    "takeoff_height_m": (1.0, 50.0), "v_max_mps": (0.1, 12.0), "a_max_mps2": (0.5, 8.0),
    "goal_tolerance_m": (0.1, 50.0), "time_limit_s": (1.0, 86400.0),
    "map_resolution_m": (0.05, 1.0), "map_range_m": (2.0, 25.0), "camera_rate_hz": (0.1, 50.0),
    "loss_limit_s": (0.1, 3600.0),
}  # fmt: skip


@pytest.mark.parametrize("name", LIMITED)
def test_limits_are_inclusive_and_named_where_broken(name):
    low, high = LIMITED[name]
    needed = (
        {"link": "udpin:127.0.0.1:1", "goal": (9.0, 9.0, 5.0)} if name == "loss_limit_s" else {}
    )
    for good in (low, high):
        assert getattr(MissionConfig(**{name: good}, **needed), name) == good
    for bad in (math.nextafter(low, -1), math.nextafter(high, math.inf), math.nan, -math.inf):
        with pytest.raises(ConfigError, match=f"^{name}: must be (within|between)"):
            MissionConfig(**{name: bad})


def test_a_limit_on_loss_is_for_a_link_and_in_its_record_only():
    with pytest.raises(ConfigError, match=r"^loss_limit_s: needs --link"):
        MissionConfig(loss_limit_s=10.0)
    assert "loss_limit_s" not in MissionConfig().to_dict()
    config = MissionConfig(link="udpin:127.0.0.1:1", eyes=True, loss_limit_s=10.0)
    assert config.to_dict()["loss_limit_s"] == 10.0


def test_the_record_of_a_foreign_flight_names_no_world_that_took_no_part():
    goal = (20.0, 1.0, 5.0)
    blind = MissionConfig(link="udpin:127.0.0.1:1", goal=goal).to_dict()
    seeing = MissionConfig(link="udpin:127.0.0.1:1", eyes=True).to_dict()
    assert {blind[name] for name in OF_THE_WORLD} == {None}
    assert (seeing["world"], seeing["vehicle"], seeing["eyes"]) == ("dense", "solo", True)
    assert not {"eyes", "origin"} & MissionConfig().to_dict().keys()


def test_settings_of_a_world_need_eyes():
    for name, value in (("world", "farm"), ("start", (1.0, 2.0, 0.0)), ("camera_rows", 60)):
        with pytest.raises(ConfigError, match=f"^{name}: has no effect with --link"):
            MissionConfig(link="udpin:127.0.0.1:1", goal=(9.0, 9.0, 5.0), **{name: value})


@pytest.mark.parametrize("seed", [-1, 2**31])
def test_seeds_that_sitl_could_not_take(seed):
    with pytest.raises(ConfigError, match=r"^seed: "):
        MissionConfig(seed=seed)


def test_nodes_that_can_be_isolated():
    assert MissionConfig(isolate=KERNELS).isolate == KERNELS
    with pytest.raises(UnknownName, match="did you mean 'planner'"):
        MissionConfig(isolate=("plannner",))


# Briefing ------------------------------------------------------------------------------------


PLACES = st.tuples(*[st.floats(-500.0, 500.0)] * 2, st.floats(2.0, 10.0))


@given(PLACES, PLACES)
def test_a_foreign_mission_may_fly_between_start_and_goal_with_a_margin(start, goal):
    config = MissionConfig(link="udpin:127.0.0.1:1", goal=goal)
    told = config.briefing(np.array(start))
    low, high = told.bounds_enu_m[:3], told.bounds_enu_m[3:]
    for place in (np.array(goal), np.array(start)):
        assert (place[:2] - low[:2] >= MARGIN_M - 1e-9).all()
        assert (high[:2] - place[:2] >= MARGIN_M - 1e-9).all()
    assert (low[2], high[2]) == (LOWEST_M, HIGHEST_M)
    np.testing.assert_array_equal(told.goal_enu_m, goal)


@pytest.mark.parametrize("text", [None, "", "{", "{}", '{"goal_enu_m": "x"}'])
def test_a_vehicle_that_left_no_briefing(tmp_path, text):
    path = tmp_path / "briefing.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(VehicleProcessError, match="the briefing cannot be read"):
        Vehicle.read_briefing(path)


# Files ---------------------------------------------------------------------------------------


def test_a_write_that_fails_leaves_the_old_file_and_no_other(tmp_path):
    path = tmp_path / "file"
    write_text(path, "old")

    def half(file):
        file.write(b"new")
        raise OSError(28, "No space left on device")

    with pytest.raises(RecordError, match="No space left on device"):
        write_atomically(path, half)
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_a_folder_that_is_not_there_is_one_line(tmp_path):
    with pytest.raises(RecordError, match="No such file"):
        write_text(tmp_path / "none" / "file", "x")


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=12,
)


@given(values)
def test_json_is_always_strict_and_only_what_is_not_finite_is_lost(tmp_path_factory, value):
    path = tmp_path_factory.getbasetemp() / "value.json"
    write_json(path, value)
    back = json.loads(path.read_text(), parse_constant=pytest.fail)
    assert back == plain(value)


def test_arrays_and_numpy_scalars_become_plain():
    value = {"a": np.array([[1.0, math.nan], [math.inf, 2.0]]), "b": np.int32(3), "c": (1, 2)}
    assert plain(value) == {"a": [[1.0, None], [None, 2.0]], "b": 3, "c": [1, 2]}


# Run folders ---------------------------------------------------------------------------------


def test_run_folders_count_up_and_are_never_taken_twice(tmp_path):
    names = [RunFolder.new(tmp_path / "runs", "dense", 1).path.name for _ in range(3)]
    assert names == ["dense-1-001", "dense-1-002", "dense-1-003"]
    (tmp_path / "runs/dense-1-1000").mkdir()
    (tmp_path / "runs/dense-1-old").mkdir()
    assert RunFolder.new(tmp_path / "runs", "a/dense.toml", 1).path.name == "dense-1-1001"
    assert RunFolder.new(tmp_path / "runs", "dense", 11).path.name == "dense-11-001"


def test_a_run_that_is_not_there(tmp_path):
    with pytest.raises(RecordError, match="no such run folder"):
        load_run(tmp_path / "nothing")


# Trace ---------------------------------------------------------------------------------------


def vehicle(stamp_s, x):
    return VehicleState(
        stamp_s=stamp_s, position_enu_m=np.array([x, 2.0, 3.0]),
        velocity_enu_mps=np.array([4.0, 5.0, 6.0]), quaternion=np.zeros(4), yaw_rad=0.5,
    )  # fmt: skip


def a_trace():
    report = CollisionReport(
        stamp_s=0.0, collision=True, time_to_collision_s=math.inf, future_collision_seq=7
    )
    waypoints = np.arange(20.0).reshape(2, 10)
    trajectory = Trajectory(
        stamp_s=0.0, waypoints=waypoints, durations_s=np.array([0.5, 0.25]), trajectory_seq=4,
        future_collision_seq=6,
    )  # fmt: skip
    command = Command(stamp_s=0.0, velocity_enu_mps=np.array([0.1, 0.2, 0.3]), yaw_rad=-1.0)
    trace = Trace()
    trace.add(0.02, "waiting", vehicle(0.02, 1.0), None, None, None)
    trace.add(0.04, "flying", vehicle(0.04, 1.5), report, (trajectory, 1), command)
    return trace


TRUTH = {
    "stamp_s": np.array([0.0, 0.02, 0.16]), "position_enu_m": np.arange(9.0).reshape(3, 3),
    "velocity_enu_mps": np.zeros((3, 3)), "clearance_m": np.array([9.0, 8.0, 7.0]),
    "power_regression_w": np.ones(3), "power_propeller_w": np.ones(3),
}  # fmt: skip


def test_a_trace_comes_back_from_its_file(tmp_path):
    table = a_trace().table(TRUTH)
    write_parquet(tmp_path / "trace.parquet", table)
    assert read_parquet(tmp_path / "trace.parquet", "trace").equals(table)
    first = (tmp_path / "trace.parquet").read_bytes()
    write_parquet(tmp_path / "again.parquet", a_trace().table(TRUTH))
    assert (tmp_path / "again.parquet").read_bytes() == first


def test_every_state_is_what_its_message_said():
    silent, told = a_trace().table(None).to_pylist()
    assert all(silent[state.name] is None for state in STATES)
    assert told["time_to_collision"] == math.inf
    assert told["future_collision_seq"] == 7
    assert told["collision"] is True
    names = ("x", "y", "z", "yaw", "vx", "vy", "vz", "ax", "ay", "az")
    assert [told[f"waypoint_{name}"] for name in names] == list(range(10, 20))
    assert (told["waypoint_duration"], told["plan_trajectory_seq"]) == (0.25, 4)
    assert [told[f"command_v{axis}"] for axis in "xyz"] == [0.1, 0.2, 0.3]
    assert (told["command_yaw"], told["yaw_rad"], told["x_m"], told["phase"]) == (
        -1.0, 0.5, 1.5, "flying",
    )  # fmt: skip


def test_truth_is_joined_by_stamp_and_null_where_there_is_none():
    first, second = a_trace().table(TRUTH).to_pylist()
    assert (first["truth_x_m"], first["truth_z_m"], first["truth_clearance_m"]) == (3.0, 5.0, 8.0)
    assert second["truth_x_m"] is None
    assert "truth_x_m" not in a_trace().table(None).column_names


def test_truth_between_two_ticks_is_interpolated():
    stamps = a_trace().table(None)["stamp_s"].to_pylist()
    ticks = {name: np.repeat(column[:1], 3, axis=0) for name, column in TRUTH.items()}
    ticks["stamp_s"] = np.array([stamps[0], stamps[1] - 0.005, stamps[1] + 0.015])
    ticks["position_enu_m"] = np.array([[0.0, 0, 0], [1.0, 2.0, 3.0], [2.0, 2.0, 7.0]])
    ticks["clearance_m"] = np.array([1.0, np.inf, np.inf])
    _, second = a_trace().table(ticks).to_pylist()
    assert (second["truth_x_m"], second["truth_z_m"]) == pytest.approx((1.25, 4.0))


@pytest.mark.parametrize(("gap_s", "is_known"), [(0.024, True), (0.099, True), (0.102, False)])
def test_truth_is_null_in_a_long_silence_of_the_referee(gap_s, is_known):
    """PX4's own simulator tells its attitude every 16 or 24 ms."""
    stamps = a_trace().table(None)["stamp_s"].to_pylist()
    ticks = {name: np.repeat(column[:1], 2, axis=0) for name, column in TRUTH.items()}
    ticks["stamp_s"] = stamps[1] + gap_s * np.array([-0.5, 0.5])
    _, second = a_trace().table(ticks).to_pylist()
    assert (second["truth_x_m"] is not None) == is_known


def test_a_trace_of_nothing_is_a_table_all_the_same(tmp_path):
    write_parquet(tmp_path / "trace.parquet", Trace().table(TRUTH))
    assert read_parquet(tmp_path / "trace.parquet", "trace").num_rows == 0


# Quality of flight ---------------------------------------------------------------------------


def circle(count=2001, radius_m=3.0, time_s=10.0):
    """Once round at constant speed, with a power that grows evenly from 0 to 20 W."""
    stamps = np.linspace(5.0, 5.0 + time_s, count)
    angle = math.tau * (stamps - 5.0) / time_s
    speed = math.tau * radius_m / time_s
    zero = np.zeros(count)
    return {
        "stamp_s": stamps,
        "position_enu_m": radius_m * np.column_stack([np.cos(angle), np.sin(angle), zero]),
        "velocity_enu_mps": speed * np.column_stack([-np.sin(angle), np.cos(angle), zero]),
        "clearance_m": 2.0 + np.cos(angle),
        "power_regression_w": 2.0 * (stamps - 5.0),
        "power_propeller_w": np.full(count, 7.0),
    }


def test_quality_of_a_circle_against_its_closed_form():
    found = quality_of(circle(), 0.0, 99.0, np.array([3.0, 4.0, 0.0]))
    assert found.flight_time_s == pytest.approx(10.0)
    assert found.distance_m == pytest.approx(math.tau * 3.0, rel=1e-5)
    assert found.mean_speed_mps == pytest.approx(0.6 * math.pi, rel=1e-5)
    assert found.max_speed_mps == pytest.approx(0.6 * math.pi)
    assert found.min_clearance_m == pytest.approx(1.0, abs=1e-5)
    assert found.goal_distance_m == pytest.approx(4.0)
    assert found.energy_regression_j == pytest.approx(100.0)
    assert found.energy_propeller_j == pytest.approx(70.0)


def test_only_the_flight_itself_counts():
    half = quality_of(circle(), 5.0, 10.0, np.zeros(3))
    assert half.flight_time_s == pytest.approx(5.0)
    assert half.distance_m == pytest.approx(math.pi * 3.0, rel=1e-5)
    assert half.energy_regression_j == pytest.approx(25.0)


@pytest.mark.parametrize("window", [(math.inf, 12.0), (99.0, 100.0), (7.0, 7.0)])
def test_a_flight_that_never_was_has_no_quality(window):
    assert quality_of(circle(), *window, np.zeros(3)) == QualityOfFlight()


def test_what_the_companion_knows_by_itself():
    data = circle()
    received = {name: data[name] for name in ("stamp_s", "position_enu_m", "velocity_enu_mps")}
    found = quality_of(received, 0.0, 99.0, np.zeros(3))
    true = quality_of(data, 0.0, 99.0, np.zeros(3))
    unknown = dict.fromkeys(("min_clearance_m", "energy_regression_j", "energy_propeller_j"))
    assert found == replace(true, **unknown)


def test_a_world_without_boxes_has_no_clearance():
    data = {**circle(), "clearance_m": np.full(2001, math.inf)}
    assert quality_of(data, 0.0, 99.0, np.zeros(3)).min_clearance_m is None


# Response time -------------------------------------------------------------------------------


def test_response_times_are_those_of_numpy():
    times = [0.3, 0.5, 0.1, 0.4, 0.2]
    reactions = [Reaction(frame_stamp_s=k, setpoint_stamp_s=k + t) for k, t in enumerate(times)]
    found = response_times(reactions)
    assert found.median == pytest.approx(0.3)
    assert found.p95 == pytest.approx(np.percentile(times, 95))
    assert found.count == 5


def test_no_reaction_no_response_time():
    empty = ResponseTime()
    assert response_times([]) == empty
    assert response_times([Reaction(frame_stamp_s=math.nan, setpoint_stamp_s=1.0)]) == empty
