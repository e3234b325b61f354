"""The gate in a mission: what is withheld, what is computed again, when it ends, what is told."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mavfi_cli.campaigns.specification_file import load_spec
from mavfi_cli.companion.protection import PASSED, Protection, Response
from mavfi_cli.core.errors import ConfigError, FaultSpecError, ModelError, UnknownName
from mavfi_cli.core.flight_record import RecordedRecovery
from mavfi_cli.core.types import CollisionReport, Command, Stage, Trajectory
from mavfi_cli.core.wall import WallClock
from mavfi_cli.detect.base import shipped
from mavfi_cli.detect.preprocess import NAMES, REFERENCE, SPANS
from mavfi_cli.mission.progress import Watcher
from mavfi_cli.mission.run import fly_mission
from mavfi_cli.mission.run_folder import load_run
from mavfi_cli.spec.detector import DetectorConfig
from mavfi_cli.spec.fault import FaultConfig
from mavfi_cli.spec.stack import load_stack

LIMIT = 8.0
TRAJECTORY = Trajectory(
    stamp_s=0.0, waypoints=np.full((6, 10), 1.5), durations_s=np.full(6, 0.5), trajectory_seq=1,
    future_collision_seq=0,
)  # fmt: skip
COMMAND = Command(stamp_s=0.0, velocity_enu_mps=np.ones(3), yaw_rad=0.5)
WILD = Command(stamp_s=0.0, velocity_enu_mps=np.array([1e200, 1.0, 1.0]), yaw_rad=0.5)


class Limit:
    """Alarms on any delta beyond a limit; per stage, or over all."""

    name = "limit"

    def __init__(self, *, per_stage):
        self.per_stage = per_stage
        self.memory = {"threshold": np.array([LIMIT])}

    @property
    def threshold(self):
        return float(self.memory["threshold"][0])

    def score(self, deltas, stage):
        first, end = SPANS[stage] if self.per_stage else (0, len(deltas))
        return float(np.abs(deltas[first:end].astype(int)).max())

    def learn(self, deltas, stage):
        pass


@pytest.fixture(params=[True, False], ids=["per_stage", "over_all"])
def per_stage(request):
    return request.param


@pytest.fixture
def limit(monkeypatch, per_stage):
    """The registry knows one detector."""
    monkeypatch.setattr(DetectorConfig, "build", lambda *_: Limit(per_stage=per_stage))
    return DetectorConfig(name="limit", alarms_max=3)


def protection(config):
    return Protection(config, "mavbench", WallClock())


def tick(gate, command, at_s=0.0):
    return gate.tick(TRAJECTORY, 0, command, at_s).response


def test_after_so_many_alarms_in_a_row_it_holds_and_then_accepts(limit):
    gate = protection(limit)
    assert tick(gate, COMMAND) is Response.PASS
    told = [tick(gate, WILD, at_s) for at_s in (0.02, 0.04, 0.06, 0.08, 0.1)]
    assert told == [
        Response.RECOMPUTE, Response.RECOMPUTE, Response.HOLD, Response.ACCEPT, Response.PASS,
    ]  # fmt: skip
    summary = gate.summary()
    assert summary.responses == {"recompute": 2, "hold": 1, "accept": 1}
    assert summary.alarm_count == 4
    assert summary.recoveries["control"] == RecordedRecovery(count=1, total_s=0.06)


def test_a_message_that_passes_ends_the_row(limit):
    gate = protection(limit)
    told = [tick(gate, c) for c in (COMMAND, WILD, WILD, COMMAND, WILD, WILD, COMMAND)]
    assert told.count(Response.RECOMPUTE) == 4
    assert told.count(Response.PASS) == 3


def test_a_hover_does_not_end_the_row(limit):
    """A flip in the gate's own reference: the first waypoint of every plan looks wrong."""
    gate = protection(limit)
    tick(gate, COMMAND)
    gate.gate.memory["gate"][REFERENCE, NAMES.index("waypoint_vy")] += 2048
    told = [gate.tick(TRAJECTORY, 1, COMMAND, at_s).response for at_s in (0.02, 0.04, 0.06)]
    assert told == [Response.RECOMPUTE, Response.RECOMPUTE, Response.HOLD]
    plan = replace(TRAJECTORY, trajectory_seq=2)
    assert gate.tick(None, -1, COMMAND, 0.08).response is Response.PASS
    assert gate.plan(plan, 0.1).response is Response.PASS
    assert gate.ahead(plan, 0, None, 0.1).response is Response.PASS
    assert gate.tick(plan, 0, COMMAND, 0.1).response is Response.ACCEPT
    assert gate.tick(plan, 1, COMMAND, 0.12).response is Response.PASS
    assert tick(gate, WILD, 0.14) is Response.RECOMPUTE  # a row of its own


