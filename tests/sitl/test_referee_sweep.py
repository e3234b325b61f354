from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from mavfi_cli.core.frames import quaternion_from_euler
from sitl.sweep import APPROACH_TOLERANCE_M, CONTACT_M, clearance, sweep

LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
BODY = np.array([0.25, 0.25, 0.08])


def go(start: tuple, end: tuple, boxes: list, least: float = math.inf) -> tuple:
    places = [np.array(p, dtype=float) for p in (start, end)]
    return sweep(places[0], LEVEL, places[1], LEVEL, BODY, np.array(boxes, dtype=float), least)


def test_a_head_on_touch_comes_where_the_nose_meets_the_wall() -> None:
    share, box, least = go((0, 0, 5), (10, 0, 5), [[4, -9, 0, 4.01, 9, 20]])
    assert share == pytest.approx((4.0 - 0.25) / 10.0, abs=2 * CONTACT_M / 10.0)
    assert (box, least) == (0, 0.0)


@pytest.mark.parametrize("speed", [3.0, 20.0, 340.0])
@pytest.mark.parametrize("thickness", [0.01, 1e-6])
def test_a_thin_wall_is_never_skipped(speed: float, thickness: float) -> None:
    step = speed * 0.02
    for k in range(20):
        start = 4.0 - 0.26 - step * k / 20.0
        share, box, _ = go((start, 0, 5), (start + step, 0, 5), [[4, -9, 0, 4 + thickness, 9, 20]])
        reaches = start + step + 0.25 >= 4.0
        assert (box == 0) == reaches
        assert math.isfinite(share) == reaches


def test_the_first_of_two_walls_is_the_one_that_is_hit() -> None:
    walls = [[8, -9, 0, 8.1, 9, 20], [4, -9, 0, 4.1, 9, 20]]
    assert go((0, 0, 5), (20, 0, 5), walls)[1] == 1


def test_passing_by_gives_the_nearest_approach_between_the_ends() -> None:
    post = [[4.9, 1.25, 0, 5.1, 2, 20]]
    share, box, least = go((0, 0, 5), (10, 0, 5), post)
    assert (share, box) == (math.inf, -1)
    assert least == pytest.approx(1.0, abs=APPROACH_TOLERANCE_M)


def test_only_a_nearer_approach_counts() -> None:
    assert go((0, 0, 5), (1, 0, 5), [[4, -9, 0, 5, 9, 20]], least=0.5)[2] == 0.5


@pytest.mark.parametrize("sign", [1.0, -1.0])  # the same attitude, and the short way round
def test_turning_on_the_spot_can_touch(sign: float) -> None:
    bar = np.array([1.0, 0.1, 0.1])
    wall = np.array([[-9.0, 0.5, 0.0, 9.0, 0.6, 20.0]])
    place = np.array([0.0, 0.0, 5.0])
    turned = quaternion_from_euler(0.0, 0.0, math.pi / 2.0)
    share, box, _ = sweep(place, LEVEL, place, sign * turned, bar, wall, math.inf)
    # the corner (1, 0.1) reaches y = 0.5 where sin(a) + 0.1 cos(a) = 0.5
    angle = math.asin(0.5 / math.hypot(1.0, 0.1)) - math.atan(0.1)
    assert (box, share) == (0, pytest.approx(angle / (math.pi / 2.0), abs=1e-3))


def test_touching_already_is_a_touch_at_once() -> None:
    assert go((0, 0, 5), (0, 0, 5), [[0.25, -9, 0, 1, 9, 20]])[:2] == (0.0, 0)


def test_a_world_without_boxes() -> None:
    still = np.zeros(3)
    nothing = np.zeros((0, 6))
    assert sweep(still, LEVEL, still, LEVEL, BODY, nothing, 7.0) == (math.inf, -1, 7.0)


def brute(p0: NDArray, q0: NDArray, p1: NDArray, q1: NDArray, boxes: NDArray, n: int) -> list:
    """Clearances at n + 1 poses on the way."""
    gaps = []
    for k in range(n + 1):
        a, b = 1.0 - k / n, k / n
        angle = math.acos(min(1.0, abs(float(q0 @ q1))))
        if angle > 1e-9:
            a, b = math.sin(a * angle) / math.sin(angle), math.sin(b * angle) / math.sin(angle)
        q = a * q0 + b * (q1 if q0 @ q1 >= 0 else -q1)
        p = p0 + k / n * (p1 - p0)
        gaps.append(clearance(p, q / np.linalg.norm(q), BODY, boxes)[0])
    return gaps


def test_against_many_poses_between() -> None:
    rng = np.random.default_rng(3)
    hits = 0
    for _ in range(150):
        low = rng.uniform(-3.0, 3.0, (5, 3))
        boxes = np.hstack([low, low + rng.uniform(0.01, 1.5, (5, 3))])
        p0, p1 = rng.uniform(-3.0, 3.0, (2, 3))
        q0, q1 = (q / np.linalg.norm(q) for q in rng.normal(size=(2, 4)))
        share, box, least = sweep(p0, q0, p1, q1, BODY, boxes, math.inf)
        gaps = brute(p0, q0, p1, q1, boxes, 200)
        assert least <= min(gaps) + APPROACH_TOLERANCE_M
        if 0.0 in gaps:
            hits += 1
            assert box >= 0
            assert share <= gaps.index(0.0) / 200 + 1e-9
        if box >= 0:
            before = gaps[: int(share * 200)]
            assert all(gap > 0.0 for gap in before)
    assert 20 < hits < 140
