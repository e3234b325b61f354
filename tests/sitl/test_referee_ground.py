from __future__ import annotations

import math

import numpy as np
import pytest

from mavfi_cli.core.frames import quaternion_from_euler
from sitl.referee import Referee
from sitl.world import World

LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


def rule() -> Referee:
    world = World(
        name="empty", seed=0, boxes_enu_m=np.zeros((0, 6)),
        bounds_enu_m=np.array([-9.0, -9.0, 0.0, 9.0, 9.0, 9.0]),
        start_enu_m=np.zeros(3), goal_enu_m=np.array([5.0, 0.0, 5.0]),
    )  # fmt: skip
    return Referee(world, (0.5, 0.5, 0.16))


def watch(
    ground: Referee,
    height: float,
    *,
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
    tilt: float = 0.0,
    on_ground: bool = False,
    may_land: bool = False,
) -> bool:
    """Return True if a pose is a crash of an armed vehicle."""
    collision = ground.observe(
        0.0,
        np.array([0.0, 0.0, height]),
        quaternion_from_euler(tilt, 0.0, 0.5) if tilt else LEVEL,
        np.array(velocity),
        armed=True,
        on_ground=on_ground,
        may_land=may_land,
    )
    return collision is not None


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