def test_people_hear_of_a_row_of_alarms_once_and_of_a_hold_always(limit):
    gate = protection(limit)
    for command in (COMMAND, WILD, WILD, WILD, WILD):
        tick(gate, command)
    first, second = gate.news()
    assert first.endswith("control: command_vx; recompute")
    assert second.endswith("control: command_vx; hold")
    assert gate.news() == []


def test_a_wild_report_is_withheld(limit):
    gate = protection(limit)
    calm = CollisionReport(
        stamp_s=0.0, collision=True, time_to_collision_s=3.0, future_collision_seq=1
    )
    assert gate.report(calm, 0.0).response is Response.PASS
    wild = replace(calm, future_collision_seq=1 << 20)
    assert gate.report(wild, 0.3).response is Response.RECOMPUTE
    assert gate.report(calm, 0.6).response is Response.PASS
    assert gate.summary().recoveries["perception"] == RecordedRecovery(count=1, total_s=0.3)


def test_the_record_names_the_recomputed_stage_if_it_is_not_the_alarm_s(per_stage, limit):
    gate = protection(limit)
    for number in (0, 1 << 20):
        gate.report(replace(CALM, future_collision_seq=number), 0.0)
    (alarm,) = gate.summary().alarms
    assert (alarm.stage, alarm.message) == ("perception", "report")
    assert alarm.recomputes == (None if per_stage else "control")


CALM = CollisionReport(
    stamp_s=0.0, collision=False, time_to_collision_s=np.inf, future_collision_seq=0
)


def test_a_report_that_its_recomputation_confirms_is_accepted(limit):
    """A flip in the first report becomes the reference, so all correct reports raise an alarm."""
    gate = protection(limit)
    reports = [replace(CALM, future_collision_seq=1 << 13), CALM, CALM, CALM]
    assert [gate.report(report, 0.3).response for report in reports] == [
        Response.PASS, Response.RECOMPUTE, Response.ACCEPT, Response.PASS,
    ]  # fmt: skip


def test_reports_that_never_agree_are_accepted_in_the_end_and_never_hold_the_vehicle(limit):
    gate = protection(limit)
    reports = [replace(CALM, future_collision_seq=number) for number in (0, 50, 60, 70, 80)]
    assert [gate.report(report, 0.3).response for report in reports] == [
        Response.PASS, *[Response.RECOMPUTE] * limit.alarms_max, Response.ACCEPT,
    ]  # fmt: skip


def test_two_equal_alarms_with_a_good_report_between_them_confirm_nothing(limit):
    gate = protection(limit)
    wild = replace(CALM, future_collision_seq=1 << 13)
    told = [gate.report(report, 0.3).response for report in (CALM, wild, CALM, wild)]
    assert told[1] is told[3] is Response.RECOMPUTE


@pytest.mark.parametrize(
    ("wrong", "error"),
    [
        ({"protect": ()}, ConfigError), ({"protect": ("vision",)}, UnknownName),
        ({"threshold": 0.0}, ConfigError), ({"threshold": float("nan")}, ConfigError),
        ({"alarms_max": 0}, ConfigError), ({"watch": "all"}, UnknownName),
    ],
)  # fmt: skip
def test_what_makes_no_sense_is_refused(wrong, error):
    with pytest.raises(error):
        DetectorConfig(name="gad", **wrong)


EXTENDED = DetectorConfig(name="gad", watch="extended")
FIRST = replace(TRAJECTORY, waypoints=np.full((6, 10), 0.25))


