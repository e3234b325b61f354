"""Tests and intervals that hold at any look."""

import math

import numpy as np
import pytest

from mavfi_cli.stats.sequences import anytime_count, anytime_interval, anytime_p, anytime_z
from mavfi_cli.stats.shares import NO_INTERVAL, Interval

LOOKS = np.arange(100, 4001, 100)


def test_forty_looks_reject_a_true_rate_no_more_often_than_the_level():
    """A test for one look rejects it in a quarter of the repetitions."""
    rate, rng = 0.07, np.random.default_rng(1)
    anytime = single = 0
    for _ in range(400):
        share = np.cumsum(rng.random(LOOKS[-1]) < rate)[LOOKS - 1] / LOOKS
        z = (share - rate) / np.sqrt(share * (1.0 - share) / LOOKS)
        anytime += any(anytime_p(own, int(n)) < 0.05 for own, n in zip(z, LOOKS, strict=True))
        single += bool(np.any(np.abs(z) > 1.96))
    assert anytime / 400 < 0.05
    assert single / 400 > 0.2


@pytest.mark.parametrize("count", [50, 1000, 100_000])
def test_p_interval_and_count_belong_together(count):
    z = anytime_z(count)
    assert anytime_p(z, count) == pytest.approx(0.05)
    effect = Interval(value=0.2, low=0.2 - 1.96 * 0.01, high=0.2 + 1.96 * 0.03, count=count)
    bounds = anytime_interval(effect)
    assert bounds.low == pytest.approx(0.2 - z * 0.01, rel=1e-4)
    assert bounds.high == pytest.approx(0.2 + z * 0.03, rel=1e-4)
    needed = anytime_count(1.0, count, 0.05)
    assert anytime_p(math.sqrt(needed / count), round(needed)) == pytest.approx(0.05, rel=0.02)


def test_without_an_effect_there_is_no_evidence():
    assert anytime_p(0.0, 1000) == 1.0
    assert anytime_count(0.0, 100, 0.05) == math.inf
    assert anytime_interval(NO_INTERVAL) is NO_INTERVAL
