"""Converts coordinate frames: ENU and FLU in mavfi (ROS REP-103), NED and FRD in MAVLink.

World frame: x east, y north, z up (ENU). Body frame: x forward, y left, z up (FLU).
Yaw is measured counter-clockwise from east. A MAVLink heading is measured clockwise from north.
Quaternions are Hamilton, scalar first (w, x, y, z), and rotate body into world.
Each conversion between frames is its own inverse.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]

# Limits per axis for positions and velocities from a link. Maps end at 6.5 km.
FARTHEST_M, FASTEST_MPS = 1e4, 1e3


def is_within(limit: float, values: Iterable[float]) -> bool:
    """Return True if the magnitude of every value is at most `limit`. NaN never is."""
    return all(abs(value) <= limit for value in values)


def dot(a: Vector | Sequence[float], b: Vector | Sequence[float]) -> float:
    """Return the dot product of two vectors of shape (n,), the same on every processor.

    The products are summed in the order of the elements. numpy's `@`, `dot` and `linalg.norm` use
    BLAS, whose last digit depends on the processor.
    """
    total = 0.0
    for x, y in zip(_floats(a), _floats(b), strict=True):
        total += x * y
    return total


def norm(vector: Vector | Sequence[float]) -> float:
    """Return the Euclidean length of a vector of shape (n,), the same on every processor."""
    return math.sqrt(dot(vector, vector))


def rotate(rotation: Vector, vector: Vector | Sequence[float]) -> Vector:
    """Return the product `rotation` @ `vector` of a (3, 3) matrix and a (3,) vector, shape (3,)."""
    return np.array([dot(row, vector) for row in rotation])


def _floats(vector: Vector | Sequence[float]) -> Sequence[float]:
    return vector.tolist() if isinstance(vector, np.ndarray) else vector


def enu_from_ned(vector: Vector) -> Vector:
    """Convert vectors from NED to ENU components, or from ENU to NED, which is the same operation.

    Vectors may have any unit. The argument and the result have the shape (..., 3).
    """
    if vector.shape == (3,):
        north, east, down = vector.tolist()
        return np.array((east, north, -down))
    swapped = vector[..., [1, 0, 2]].copy()
    swapped[..., 2] *= -1.0
    return swapped


ned_from_enu = enu_from_ned


def wrap_angle(angle_rad: float) -> float:
    """Wrap an angle in radians into the range [-pi, pi). NaN and infinities give NaN."""
    if not math.isfinite(angle_rad):
        return math.nan
    return (angle_rad + math.pi) % (2.0 * math.pi) - math.pi


def ned_yaw_from_enu(yaw_rad: float) -> float:
    """Convert an ENU yaw to an NED heading, or back, which is the same operation.

    The angle is in radians. The result is in the range [-pi, pi).
    """
    return wrap_angle(math.pi / 2.0 - yaw_rad)


_HALF_SQRT2 = math.sqrt(0.5)


def flu_enu_from_frd_ned(quaternion: Vector | Sequence[float]) -> Vector:
    """Convert an attitude from FRD-to-NED to FLU-to-ENU, or back, which is the same operation.

    The attitude is a quaternion of shape (4,) that rotates body into world.


    q_enu = q(ENU<-NED) * q_ned * q(FRD<-FLU), with q(ENU<-NED) = (0, s, s, 0), s = sqrt(1/2),
    and q(FRD<-FLU) = (0, 1, 0, 0). The result is a unit quaternion with w >= 0.
    """
    w, x, y, z = _floats(quaternion)
    # (0, s, s, 0) * (w, x, y, z)
    s = _HALF_SQRT2
    aw, ax, ay, az = -s * (x + y), s * (w + z), s * (w - z), s * (y - x)
    # (aw, ax, ay, az) * (0, 1, 0, 0)
    if -ax >= 0.0:
        return np.array((-ax, aw, az, -ay))
    return np.array((ax, -aw, -az, ay))


def quaternion_from_euler(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Vector:
    """Return the quaternion, shape (4,), of a rotation by yaw, pitch and roll, in radians.

    The rotations are about the axes z, y and x, in this order.
    """
    cr, sr = math.cos(roll_rad / 2.0), math.sin(roll_rad / 2.0)
    cp, sp = math.cos(pitch_rad / 2.0), math.sin(pitch_rad / 2.0)
    cy, sy = math.cos(yaw_rad / 2.0), math.sin(yaw_rad / 2.0)
    return np.array(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )


def yaw_from_quaternion(quaternion: Vector | Sequence[float]) -> float:
    """Return the yaw of a quaternion of shape (4,), in radians in the range [-pi, pi]."""
    w, x, y, z = _floats(quaternion)
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def rotation_matrix(quaternion: Vector) -> NDArray[np.float64]:
    """Return the (3, 3) rotation matrix R of a unit quaternion of shape (4,): world = R @ body."""
    w, x, y, z = _floats(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