def test_a_plan_with_a_wrong_number_is_withheld_until_recomputing_has_confirmed_it():
    gate = protection(replace(EXTENDED, alarms_max=2))
    assert gate.plan(FIRST, 0.0).response is Response.PASS
    wrong = [replace(FIRST, trajectory_seq=number) for number in (900, 901, 902, 903)]
    assert [gate.plan(plan, 0.1).response for plan in wrong] == [
        Response.RECOMPUTE, Response.HOLD, Response.ACCEPT, Response.PASS,
    ]  # fmt: skip
    assert {alarm.states for alarm in gate.summary().alarms} == {("plan_trajectory_seq",)}
    assert "planning: plan_trajectory_seq; recompute" in gate.news()[0]


@pytest.mark.parametrize("name", ["gad", "aad"])
def test_a_flown_plan_gets_back_the_number_that_was_accepted(name):
    gate = protection(replace(EXTENDED, name=name))
    gate.plan(FIRST, 0.0)
    decision = gate.ahead(replace(FIRST, trajectory_seq=1025), 0, None, 0.1)
    assert decision.withheld
    assert decision.blames(Stage.PLANNING)
    assert decision.alarm.mended.trajectory_seq == 1
    assert gate.ahead(decision.alarm.mended, 0, None, 0.2) is PASSED


def test_a_model_is_that_of_the_stack_or_of_its_base(tmp_path):
    def path(stack, **asked):
        return DetectorConfig(name="gad", **asked).model_path(stack)

    mine = tmp_path / "mine.toml"
    mine.write_text('name = "mine"\nbase = "hardened"\nguards_tracking = false\n')
    for stack in ("mavbench", "hardened"):
        assert path(stack) == path(stack, any_stack=True) == shipped("gad", stack)
    for stack, base in (
        ("mavbench-release", "mavbench"), ("mavbench-release:goal_tolerance_m=2.0", "mavbench"),
        (str(mine), "hardened"), ("hardened:guards_tracking=false", "hardened"),
    ):  # fmt: skip
        assert path(stack) == path(stack, any_stack=True) == shipped("gad", base)
        assert DetectorConfig(name="gad", any_stack=True).build(stack).stack.name == base
    assert path("hardened", model="my.json") == Path("my.json")
    assert path("hardened", model="my.json", any_stack=True) == Path("my.json")


@pytest.mark.parametrize(
    ("stack", "asked", "problem"),
    [
        ("mavbench-release", {}, r"'mavbench', not for 'mavbench-release'"),
        ("mavbench:guards_tracking=true", {}, "mavfi train --stack mavbench:guards_tracking=true"),
        ("mavbench", {"model": str(shipped("gad", "hardened"))},
         r"hardened/gad\.json: .*'hardened', not for 'mavbench'"),
    ],
)  # fmt: skip
def test_a_model_of_another_stack_is_refused_in_one_line(stack, asked, problem):
    with pytest.raises(ModelError, match=problem) as caught:
        DetectorConfig(name="gad", **asked).build(stack)
    assert "--any-stack-model" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert DetectorConfig(name="gad", any_stack=True, **asked).build(stack).name == "gad"


def test_a_stack_that_differs_in_nothing_needs_no_model_of_its_own():
    same = "mavbench:guards_tracking=false"
    assert load_stack(same).mark.digest == load_stack("mavbench").mark.digest
    assert DetectorConfig(name="aad").build(same).stack.name == "mavbench"
    assert load_stack("hardened").mark.digest != load_stack("mavbench").mark.digest


def test_a_model_of_the_stack_as_it_once_was_is_refused(tmp_path):
    held = json.loads(shipped("gad").read_text())
    held["stack"]["digest"] = "0" * 64
    (tmp_path / "old.json").write_text(json.dumps(held))
    config = DetectorConfig(name="gad", model=str(tmp_path / "old.json"))
    with pytest.raises(ModelError, match="another version of the stack 'mavbench'"):
        config.build("mavbench")


# Whole missions ------------------------------------------------------------------------------

FLIP = FaultConfig(target="command_vx", at="time=3", exact_bits=(61,))


@pytest.fixture
def guarded(fly_short, limit):
    def fly(**changes):
        return load_run(fly_short(detector=limit, **changes).path)

    return fly


