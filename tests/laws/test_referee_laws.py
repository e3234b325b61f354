from __future__ import annotations

import math

import numpy as np
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from mavfi_cli.core.frames import quaternion_from_euler, rotation_matrix
from sitl.sweep import APPROACH_TOLERANCE_M, CONTACT_M, clearance, sweep

metres = st.floats(-5, 5)
sides = st.floats(1e-3, 3)
vectors = st.tuples(metres, metres, metres).map(np.array)
attitudes = st.tuples(*[st.floats(-3.1, 3.1)] * 3).map(lambda a: quaternion_from_euler(*a))
bodies = st.tuples(*[st.floats(0.02, 1.0)] * 3).map(np.array)
boxes = st.lists(st.tuples(metres, metres, metres, sides, sides, sides), min_size=1, max_size=5)
worlds = boxes.map(lambda rows: np.array([[*r[:3], *np.add(r[:3], r[3:])] for r in rows]))


@given(worlds, vectors, attitudes, bodies, st.integers(0, 2**31))
@settings(max_examples=150, deadline=None)
def test_clearance_is_at_most_the_distance_between_any_two_points(
    world: np.ndarray, place: np.ndarray, attitude: np.ndarray, half: np.ndarray, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    inside = rng.uniform(-1.0, 1.0, (200, 3))
    inside[:100] = np.sign(inside[:100])  # corners, too
    body = place + (inside * half) @ rotation_matrix(attitude).T
    nearest = min(
        float(np.linalg.norm(body - np.clip(body, box[:3], box[3:]), axis=1).min()) for box in world
    )
    gap, _ = clearance(place, attitude, half, world)
    assert gap <= nearest + 1e-9
    reach = float(np.linalg.norm(half))
    middle = min(float(np.linalg.norm(place - np.clip(place, b[:3], b[3:]))) for b in world)
    assert middle - reach - 1e-9 <= gap <= middle + 1e-9


@given(st.floats(-80, 80), st.floats(-1.2, 1.2), st.floats(0.0, 1.0), attitudes, attitudes, bodies)
@settings(max_examples=200, deadline=None)
def test_a_wall_of_a_centimetre_is_found_at_any_speed_course_and_phase(
    speed: float, course: float, phase: float, q0: np.ndarray, q1: np.ndarray, half: np.ndarray
) -> None:
    """The body starts wholly before the wall and ends wholly behind it, within one step."""
    reach = float(np.linalg.norm(half))
    length = 2.0 * reach + 0.03 + abs(speed) * 0.02
    start = np.array([-reach - 0.01 - phase * abs(speed) * 0.01, 0.0, 0.0])
    end = start + length * np.array([1.0, math.tan(course), 0.0])
    assume(end[0] - reach > 0.01)
    wall = np.array([[0.0, -1e3, -1e3, 0.01, 1e3, 1e3]])
    share, box, least = sweep(start, q0, end, q1, half, wall, math.inf)
    assert (box, least) == (0, 0.0)
    assert 0.0 <= share < 1.0


@given(worlds, vectors, vectors, attitudes, attitudes, bodies)
@settings(max_examples=150, deadline=None)
def test_a_way_and_its_reverse_touch_or_not_alike(
    world: np.ndarray, p0: np.ndarray, p1: np.ndarray, q0: np.ndarray, q1: np.ndarray,
    half: np.ndarray,
) -> None:  # fmt: skip
    there = sweep(p0, q0, p1, q1, half, world, math.inf)
    back = sweep(p1, q1, p0, q0, half, world, math.inf)
    if there[2] > 2.0 * APPROACH_TOLERANCE_M or back[2] > 2.0 * APPROACH_TOLERANCE_M:
        assert (there[1] < 0) == (back[1] < 0)
    assert abs(there[2] - back[2]) <= 2.0 * APPROACH_TOLERANCE_M


@given(worlds, vectors, vectors, attitudes, attitudes, bodies)
@settings(max_examples=100, deadline=None)
def test_a_way_in_two_parts_is_the_way(
    world: np.ndarray, p0: np.ndarray, p1: np.ndarray, q0: np.ndarray, q1: np.ndarray,
    half: np.ndarray,
) -> None:  # fmt: skip
    """With the attitude held, judging each half alone finds what judging all at once finds."""
    middle = (p0 + p1) / 2.0
    whole = sweep(p0, q0, p1, q0, half, world, math.inf)
    parts = [sweep(a, q0, b, q0, half, world, math.inf) for a, b in ((p0, middle), (middle, p1))]
    least = min(part[2] for part in parts)
    assert abs(whole[2] - least) <= APPROACH_TOLERANCE_M + CONTACT_M
    if whole[2] > 2.0 * APPROACH_TOLERANCE_M:
        assert parts[0][1] < 0
        assert parts[1][1] < 0
