import numpy as np
import pytest
from detect_builders import command, plan, report

from mavfi_cli.core.types import Stage
from mavfi_cli.detect import base
from mavfi_cli.detect.gate import Gate
from mavfi_cli.detect.preprocess import NAMES

HUGE = 1e200


class Notes:
    """A detector that writes down what it is asked, and alarms on any change beyond a limit."""

    name = "notes"

    def __init__(self, per_stage, limit=50):
        self.per_stage = per_stage
        self.threshold = float(limit)
        self.memory = {}
        self.scored, self.learned = [], []

    def score(self, deltas, stage):
        self.scored.append((stage, deltas.tolist()))
        first, end = {Stage.PERCEPTION: (0, 2), Stage.PLANNING: (2, 9), Stage.CONTROL: (9, 13)}[
            stage
        ]
        watched = deltas[first:end] if self.per_stage else deltas
        return float(np.abs(watched.astype(int)).max())

    def learn(self, deltas, stage):
        self.learned.append((stage, deltas.tolist()))


def corrupted(trajectory, index, column, value):
    waypoints = trajectory.waypoints.copy()
    waypoints[index, column] = value
    return type(trajectory)(
        stamp_s=0.0, waypoints=waypoints, durations_s=trajectory.durations_s, trajectory_seq=1,
        future_collision_seq=0,
    )  # fmt: skip


def primed(per_stage=True, protect=frozenset(Stage)):
    detector = Notes(per_stage)
    gate = Gate(detector, protect)
    trajectory = plan()
    assert gate.judge_report(report()) is None
    assert gate.judge_tick(trajectory, 0, command()) is None
    detector.scored.clear()
    detector.learned.clear()
    return gate, detector, trajectory


def test_a_waypoint_is_new_when_index_or_trajectory_change():
    gate, detector, trajectory = primed()
    gate.judge_tick(trajectory, 0, command())
    assert gate.fresh == (Stage.CONTROL,)
    gate.judge_tick(trajectory, 1, command())
    assert gate.fresh == (Stage.PLANNING, Stage.CONTROL)
    gate.judge_tick(plan(), 1, command())
    assert gate.fresh == (Stage.PLANNING, Stage.CONTROL)
    gate.judge_tick(None, -1, command())
    assert gate.fresh == (Stage.CONTROL,)
    assert [stage for stage, _ in detector.scored].count(Stage.PLANNING) == 2


@pytest.mark.parametrize("per_stage", [True, False])
def test_a_bad_waypoint_alarms_and_is_not_the_reference(per_stage):
    gate, detector, trajectory = primed(per_stage)
    bad = corrupted(trajectory, 1, 4, HUGE)
    alarm = gate.judge_tick(bad, 1, command())
    assert alarm is not None
    assert alarm.stage is (Stage.PLANNING if per_stage else Stage.CONTROL)
    assert (alarm.detector, alarm.states, alarm.threshold) == ("notes", ("waypoint_vx",), 50.0)
    assert alarm.score > 50.0
    assert detector.learned == []
    # The same message again is still new, and still bad; the right one is right.
    assert gate.judge_tick(bad, 1, command()) is not None
    assert gate.judge_tick(trajectory, 1, command()) is None
    assert len(detector.learned) == (2 if per_stage else 1)


@pytest.mark.parametrize("per_stage", [True, False])
def test_what_is_accepted_in_spite_of_an_alarm_becomes_the_reference(per_stage):
    gate, detector, trajectory = primed(per_stage)
    bad = corrupted(trajectory, 1, 4, HUGE)
    assert gate.judge_tick(bad, 1, command(vx=HUGE)) is not None
    gate.accept_tick()
    assert detector.learned == []
    assert gate.judge_tick(bad, 1, command(vx=HUGE)) is None
    assert gate.fresh == (Stage.CONTROL,)
    alarm = gate.judge_tick(trajectory, 2, command(vx=HUGE))
    assert alarm is not None
    assert alarm.states == ("waypoint_vx",)