def test_a_golden_flight_is_the_same_with_a_silent_gate(guarded, short_flight):
    golden, run = load_run(short_flight.path), guarded()
    assert run.result["detection"]["alarm_count"] == 0
    assert run.result["detection"]["checks"]["tick"] == run.trace.num_rows
    assert run.folder.trace.read_bytes() == golden.folder.trace.read_bytes()
    assert run.folder.tlog.read_bytes() == golden.folder.tlog.read_bytes()
    assert run.mission().detector == DetectorConfig(name="limit", alarms_max=3)
    asked = json.loads(run.folder.result.read_text())["config"]["detector"]
    assert asked["protect"] == [stage.value for stage in Stage]


def test_a_wild_command_never_leaves_and_is_told_to_ground_stations(
    guarded, short_flight, tmp_path
):
    run = guarded(fault=FLIP)
    (strike,) = run.result["fault"]["strikes"]
    (alarm,) = run.result["detection"]["alarms"]
    assert alarm["stamp_s"] == pytest.approx(strike["stamp_s"])
    assert (alarm["stage"], alarm["response"]) == ("control", "recompute")
    assert alarm["states"][0] == "command_vx"
    assert run.result["fault"]["activation"]["activation"] == "withheld"
    largest = np.abs(run.trace["command_vx"].to_numpy(zero_copy_only=False)).max()
    assert largest < 5.0
    text = b"limit alarm in control"
    assert text in run.folder.tlog.read_bytes()
    assert any(e["kind"] == "alarm" for e in run.result["events"])
    again = load_run(fly_mission(run.mission(), tmp_path, Watcher()).path)
    assert again.folder.trace.read_bytes() == run.folder.trace.read_bytes()
    assert not again.differing_sections(run)


def test_a_wild_waypoint_far_ahead_is_dropped_before_the_collision_check_sees_it(guarded):
    fault = FaultConfig(target="waypoint_x", at="time=2", exact_bits=(61,), seed=5)
    run = guarded(fault=fault)
    (change,) = run.result["fault"]["strikes"][0]["changes"]
    assert abs(change["after"]) > 1e100
    assert run.result["detection"]["alarms"][0]["message"] == "ahead"
    assert run.result["fault"]["activation"]["activation"] == "withheld"
    counters = run.result["pilot"]
    assert (counters["collisions_foreseen"], counters["stops"]) == (0, 0)
    assert run.result["outcome"] == "success"


def test_a_stage_that_is_not_protected_is_not_watched(fly_short, limit):
    config = replace(limit, protect=("perception", "planning"))
    run = load_run(fly_short(detector=config, fault=FLIP).path)
    assert run.result["detection"]["alarm_count"] == 0
    assert run.result["fault"]["activation"]["activation"] == "read"


@pytest.mark.parametrize("name", ["gad", "aad"])
@pytest.mark.parametrize(
    "fault",
    [
        FaultConfig(target="time_to_collision", at="invocation=1", exact_bits=(0,)),  # inf to NaN
        FaultConfig(target="future_collision_seq", at="invocation=1", exact_bits=(13,)),
    ],
    ids=["time", "number"],
)
def test_alarms_about_correct_reports_do_not_lengthen_the_flight(
    fly_short, short_flight, name, fault
):
    run = load_run(fly_short(detector=DetectorConfig(name=name), fault=fault).path)
    responses = [alarm["response"] for alarm in run.result["detection"]["alarms"]]
    assert responses == ["recompute", "accept"]
    golden = load_run(short_flight.path).result
    for section in ("plans", "quality_of_flight"):
        assert run.result[section] == golden[section]


@pytest.mark.slow
def test_a_flip_that_blinds_the_detector_is_a_fault_site(guarded):
    """The threshold's second exponent bit: 8 becomes a number beyond all deltas."""
    fault = FaultConfig(target="detector.threshold", at="time=1", exact_bits=(61,))
    result = guarded(fault=fault).result
    record = result["fault"]
    assert result["detection"]["alarm_count"] == 0
    assert (record["stage"], record["state"], record["activation"]["activation"]) == (
        "detector", "applied", "read",
    )  # fmt: skip
    (change,) = record["strikes"][0]["changes"]
    assert change["before"] == LIMIT
    assert change["state"] == "threshold"


