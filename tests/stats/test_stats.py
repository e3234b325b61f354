"""Statistics against counting, closed forms, and the paper's own numbers."""

import itertools
import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from mavfi_cli.core.errors import ConfigError
from mavfi_cli.stats.bootstrap import FEW, LARGE, interval, mean, median
from mavfi_cli.stats.paired import McNemar, WorstCase, holm, sign_flips
from mavfi_cli.stats.shares import (
    Interval,
    cross_layer,
    missions_for_margin,
    mixture,
    pairs_for_difference,
    unseen_share,
    wilson,
)

COUNTS = st.integers(1, 500).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n)))


@given(COUNTS, st.sampled_from([0.8, 0.95, 0.99]))
def test_intervals_of_rates_are_wilsons(counts, confidence):
    successes, total = counts
    share = wilson(successes, total, confidence=confidence)
    oracle = stats.binomtest(successes, total).proportion_ci(confidence, method="wilson")
    assert (share.low, share.high) == pytest.approx((oracle.low, oracle.high), abs=1e-12)


@given(st.floats(0.005, 0.3), st.floats(0.0, 1.0), st.sampled_from([0.9, 0.95, 0.99]))
def test_the_planned_number_is_the_fewest_with_such_a_margin(margin, expected, confidence):
    count = missions_for_margin(margin, expected=expected, confidence=confidence)
    z = stats.norm.ppf(0.5 + confidence / 2)

    def half(n):
        return z / (1 + z * z / n) * math.sqrt(expected * (1 - expected) / n + (z / n) ** 2 / 4)

    assert half(count) <= margin + 1e-9
    assert count == 1 or half(count - 1) > margin - 1e-9


def test_the_planned_number_of_a_known_case():
    assert missions_for_margin(0.05) == 381
    enough, less = (wilson(190, missions) for missions in (381, 380))
    assert enough.high - enough.low <= 2 * 0.05 < less.high - less.low


@pytest.mark.parametrize("margin", [0.0, 1e-200, 0.5, -1.0, math.nan])
def test_an_impossible_margin_is_refused(margin):
    with pytest.raises(ConfigError, match="margin"):
        missions_for_margin(margin)


@given(st.lists(st.tuples(st.booleans(), st.booleans()), max_size=200))
def test_mcnemar_is_the_sign_test_of_the_pairs_that_differ(pairs):
    found = McNemar.of([a for a, _ in pairs], [b for _, b in pairs])
    differing = found.only_first + found.only_second
    few = min(found.only_first, found.only_second)
    tail = sum(math.comb(differing, heads) for heads in range(few + 1))
    assert found.p_value == pytest.approx(min(1.0, 2 * tail / 2**differing), rel=1e-9)
    assert found.pairs == len(pairs)
    if pairs:
        expected = np.mean([b for _, b in pairs]) - np.mean([a for a, _ in pairs])
        assert found.difference == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(("count", "least", "most"), [(3, 0.65, 0.85), (FEW, 0.86, 0.94)])
def test_how_often_an_interval_of_few_values_holds_the_true_mean(count, least, most):
    """Of 95 in a hundred that it promises; what the text says of few flights hangs on it."""
    rng = np.random.default_rng(8)
    found = [interval(rng.normal(size=count), resamples=999) for _ in range(400)]
    assert least < np.mean([each.low <= 0.0 <= each.high for each in found]) < most


@given(st.lists(st.integers(-20, 20), min_size=1, max_size=7))
def test_sign_flips_count_all_patterns(differences):
    patterns = itertools.product(*([d, -d] for d in differences))
    extreme = [abs(sum(pattern)) >= abs(sum(differences)) for pattern in patterns]
    assert sign_flips([d / 10 for d in differences]) == pytest.approx(np.mean(extreme))


SAMPLES = st.lists(st.floats(-1e3, 1e3).map(lambda x: round(x, 3)), min_size=2, max_size=9)


@given(SAMPLES, SAMPLES)
def test_the_difference_of_means_is_welchs(first, second):
    a, b = np.array(first), np.array(second)
    found = Interval.welch(a, b)
    errors = np.array([own.var(ddof=1) / len(own) for own in (a, b)])
    assert found.value == pytest.approx(b.mean() - a.mean(), abs=1e-9)
    if not errors.any():
        assert (found.low, found.high) == (found.value, found.value)
        return
    freedom = errors.sum() ** 2 / (errors**2 / (len(a) - 1, len(b) - 1)).sum()
    half = stats.t.ppf(0.975, freedom) * np.sqrt(errors.sum())
    assert found.high - found.value == pytest.approx(half, rel=1e-6, abs=1e-9)


