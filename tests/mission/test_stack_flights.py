"""Stacks: what each key does to a flight."""

import json
import math

import pytest
from record_digest import record_digest

from mavfi_cli.core.errors import RecordError
from mavfi_cli.mission.progress import Watcher
from mavfi_cli.mission.run import fly_mission
from mavfi_cli.mission.run_folder import load_run
from mavfi_cli.spec.fault import FaultConfig
from mavfi_cli.spec.mission import MissionConfig


def fly(tmp_path, **values):
    folder = fly_mission(MissionConfig(**{"world": "dense", "seed": 3, **values}), tmp_path,
                         Watcher())  # fmt: skip
    return load_run(folder.path)


@pytest.fixture(scope="module")
def golden(tmp_path_factory):
    return fly(tmp_path_factory.mktemp("golden"))


@pytest.mark.slow
def test_the_paper_s_stack_turns_round_stops_and_plans_from_the_hover(golden):
    result = golden.result
    assert result["outcome"] == "success"
    assert result["config"]["stack"] == "mavbench"
    assert result["config"]["goal_tolerance_m"] == 8.0
    phases = golden.trace["phase"].to_pylist()
    assert phases[0] == "turning"
    assert phases.count("turning") * 0.02 == pytest.approx(6.0, abs=0.1)
    assert {"evading", "slowing"}.isdisjoint(phases)
    assert result["pilot"]["replans"] == result["pilot"]["stops"] == 2
    speeds = [math.hypot(*v) for v in zip(*(golden.trace[f"v{a}_mps"].to_pylist() for a in "xyz"),
                                          strict=True)]  # fmt: skip
    departures = [n for n in range(1, len(phases))
                  if phases[n] == "flying" and phases[n - 1] != "flying"]  # fmt: skip
    assert len(departures) == 3
    assert max(speeds[n] for n in departures) <= 0.3


@pytest.mark.slow
@pytest.mark.parametrize(
    "key",
    ["refuses_far_waypoints=true", "control_owns_queue=false", "stretches_clock=false",
     "rejected_plan_pause_s=0.2"],
)  # fmt: skip
def test_a_protection_changes_nothing_without_a_fault(key, golden, tmp_path):
    """What masks faults must not act in a golden flight, else its ablation would say nothing."""
    variant = fly(tmp_path, stack=f"mavbench:{key}")
    for name in ("trace.parquet", "plans.parquet"):
        assert (variant.folder.path / name).read_bytes() == (golden.folder.path / name).read_bytes()


@pytest.mark.slow
def test_a_flight_of_the_paper_s_stack_repeats_with_its_nodes_apart(golden, tmp_path):
    again = fly(tmp_path, isolate=("octomap", "control"))
    assert record_digest(again.folder.path) == record_digest(golden.folder.path)


@pytest.mark.slow
def test_a_number_that_a_fault_has_raised_stalls_the_mission_and_heals_where_it_is_shared(tmp_path):
    """Bit 30 of the first plan's trajectory_seq: no later plan has a larger number."""
    fault = FaultConfig(target="plan_trajectory_seq", at="invocation=1", exact_bits=(30,))
    lost = fly(tmp_path, fault=fault, time_limit_s=60.0)
    assert lost.result["outcome"] == "timeout"
    asked = lost.result["pilot"]
    assert asked["plans_ignored"] > 5
    assert asked["plans_requested"] < 60  # about one a second, not ten
    kept = fly(tmp_path, fault=fault, stack="mavbench:owns_sequence_numbers=false",
               time_limit_s=60.0)  # fmt: skip
    assert kept.result["outcome"] == "success"


@pytest.mark.slow
def test_a_far_waypoint_is_flown_until_its_distance_is_flown(tmp_path):
    fault = FaultConfig(target="queue.waypoint_x", at="time=10", exact_bits=(57,))
    where = {"world": "farm", "time_limit_s": 40.0, "fault": fault}
    lost = fly(tmp_path, **where)
    assert lost.result["outcome"] == "timeout"
    assert lost.trace["x_m"][-1].as_py() > 60.0
    for key in ("stretches_clock=false", "guards_tracking=true", "control_owns_queue=false"):
        kept = fly(tmp_path, stack=f"mavbench:{key}", **where)
        assert kept.result["outcome"] == "success", key


@pytest.mark.slow
def test_a_dead_process_takes_its_mates_and_the_map_with_it(golden, tmp_path):
    fault = FaultConfig(target="process.planner", at="time=9")
    run = fly(tmp_path, fault=fault)
    nodes = run.result["nodes"]
    assert {name: node["restarts"] for name, node in nodes.items()} == {
        "point_cloud": 0, "octomap": 1, "collision_check": 1, "planner": 1, "control": 0,
    }  # fmt: skip
    assert run.result["fault"]["states"] == ["process.planner"]
    assert run.result["fault"]["strike_count"] == 1
    never = fly(tmp_path, fault=fault, node_restart_s=3600.0)
    assert never.result["outcome"] == "collision"  # nobody looks ahead any more
    assert fly(tmp_path, fault=fault).trace.equals(run.trace)


@pytest.mark.slow
def test_a_supervisor_or_a_standby_keeps_the_reports_of_a_check_that_dies(golden, tmp_path):
    fault = FaultConfig(target="process.planner", at="time=18")  # after the second of three plans
    plain, restored, covered = (
        fly(tmp_path, fault=fault, stack=f"mavbench{variant}", time_limit_s=90.0)
        for variant in ("", ":restores_counters=true", ':standby=["planner"]')
    )
    # The restarted check counts from 0 again, so the pilot takes its second report for the first.
    foreseen = [r.result["pilot"]["collisions_foreseen"] for r in (plain, restored, covered)]
    assert foreseen == [1, 2, 2]
    assert restored.result["nodes"]["planner"]["restarts"] == 1
    # The standby has the same map and the same numbers, so the flight is that without a fault.
    assert covered.trace.equals(golden.trace)
    assert covered.result["nodes"]["planner"]["restarts"] == 0
    assert len(covered.result["nodes"]["planner"]["crashes"]) == 1


@pytest.mark.slow
def test_a_record_of_before_there_were_stacks_replays_as_hardened(golden, tmp_path):
    folder = tmp_path / "older"
    folder.mkdir()
    result = json.loads(golden.folder.result.read_text())
    del result["config"]["stack"], result["config"]["world_seed"]
    (folder / "result.json").write_text(json.dumps(result))
    assert load_run(folder).mission().stack == "hardened"


def test_a_stack_file_that_changes_is_noticed(fly_short, tmp_path):
    stack = tmp_path / "mine.toml"
    stack.write_text('base = "mavbench"\n')
    run = load_run(fly_short(stack=str(stack)).path)
    assert run.mission().stack == str(stack)
    stack.write_text('base = "mavbench"\nguards_tracking = true\n')
    with pytest.raises(RecordError, match="has changed since this flight"):
        run.mission()
    stack.unlink()
    with pytest.raises(RecordError, match="does not exist"):
        run.mission()
