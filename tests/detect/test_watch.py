"""The states beyond the 13, judged one by one."""

from dataclasses import replace

import numpy as np
import pytest
from detect_builders import RANGES, command, plan, report, trace

from mavfi_cli.core.types import CollisionReport, Stage, Trajectory
from mavfi_cli.detect import base
from mavfi_cli.detect.gate import Gate
from mavfi_cli.detect.offline import FlightSamples
from mavfi_cli.detect.preprocess import EXTENDED

OURS = ["gad", "aad", "range", "l2"]
FIRST = plan()
STATES = ("plan_trajectory_seq", "plan_future_collision_seq")


def numbered(seq, known=0, stamp_s=0.0):
    return replace(FIRST, trajectory_seq=seq, future_collision_seq=known, stamp_s=stamp_s)


def gate_of(name, *, ranges=RANGES, **options):
    return Gate(base.find_detector(name), extended=ranges, **options)


@pytest.mark.parametrize("name", OURS)
@pytest.mark.parametrize(
    ("wrong", "state", "score"),
    [
        (numbered(4), STATES[0], 2.0),
        (numbered(0), STATES[0], 1.0),
        (numbered(2, 3), STATES[1], 1.0),
        (numbered(2, -1), STATES[1], 1.0),
        (numbered(2, 2**31 - 1), STATES[1], 32765.0),
    ],
)
def test_a_plan_whose_number_leaves_its_range_is_an_alarm_of_planning(name, wrong, state, score):
    gate = gate_of(name)
    assert gate.judge_plan(numbered(1)) is None
    alarm = gate.judge_plan(wrong)
    assert (alarm.stage, alarm.states, alarm.score) == (Stage.PLANNING, (state,), score)
    assert not alarm.score <= alarm.threshold
    assert (alarm.waypoint, alarm.mended) == (None, None)


@pytest.mark.parametrize("name", OURS)
def test_numbers_within_their_ranges_are_no_alarm(name):
    gate = gate_of(name)
    for seq, known in ((1, 0), (2, 2), (2, 2), (3, 3)):
        assert gate.judge_plan(numbered(seq, known)) is None


def test_the_first_message_is_judged_as_well():
    assert gate_of("aad").judge_plan(numbered(1025)).states == (STATES[0],)


def test_the_worst_state_is_named_first():
    gate = gate_of("aad")
    gate.judge_plan(numbered(1))
    assert gate.judge_plan(numbered(4, 500)).states == (STATES[1], STATES[0])


def test_a_plan_that_was_withheld_counts_where_the_planner_counts_by_itself():
    gate = gate_of("gad")
    gate.judge_plan(numbered(1))
    assert gate.judge_plan(numbered(1025)) is not None
    assert gate.judge_plan(numbered(3)) is None  # two more than 1: one was withheld
    assert gate.judge_plan(numbered(5)) is not None  # the row is over
    for _ in range(3):
        gate.lose_plan()
    assert gate.judge_plan(numbered(8)) is None


def test_a_plan_that_is_withheld_for_its_waypoints_is_no_reference():
    gate = gate_of("gad")
    gate.judge_plan(numbered(1))
    waypoints = FIRST.waypoints.copy()
    waypoints[7, 0] = -1e200
    assert gate.judge_plan(replace(numbered(2, 2), waypoints=waypoints)).waypoint == 7
    assert gate.judge_plan(numbered(1, 4)) is None  # two changes of 2


def test_a_plan_that_passes_nevertheless_is_the_reference():
    gate = gate_of("aad")
    gate.judge_plan(numbered(1))
    far = numbered(1000)
    assert gate.judge_plan(far) is not None
    gate.accept_plan(far)
    assert gate.judge_plan(numbered(1001)) is None


@pytest.mark.parametrize("name", OURS)
def test_a_number_that_changes_in_the_flown_plan_is_mended(name):
    gate = gate_of(name)
    flown = numbered(1, 0, stamp_s=4.0)
    gate.judge_plan(flown)
    assert gate.judge_plan(numbered(2, 0, stamp_s=9.0)) is None  # waits; `flown` is still flown
    assert gate.judge_ahead(flown, 3) is None
    struck = replace(flown, future_collision_seq=16384)
    alarm = gate.judge_ahead(struck, 3)
    assert (alarm.stage, alarm.states) == (Stage.PLANNING, (STATES[1],))
    assert (alarm.mended.trajectory_seq, alarm.mended.future_collision_seq) == (1, 0)
    assert alarm.mended.waypoints is struck.waypoints
    assert gate.judge_ahead(alarm.mended, 3) is None
    assert gate.judge_ahead(replace(struck, stamp_s=5.0), 3) is None  # a plan it never saw


