import numpy as np
import pyarrow.parquet as pq
import pytest
from detect_builders import plan, trace

from mavfi_cli.core.errors import ModelError
from mavfi_cli.core.types import Stage
from mavfi_cli.detect import base
from mavfi_cli.detect.offline import FlightSamples, PlanStrike, columns_of, replay
from mavfi_cli.detect.preprocess import NAMES


def test_every_message_is_judged_once_and_in_order():
    judged = list(replay(trace(4.0), None))
    assert sum(each.report is not None for each in judged) == 14  # every 0.3 s, equal ones too
    assert sum(each.new_waypoint for each in judged) == 8  # every 0.5 s
    assert sum(each.report is None for each in judged) == 200
    stamps = [each.stamp_s for each in judged]
    assert stamps == sorted(stamps)
    assert all(each.alarm is None and each.score == 0.0 for each in judged)


def test_without_the_telling_columns_equal_messages_are_one():
    columns = trace(4.0)
    del columns["report_stamp_s"], columns["waypoint_index"]
    columns["future_collision_seq"][:] = 0
    columns["time_to_collision"][:] = np.inf
    judged = list(replay(columns, None))
    assert sum(each.report is not None for each in judged) == 1
    assert sum(each.new_waypoint for each in judged) == 8  # their positions differ


@pytest.mark.parametrize("name", ["gad", "aad", "l2", "range"])
def test_a_struck_waypoint_is_found_where_it_is(name):
    columns = trace(6.0)
    columns["waypoint_x"][100:125] = -1e99
    alarms = [j for j in replay(columns, base.find_detector(name), patience=10**6) if j.alarm]
    assert {each.stamp_s for each in alarms} == set(columns["stamp_s"][100:125].tolist())
    assert alarms[0].alarm.states[0] == "waypoint_x"
    # A score does not depend on the threshold where every message becomes the reference.
    follows = [j.score for j in replay(columns, base.find_detector(name))]
    lenient = [j.score for j in replay(columns, base.find_detector(name, threshold=1e9))]
    if name != "gad":  # which learns from what its threshold lets pass
        assert follows == lenient
    assert [s > base.find_detector(name).threshold for s in follows].count(True) == 2


@pytest.fixture
def planned():
    """A flight of 6 s, and the one plan that is flown in it."""
    columns = trace(6.0)
    columns["trajectory_stamp_s"] = np.zeros(len(columns["stamp_s"]))
    return columns, plan(13)


FAR = PlanStrike(stamp_s=1.0, state="waypoint_x", waypoint=8, before=13.6, after=-1e99)


@pytest.mark.parametrize("name", ["gad", "aad", "l2", "range"])
def test_a_struck_waypoint_is_seen_ahead_as_soon_as_it_is_struck(name, planned):
    columns, flown = planned
    threshold = base.find_detector(name).threshold
    assert flown.waypoints[8, 0] == FAR.before

    def high(strikes):
        judged = replay(columns, base.find_detector(name), plans=[flown], strikes=strikes)
        return [each.stamp_s for each in judged if each.score > threshold]

    assert high([]) == []
    # At the strike, then at each begun waypoint up to the one from which the step back leaves.
    assert high([FAR]) == pytest.approx([1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0])


def test_a_plan_that_was_published_with_the_value_is_seen_when_it_is_new(planned):
    columns, flown = planned
    flown.waypoints[8, 0] = FAR.after
    judged = replay(columns, base.find_detector("range"), plans=[flown], strikes=[FAR])
    assert next(each.stamp_s for each in judged if each.score > 1.0) == 0.0


def test_looks_ahead_need_to_know_which_plan_is_flown(planned):
    columns, flown = planned
    del columns["trajectory_stamp_s"]
    with pytest.raises(ModelError, match="needs the columns trajectory_stamp_s"):
        list(replay(columns, None, plans=[flown]))


def test_patience_is_how_many_alarms_in_a_row_are_obeyed():
    columns = trace(6.0)
    columns["command_vx"][100:] = -1e99
    for patience, expected in ((0, 1), (3, 4)):
        judged = replay(columns, base.find_detector("range"), patience=patience)
        assert sum(j.alarm is not None for j in judged) == expected


def test_only_protected_stages_are_judged():
    columns = trace(6.0)
    columns["waypoint_x"][100:125] = -1e99
    alarms = [
        j for j in replay(columns, base.find_detector("gad"), protect=frozenset({Stage.CONTROL}))
        if j.alarm
    ]  # fmt: skip
    assert alarms == []


def test_a_nan_is_a_value_and_a_null_is_none():
    columns = trace(2.0)
    plain = {name: np.ma.array(column, mask=False) for name, column in columns.items()}
    plain["command_vy"][50] = np.nan
    alarms = [j for j in replay(plain, base.find_detector("gad"), patience=9) if j.alarm]
    assert [each.stamp_s for each in alarms] == [1.0]
    plain["command_yaw"][:50] = np.ma.masked
    assert sum(j.report is None for j in replay(plain, None)) == 50


def test_steps_of_plans_are_what_the_gate_looks_at():
    """All steps, also those in which no code changes, with the other stages' states at 0."""
    flown = plan(20)
    flown.waypoints[9, 4:6] = -2.5, 2.5
    flight = FlightSamples.of_trace(trace(1.0), "w", 1, plans=[flown])
    steps = flight.deltas[flight.plan_steps]
    assert steps.shape == (19, 13)
    changed = np.flatnonzero(steps.any(axis=1)).tolist()
    assert {8, 9} < set(changed)
    place = NAMES.index("waypoint_vx")
    assert steps[8, place] == -steps[9, place] == -2
    assert not steps[:, 9:].any()
    assert not FlightSamples.of_trace(trace(1.0), "w", 1, plans=[plan(1)]).plan_steps.any()


def test_a_missing_column_is_named():
    columns = trace(1.0)
    del columns["waypoint_vx"]
    with pytest.raises(ModelError, match="the trace has no column 'waypoint_vx'"):
        list(replay(columns, None))


def test_a_real_flight_gives_samples(short_flight):
    columns = columns_of(pq.read_table(short_flight.trace))
    flight = FlightSamples.of_trace(columns, "farm", 5)
    assert flight.reports.sum() > 0
    assert flight.new_waypoint.sum() > 5
    ticks = flight.deltas[~flight.reports]
    assert len(ticks) > 100
    assert (ticks[:, NAMES.index("command_vx")] != 0).any()
    again = FlightSamples.of_trace(columns, "farm", 5)
    np.testing.assert_array_equal(flight.deltas, again.deltas)