def test_a_bad_command_leaves_a_good_waypoint_accepted():
    gate, detector, trajectory = primed()
    alarm = gate.judge_tick(trajectory, 1, command(vy=HUGE))
    assert alarm is not None
    assert (alarm.stage, alarm.states) == (Stage.CONTROL, ("command_vy",))
    assert [stage for stage, _ in detector.learned] == [Stage.PLANNING]
    assert gate.judge_tick(trajectory, 1, command()) is None
    assert gate.fresh == (Stage.CONTROL,)


@pytest.mark.parametrize("per_stage", [True, False])
def test_a_bad_report(per_stage):
    gate, detector, _ = primed(per_stage)
    alarm = gate.judge_report(report(seq=2**30))
    assert alarm is not None
    assert alarm.stage is (Stage.PERCEPTION if per_stage else Stage.CONTROL)
    assert alarm.states == ("future_collision_seq",)
    assert gate.judge_report(report(seq=1)) is None
    assert gate.judge_report(report(seq=2**30)) is not None
    gate.accept_report()
    assert gate.judge_report(report(seq=2**30)) is None
    assert len(detector.learned) == 2


def test_a_detector_over_all_stages_sees_a_report_with_the_next_tick_only():
    gate, detector, trajectory = primed(per_stage=False)
    gate.judge_report(report(time_s=3.0, seq=1))
    gate.judge_tick(trajectory, 1, command())
    gate.judge_tick(trajectory, 1, command())
    seen = [deltas[:2] for _, deltas in detector.scored]
    assert seen == [[-3, 1], [-3, 1], [0, 0]]
    # One that raised an alarm is not seen again, even when it is accepted.
    detector.scored.clear()
    gate.judge_report(report(seq=2**30))
    gate.accept_report()
    gate.judge_tick(trajectory, 1, command())
    assert detector.scored[-1] == (Stage.CONTROL, [0] * 13)


@pytest.mark.parametrize("per_stage", [True, False])
@pytest.mark.parametrize("stage", list(Stage))
def test_only_protected_stages_raise_alarms(per_stage, stage):
    gate, _, trajectory = primed(per_stage, frozenset({stage}))
    found = {
        Stage.PERCEPTION: gate.judge_report(report(seq=2**30)),
        Stage.CONTROL: gate.judge_tick(trajectory, 0, command(vx=HUGE)),
        Stage.PLANNING: gate.judge_tick(corrupted(trajectory, 0, 0, HUGE), 0, command(vx=HUGE)),
    }
    if stage is Stage.CONTROL:  # the huge command is still anomalous in the next tick
        assert found.pop(Stage.PLANNING) is not None
    assert {where for where, alarm in found.items() if alarm is not None} == {stage}


@pytest.mark.parametrize("per_stage", [True, False])
@pytest.mark.parametrize("column", [0, 3, 4])
@pytest.mark.parametrize("value", [HUGE, -HUGE, np.nan, np.inf])
@pytest.mark.parametrize("index", [3, 4, 7, 18, 19])
def test_a_plan_is_looked_through_without_a_trace(per_stage, column, value, index):
    """Wherever the bad waypoint is from the present one on, the alarm names it."""
    gate, detector, trajectory = primed(per_stage)
    before = gate.memory["gate"].copy()
    bad = corrupted(trajectory, index, column, value)
    for looked_from in (0, 3):
        assert gate.judge_ahead(trajectory, looked_from) is None
        alarm = gate.judge_ahead(bad, looked_from)
        assert alarm is not None
        assert alarm.waypoint == index
        assert alarm.states == (NAMES[2 + column],)
        assert alarm.stage is (Stage.PLANNING if per_stage else Stage.CONTROL)
    assert gate.judge_ahead(bad, index + 1) is None  # behind the vehicle
    # As it is published, only a detector that judges planning alone can ask for another plan.
    assert gate.judge_plan(bad) == (gate.judge_ahead(bad, 0) if per_stage else None)
    assert detector.learned == []
    np.testing.assert_array_equal(gate.memory["gate"], before)


