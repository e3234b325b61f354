"""Stratified samples: their sizes, their rounding, and rates by weight."""

import math
from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavfi_cli.stats.shares import wilson
from mavfi_cli.stats.strata import DEFENCE, allocate, kish, rounded, spread, weighted_share

wilson(1, 2)  # imports SciPy, for which an example of hypothesis has no time
SIZES, RATES = (0.1, 0.1, 0.4, 0.4), (0.5, 0.2, 0.0, 0.0)  # of cells with known rates
MISSIONS, ROUND, REPETITIONS = 400, 50, 200


def sampled(seed):
    """A stratified sample in rounds, and the share of hits among as many uniform missions."""
    rng = np.random.default_rng(seed)
    hits, flown = [0] * len(SIZES), [0] * len(SIZES)
    rows = []
    for _ in range(MISSIONS // ROUND):
        spreads = [spread(*counts) for counts in zip(hits, flown, strict=True)]
        for place, count in enumerate(allocate(SIZES, spreads, ROUND)):
            drawn = rng.random(count) < RATES[place]
            hits[place] += int(drawn.sum())
            flown[place] += count
            rows += [(hit, True, ROUND * SIZES[place] / count, str(place))
                     for hit in drawn.tolist()]  # fmt: skip
    truth = math.fsum(size * rate for size, rate in zip(SIZES, RATES, strict=True))
    return weighted_share(*zip(*rows, strict=True)), rng.binomial(MISSIONS, truth) / MISSIONS


def test_rates_of_known_cells_are_unbiased_and_narrower_than_uniform_ones():
    truth = math.fsum(size * rate for size, rate in zip(SIZES, RATES, strict=True))
    shares, uniform = zip(*map(sampled, range(REPETITIONS)), strict=True)
    values = np.array([share.share for share in shares])
    assert abs(values.mean() - truth) < 3 * values.std() / math.sqrt(REPETITIONS)
    assert values.std() < 0.7 * np.std(uniform)
    covered = sum(share.low <= truth <= share.high for share in shares)
    assert covered >= 0.93 * REPETITIONS
    assert np.mean([share.effective for share in shares]) > 1.5 * MISSIONS


def test_without_strata_the_interval_is_wilsons():
    hits, counted = [True, True, False, False, False], [True, False, True, True, True]
    assert weighted_share(hits, counted, [1.0] * 5, [None] * 5) == wilson(1, 4)
    share = weighted_share(hits, counted, [1.0] * 5, ["one"] * 5)
    assert (share.low, share.high) == pytest.approx((wilson(1, 4).low, wilson(1, 4).high))


def test_a_part_of_the_population_that_counts_is_estimated_too():
    """Two strata that differ in hits: whether a mission counts moves the share."""
    hits = [True] * 40 + [False] * 40
    strata = ["a"] * 40 + ["b"] * 40
    whole = weighted_share(hits, [True] * 80, [1.0] * 80, strata)
    half = weighted_share(hits, [True, False] * 40, [1.0] * 80, strata)
    assert whole.share == half.share == 0.5
    assert half.high - half.low > whole.high - whole.low


@given(
    st.lists(st.floats(0.01, 1.0), min_size=1, max_size=8),
    st.integers(0, 200),
    st.randoms(use_true_random=False),
)
def test_allocations_add_up_and_none_is_empty(sizes, extra, random):
    total = math.fsum(sizes)
    shares = [size / total for size in sizes]
    spreads = [spread(random.randrange(9), 9) for _ in sizes]
    missions = len(sizes) + extra
    counts = allocate(shares, spreads, missions)
    assert sum(counts) == missions
    assert min(counts) >= 1
    for share, count in zip(shares, counts, strict=True):
        assert count >= math.floor(extra * DEFENCE * share)


@given(st.integers(0, 1000), st.integers(1, 6), st.integers(1, 5))
def test_rounding_moves_no_cell_row_or_column_by_one(seed, rows, columns):
    rng = np.random.default_rng(seed)
    table = rng.uniform(0.0, 2.0, (rows, columns))
    whole = np.array(rounded(table.tolist(), rng))
    for axis in (None, 0, 1):
        assert np.all(np.abs(whole.sum(axis) - table.sum(axis)) < 1.0 + 1e-9)
    assert np.all(np.abs(whole - table) < 1.0)


def test_rounding_is_unbiased():
    table = [[0.3, 0.2, 0.5], [0.1, 0.9, 1.7]]
    rng = np.random.default_rng(1)
    mean = np.mean([rounded(table, rng) for _ in range(2000)], axis=0)
    assert mean == pytest.approx(np.array(table), abs=0.04)


def test_equal_weights_are_all_effective():
    assert kish([2.0] * 7) == pytest.approx(7.0)
    assert Counter([kish([1.0, 0.0]), kish([3.0])]) == {1.0: 2}