def test_the_difference_of_means_of_few_values_has_no_ends():
    one, two = np.array([1.0]), np.array([2.0, 4.0])
    assert Interval.welch(one, two).value == 2.0
    assert math.isnan(Interval.welch(one, two).low)
    assert math.isnan(Interval.welch(one[:0], two).value)
    same = Interval.welch(np.full(36, 16.02), np.full(13, 16.02))
    assert (same.value, same.low, same.high) == (0.0, 0.0, 0.0)


@given(COUNTS, COUNTS)
def test_independent_rates_are_tested_as_by_fisher(first, second):
    table = [[hits, total - hits] for hits, total in (first, second)]
    p_value = wilson(*first).fisher(wilson(*second))
    assert p_value == pytest.approx(stats.fisher_exact(table).pvalue)
    assert wilson(0, 0).fisher(wilson(*second)) == 1.0


def test_sign_flips_of_many_differences_are_near_the_t_test():
    differences = np.random.default_rng(3).normal(0.2, 1.0, 120)
    oracle = stats.ttest_1samp(differences, 0.0).pvalue
    assert sign_flips(differences.tolist()) == pytest.approx(oracle, abs=0.01)
    assert sign_flips([*differences.tolist(), *[0.0] * 500]) == sign_flips(differences.tolist())


def test_mcnemar_of_hundreds_of_pairs():
    pairs = [(True, False)] * 300 + [(False, True)] * 280
    tail = Fraction(sum(math.comb(580, heads) for heads in range(281)), 2**579)
    assert McNemar.of(*zip(*pairs, strict=True)).p_value == pytest.approx(float(tail), rel=1e-9)


def test_pairs_for_a_difference_reach_the_power_that_was_asked_for():
    d, q = 0.1, 0.2
    count = pairs_for_difference(d, q, power=0.8)
    rng = np.random.default_rng(1)
    kinds = rng.multinomial(count, [(q + d) / 2, (q - d) / 2, 1 - q], size=2000)
    z = (kinds[:, 0] - kinds[:, 1]) / np.sqrt(kinds[:, 0] + kinds[:, 1])
    assert np.mean(np.abs(z) > 1.96) == pytest.approx(0.8, abs=0.04)


def test_holm_of_a_family_worked_by_hand():
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([]) == []


@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=12))
def test_holm_keeps_the_order_and_lies_between_nothing_and_bonferroni(p_values):
    corrected = holm(p_values)
    for p, q in zip(p_values, corrected, strict=True):
        assert p <= q <= 1.0
    ranked = [q for _, q in sorted(zip(p_values, corrected, strict=True))]
    assert ranked == sorted(ranked)
    least = min(range(len(p_values)), key=lambda i: p_values[i])
    assert corrected[least] == pytest.approx(min(1.0, len(p_values) * p_values[least]))


def bca(values, statistic):
    """Efron's BCa interval, equation by equation, from resamples of its own."""
    rng, normal = np.random.default_rng(7), stats.norm
    drawn = np.array([statistic(rng.choice(values, len(values))) for _ in range(9999)])
    left_out = np.array([statistic(np.delete(values, i)) for i in range(len(values))])
    centred = left_out.mean() - left_out
    bias = normal.ppf(np.mean(drawn < statistic(values)) + np.mean(drawn == statistic(values)) / 2)
    skew = np.sum(centred**3) / (6.0 * np.sum(centred**2) ** 1.5)
    shifted = bias + normal.ppf([0.025, 0.975])
    return np.quantile(drawn, normal.cdf(bias + shifted / (1.0 - skew * shifted)))


@pytest.mark.parametrize(("statistic", "oracle"), [(mean, np.mean), (median, np.median)])
def test_bootstrap_intervals_are_efrons(statistic, oracle):
    values = np.random.default_rng(5).lognormal(3.0, 0.4, size=101)
    found, (low, high) = interval(values, statistic), bca(values, oracle)
    assert found.value == oracle(values)
    assert found.low == pytest.approx(low, abs=0.06 * (high - low))
    assert found.high == pytest.approx(high, abs=0.06 * (high - low))


def test_weights_are_refused_for_another_statistic_than_the_mean():
    values, weights = np.arange(9.0), np.arange(1.0, 10.0)
    with pytest.raises(ValueError, match="with the mean only"):
        interval(values, median, resamples=99, weights=weights)
    found = interval(values, resamples=99, weights=weights)
    assert found.value == np.average(values, None, weights)


def test_bootstrap_intervals_cover_as_often_as_they_say():
    rng = np.random.default_rng(3)
    covered = 0
    for trial in range(300):
        found = interval(rng.exponential(size=40), resamples=999, seed=trial)
        covered += found.low <= 1.0 <= found.high
    assert 0.89 <= covered / 300 <= 0.98


