"""The tracking PID against closed forms."""

import math
from dataclasses import replace

import numpy as np
import pytest

from mavfi_cli.autonomy import tracking
from mavfi_cli.autonomy.tracking import TrackingInputs, TrackingParams, TrackingState
from mavfi_cli.core.types import Trajectory

PARAMS = TrackingParams()
START = TrackingState(yaw_rad=0.0, stamp_s=0.0)


def following(row, **changes):
    trajectory = Trajectory(
        stamp_s=0.0,
        waypoints=np.array([row, row], np.float64),
        durations_s=np.array([1.0, 1.0]),
        trajectory_seq=1,
        future_collision_seq=0,
    )
    return holding(trajectory=trajectory, **changes)


def holding(**changes):
    given = {
        "stamp_s": 0.02,
        "position_enu_m": np.zeros(3),
        "velocity_enu_mps": np.zeros(3),
        "trajectory": None,
        "hold_enu_m": np.zeros(3),
        "hold_yaw_rad": 0.0,
    }
    return TrackingInputs(**{**given, **changes})


def test_p_i_d_and_feed_forward_add_up():
    row = [1.0, 0, 0, 0, 0.5, 0, 0, 0.7, 0, 0]
    inputs = following(row, velocity_enu_mps=np.array([0.2, 0.0, 0.0]))
    state = replace(START, integral_mps=np.array([0.1, 0.0, 0.0]))
    after, command = tracking.step(state, inputs, PARAMS)
    p, i, d = PARAMS.kp_per_s * 1.0, 0.1, PARAMS.kd * (0.5 - 0.2)
    assert command.velocity_enu_mps[0] == pytest.approx(0.5 + p + i + d)
    assert command.acceleration_enu_mps2.tolist() == [0.7, 0, 0]
    assert after.integral_mps[0] == pytest.approx(0.1 + PARAMS.ki_per_s2 * 1.0 * 0.02)
    assert command.stamp_s == after.stamp_s == 0.02


def test_velocity_and_acceleration_are_cut_as_vectors():
    row = [0, 0, 0, 0, 30.0, 40.0, 0, 0, 60.0, 80.0]
    _, command = tracking.step(START, following(row), PARAMS)
    np.testing.assert_allclose(command.velocity_enu_mps, [1.8, 2.4, 0.0], atol=1e-12)
    np.testing.assert_allclose(command.acceleration_enu_mps2, [0.0, 3.0, 4.0], atol=1e-12)


def test_the_integral_is_limited_and_does_not_wind_up_at_the_speed_limit():
    far, near = np.array([100.0, 0, 0]), np.array([0.5, 0.0, 0.0])
    state = START
    for k in range(1, 200):
        state, _ = tracking.step(state, holding(stamp_s=0.02 * k, hold_enu_m=far), PARAMS)
    assert not state.integral_mps.any()
    for k in range(200, 3000):
        state, _ = tracking.step(state, holding(stamp_s=0.02 * k, hold_enu_m=near), PARAMS)
    assert state.integral_mps[0] == PARAMS.integral_max_mps


def test_a_steady_wind_is_integrated_away():
    wind, position, state = np.array([0.2, -0.1, 0.0]), np.zeros(3), START
    for k in range(1, 6000):
        inputs = holding(stamp_s=0.02 * k, position_enu_m=position)
        state, command = tracking.step(state, inputs, PARAMS)
        position = position + 0.02 * (command.velocity_enu_mps + wind)
    assert np.abs(position).max() < 0.01


def test_running_slower_scales_velocity_and_acceleration():
    row = [0, 0, 0, 0, 2.0, 0, 0, 1.0, 0, 0]
    inputs = following(row, rate=0.5, rate_change_per_s=-0.3)
    _, command = tracking.step(START, inputs, replace(PARAMS, kd=0.0))
    assert command.velocity_enu_mps[0] == pytest.approx(1.0)
    assert command.acceleration_enu_mps2[0] == pytest.approx(0.25 * 1.0 - 0.3 * 2.0)


