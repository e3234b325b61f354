"""Curves of scores whose order is known."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavfi_cli.stats.roc import Curves

SCORES = st.lists(
    st.one_of(st.sampled_from([0.0, 1.0, 2.0, math.inf]), st.floats(0.0, 10.0)), min_size=1,
    max_size=12,
)  # fmt: skip


def test_a_perfect_detector():
    drawn = Curves.of([2.0, 3.0, math.inf], [0.1, 0.5])
    assert drawn.area == drawn.average_precision == 1.0
    assert drawn.operating_point == (0.0, 1.0)
    assert drawn.area_low < 1.0 == drawn.area_high


def test_a_known_order():
    drawn = Curves.of([3.0, 1.0], [2.0, 0.5])
    assert drawn.area == 0.75  # three of four pairs are in order
    # Descending: hit, miss, hit, miss.
    assert drawn.recall == [0.0, 0.5, 0.5, 1.0, 1.0]
    assert drawn.false_positive_rate == [0.0, 0.0, 0.5, 0.5, 1.0]
    assert drawn.precision == pytest.approx([1.0, 1.0, 0.5, 2 / 3, 0.5])
    assert drawn.average_precision == pytest.approx(0.5 * 1.0 + 0.5 * 2 / 3)
    assert drawn.thresholds == [3.0, 2.0, 1.0, 0.5, -math.inf]
    assert drawn.operating_point == (0.5, 0.5)  # a score of 1 is no alarm


def test_nothing_to_tell_apart():
    assert Curves.of([1.0], [1.0]).area == 0.5
    empty = Curves.of([], [1.0])
    assert math.isnan(empty.area)
    assert empty.thresholds == []


@given(SCORES, SCORES)
def test_every_point_is_what_counting_gives(positive, negative):
    drawn = Curves.of(positive, negative)
    for threshold, fallout, recall in zip(
        drawn.thresholds, drawn.false_positive_rate, drawn.recall, strict=True
    ):
        assert recall == pytest.approx(np.mean([score > threshold for score in positive]))
        assert fallout == pytest.approx(np.mean([score > threshold for score in negative]))
    pairs = [(p > n) + (p == n) / 2 for p in positive for n in negative]
    assert drawn.area == pytest.approx(np.mean(pairs))
    under = np.trapezoid([*drawn.recall], [*drawn.false_positive_rate])
    assert drawn.area == pytest.approx(under)
    assert 0.0 <= drawn.area_low <= drawn.area <= drawn.area_high <= 1.0
