"""Simulates range finders at the depth camera: a ring of 72 sectors, and beams forward and down.

They sit at the optical centre on a levelled mount that turns only with the vehicle's yaw. Ranges
come from the depth renderer, so they have its resolution of 0.1 m.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from mavfi_cli.core.frames import Vector, quaternion_from_euler, yaw_from_quaternion
from mavfi_cli.link.codec import Message, dialect
from sitl.camera.depth import LEVELS_PER_M, NOTHING, render_depth

_LEAST_CM, _MOST_CM = 10, 2500
_CM_PER_LEVEL = round(100 / LEVELS_PER_M)
_QUADRANTS = 4
_SECTORS = 72  # in OBSTACLE_DISTANCE
_COLUMNS = 180  # in a quadrant's image, at most 0.64 degrees apart
_SIDEWAYS = [(2 * column + 1 - _COLUMNS) / _COLUMNS for column in range(_COLUMNS)]  # to the right
_STRETCH = [math.hypot(1.0, side) for side in _SIDEWAYS]  # range per planar depth
_SECTOR_OF = [
    [
        round((90.0 * quadrant + math.degrees(math.atan(side))) * _SECTORS / 360.0) % _SECTORS
        for side in _SIDEWAYS
    ]
    for quadrant in range(_QUADRANTS)
]
_FORWARD, _DOWN = dialect.MAV_SENSOR_ROTATION_NONE, dialect.MAV_SENSOR_ROTATION_PITCH_270
_UNKNOWN_COVARIANCE = 255
_RIGHT_ANGLE = math.pi / 2.0


def _sector_ranges_cm(boxes_enu_m: Vector, position_enu_m: Vector, yaw_rad: float) -> list[int]:
    """Return the range, cm, to the nearest obstacle in each of 72 horizontal sectors of 5 degrees.

    The first sector is centred on the vehicle's nose, and the others follow clockwise. A range of
    2501 means that the sector is free for 25 m.

    Args:
        boxes_enu_m: Boxes (n, 6) xmin ymin zmin xmax ymax zmax.
        position_enu_m: Position of the ring (3,).
        yaw_rad: ENU yaw, counter-clockwise from east.
    """
    ranges_cm = [_MOST_CM + 1] * _SECTORS
    for quadrant, sectors in enumerate(_SECTOR_OF):
        attitude = quaternion_from_euler(0.0, 0.0, yaw_rad - quadrant * _RIGHT_ANGLE)
        image = render_depth(boxes_enu_m, position_enu_m, attitude, _COLUMNS, 1, _RIGHT_ANGLE)
        for sector, level, stretch in zip(sectors, image[0].tolist(), _STRETCH, strict=True):
            if level != NOTHING:
                ranges_cm[sector] = min(ranges_cm[sector], int(level * _CM_PER_LEVEL * stretch))
    return ranges_cm


def _ring(
    boxes_enu_m: Vector, stamp_s: float, position: Vector, quaternion: Vector
) -> list[Message]:
    """Return one OBSTACLE_DISTANCE message, with the ranges around the vehicle.

    `stamp_s` is the boot clock, `position` is in ENU m, and `quaternion` rotates FLU to ENU.
    """
    yaw_rad = yaw_from_quaternion(quaternion)
    return [
        dialect.MAVLink_obstacle_distance_message(
            round(stamp_s * 1e6), dialect.MAV_DISTANCE_SENSOR_LASER,
            _sector_ranges_cm(boxes_enu_m, position, yaw_rad), 360 // _SECTORS,
            _LEAST_CM, _MOST_CM, 0.0, 0.0, dialect.MAV_FRAME_BODY_FRD,
        )
    ]  # fmt: skip


def _beams(
    boxes_enu_m: Vector, stamp_s: float, position: Vector, quaternion: Vector
) -> list[Message]:
    """Return two DISTANCE_SENSOR messages: forward (id 0) and down (id 1).

    The arguments are those of `_ring`.
    """
    yaw_rad = yaw_from_quaternion(quaternion)
    messages = []
    for number, (orientation, pitch_rad) in enumerate(((_FORWARD, 0.0), (_DOWN, _RIGHT_ANGLE))):
        attitude = quaternion_from_euler(0.0, pitch_rad, yaw_rad)
        level = int(render_depth(boxes_enu_m, position, attitude, 1, 1, 1.0)[0, 0])
        range_cm = _MOST_CM + 1 if level == NOTHING else level * _CM_PER_LEVEL
        messages.append(
            dialect.MAVLink_distance_sensor_message(
                round(stamp_s * 1e3) & 0xFFFF_FFFF, _LEAST_CM, _MOST_CM, range_cm,
                dialect.MAV_DISTANCE_SENSOR_LASER, number, orientation, _UNKNOWN_COVARIANCE,
            )
        )  # fmt: skip
    return messages


SENSORS: dict[int, Callable[[Vector, float, Vector, Vector], list[Message]]] = {
    dialect.MAVLINK_MSG_ID_OBSTACLE_DISTANCE: _ring,
    dialect.MAVLINK_MSG_ID_DISTANCE_SENSOR: _beams,
}
"""Functions that build a range sensor's messages, keyed by message id.

Their arguments are boxes, stamp, position and attitude.
"""
