"""Builds the camera's MAVLink messages, without state or clock.

A frame consists of CAMERA_IMAGE_CAPTURED (stamp, pose and checksum of the pixels),
DATA_TRANSMISSION_HANDSHAKE (size) and ENCAPSULATED_DATA (253 bytes each). This is MAVLink's image
transmission protocol (https://mavlink.io/en/services/image_transmission.html).
"""

from __future__ import annotations

import math
import zlib
from typing import Any

from mavfi_cli.link.codec import dialect
from sitl.camera.depth import Image
from sitl.camera.geometry import CameraPose, Optics
from sitl.geodesy import Origin

PAYLOAD_BYTES = 253
_PIXEL_PITCH_MM = 0.01  # arbitrary: field of view = 2 atan(sensor / 2 / focal length)
_UNKNOWN = 0x7FFF_FFFF
_IMAGE_MODE = 0
_VENDOR, _MODEL = b"mavfi", b"depth8"


def boot_ms(stamp_s: float) -> int:
    """Convert a stamp to MAVLink's milliseconds since boot."""
    return round(stamp_s * 1000.0) & 0xFFFF_FFFF


def heartbeat() -> Any:
    """Return the HEARTBEAT of a working camera."""
    return dialect.MAVLink_heartbeat_message(
        dialect.MAV_TYPE_CAMERA, dialect.MAV_AUTOPILOT_INVALID, 0, 0, dialect.MAV_STATE_ACTIVE, 3
    )


def information(optics: Optics, stamp_s: float) -> Any:
    """Return CAMERA_INFORMATION. Focal length and sensor size give the exact field of view."""
    return dialect.MAVLink_camera_information_message(
        boot_ms(stamp_s),
        list(_VENDOR.ljust(32, b"\0")),
        list(_MODEL.ljust(32, b"\0")),
        1,
        optics.focal_px * _PIXEL_PITCH_MM,
        optics.columns * _PIXEL_PITCH_MM,
        optics.rows * _PIXEL_PITCH_MM,
        optics.columns,
        optics.rows,
        0,
        dialect.CAMERA_CAP_FLAGS_CAPTURE_IMAGE,
        0,
        b"",
    )


def settings(stamp_s: float) -> Any:
    """Return CAMERA_SETTINGS: photo mode, no zoom, no focus."""
    return dialect.MAVLink_camera_settings_message(
        boot_ms(stamp_s), _IMAGE_MODE, math.nan, math.nan
    )


def storage_information(stamp_s: float) -> Any:
    """Return STORAGE_INFORMATION without storage, as frames are sent at once."""
    return dialect.MAVLink_storage_information_message(
        boot_ms(stamp_s), 1, 0, dialect.STORAGE_STATUS_NOT_SUPPORTED, 0.0, 0.0, 0.0, 0.0, 0.0
    )


def capture_status(stamp_s: float, *, interval_s: float | None, images: int) -> Any:
    """Return CAMERA_CAPTURE_STATUS. An interval of None means idle."""
    image_status = 0 if interval_s is None else 3  # idle, or interval set and capturing
    return dialect.MAVLink_camera_capture_status_message(
        boot_ms(stamp_s), image_status, 0, interval_s or 0.0, 0, 0.0, images
    )


def fov_status(optics: Optics, pose: CameraPose, origin: Origin) -> Any:
    """Return CAMERA_FOV_STATUS. The geographic position of the image centre is unknown."""
    return dialect.MAVLink_camera_fov_status_message(
        boot_ms(pose.stamp_s),
        *_geodetic_e7_mm(pose, origin),
        _UNKNOWN,
        _UNKNOWN,
        _UNKNOWN,
        pose.quaternion_frd_ned,
        math.degrees(optics.hfov_rad),
        math.degrees(optics.vfov_rad),
    )


def frame_messages(image: Image, index: int, pose: CameraPose, origin: Origin) -> list[Any]:
    """Return the messages of one frame (rows, columns) in the order of sending."""
    rows, columns = image.shape
    pixels = image.tobytes()
    captured = dialect.MAVLink_camera_image_captured_message(
        boot_ms(pose.stamp_s),
        0,
        0,
        *_geodetic_e7_mm(pose, origin),
        _int32(pose.position_enu_m[2] * 1e3),
        pose.quaternion_frd_ned,
        index,
        1,
        b"depth8:crc32=%08x" % zlib.crc32(pixels),
    )
    packets = -(-len(pixels) // PAYLOAD_BYTES)
    handshake = dialect.MAVLink_data_transmission_handshake_message(
        dialect.MAVLINK_DATA_STREAM_IMG_RAW8U,
        len(pixels),
        columns,
        rows,
        packets,
        PAYLOAD_BYTES,
        100,
    )
    padded = pixels.ljust(packets * PAYLOAD_BYTES, b"\0")
    data = [
        dialect.MAVLink_encapsulated_data_message(
            number, padded[number * PAYLOAD_BYTES : (number + 1) * PAYLOAD_BYTES]
        )
        for number in range(packets)
    ]
    return [captured, handshake, *data]


def _geodetic_e7_mm(pose: CameraPose, origin: Origin) -> tuple[int, int, int]:
    east, north, up = (float(c) for c in pose.position_enu_m)
    latitude, longitude = origin.geodetic(north, east)
    altitude = _int32((origin.altitude_amsl_m + up) * 1e3)
    return _int32(latitude * 1e7), _int32(longitude * 1e7), altitude


def _int32(value: float) -> int:
    return max(-(2**31), min(2**31 - 1, round(float(value))))
