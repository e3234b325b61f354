"""Corner speeds and phases against their closed forms."""

import math

import numpy as np
import pytest

from mavfi_cli.autonomy.corners import MotionLimits, motion, polyline, squared_corner_speeds

LIMITS = MotionLimits(speed_mps=2.0, climb_mps=1.0, descent_mps=0.5, acceleration_mps2=2.0)


def bent(angle_rad, leg_m=20.0):
    turn = np.array([math.cos(angle_rad), math.sin(angle_rad), 0.0])
    return np.array([[0.0, 0, 0], [leg_m, 0, 0], np.array([leg_m, 0, 0]) + leg_m * turn])


@pytest.mark.parametrize("degrees", [10, 45, 90, 135, 179])
def test_a_blend_passes_the_corner_as_near_as_its_formula_says(degrees):
    line = polyline(bent(math.radians(degrees)), LIMITS)
    q = squared_corner_speeds(line, 0.0, np.full(3, np.inf), 2.0)
    moving = motion(line, q, np.zeros(3), 2.0)
    near = np.linalg.norm(
        moving.position(np.linspace(0, moving.duration_s, 40_000)) - line.vertices[1], axis=1
    ).min()
    sine = math.sin(math.radians(degrees) / 2)
    assert near == pytest.approx(q[1] * sine**2 / (2 * 2.0), rel=0.02, abs=1e-3)


def test_a_short_segment_between_corners_lowers_their_speeds():
    vertices = np.array([[0.0, 0, 0], [10, 0, 0], [10, 0.3, 0], [0, 0.3, 0]])
    line = polyline(vertices, LIMITS)
    q = squared_corner_speeds(line, 0.0, np.full(4, np.inf), 2.0)
    trims = q * line.half_sines / 2.0
    assert trims[1] + trims[2] <= 0.3 + 1e-9
    assert q[1] > 0.0


def test_a_rest_to_rest_segment_is_the_textbook_profile():
    line = polyline(np.array([[0.0, 0, 0], [9.0, 0, 0]]), LIMITS)
    moving = motion(line, np.zeros(2), np.zeros(2), 2.0)
    assert moving.duration_s == pytest.approx(9.0 / 2.0 + 2.0 / 2.0, abs=2e-3)
    assert moving.position(np.array([0.5]))[0, 0] == pytest.approx(0.25)
    assert moving.position(np.array([99.0]))[0].tolist() == [9.0, 0.0, 0.0]


def test_steep_directions_have_lower_caps():
    line = polyline(np.array([[0.0, 0, 0], [0, 0, 5], [0, 4, 2]]), LIMITS)
    assert line.speed_caps.tolist() == pytest.approx([1.0, 0.5 / 0.6])


def test_repeated_vertices_count_once():
    line = polyline(np.array([[0.0, 0, 0], [0, 0, 0], [1, 0, 0], [1, 0, 0]]), LIMITS)
    assert len(line.vertices) == 2
