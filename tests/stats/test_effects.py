"""Effects with intervals against scipy and closed forms, and the rule of the verdicts."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from mavfi_cli.stats.paired import (
    ClaimVerdict,
    McNemar,
    correlation,
    excess_over_mean,
    recovered_share,
)
from mavfi_cli.stats.shares import Interval, wilson


def between(low, high):
    return Interval(value=(low + high) / 2, low=low, high=high, count=9)


@pytest.mark.parametrize(
    ("effect", "low", "high", "verdict"),
    [
        (between(0.1, 0.2), 0.0, math.inf, ClaimVerdict.REPRODUCED),
        (between(0.0, 0.2), 0.0, math.inf, ClaimVerdict.OPEN),
        (between(-0.1, 0.2), 0.0, math.inf, ClaimVerdict.OPEN),
        (between(-0.2, 0.0), 0.0, math.inf, ClaimVerdict.NOT_REPRODUCED),
        (between(0.1, 0.2), 0.0, 0.15, ClaimVerdict.OPEN),
        (between(0.2, 0.3), 0.0, 0.15, ClaimVerdict.NOT_REPRODUCED),
        (between(-0.3, -0.2), -math.inf, 0.0, ClaimVerdict.REPRODUCED),
        (between(math.nan, math.nan), 0.0, math.inf, ClaimVerdict.NOT_FLOWN),
        (None, 0.0, math.inf, ClaimVerdict.NOT_FLOWN),
    ],
)
def test_the_whole_interval_decides(effect, low, high, verdict):
    assert ClaimVerdict.of(effect, low, high) is verdict


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
    few, many = (McNemar.of([True] * n, [True] * n).effect for n in (20, 2000))  # nothing differs
    assert few.value == many.value == 0.0
    assert few.low < many.low < 0.0 < many.high < few.high
    worse = McNemar.of([True] * 100, [False] * 30 + [True] * 70).effect
    assert worse.value == pytest.approx(-0.3)
    assert -0.42 < worse.low < -0.3 < worse.high < -0.2


def test_a_paired_difference_covers_the_truth():
    rng = np.random.default_rng(3)
    inside = 0
    for _ in range(400):
        first = rng.random(80) < 0.9
        second = first & (rng.random(80) < 0.9)
        found = McNemar.of(first, second).effect
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


def test_the_longest_of_many_flights():
    found = wilson(1, 100).longest_reaches(300)
    assert found.value == pytest.approx(1.0 - 0.99**300)
    assert found.low < found.value < found.high <= 1.0
    assert wilson(0, 10).longest_reaches(300).low == 0.0
    assert wilson(10, 10).longest_reaches(3).value == 1.0


def test_a_correlation_is_scipys():
    rng = np.random.default_rng(5)
    first = rng.normal(size=30)
    second = first + rng.normal(size=30)
    found = correlation([*zip(first.tolist(), second.tolist(), strict=True)])
    z = math.atanh(stats.pearsonr(first, second).statistic)
    half = stats.norm.ppf(0.975) / math.sqrt(27)
    assert (found.low, found.high) == pytest.approx((math.tanh(z - half), math.tanh(z + half)))


def test_a_constant_correlates_with_nothing():
    assert math.isnan(correlation([(1.0, 2.0), (1.0, 3.0), (1.0, 4.0), (1.0, 5.0)]).value)


def test_the_longest_over_the_mean():
    assert excess_over_mean([10.0, 20.0, 30.0], [40.0]) == (0.5, 1.0)
    assert all(map(math.isnan, excess_over_mean([], [40.0])))
