import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavfi_cli.core import frames

angles = st.floats(-20.0, 20.0)
finite = st.floats(-1e6, 1e6)


@given(st.tuples(finite, finite, finite))
def test_enu_ned_is_an_involution(vector):
    there = frames.ned_from_enu(np.array(vector))
    assert frames.enu_from_ned(there).tolist() == list(vector)


def test_enu_ned_by_hand():
    assert frames.ned_from_enu(np.array([1.0, 2.0, 3.0])).tolist() == [2.0, 1.0, -3.0]


@given(angles)
def test_wrapping_keeps_the_direction(angle):
    wrapped = frames.wrap_angle(angle)
    assert -math.pi <= wrapped <= math.pi
    assert math.cos(wrapped) == pytest.approx(math.cos(angle), abs=1e-9)
    assert math.sin(wrapped) == pytest.approx(math.sin(angle), abs=1e-9)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_wrapping_what_is_no_angle(bad):
    assert math.isnan(frames.wrap_angle(bad))


def test_yaw_by_hand():
    assert frames.ned_yaw_from_enu(0.0) == pytest.approx(math.pi / 2)  # north
    assert frames.ned_yaw_from_enu(math.pi / 2) == pytest.approx(0.0)  # east


@given(angles, st.floats(-1.4, 1.4), angles, st.tuples(finite, finite, finite))
def test_quaternion_change_of_frames_equals_rotating_in_ned(roll, pitch, yaw, body_flu):
    q_ned = frames.quaternion_from_euler(roll, pitch, yaw)
    q_enu = frames.flu_enu_from_frd_ned(q_ned)
    body_flu = np.array(body_flu)
    body_frd = body_flu * [1.0, -1.0, -1.0]
    expected = frames.enu_from_ned(frames.rotation_matrix(q_ned) @ body_frd)
    scale = 1.0 + np.abs(body_flu).max()
    turned = frames.rotation_matrix(q_enu) @ body_flu
    np.testing.assert_allclose(turned, expected, atol=1e-9 * scale)
    back = frames.flu_enu_from_frd_ned(q_enu)
    assert abs(float(back @ q_ned)) == pytest.approx(1.0)


@given(st.floats(-1.4, 1.4), st.floats(-1.4, 1.4), st.floats(-3.1, 3.1))
def test_yaw_of_a_quaternion(roll, pitch, yaw):
    quaternion = frames.quaternion_from_euler(roll, pitch, yaw)
    assert frames.yaw_from_quaternion(quaternion) == pytest.approx(yaw, abs=1e-9)


def test_sums_of_products_are_added_in_their_order():
    a, b = np.array([1e16, 1.0, -1e16]), np.array([1.0, 1.0, 1.0])
    assert frames.dot(a, b) == frames.dot([*a], b) == (1e16 + 1.0) - 1e16 == 0.0
    assert frames.norm(np.array([3.0, 4.0])) == 5.0
    assert frames.norm(np.array([np.inf, 0.0])) == np.inf
    assert np.isnan(frames.norm(np.array([np.nan, 0.0])))
    turn = frames.rotation_matrix(frames.quaternion_from_euler(0.1, -0.2, 2.0))
    np.testing.assert_allclose(frames.rotate(turn, a), turn @ a, rtol=1e-14)
    with pytest.raises(ValueError, match="shorter"):
        frames.dot(a, b[:2])