def test_collision_is_judged_with_the_report():
    gate = gate_of("gad", ranges={**RANGES, "collision": (0, 0)})
    gate.judge_tick(None, -1, command())
    assert gate.judge_report(report()) is None
    alarm = gate.judge_report(replace(report(), collision=True))
    assert (alarm.stage, alarm.states) == (Stage.PERCEPTION, ("collision",))
    gate.accept_report()
    assert gate.judge_report(replace(report(), collision=True)) is None
    gate = gate_of("gad")  # as the shipped models have it: a flip looks like news
    gate.judge_report(report())
    assert gate.judge_report(replace(report(), collision=True)) is None


@pytest.mark.parametrize("stage", [Stage.PERCEPTION, Stage.PLANNING])
def test_only_protected_stages_are_watched(stage):
    narrow = {**RANGES, "collision": (0, 0)}
    gate = gate_of("aad", ranges=narrow, protect=frozenset({stage}))
    gate.judge_report(report())
    gate.judge_plan(numbered(1))
    found = gate.judge_report(replace(report(), collision=True)), gate.judge_plan(numbered(99))
    assert [alarm is not None for alarm in found] == [
        stage is Stage.PERCEPTION, stage is Stage.PLANNING,
    ]  # fmt: skip
    assert (gate.judge_ahead(numbered(99), 0) is not None) is (stage is Stage.PLANNING)


def test_what_the_watch_decides_by_is_part_of_the_gates_memory():
    assert "watch" not in Gate(base.find_detector("gad")).memory
    gate = gate_of("gad")
    gate.judge_plan(numbered(1))
    gate.memory["watch"][0, 1] += 1024  # the reference of trajectory_seq
    assert gate.judge_plan(numbered(2)).states == (STATES[0],)
    gate.memory["watch"][1] = -2048  # and now all that is smaller will do
    assert gate.judge_plan(numbered(2)) is None


@pytest.mark.parametrize("name", OURS)
def test_watching_more_changes_nothing_for_the_13_states(name):
    plain, wide = Gate(base.find_detector(name)), gate_of(name)
    rng = np.random.default_rng(6)
    for number in range(40):
        flown = numbered(number + 1, stamp_s=float(number))
        flown.waypoints[:, 4] = rng.uniform(1.0, 3.0)
        said, sent = report(rng.choice([np.inf, 3.0]), number), command(rng.choice([1.0, 2.0]))
        for judge in (
            lambda gate, said=said: gate.judge_report(said),
            lambda gate, flown=flown: gate.judge_plan(flown),
            lambda gate, flown=flown: gate.judge_ahead(flown, 0),
            lambda gate, flown=flown, sent=sent: gate.judge_tick(flown, 0, sent),
        ):
            assert repr(judge(plain)) == repr(judge(wide))
    for part, array in plain.memory.items():
        np.testing.assert_array_equal(array, wide.memory[part])


def test_a_flight_tells_the_changes_of_its_messages():
    columns = trace(4.0)
    columns["collision"] = np.isfinite(columns["time_to_collision"])
    plans = [numbered(seq, known) for seq, known in ((1, 0), (2, 0), (4, 5), (-1, 5))]
    flown = FlightSamples.of_trace(columns, "w", 1, plans=plans)
    assert flown.extended.shape == (len(flown.deltas), 3)
    first_steps = np.flatnonzero(flown.plan_steps)[:: len(FIRST.waypoints) - 1]
    assert flown.extended[first_steps].tolist() == [[0, 1, 0], [0, 1, 0], [0, 2, 5], [0, -5, 0]]
    assert set(flown.extended[flown.reports, 0].tolist()) == {-1, 0, 1}
    others = flown.extended.copy()
    others[first_steps], others[flown.reports] = 0, 0
    assert not others.any()
    assert {state.message for state in EXTENDED} == {CollisionReport, Trajectory}
