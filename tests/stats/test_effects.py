"""Effects with intervals, against scipy and closed forms."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from mavfi_cli.stats.paired import (
    net_share,
    paired_difference,
    recovered_share,
)
from mavfi_cli.stats.shares import Interval, wilson


def between(low, high):
    return Interval(value=(low + high) / 2, low=low, high=high, count=9)


def test_newcombes_interval_of_his_own_example():
    """Table II of Newcombe (1998), method 10: 56/70 against 48/80 is 0.0524 to 0.3339."""
    found = wilson(56, 70).minus(wilson(48, 80))
    assert (found.low, found.high) == pytest.approx((0.0524, 0.3339), abs=5e-5)
    assert found.value == pytest.approx(0.2)


@given(st.integers(1, 300), st.integers(0, 300), st.integers(0, 300))
def test_a_difference_turns_its_sign_with_its_order(total, first, second):
    one, other = (wilson(min(each, total), total) for each in (first, second))
    there, back = one.minus(other), other.minus(one)
    assert (there.low, there.high) == pytest.approx((-back.high, -back.low))
    assert there.low <= there.value <= there.high


def test_a_difference_of_effects_adds_distances_in_squares():
    found = between(0.1, 0.3).minus(between(-0.1, 0.1))
    half = math.hypot(0.1, 0.1)
    assert (found.value, found.low, found.high) == pytest.approx((0.2, 0.2 - half, 0.2 + half))


def test_a_paired_difference_narrows_with_the_pairs_and_keeps_a_width():
    few, many = (paired_difference([True] * n, [True] * n, range(n)) for n in (20, 2000))
    assert few.value == many.value == 0.0
    assert few.low < many.low < 0.0 < many.high < few.high
    worse = paired_difference([True] * 100, [False] * 30 + [True] * 70, range(100))
    assert worse.value == pytest.approx(-0.3)
    assert -0.42 < worse.low < -0.3 < worse.high < -0.2


def test_a_paired_difference_covers_the_truth():
    rng = np.random.default_rng(3)
    inside = 0
    for _ in range(400):
        first = rng.random(80) < 0.9
        second = first & (rng.random(80) < 0.9)
        found = paired_difference(first, second, range(80))
        inside += found.low <= -0.09 <= found.high
    assert inside >= 370


def test_recovered_is_a_ratio_whose_interval_is_wide_at_the_papers_n():
    found = recovered_share((95, 100), (265, 300), (283, 300))
    assert found.value == pytest.approx((283 - 265) / (285 - 265))
    assert found.low < 0.2
    assert found.high > 2.0
    sure = recovered_share((10_000, 10_000), (7_000, 10_000), (9_000, 10_000))
    half = stats.norm.ppf(0.975) * math.sqrt(0.09 + 0.21 / 9) / 100 / 0.3  # the delta method
    assert (sure.low, sure.high) == pytest.approx((2 / 3 - half, 2 / 3 + half), abs=1e-3)


def test_no_pairs_have_no_difference():
    assert math.isnan(paired_difference([], [], []).low)


def test_copies_of_a_mission_tell_no_more_than_the_mission():
    first, second = [True] * 40, [False] * 10 + [True] * 30
    once = paired_difference(first, second, range(40))
    twice = paired_difference(first * 2, second * 2, [*range(40)] * 2)
    free = paired_difference(first * 2, second * 2, range(80))
    wider = (once.high - once.low) / (twice.high - twice.low)
    assert wider == pytest.approx(math.sqrt(39 / 40), abs=0.01)  # of a sample's variance
    assert free.high - free.low < 0.75 * (twice.high - twice.low)
    assert twice.count == 80


def test_a_net_share_counts_what_is_undone_and_what_is_caused():
    before = np.array([True] * 50 + [False] * 950)
    undone, caused = np.array([False] * 1000), before.copy()
    caused[60:85] = True
    good, none, bad = (net_share(before, after, range(1000)) for after in (undone, before, caused))
    assert (good.value, none.value, bad.value) == (1.0, 0.0, -0.5)
    assert 0.9 < good.low < good.high == 1.0
    assert none.low < 0.0 < none.high < 0.1
    assert bad.low < -0.5 < bad.high < -0.25
    assert math.isnan(net_share(undone, before, range(1000)).low)


@pytest.mark.slow
def test_a_net_share_covers_the_truth():
    rng = np.random.default_rng(5)
    inside = 0
    for _ in range(200):
        before = rng.random(400) < 0.2
        after = np.where(before, rng.random(400) < 0.6, rng.random(400) < 0.05)
        found = net_share(before, after, range(400))  # (0.08 - 0.04) / 0.2
        inside += found.low <= 0.2 <= found.high
    assert inside >= 184
