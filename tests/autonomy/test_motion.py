"""The motion behind a trajectory, sampled so finely that it shows: against its closed forms."""

import math
from dataclasses import replace

import numpy as np
import pytest

from mavfi_cli.autonomy.grid import ObstacleGrid
from mavfi_cli.autonomy.occupancy import MapSnapshot
from mavfi_cli.autonomy.pilot import PlanRequest
from mavfi_cli.autonomy.smoothing import SmoothingParams, smooth

STEP_S = 1e-3
PARAMS = SmoothingParams(
    v_max_mps=2.0, a_max_mps2=2.0, speed_share=1.0, acceleration_share=1.0,
    climb_max_mps=1.0, descent_max_mps=0.5, sample_period_s=STEP_S, corner_cut_m=100.0,
)  # fmt: skip
OPEN = ObstacleGrid.build(MapSnapshot.empty(), np.repeat([-math.inf, math.inf], 3), 0.5)


def flown(vertices, yaw_rad=0.0, params=PARAMS):
    """The waypoints along the vertices, from rest."""
    vertices = np.array(vertices, np.float64)
    request = PlanRequest(
        stamp_s=0.0, position_enu_m=vertices[0], velocity_enu_mps=np.zeros(3), yaw_rad=yaw_rad,
        goal_enu_m=vertices[-1], attempt=1,
    )  # fmt: skip
    trajectory, free = smooth(vertices, OPEN, request, params)
    assert free
    return trajectory.waypoints


def speeds_of(rows):
    return np.linalg.norm(rows[:, 4:7], axis=1)


@pytest.mark.parametrize("degrees", [10, 45, 90, 135, 179])
def test_a_blend_passes_the_corner_as_near_as_its_formula_says(degrees):
    angle = math.radians(degrees)
    rows = flown([[0, 0, 0], [6, 0, 0], [6 + 6 * math.cos(angle), 6 * math.sin(angle), 0]])
    near = np.linalg.norm(rows[:, :3] - [6, 0, 0], axis=1).min()
    sine, squared_corner_speed = math.sin(angle / 2), 2.0**2
    assert near == pytest.approx(squared_corner_speed * sine**2 / (2 * 2.0), rel=0.02, abs=1e-3)


def test_a_short_segment_between_corners_lowers_their_speeds():
    rows = flown([[0, 0, 0], [10, 0, 0], [10, 0.3, 0], [0, 0.3, 0]])
    across = speeds_of(rows)[np.abs(rows[:, 1] - 0.15) < 0.05]
    sine = math.sin(math.pi / 4)
    assert 0.0 < across.max() <= math.sqrt(0.5 * 0.3 * 2.0 / sine) + 1e-6  # both blends fit


def test_a_rest_to_rest_segment_is_the_textbook_profile():
    rows = flown([[0, 0, 0], [9, 0, 0]])
    assert len(rows) * STEP_S == pytest.approx(9.0 / 2.0 + 2.0 / 2.0, abs=5e-3)
    assert rows[round(0.5 / STEP_S), 0] == pytest.approx(0.25, abs=2e-3)
    assert rows[-1, :3] == pytest.approx([9.0, 0.0, 0.0])


@pytest.mark.slow
def test_steep_directions_have_lower_speeds():
    rows = flown([[0, 0, 0], [0, 0, 5], [0, 4, 2]])
    assert speeds_of(rows[rows[:, 1] < 1e-6]).max() == pytest.approx(1.0)
    assert speeds_of(rows[rows[:, 1] > 1.0]).max() == pytest.approx(0.5 / 0.6)


def test_repeated_vertices_count_once():
    np.testing.assert_array_equal(
        flown([[0, 0, 0], [0, 0, 0], [1, 0, 0], [1, 0, 0]]), flown([[0, 0, 0], [1, 0, 0]])
    )


COARSE = replace(PARAMS, sample_period_s=0.5, corner_cut_m=0.5)


def test_a_circle_is_followed_round_and_round_without_a_jump():
    angle = np.linspace(0, 6 * math.pi, 120)
    circle = 8 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    rows = flown(circle, math.pi / 2, COARSE)
    assert np.abs(np.diff(rows[:, 3])).max() < 0.4
    azimuth = np.unwrap(np.arctan2(rows[:, 1], rows[:, 0]))
    assert rows[-10, 3] == pytest.approx(azimuth[-10] + math.pi / 2, abs=0.4)
    assert azimuth[-1] > 5.5 * math.pi


def test_turns_are_no_faster_than_allowed():
    rows = flown([[0, 0, 0], [9, 0, 0], [0, 0, 0]], params=replace(COARSE, yaw_rate_max_radps=1.0))
    assert np.abs(np.diff(rows[:, 3])).max() <= 0.5 + 1e-12
    assert math.cos(rows[-1, 3]) == pytest.approx(-1.0)


def test_climbing_leaves_the_yaw_alone():
    assert set(flown([[0, 0, 0], [0, 0, 6]], 1.2, COARSE)[:, 3].tolist()) == {1.2}


def test_a_yaw_that_is_not_finite_starts_at_zero():
    assert flown([[0, 0, 0], [0, 0, 6]], math.nan, COARSE)[:, 3].tolist()[0] == 0.0


@pytest.mark.parametrize(
    ("yaw", "goal", "expected_s"),
    [(0.0, [0, 9, 0], 1.0), (0.0, [9, 4.5, 0], 0.0), (0.0, [0, 0, 9], 0.0), (3.0, [-9, 0, 0], 0.0)],
)
def test_a_large_turn_takes_its_time_before_departure(yaw, goal, expected_s):
    rows = flown([[0, 0, 0], goal], yaw)
    waited = np.flatnonzero(speeds_of(rows) > 0.0)[0] * STEP_S
    assert waited == pytest.approx(expected_s, abs=3 * STEP_S)
