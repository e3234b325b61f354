from __future__ import annotations

import fcl
import numpy as np
import pytest
from numpy.typing import NDArray

from mavfi_cli.core.frames import quaternion_from_euler
from sitl.sweep import clearance

LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
BODY = np.array([0.25, 0.2, 0.08])


def gap(position: NDArray, quaternion: NDArray, half: NDArray, box: NDArray) -> float:
    return clearance(position, quaternion, half, box[np.newaxis])[0]


def fcl_pair(
    position: NDArray, quaternion: NDArray, half: NDArray, box: NDArray
) -> tuple[fcl.CollisionObject, fcl.CollisionObject]:
    body = fcl.CollisionObject(fcl.Box(*(2.0 * half)), fcl.Transform(quaternion, position))
    middle = (box[:3] + box[3:]) / 2.0
    return body, fcl.CollisionObject(fcl.Box(*(box[3:] - box[:3])), fcl.Transform(middle))


def test_distance_and_overlap_agree_with_fcl() -> None:
    rng = np.random.default_rng(0)
    overlaps = 0
    for k in range(2000):
        half, low = rng.uniform(0.01, 2.0, 3), rng.uniform(-3.0, 3.0, 3)
        box = np.concatenate([low, low + rng.uniform(0.01, 3.0, 3)])
        position, quaternion = rng.uniform(-4.0, 4.0, 3), rng.normal(size=4)
        quaternion = LEVEL if k % 5 == 0 else quaternion / np.linalg.norm(quaternion)
        pair = fcl_pair(position, quaternion, half, box)
        ours = gap(position, quaternion, half, box)
        touching = fcl.collide(*pair, fcl.CollisionRequest(), fcl.CollisionResult()) > 0
        assert (ours == 0.0) == touching
        if touching:
            overlaps += 1
        else:
            theirs = fcl.distance(*pair, fcl.DistanceRequest(), fcl.DistanceResult())
            assert ours == pytest.approx(theirs, abs=1e-6)
    assert overlaps > 100


@pytest.mark.parametrize(
    ("position", "expected"),
    [
        ((2.0, 0.5, 0.5), 0.75),  # face to face, along x
        ((0.5, 3.0, 0.5), 1.8),  # along y
        ((1.55, 1.6, 0.5), 0.5),  # edge to edge: 0.3 and 0.4 apart
        ((0.5, 0.5, 0.5), 0.0),  # inside
        ((1.25, 0.5, 0.5), 0.0),  # touching
    ],
)
def test_distances_one_can_work_out_by_hand(position: tuple[float, ...], expected: float) -> None:
    box = np.array([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])
    found = gap(np.array(position), LEVEL, BODY, box)
    assert found == pytest.approx(expected, abs=1e-12)


def test_crossed_edges() -> None:
    """A body tilted by 45 degrees about y above a box tilted likewise in effect: edge on edge."""
    half, box = np.array([1.0, 1.0, 1.0]), np.array([-1.0, -1.0, -9.0, 1.0, 1.0, -5.0])
    quaternion = quaternion_from_euler(0.0, np.pi / 4.0, np.pi / 4.0)
    found = gap(np.zeros(3), quaternion, half, box)
    assert found == pytest.approx(5.0 - np.sqrt(2.0), abs=1e-12)


def test_the_nearest_of_many_boxes() -> None:
    boxes = np.array([[10, 0, 0, 11, 1, 9], [-6, -1, 0, -5, 1, 9], [20, 0, 0, 21, 1, 9.0]])
    found, index = clearance(np.array([0.0, 0.0, 5.0]), LEVEL, BODY, boxes)
    assert (found, index) == (pytest.approx(4.75), 1)
    assert clearance(np.zeros(3), LEVEL, BODY, np.zeros((0, 6))) == (np.inf, -1)
