"""Yaw along the direction of travel."""

import math

import numpy as np
import pytest

from mavfi_cli.autonomy.smoothing import headings, turn_time_s


def test_a_circle_is_followed_round_and_round_without_a_jump():
    angle = np.linspace(0, 6 * math.pi, 120)
    circle = 8 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    yaws = headings(circle, math.pi / 2, 2, math.pi / 4)
    assert np.abs(np.diff(yaws)).max() < 0.4
    assert yaws[-10] == pytest.approx(angle[-10] + math.pi / 2, abs=0.4)


def test_turns_are_no_faster_than_allowed():
    there_and_back = np.array([[float(x), 0, 0] for x in [*range(10), *range(10, 0, -1)]])
    yaws = headings(there_and_back, 0.0, 2, 0.5)
    assert np.abs(np.diff(yaws)).max() <= 0.5 + 1e-12
    assert math.cos(yaws[-1]) == pytest.approx(-1.0)


def test_while_standing_it_looks_where_it_will_go():
    waiting = np.array([[0.0, 0, 0]] * 6 + [[0.0, y, 0] for y in range(1, 5)])
    assert headings(waiting, 0.0, 2, math.pi)[1] == pytest.approx(math.pi / 2)


def test_climbing_leaves_the_yaw_alone():
    column = np.array([[0.0, 0, z] for z in range(6)])
    assert headings(column, 1.2, 2, 0.5).tolist() == [1.2] * 6


def test_a_yaw_that_is_not_finite_starts_at_zero():
    assert headings(np.zeros((2, 3)), math.nan, 2, 0.5).tolist() == [0.0, 0.0]


@pytest.mark.parametrize(
    ("yaw", "direction", "expected"),
    [(0.0, [0, 1, 0], 1.0), (0.0, [1, 0.5, 0], 0.0), (0.0, [0, 0, 1], 0.0), (3.0, [-1, 0, 0], 0.0)],
)
def test_time_for_a_large_turn(yaw, direction, expected):
    found = turn_time_s(yaw, np.array(direction, float), math.pi / 4, math.pi / 2)
    assert found == pytest.approx(expected)
