"""Metrics of hand-made pairs, against numbers counted by hand."""

import math

import pyarrow as pa
import pytest
from made_flights import error_free, flight, pair, pairs_table, struck

from mavfi_cli.analysis import detectors as question

NO_SCORES = pa.table({"stage": [], "field": [], "score": []})


def answers(error_free, faults, *detectors):
    """What is found of pairs whose flights have no score."""
    free, hit = pairs_table(error_free), pairs_table(faults)
    about = {"schema": 2, "plan": None, "versions": {}, "errors": []}
    return question.results(detectors, free, hit, lambda _: (NO_SCORES, []), **about)


def row(rows):
    (found,) = [row for row in rows if (row.by, row.detector) == ("all", "gad")]
    return found


def error_free_metrics(pairs):
    return row(answers(pairs, [], "gad").error_free)


def fault_metrics(bare, pairs):
    return row(answers([], [*bare, *pairs], "none", "gad").faults)


def test_false_alarms_a_flight_hour():
    quiet = [error_free(seed=seed) for seed in range(8)]
    loud = error_free(watched=flight(1000.0, alarms_s=(1.0, 2.0, 3.0)), seed=8)
    found = error_free_metrics([*quiet, loud])
    assert found.hours == pytest.approx(1800 / 3600)
    assert (found.alarms, found.episodes) == (3, 1)
    assert found.alarms_per_hour.value == pytest.approx(6.0)
    assert found.alarms_per_hour.low < 6.0 < found.alarms_per_hour.high
    assert (found.with_alarm.count, found.with_alarm.total) == (1, 9)


def test_no_alarm_at_all_still_has_an_upper_limit():
    found = error_free_metrics([error_free(seed=seed) for seed in range(36)])  # one hour
    assert found.alarms_per_hour.value == 0.0
    # The Poisson mean of which nothing is seen with probability 2.5 %.
    assert math.exp(-found.alarms_per_hour.high) == pytest.approx(0.025)


def test_missions_without_a_flight_time_have_no_part_in_the_rate():
    cut_off = error_free(watched=flight(None, outcome="crash"))
    found = error_free_metrics([error_free(seed=2, watched=flight(alarms_s=(1.0,))), cut_off])
    assert (found.alarms_per_hour.value, found.alarms_per_hour.count) == (36.0, 1)
    assert math.isnan(error_free_metrics([cut_off]).alarms_per_hour.value)


def test_missions_lost_and_lengthened_by_false_alarms():
    pairs = [
        error_free(flight(), flight(102.0), seed=0),
        error_free(flight(), flight(104.0), seed=1),
        error_free(flight(), flight(100.0), seed=2),
        error_free(flight(), flight(None), seed=3),
        error_free(flight(outcome="timeout"), flight(250.0), seed=4),
    ]
    found = error_free_metrics(pairs)
    assert (found.lost.count, found.lost.total, found.gained) == (1, 4, 1)
    assert found.lengthening.value == pytest.approx(0.02)
    assert found.lengthening.count == 3


# Unprotected and protected flights of six faults; golden flights take 100 s and succeed.
LOST, LONGER, HARMLESS = struck(None), struck(150.0), struck(101.0)
UNREAD = struck(injected="not_activated")
ABSENT = flight(injected="not_injected")
CASES = [
    (LOST, struck(103.0, alarms_s=(20.0,))),  # recovered, seen at once
    (LOST, struck(None, alarms_s=(20.4,))),  # seen, but lost all the same
    (LONGER, struck(120.0, alarms_s=(10.0, 20.2))),  # better, yet not undone
    (HARMLESS, struck(101.0)),  # not seen, not needed
    (HARMLESS, struck(300.0, outcome="timeout", alarms_s=(30.0,))),  # made worse
    (UNREAD, struck(alarms_s=(20.0,))),
    (ABSENT, flight(alarms_s=(50.0,))),
]


@pytest.fixture(scope="module")
def found():
    bare = [pair(faulty, seed=seed) for seed, (faulty, _) in enumerate(CASES)]
    pairs = [pair(*case, seed=seed) for seed, case in enumerate(CASES)]
    return fault_metrics(bare, pairs)


def test_faults_without_effect_are_counted_apart(found):
    assert (found.planned, found.not_injected, found.not_activated, found.active) == (7, 1, 1, 5)
    assert (found.detected_inactive.count, found.detected_inactive.total) == (1, 1)