def test_intervals_of_large_samples_are_nearly_those_of_the_bootstrap():
    values = np.random.default_rng(2).lognormal(3.0, 0.4, size=LARGE)
    normal, resampled = interval(values), interval(values[:-1], resamples=2000)
    width = resampled.high - resampled.low
    assert normal.low == pytest.approx(resampled.low, abs=0.1 * width)
    assert normal.high == pytest.approx(resampled.high, abs=0.1 * width)


def test_more_values_than_resamples_have_nearly_the_same_interval():
    values = np.random.default_rng(8).exponential(10.0, 2000)
    bca, percentile = (interval(values, median, resamples=n) for n in (2000, 1999))
    width = bca.high - bca.low
    assert bca != percentile
    assert (percentile.low, percentile.high) == pytest.approx((bca.low, bca.high), abs=0.08 * width)


def test_a_median_that_no_left_out_value_moves_has_an_interval():
    tied = interval([1.0, *[2.0] * 9, 3.0], median)
    assert (tied.low, tied.value, tied.high) == (2.0, 2.0, 2.0)
    largest = interval(np.arange(30.0), lambda drawn: drawn.max(axis=-1))
    assert 20.0 < largest.low < largest.high == 29.0


def test_bootstrap_intervals_repeat_and_survive_few_values():
    values = list(range(30))
    assert interval(values) == interval(values)
    assert interval(values, resamples=50, seed=2) != interval(values, resamples=50, seed=3)
    assert math.isnan(interval([]).value)
    assert interval([3.0]).value == 3.0
    assert math.isnan(interval([3.0]).low)
    assert (interval([2.0, 2.0]).low, interval([2.0, 2.0]).high) == (2.0, 2.0)


def test_the_worst_case_is_the_papers():
    """Factory: +73.8 %, recovered by 64.2 points (VII-A), which is 87.1 % of it (Fig. 14)."""
    worst = WorstCase.of([99.0, 101.0], [100.0, 173.8], [100.0, 109.6])
    assert worst.increase == pytest.approx(0.738)
    assert worst.recovered == pytest.approx(0.642)
    assert worst.recovered_share == pytest.approx(0.871, abs=0.002)


def test_no_worst_case_without_flights():
    assert math.isnan(WorstCase.of([], [1.0], [1.0]).increase)
    assert math.isnan(WorstCase.of([1.0], [2.0]).recovered)
    assert math.isnan(WorstCase.of([2.0], [1.0], [1.0]).recovered_share)
    longest_world = WorstCase.of([10.0, 30.0], [10.0, 30.0], [10.0, 29.0])
    assert longest_world.increase == 0.5
    assert math.isnan(longest_world.recovered_share)


def test_failure_given_corruption():
    found = cross_layer(400, 1000, 20, 100)
    assert found.failure_given_corruption[0] == pytest.approx(0.5)
    low, high = found.failure_given_corruption[1:]
    assert low < 0.5 < high
    assert cross_layer(0, 1000, 20, 100).failure_given_corruption is None
    assert cross_layer(10, 1000, 20, 100).failure_given_corruption is None


def test_failures_an_hour_are_the_upsets_that_fail_missions():
    share = wilson(20, 100)
    assert share.per_hour(3.0) == pytest.approx((0.6, 3.0 * share.low, 3.0 * share.high))
    with pytest.raises(ConfigError, match="at least 0"):
        share.per_hour(-1.0)


def test_a_mixture_of_one_part_is_that_part():
    part = wilson(7, 9)
    whole = mixture([(90, part), (0, wilson(0, 0))])
    assert whole == pytest.approx({"share": part.share, "low": part.low, "high": part.high})


def test_a_mixture_weighs_by_size_not_by_sample():
    whole = mixture([(900, wilson(10, 10)), (100, wilson(0, 50))])
    assert whole["share"] == pytest.approx(0.9)
    assert whole["low"] < 0.9 <= whole["high"]
    assert math.isnan(mixture([(5, wilson(0, 0)), (5, wilson(1, 1))])["share"])


@pytest.mark.parametrize(("count", "total"), [(0, 10), (3, 10), (10, 10), (84, 1000)])
def test_wilson_against_scipy(count, total):
    ours = wilson(count, total)
    theirs = stats.binomtest(count, total).proportion_ci(method="wilson")
    assert ours.low == pytest.approx(theirs.low, abs=1e-12)
    assert ours.high == pytest.approx(theirs.high, abs=1e-12)


@pytest.mark.parametrize("total", [1, 20, 300])
def test_an_unseen_share_is_the_largest_that_leaves_no_hit_once_in_twenty(total):
    share = unseen_share(total)
    assert (1.0 - share) ** total == pytest.approx(0.05)
    assert unseen_share(0) == 1.0
    if total > 100:
        assert share == pytest.approx(3.0 / total, rel=0.01)  # the rule of three
