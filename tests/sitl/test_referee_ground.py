from __future__ import annotations

import math

import numpy as np
import pytest

from mavfi_cli.core.frames import quaternion_from_euler
from sitl.referee import GroundRule

LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


def rule() -> GroundRule:
    return GroundRule(half_m=(0.25, 0.25, 0.08))


def watch(
    ground: GroundRule,
    height: float,
    *,
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
    tilt: float = 0.0,
    on_ground: bool = False,
    may_land: bool = False,
) -> bool:
    return ground.crashed(
        np.array([0.0, 0.0, height]),
        quaternion_from_euler(tilt, 0.0, 0.5) if tilt else LEVEL,
        np.array(velocity),
        on_ground=on_ground,
        may_land=may_land,
    )


@pytest.mark.parametrize("height", [0.0, 0.11])
def test_standing_on_the_ground_is_no_crash(height: float) -> None:
    ground = rule()
    assert not any(watch(ground, height, on_ground=True) for _ in range(10))


def test_take_off_and_gentle_landing() -> None:
    ground = rule()
    watch(ground, 0.11, on_ground=True)
    for height in (0.2, 1.0, 5.0, 0.3):
        assert not watch(ground, height, velocity=(0.0, 0.0, -0.7))
    assert not watch(ground, 0.11, on_ground=True, may_land=True)


@pytest.mark.parametrize(
    ("velocity", "tilt", "may_land"),
    [
        ((0.0, 0.0, -0.7), 0.0, False),  # nobody meant to land
        ((0.0, 0.0, -3.0), 0.0, True),  # too fast down
        ((2.0, 0.0, -0.7), 0.0, True),  # too fast along
        ((0.0, 0.0, -0.7), math.radians(60), True),  # on its side
    ],
)
def test_what_is_no_landing_is_a_crash_once(
    velocity: tuple[float, float, float], tilt: float, may_land: bool
) -> None:
    ground = rule()
    watch(ground, 2.0, velocity=velocity, tilt=tilt)
    # the contact has already taken the speed away
    assert watch(ground, 0.11, tilt=tilt, on_ground=True, may_land=may_land)
    assert not watch(ground, 0.11, tilt=tilt, on_ground=True, may_land=may_land)


def test_a_tilted_body_meets_the_ground_with_its_lowest_corner() -> None:
    ground = rule()
    watch(ground, 2.0, tilt=math.pi / 2.0)
    assert not watch(ground, 0.26, tilt=math.pi / 2.0)
    assert watch(ground, 0.24, tilt=math.pi / 2.0)


def test_bouncing_below_flight_height_is_one_touch() -> None:
    ground = rule()
    watch(ground, 2.0)
    assert not watch(ground, 0.11, on_ground=True, may_land=True)
    assert not watch(ground, 0.2)
    assert not watch(ground, 0.11, on_ground=True)