def test_the_yaw_turns_no_faster_than_its_limit_and_the_short_way():
    state = replace(START, yaw_rad=3.0)
    yaws = [3.0]
    for k in range(1, 60):
        state, command = tracking.step(state, holding(stamp_s=0.02 * k, hold_yaw_rad=-2.0), PARAMS)
        yaws.append(command.yaw_rad)
    turned = np.abs(np.diff(np.unwrap(yaws)))
    assert turned.max() <= PARAMS.yaw_rate_max_radps * 0.02 + 1e-12
    assert np.unwrap(yaws)[-1] == pytest.approx(2 * math.pi - 2.0)
    assert all(-math.pi <= yaw <= math.pi for yaw in yaws)


def test_a_long_pause_does_not_make_a_long_step():
    state = replace(START, stamp_s=-100.0)
    _, command = tracking.step(state, holding(hold_yaw_rad=3.0), PARAMS)
    assert command.yaw_rad == pytest.approx(PARAMS.yaw_rate_max_radps * PARAMS.step_max_s)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_is_left_out(bad):
    params = replace(PARAMS, kd=0.0)
    row = [0.5, 0, 0, 0.2, 1.0, 0, 0, 1.0, 0, 0]
    clean = tracking.step(START, following(row), params)[1]
    # Column, then what remains of velocity and acceleration along x.
    for column, velocity, acceleration in [(0, 1.0, 1.0), (4, 0.0, 1.0), (7, 0.0, 0.0)]:
        broken = list(row)
        broken[column] = bad
        command = tracking.step(START, following(broken), params)[1]
        assert command.velocity_enu_mps.tolist() == [velocity, 0.0, 0.0]
        assert command.acceleration_enu_mps2.tolist() == [acceleration, 0.0, 0.0]
        assert command.yaw_rad == clean.yaw_rad
    broken = list(row)
    broken[3] = bad
    command = tracking.step(replace(START, yaw_rad=0.1), following(broken), params)[1]
    assert command.yaw_rad == 0.1
    assert command.velocity_enu_mps.tolist() == clean.velocity_enu_mps.tolist()


def test_a_huge_reference_is_obeyed_at_the_limit():
    row = [0, 0, 0, 0, 0, 0, 0, 0, 0, 0]
    row[1] = row[8] = 1e300
    _, command = tracking.step(START, following(row), PARAMS)
    np.testing.assert_allclose(command.velocity_enu_mps, [0.0, 3.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(command.acceleration_enu_mps2, [0.0, 5.0, 0.0], atol=1e-12)


@pytest.mark.parametrize(
    ("planned_mps", "slice_period_s", "pace"),
    [
        (1.0, 0.01, 1.0),
        (1.0, 0.0265, 0.01 / 0.0265),
        (6.0, 0.01, 0.5),  # twice the speed limit stretches the slice
        (6.0, 0.0265, 0.01 / 0.0265),  # a slice that takes longer anyway is not stretched further
        (12.0, 0.0265, 0.25),
    ],
)
def test_a_slice_that_takes_long_slows_the_clock_but_not_the_command(
    planned_mps, slice_period_s, pace
):
    params = replace(
        PARAMS, kp_per_s=0.2, kp_climb_per_s=0.2, ki_per_s2=0.0, kd=0.0, stretches_clock=True,
        slice_period_s=slice_period_s,
    )  # fmt: skip
    row = [0.0, 0.0, 5.0, 0.0, planned_mps, 0.0, 0.0, 0.0, 0.0, 0.0]
    at_reference = replace(following(row), position_enu_m=np.array([0.0, 0.0, 5.0]), time_s=0.0)
    _, command = tracking.step(START, at_reference, params)
    assert command.pace == pytest.approx(pace)
    assert command.velocity_enu_mps[0] == pytest.approx(min(planned_mps, 3.0))