@pytest.mark.slow
def test_a_flip_in_a_number_of_a_plan_is_seen_by_the_extended_watch_alone(
    fly_short, short_flight, tmp_path
):
    fault = FaultConfig(target="plan_trajectory_seq", at="invocation=1", exact_bits=(10,))
    runs = {
        watch: load_run(fly_short(detector=replace(EXTENDED, watch=watch), fault=fault).path)
        for watch in ("paper", "extended")
    }
    assert runs["paper"].result["detection"]["alarm_count"] == 0
    assert runs["paper"].result["fault"]["activation"]["activation"] == "read"
    result = runs["extended"].result
    (alarm,) = result["detection"]["alarms"]
    assert (alarm["message"], alarm["stage"]) == ("plan", "planning")
    assert (alarm["states"], alarm["response"]) == (["plan_trajectory_seq"], "recompute")
    assert result["fault"]["activation"]["activation"] == "withheld"
    assert result["pilot"]["plans_rejected"] == 1
    assert result["outcome"] == "success"
    assert result["config"]["detector"]["watch"] == "extended"
    again = load_run(fly_mission(runs["extended"].mission(), tmp_path, Watcher()).path)
    assert again.folder.trace.read_bytes() == runs["extended"].folder.trace.read_bytes()


@pytest.mark.parametrize("name", ["gad", "aad"])
def test_a_flip_in_a_number_of_the_flown_plan_is_undone_before_the_check_reads_it(fly_short, name):
    fault = FaultConfig(target="plan_future_collision_seq", at="phase=flying", exact_bits=(14,))
    detector = replace(EXTENDED, name=name)
    result = load_run(fly_short(detector=detector, fault=fault).path).result
    assert result["fault"]["activation"]["activation"] == "withheld"
    (alarm,) = result["detection"]["alarms"]
    assert (alarm["message"], alarm["stage"]) == ("ahead", "planning")
    assert alarm["states"] == ["plan_future_collision_seq"]
    assert result["pilot"]["stops"] == 0
    assert result["outcome"] == "success"


def test_a_golden_flight_is_the_same_with_the_extended_watch(watched_flight, short_flight):
    golden, run = load_run(short_flight.path), load_run(watched_flight.path)
    assert run.result["detection"]["alarm_count"] == 0
    assert run.folder.trace.read_bytes() == golden.folder.trace.read_bytes()
    assert run.folder.tlog.read_bytes() == golden.folder.tlog.read_bytes()


def test_a_flight_with_a_model_of_another_stack_ends_before_it_begins(fly_short, mavfi, tmp_path):
    with pytest.raises(ModelError):
        fly_short(stack="mavbench-release", detector=DetectorConfig(name="gad"))
    words = ("fly", "--stack", "mavbench-release", "--detector", "gad", "--out", tmp_path / "runs")
    done = mavfi(*words)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("error: ")
    assert re.search("mavbench/gad.json: .*'mavbench'", done.stderr)
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "runs").exists()


def test_a_model_of_another_stack_flies_where_that_is_asked_for(fly_short):
    detector = DetectorConfig(name="gad", any_stack=True)
    run = load_run(fly_short(stack="mavbench-release", detector=detector).path)
    assert run.result["outcome"] == "success"
    assert run.result["detection"]["checks"]["tick"] == run.trace.num_rows
    assert run.result["config"]["detector"]["any_stack"] is True


def test_a_campaign_refuses_a_model_of_another_stack_before_it_flies(mavfi, tmp_path):
    text = (
        'name = "other"\nrepetitions = 1\n[factors]\nstack = "mavbench-release"\n'
        'detector = "gad"\nany_stack = {}\nwatch = ["paper", "extended"]\n'
    )
    specification = tmp_path / "other.toml"
    specification.write_text(text.format("false"))
    done = mavfi("campaign", "run", specification, "--out", tmp_path / "flown", "--quiet")
    assert done.returncode == 1
    assert "stack 'mavbench'" in done.stderr
    assert not (tmp_path / "flown").exists()
    specification.write_text(text.format("true"))
    missions = [m.config.detector for m in load_spec(str(specification)).missions()]
    assert [(each.any_stack, each.watch) for each in missions] == [
        (True, "paper"), (True, "extended"),
    ]  # fmt: skip


def test_a_fault_in_no_detector_is_refused(fly_short):
    with pytest.raises(FaultSpecError, match="--detector"):
        fly_short(fault=FaultConfig(target="detector"))
