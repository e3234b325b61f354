"""What faults cost on each platform, against numbers made by hand and by NumPy."""

import math
from dataclasses import astuple

import numpy as np
import pytest
from made_flights import SEEDS, compared, on

from mavfi_cli.analysis.platforms import FaultCosts, WorstFault
from mavfi_cli.stats.shares import Interval


def struck(golden, counted, setting="none"):
    return FaultCosts(compared([*golden, *counted]).chosen(setting=setting))


def cost_row(setting, found):
    return found.row("x86", setting)


def beyond(found, first):
    return found.beyond(first, "tx2", "none", "x86")


def of(platform, costs, *, golden_s=20.0, target="planning", lost=()):
    """Flights whose faults cost so many seconds, by seed, beside their golden ones."""
    golden = [on(platform, seed, golden_s) for seed in {*costs, *lost}]
    counted = [on(platform, s, golden_s + c, "none", target=target) for s, c in costs.items()]
    counted += [on(platform, s, 5.0, "none", target=target, outcome="collision") for s in lost]
    return struck(golden, counted)


def test_the_cost_is_held_against_the_own_golden_flight():
    golden = [on("x86", 1, 20.0), on("x86", 2, 40.0), on("x86", 5, 40.0)]
    counted = [on("x86", 1, 25.0, "none"), on("x86", 2, 44.0, "none")]
    bare = struck(golden, counted)
    told = cost_row("none", bare)
    assert told.pairs == 2
    assert told.cost_s.mean.value == pytest.approx(4.5)
    assert told.cost_s.largest == pytest.approx(5.0)
    assert told.over_own.largest == pytest.approx(1.25)
    assert told.worst_flight == WorstFault(seed=1, target="planning", fault_seed=7)
    assert math.isnan(told.over_own.recovered_share)  # there is no detector


def test_a_flight_that_only_the_fault_lost_is_counted_as_lost_and_costs_nothing():
    found = of("x86", {1: 0.0, 2: 1.0}, lost=(3, 4))
    told = cost_row("none", found)
    assert (told.pairs, told.lost) == (2, 2)
    golden_lost = struck([on("x86", 1, 20.0)], [on("x86", 2, 5.0, "none", outcome="crash")])
    assert cost_row("none", golden_lost).lost == 0


def recovered(bare, protected):
    """The share that a detector recovers of costs by seed, s, over golden flights of 20 s."""
    golden = [on("x86", seed, 20.0) for seed in {*bare, *protected}]
    costs = {"none": bare, "gad": protected}
    faulty = [on("x86", seed, 20.0 + c, name) for name in costs for seed, c in costs[name].items()]
    return cost_row("gad", struck(golden, faulty, "gad")).over_own.recovered_share


def test_a_detector_recovers_a_share_of_the_largest_increase():
    bare = {1: 0.0, 2: 10.0}
    assert recovered(bare, {1: 2.5, 2: 1.0}) == 0.75
    assert recovered(bare, {1: 15.0, 2: 0.0}) == -0.5


def test_a_detector_recovers_nothing_of_a_fault_that_it_did_not_fly():
    assert recovered({1: 4.0, 2: 10.0}, {1: 2.0}) == pytest.approx(0.5)


def test_the_95th_percentile_is_numpys_and_lies_in_its_interval():
    rng = np.random.default_rng(4)
    costs = dict(enumerate(rng.exponential(1.0, 150).tolist()))
    found = of("x86", costs)
    late = cost_row("none", found).over_own.p95
    assert late.value == pytest.approx(np.quantile([1.0 + c / 20.0 for c in costs.values()], 0.95))
    assert late.low < late.value < late.high
    assert late.count == 150


