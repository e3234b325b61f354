"""Curves of scores whose order is known."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavfi_cli.stats.roc import curves

SCORES = st.lists(
    st.one_of(st.sampled_from([0.0, 1.0, 2.0, math.inf]), st.floats(0.0, 10.0)), min_size=1,
    max_size=12,
)  # fmt: skip


def test_a_perfect_detector():
    found = curves([2.0, 3.0, math.inf], [0.1, 0.5])
    assert found["area"] == found["average_precision"] == 1.0
    assert found["operating_point"] == (0.0, 1.0)
    assert found["area_low"] < 1.0 == found["area_high"]


def test_a_known_order():
    found = curves([3.0, 1.0], [2.0, 0.5])
    assert found["area"] == 0.75  # three of four pairs are in order
    # Descending: hit, miss, hit, miss.
    assert found["recall"] == [0.0, 0.5, 0.5, 1.0, 1.0]
    assert found["false_positive_rate"] == [0.0, 0.0, 0.5, 0.5, 1.0]
    assert found["precision"] == pytest.approx([1.0, 1.0, 0.5, 2 / 3, 0.5])
    assert found["average_precision"] == pytest.approx(0.5 * 1.0 + 0.5 * 2 / 3)
    assert found["thresholds"] == [3.0, 2.0, 1.0, 0.5, -math.inf]
    assert found["operating_point"] == (0.5, 0.5)  # a score of 1 is no alarm


def test_nothing_to_tell_apart():
    assert curves([1.0], [1.0])["area"] == 0.5
    empty = curves([], [1.0])
    assert math.isnan(empty["area"])
    assert empty["thresholds"] == []


@given(SCORES, SCORES)
def test_every_point_is_what_counting_gives(positive, negative):
    found = curves(positive, negative)
    for threshold, fallout, recall in zip(
        found["thresholds"], found["false_positive_rate"], found["recall"], strict=True
    ):
        assert recall == pytest.approx(np.mean([score > threshold for score in positive]))
        assert fallout == pytest.approx(np.mean([score > threshold for score in negative]))
    pairs = [(p > n) + (p == n) / 2 for p in positive for n in negative]
    assert found["area"] == pytest.approx(np.mean(pairs))
    under = np.trapezoid([*found["recall"]], [*found["false_positive_rate"]])
    assert found["area"] == pytest.approx(under)
    assert 0.0 <= found["area_low"] <= found["area"] <= found["area_high"] <= 1.0