def test_harm(found):
    assert (found.harmful.count, found.harmful.total) == (3, 5)
    assert (found.lost, found.longer) == (2, 1)


def test_detection(found):
    assert (found.detected_harmful.count, found.detected_harmful.total) == (3, 3)
    assert (found.detected_active.count, found.detected_active.total) == (4, 5)
    assert found.latency_s.value == pytest.approx(0.2)  # of 0, 0.4 and 0.2
    assert found.latency_ticks == pytest.approx(10.0)  # ticks of 20 ms
    assert found.latency_s_p95.value == pytest.approx(0.38)


def test_recovery(found):
    assert (found.recovered.count, found.recovered.total) == (1, 2)
    assert (found.undone.count, found.undone.total) == (1, 3)
    assert (found.added.count, found.added.total) == (1, 2)
    assert (found.unprotected.count, found.unprotected.total) == (3, 5)
    assert found.protected["share"] == pytest.approx(3 / 5)
    assert (found.success.only_first, found.success.only_second) == (1, 1)


def test_worst_case_and_its_recovery(found):
    assert (found.worst.faulty, found.worst.protected) == pytest.approx((0.5, 0.2))
    assert found.worst.recovered.value == pytest.approx(0.3)
    assert found.worst.recovered_share == pytest.approx(0.6)


def test_a_worst_flight_that_is_no_harm_needs_no_recovery():
    worst = fault_metrics([pair(HARMLESS)], [pair(HARMLESS, struck(90.0))]).worst
    assert (worst.faulty, worst.protected) == pytest.approx((0.01, -0.1))
    assert math.isnan(worst.recovered_share)


def test_harmless_faults_of_incomplete_missions_count_by_their_number_only():
    """Two of four harmless faults are flown with the detector, one of them is lost."""
    bare = [pair(HARMLESS, seed=seed) for seed in range(4)] + [pair(LOST, seed=4)]
    flown_too = [
        pair(HARMLESS, struck(), seed=0),
        pair(HARMLESS, struck(None), seed=1),
        pair(LOST, struck(alarms_s=(20.0,)), seed=4, complete=False),
    ]
    found = fault_metrics(bare, flown_too)
    assert (found.active, found.flown) == (5, 3)
    assert found.harmful.total == 5
    assert (found.detected_active.count, found.detected_active.total) == (0, 2)
    assert (found.detected_harmful.count, found.detected_harmful.total) == (1, 1)
    assert found.protected["share"] == pytest.approx(4 / 5 * 1 / 2 + 1 / 5)
    assert found.success.pairs == 2  # of the complete missions


def test_a_mission_that_fails_without_the_fault_cannot_be_harmed():
    doomed = [pair(LOST, golden=flight(outcome="timeout"), seed=1)]
    protected = [pair(LOST, struck(), golden=flight(outcome="timeout"), seed=1)]
    found = fault_metrics([pair(LOST), *doomed], [pair(LOST, struck()), *protected])
    assert (found.planned, found.golden_failed, found.active) == (2, 1, 1)
    assert (found.harmful.count, found.harmful.total, found.recovered.total) == (1, 1, 1)
    assert found.success.pairs == 1


def test_without_an_active_fault_nothing_is_known():
    nothing = fault_metrics([pair(ABSENT)], [pair(ABSENT, ABSENT)])
    assert (nothing.planned, nothing.active) == (1, 0)
    assert math.isnan(nothing.harmful.share)
    assert math.isnan(nothing.latency_s.value)
    assert math.isnan(nothing.worst.recovered_share)
    assert math.isnan(nothing.protected["share"])


def test_two_detectors_on_the_same_faults():
    first = [pair(LOST, struck(), seed=seed) for seed in range(3)]
    second = [pair(LOST, struck(None), seed=seed, detector="aad") for seed in (2, 1, 5)]
    first.append(pair(LONGER, struck(150.0), seed=9))
    second.append(pair(LONGER, struck(), seed=9, detector="aad"))
    (compared,) = answers([], [*first, *second], "gad", "aad").comparisons
    kinds = ("both", "only_first", "only_second", "neither")
    assert [getattr(compared.recovered, kind) for kind in kinds] == [0, 2, 0, 0]
    assert [getattr(compared.undone, kind) for kind in kinds] == [0, 2, 1, 0]