def test_faults_of_one_mission_are_drawn_together():
    """Twice the same costs under another target are no more missions, and no narrower interval."""
    costs = {seed: 0.3 * (seed % 4) for seed in SEEDS}
    golden = [on("x86", seed, 20.0) for seed in SEEDS]
    once = [on("x86", s, 20.0 + c, "none", target="planning") for s, c in costs.items()]
    again = [on("x86", s, 20.0 + c, "none", target="control") for s, c in costs.items()]
    one, two = struck(golden, once), struck(golden, once + again)
    single, double = (cost_row("none", each).cost_s.mean for each in (one, two))
    assert astuple(single) == pytest.approx(astuple(double))
    assert single.low < single.high


def test_missing_flights_of_a_mission_leave_the_others():
    golden = [on("x86", seed, 20.0) for seed in SEEDS]
    counted = [on("x86", s, 21.0, "none", target="planning") for s in SEEDS]
    counted += [on("x86", s, 23.0, "none", target="control") for s in (2, 5)]
    found = struck(golden, counted)
    told = cost_row("none", found)
    values = [1.0] * 10 + [3.0] * 2
    assert told.pairs == 12
    assert told.cost_s.mean.value == pytest.approx(np.mean(values))
    over = [1.0 + value / 20.0 for value in values]
    assert told.over_own.p95.value == pytest.approx(np.quantile(over, 0.95))


def test_platforms_are_compared_over_the_faults_that_both_have_a_cost_of():
    first = of("x86", {1: 0.0, 2: 1.0, 3: 0.0, 4: 99.0})
    second = of("tx2", {1: 0.5, 2: 3.0, 3: 0.5, 5: 99.0})
    told = beyond(second, first)
    assert told.pairs == 3
    assert told.extra_s.value == pytest.approx(1.0)
    assert told.extra_s.low >= 0.5
    assert told.extra_s.high <= 2.0
    here, there = (np.quantile([1.0 + c / 20.0 for c in costs], 0.95) for costs in (
        (0.0, 1.0, 0.0), (0.5, 3.0, 0.5)))  # fmt: skip
    assert told.p95_ratio.value == pytest.approx(there / here)
    # A worst case is that of all flights of its platform.
    assert told.largest_ratio == pytest.approx(1.0)
    assert told.longest_ratio == pytest.approx(1.0)


def test_the_longest_flight_counts_where_its_golden_one_failed_too():
    first = struck([on("x86", 1, 20.0)], [on("x86", s, 20.0 * s, "none") for s in (1, 2)])
    second = struck([on("tx2", 1, 20.0)], [on("tx2", s, 30.0 * s, "none") for s in (1, 2)])
    assert (second.costs.num_rows, second.longest_s) == (1, 60.0)
    told = beyond(second, first)
    assert (told.pairs, told.longest_ratio) == (1, 1.5)


def test_equal_costs_differ_by_nothing_with_no_width():
    costs = {seed: float(seed % 3) for seed in SEEDS}
    told = beyond(of("tx2", costs), of("x86", costs))
    assert told.extra_s == Interval(value=0.0, low=0.0, high=0.0, count=10)
    assert told.p95_ratio == Interval(value=1.0, low=1.0, high=1.0, count=10)


def test_three_faults_that_cost_more_are_no_difference_whatever_the_interval():
    """A bootstrap of zeros and a few positive costs never falls below zero; chance is 2 in 8."""
    costs = dict.fromkeys(range(1, 51), 0.0)
    slower = of("tx2", costs | {3: 1.84, 14: 0.38, 15: 0.5})
    told = beyond(slower, of("x86", costs))
    assert (told.pairs, told.differ) == (50, 3)
    assert told.extra_s.low > 0.0
    assert told.p_value == pytest.approx(0.25)


def test_the_chance_takes_the_faults_of_one_mission_as_one():
    golden = [on(p, seed, 20.0) for p in ("x86", "tx2") for seed in SEEDS]

    def found(platform, cost_s):
        own = [each for each in golden if each["platform"] == platform]
        return struck(own, [on(platform, s, 20.0 + cost_s, "none", target=target)
                            for s in (1, 2, 3) for target in ("planning", "control")])  # fmt: skip

    told = beyond(found("tx2", 1.0), found("x86", 0.0))
    assert (told.pairs, told.differ, told.p_value) == (6, 6, 0.25)