def test_a_plan_of_an_unwatched_stage_or_without_a_step_is_not_looked_through():
    bad = corrupted(plan(), 7, 1, HUGE)
    for per_stage in (True, False):
        unwatched = Gate(Notes(per_stage), frozenset({Stage.CONTROL, Stage.PERCEPTION}))
        assert unwatched.judge_plan(bad) is unwatched.judge_ahead(bad, 0) is None
        assert Gate(Notes(per_stage)).judge_ahead(corrupted(plan(1), 0, 0, HUGE), 0) is None


def test_a_nan_threshold_or_score_is_an_alarm():
    gate, detector, trajectory = primed()
    detector.threshold = float("nan")
    assert gate.judge_tick(trajectory, 0, command()) is not None
    detector.threshold = 50.0
    detector.score = lambda deltas, stage: float("nan")
    assert gate.judge_tick(trajectory, 0, command()) is not None


def test_a_flip_in_the_gates_own_memory_takes_effect():
    gate, _, trajectory = primed()
    gate.memory["gate"][0, NAMES.index("command_vx")] ^= 1 << 12
    alarm = gate.judge_tick(trajectory, 0, command())
    assert alarm is not None
    assert alarm.states == ("command_vx",)


@pytest.mark.parametrize("name", ["gad", "aad", "l2", "range"])
def test_shipped_detectors_pass_a_quiet_flight_and_catch_a_wild_command(name):
    gate = Gate(base.find_detector(name))
    trajectory = plan()
    for tick in range(200):
        assert gate.judge_tick(trajectory, tick // 25, command(vx=2.2 + 0.001 * tick)) is None
    alarm = gate.judge_tick(trajectory, 8, command(vx=-1e80))
    assert alarm is not None
    assert alarm.stage is Stage.CONTROL
    assert alarm.states[0] == "command_vx"


class Plain:
    """A fitted detector as the gate sees one of another package: score and learn, nothing else."""

    def __init__(self, fitted):
        self._fitted = fitted
        self.name, self.per_stage = fitted.name, fitted.per_stage
        self.score, self.learn = fitted.score, fitted.learn

    threshold = property(lambda self: self._fitted.threshold)
    memory = property(lambda self: self._fitted.memory)


@pytest.mark.parametrize("name", ["aad", "gad"])
@pytest.mark.parametrize("accepted", [False, True])
def test_one_compiled_call_judges_as_single_ones_do(name, accepted):
    detector = base.find_detector(name)
    assert detector.tick_judge is not None
    fused, plain = Gate(detector), Gate(Plain(base.find_detector(name)))
    rng = np.random.default_rng(4)
    kinds = set()
    for number in range(60):
        flown = plan(speed=rng.uniform(1.0, 3.0))
        if number % 3 == 0:
            row, column = rng.integers(20), rng.integers(7)
            flown = corrupted(flown, row, column, rng.choice([1e300, -1e-300, np.nan, 64.0]))
        for index in range(0, 20, 3):
            said = report(rng.choice([np.inf, 3.0, 1e-9, np.nan]), int(rng.integers(4)) ** 8)
            sent = command(*rng.choice([0.0, 1.0, 2.0, -1e200], 3, p=[0.3, 0.4, 0.25, 0.05]))
            for judge in (
                lambda gate, said=said: gate.judge_report(said),
                lambda gate, flown=flown, index=index: gate.judge_ahead(flown, index),
                lambda gate, flown=flown, index=index, sent=sent: gate.judge_tick(
                    flown, index, sent
                ),
            ):
                alarms = [judge(fused), judge(plain)]
                assert repr(alarms[0]) == repr(alarms[1])  # a NaN is not equal to itself
                if alarms[0] is not None:
                    kinds.add((alarms[0].stage, alarms[0].waypoint is None))
            if accepted:
                fused.accept_tick()
                plain.accept_tick()
        for part in fused.memory:
            np.testing.assert_array_equal(fused.memory[part], plain.memory[part])
    assert (Stage.CONTROL, True) in kinds
    assert (Stage.PLANNING if name == "gad" else Stage.CONTROL, False) in kinds
