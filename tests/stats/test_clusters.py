"""Intervals from samples of clusters hold what they promise."""

import math

import numpy as np
import pytest

from mavfi_cli.stats.shares import _student, clustered_share, design_effect, estimated_total, wilson


def test_runs_of_a_window_count_less_the_more_they_are_alike():
    """Against the spread of the share over repeated samples of windows and of runs in them."""
    rng = np.random.default_rng(4)
    chances = rng.beta(0.5, 0.5, size=5000)  # of a crash, window by window

    def campaign():
        drawn = rng.choice(chances, size=20)
        windows = rng.integers(20, size=400)
        return rng.random(400) < drawn[windows], [("f", int(window)) for window in windows]

    campaigns = [campaign() for _ in range(300)]
    spread = np.var([hits.mean() for hits, _ in campaigns])
    binomial = chances.mean() * (1.0 - chances.mean()) / 400
    effects = [design_effect(hits.tolist(), windows) for hits, windows in campaigns]
    assert spread / binomial > 5.0
    assert np.mean(effects) == pytest.approx(spread / binomial, rel=0.2)


def population(rng):
    """Lengths of the windows of two strata, and the chance of a crash in each window."""
    many, few = rng.lognormal(5.0, 0.5, 400), rng.lognormal(8.0, 0.5, 60)
    return [(many, rng.beta(2.0, 8.0, 400)), (few, rng.beta(6.0, 4.0, 60))]


def sampled_runs(strata, rng, runs=500, windows=16):
    """Runs in windows as a profile draws them: their strata's estimated lengths are the weights."""
    drawn = [rng.choice(len(lengths), windows, replace=False) for lengths, _ in strata]
    known = [
        (lengths[d].tolist(), len(lengths)) for (lengths, _), d in zip(strata, drawn, strict=True)
    ]
    weights = np.array([np.mean(values) * number for values, number in known])
    hits, clusters = [], []
    for stratum in rng.choice(len(strata), runs, p=weights / weights.sum()):
        (lengths, chances), chosen = strata[stratum], drawn[stratum]
        window = rng.choice(chosen, p=lengths[chosen] / lengths[chosen].sum())
        hits.append(rng.random() < chances[window])
        clusters.append((int(stratum), int(window)))
    return known, hits, clusters


@pytest.mark.slow
def test_intervals_of_share_and_size_contain_the_error_of_the_weights():
    rng = np.random.default_rng(8)
    strata = population(rng)
    size = sum(lengths.sum() for lengths, _ in strata)
    true = sum((lengths * chances).sum() for lengths, chances in strata) / size
    inside = plain = total = 0
    estimates = []
    for _ in range(300):
        known, hits, clusters = sampled_runs(strata, rng)
        share = clustered_share(hits, clusters, {0: 16, 1: 16})
        alone, found = wilson(sum(hits), len(hits)), estimated_total(known)
        inside += share.low <= true <= share.high
        plain += alone.low <= true <= alone.high
        total += found.low <= size <= found.high
        estimates.append(found.value)
    assert 0.91 <= inside / 300 <= 0.99
    assert 0.91 <= total / 300 <= 0.99
    assert plain / 300 < 0.85
    assert abs(np.mean(estimates) / size - 1.0) < 3.0 * np.std(estimates) / size / math.sqrt(300)


def test_a_stratum_that_was_seen_whole_has_no_error():
    found = estimated_total([([3.0, 9.0], 2), ([5.0], 1)])
    assert (found.low, found.value, found.high) == (17.0, 17.0, 17.0)


def test_one_member_out_of_several_does_not_tell_its_error():
    found = estimated_total([([3.0], 4)])
    assert (found.low, found.value, found.high) == (3.0, 12.0, math.inf)


def test_clusters_that_no_run_hit_count_as_sampled():
    hits, clusters = [True, False, True, True], [("f", 1), ("f", 2), ("f", 1), ("f", 1)]
    more = clustered_share(hits, clusters, {"f": 40})
    fewer = clustered_share(hits, clusters, {"f": 2})
    assert more.share == fewer.share == 0.75
    assert more.high - more.low < fewer.high - fewer.low


@pytest.mark.parametrize(("freedom", "quantile"), [(1, 12.706), (3, 3.182), (15, 2.131)])
def test_quantiles_are_those_of_students_table(freedom, quantile):
    assert _student([1.0], [freedom]) == pytest.approx(quantile, abs=5e-4)
    assert _student([], []) == pytest.approx(1.96, abs=5e-4)


def test_independent_runs_count_in_full():
    hits = (np.random.default_rng(5).random(400) < 0.3).tolist()
    assert design_effect(hits, [None] * 400) == pytest.approx(1.0, abs=0.01)
    strata = [(number % 2, number) for number in range(400)]
    assert design_effect(hits, strata) == pytest.approx(1.0, abs=0.02)
    assert design_effect([True] * 9, [("f", 1)] * 9) == 1.0
