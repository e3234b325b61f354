"""Implements the depth camera as a MAVLink camera component, which obeys commands and sends frames.

It has no clock, and no socket except its depth stream's. `handle` answers a message, and `poll`
returns the messages due at a stamp. The same stamps and messages give the same bytes.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mavfi_cli.core.errors import ConfigError
from mavfi_cli.core.frames import (
    Vector,
    enu_from_ned,
    flu_enu_from_frd_ned,
    rotate,
    rotation_matrix,
)
from mavfi_cli.link.codec import Message, dialect
from sitl.autopilot.telemetry import int32
from sitl.camera.depth import Image, render_depth
from sitl.camera.ranges import SENSORS
from sitl.camera.stream import DepthStream
from sitl.geodesy import Origin

_SLACK_S = 1e-6  # tolerance, because stamps are sums of steps with rounding errors

COMPONENT_ID: int = dialect.MAV_COMP_ID_CAMERA
MAX_RATE_HZ = 50.0  # one frame per control tick
_SENSOR_INTERVAL_S = 0.1
_MAX_SIDE_PX = 2048
_LEVEL = np.array([1.0, 0.0, 0.0, 0.0])

_LEGACY_REQUESTS: dict[int, int] = {
    dialect.MAV_CMD_REQUEST_CAMERA_INFORMATION: dialect.MAVLINK_MSG_ID_CAMERA_INFORMATION,
    dialect.MAV_CMD_REQUEST_CAMERA_SETTINGS: dialect.MAVLINK_MSG_ID_CAMERA_SETTINGS,
    dialect.MAV_CMD_REQUEST_STORAGE_INFORMATION: dialect.MAVLINK_MSG_ID_STORAGE_INFORMATION,
    dialect.MAV_CMD_REQUEST_CAMERA_CAPTURE_STATUS: dialect.MAVLINK_MSG_ID_CAMERA_CAPTURE_STATUS,
}

_PAYLOAD_BYTES = 253
_PIXEL_PITCH_MM = 0.01  # arbitrary: field of view = 2 atan(sensor / 2 / focal length)


@dataclass(slots=True)
class _Schedule:
    """A periodic schedule, which is due at the first poll and then every `interval_s` after it.

    A late poll does not delay later times. Missed times are skipped.
    """

    interval_s: float
    _first_s: float | None = None
    _count: int = 0

    def due(self, stamp_s: float) -> bool:
        """Return True if the schedule is due at a stamp; if so, advance it to the next time."""
        if self._first_s is None:
            self._first_s = stamp_s
        elapsed_s = stamp_s - self._first_s + _SLACK_S
        if elapsed_s < self._count * self.interval_s:
            return False
        self._count = int(elapsed_s / self.interval_s) + 1
        return True

    def restart(self) -> None:
        """Make the schedule due at the next poll, and count the interval from that poll."""
        self._first_s, self._count = None, 0


class Camera:
    """Simulates a depth camera on a vehicle in a world, as a MAVLink camera component.

    Args:
        world_boxes: Boxes (n, 6) xmin ymin zmin xmax ymax zmax, ENU m.
        mount_offset_flu_m: Offset of the optical centre from the vehicle's position.
        rate_hz: Default frame rate, at most 50 Hz.
        heartbeat_hz: Heartbeats per second. 0 turns them off.
        system: MAVLink system id of the vehicle. Commands for other systems are ignored.
        depth: Stream that gets frames at the default rate while it has readers, or None.

    Raises ConfigError if the size, field of view or rate is invalid.
    """

    def __init__(
        self,
        world_boxes: Vector,
        *,
        columns: int = 64,
        rows: int = 48,
        hfov_rad: float = math.pi / 2.0,
        mount_offset_flu_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
        rate_hz: float = 10.0,
        heartbeat_hz: float = 1.0,
        system: int = 1,
        depth: DepthStream | None = None,
    ) -> None:
        if not 0.0 < rate_hz <= MAX_RATE_HZ:
            limits = f"above 0 and at most {MAX_RATE_HZ:g} Hz"
            raise ConfigError(f"camera rate must be {limits}, got {rate_hz:g}")
        if not (1 <= columns <= _MAX_SIDE_PX and 1 <= rows <= _MAX_SIDE_PX):
            limits = f"between 1x1 and {_MAX_SIDE_PX}x{_MAX_SIDE_PX} pixels"
            raise ConfigError(f"camera size must be {limits}, got {columns}x{rows}")
        if not 0.01 <= hfov_rad <= 3.1:
            raise ConfigError(
                f"camera field of view must be between 0.01 and 3.1 rad, got {hfov_rad:g}"
            )
        self.mount_offset_flu_m = np.array(mount_offset_flu_m, dtype=np.float64)
        self._columns, self._rows, self._hfov_rad = columns, rows, hfov_rad
        self.system = system
        self.images = 0  # images since boot, which is also the next index
        self._boxes = np.array(world_boxes, dtype=np.float64).reshape(-1, 6)
        self._origin = Origin()
        self.local_origin_enu_m = np.zeros(3)  # origin of LOCAL_POSITION_NED in the world, m
        self._default_interval_s = 1.0 / rate_hz
        # Load the compiled renderer now, so that the first frame does not stall a real-time flight.
        render_depth(self._boxes, np.zeros(3), _LEVEL, 1, 1, 1.0)
        self._stamp_s = 0.0
        self._heartbeat = _Schedule(1.0 / heartbeat_hz) if heartbeat_hz > 0.0 else None
        self._frames: _Schedule | None = None
        self._frames_left = 0  # 0: unlimited
        self._depth, self._streamed = depth, _Schedule(self._default_interval_s)
        self._sensors: dict[int, _Schedule] = {}  # those requested by a client, by message id

    def handle(self, message: Message, *, component: int = COMPONENT_ID) -> list[Message]:
        """Handle a message, and return the answers to it.

        The list is empty if the message is not a command for this camera, or is a command for all
        components that the camera refuses.

        Args:
            component: Component for which the camera answers.
        """
        kind = message.get_type()
        if kind not in ("COMMAND_LONG", "COMMAND_INT") or message.target_system != self.system:
            return []
        if message.target_component not in (component, dialect.MAV_COMP_ID_ALL):
            return []
        answers = self._command(message)
        # The autopilot also gets a broadcast command, so a refusal here would confuse the sender.
        is_ours = message.target_component == component
        return answers if is_ours or answers[-1].result == dialect.MAV_RESULT_ACCEPTED else []

    def poll(
        self, stamp_s: float, position_enu_m: Vector, quaternion_flu_enu: Vector
    ) -> list[Message]:
        """Return the messages due at a stamp: a heartbeat, and a frame and ranges seen from a pose.

        A frame that is due on the depth stream is sent there.

        Args:
            stamp_s: Boot clock of the vehicle, s. A step back by more than 1 s is a reboot.
            position_enu_m: Position of the vehicle (3,).
            quaternion_flu_enu: Attitude of the vehicle (4,).
        """
        if stamp_s < self._stamp_s - 1.0:
            schedules = (self._heartbeat, self._frames, self._streamed, *self._sensors.values())
            for schedule in filter(None, schedules):
                schedule.restart()
        self._stamp_s = stamp_s
        due = self.idle() if self._heartbeat and self._heartbeat.due(stamp_s) else []
        frame_is_due = self._frames is not None and self._frames.due(stamp_s)
        depth = self._depth if self._depth is not None and self._depth.serve() else None
        streamed = depth is not None and self._streamed.due(stamp_s)
        sensors = [number for number, schedule in self._sensors.items() if schedule.due(stamp_s)]
        if frame_is_due or streamed or sensors:
            offset_m = rotate(rotation_matrix(quaternion_flu_enu), self.mount_offset_flu_m)
            lens_enu_m = position_enu_m + offset_m
            pose = lens_enu_m, quaternion_flu_enu
            if frame_is_due or streamed:
                pixels = render_depth(self._boxes, *pose, self._columns, self._rows, self._hfov_rad)
                if depth is not None and streamed:
                    depth.send(pixels, stamp_s, *pose, self._hfov_rad)
                if frame_is_due:
                    due += self._frame(pixels, *pose)
            for number in sensors:
                due += SENSORS[number](self._boxes, stamp_s, *pose)
        return due

    def idle(self) -> list[Message]:
        """Return the messages to send while no pose is known: a heartbeat, unless they are off."""
        if self._heartbeat is None:
            return []
        kind, no_autopilot = dialect.MAV_TYPE_CAMERA, dialect.MAV_AUTOPILOT_INVALID
        active = dialect.MAV_STATE_ACTIVE
        return [dialect.MAVLink_heartbeat_message(kind, no_autopilot, 0, 0, active, 3)]

    def _frame(
        self, image: Image, position_enu_m: Vector, quaternion_flu_enu: Vector
    ) -> list[Message]:
        """Return the messages of one frame in sending order.

        They are CAMERA_IMAGE_CAPTURED (stamp, pose and checksum of the pixels),
        DATA_TRANSMISSION_HANDSHAKE (size) and ENCAPSULATED_DATA (253 bytes each). Source:
        https://mavlink.io/en/services/image_transmission.html.
        """
        rows, columns = self._rows, self._columns
        pixels = image.tobytes()
        east, north, up = position_enu_m.tolist()
        latitude, longitude = self._origin.geodetic(north, east)
        captured = dialect.MAVLink_camera_image_captured_message(
            self._boot_ms, 0, 0, int32(latitude * 1e7), int32(longitude * 1e7),
            int32((self._origin.altitude_amsl_m + up) * 1e3), int32(up * 1e3),
            flu_enu_from_frd_ned(quaternion_flu_enu).tolist(),
            self.images, 1, b"depth8:crc32=%08x" % zlib.crc32(pixels),
        )  # fmt: skip
        packets = -(-len(pixels) // _PAYLOAD_BYTES)
        handshake = dialect.MAVLink_data_transmission_handshake_message(
            dialect.MAVLINK_DATA_STREAM_IMG_RAW8U, len(pixels), columns, rows, packets,
            _PAYLOAD_BYTES, 100,
        )  # fmt: skip
        padded = pixels.ljust(packets * _PAYLOAD_BYTES, b"\0")
        starts = range(0, len(padded), _PAYLOAD_BYTES)
        data = [
            dialect.MAVLink_encapsulated_data_message(
                number, padded[start : start + _PAYLOAD_BYTES]
            )
            for number, start in enumerate(starts)
        ]
        self.images += 1
        if self._frames_left:
            self._frames_left -= 1
            if not self._frames_left:
                self._frames = None
        return [captured, handshake, *data]

    def _command(self, message: Message) -> list[Message]:
        """Execute a command. Return the requested messages, then the acknowledgement."""
        number = int(message.command)
        answers: list[Message] = []
        if number == dialect.MAV_CMD_REQUEST_MESSAGE or number in _LEGACY_REQUESTS:
            build = _BUILDERS.get(_whole(_LEGACY_REQUESTS.get(number, message.param1)))
            answers = [] if build is None else [build(self)]
            result = dialect.MAV_RESULT_ACCEPTED if answers else dialect.MAV_RESULT_DENIED
        else:
            result = self._act(number, message)
        ack = dialect.MAVLink_command_ack_message(
            number, result, 0, 0, message.get_srcSystem(), message.get_srcComponent()
        )
        return [*answers, ack]

    def _information(self) -> Message:
        """Return CAMERA_INFORMATION, whose focal length and sensor size give the field of view."""
        sensor_mm = (self._columns * _PIXEL_PITCH_MM, self._rows * _PIXEL_PITCH_MM)
        focal_px = self._columns / 2.0 / math.tan(self._hfov_rad / 2.0)
        return dialect.MAVLink_camera_information_message(
            self._boot_ms, list(b"mavfi".ljust(32, b"\0")), list(b"depth8".ljust(32, b"\0")), 1,
            focal_px * _PIXEL_PITCH_MM, *sensor_mm, self._columns, self._rows, 0,
            dialect.CAMERA_CAP_FLAGS_CAPTURE_IMAGE, 0, b"",
        )  # fmt: skip

    def _capture_status(self) -> Message:
        status, interval_s = (0, 0.0) if self._frames is None else (3, self._frames.interval_s)
        return dialect.MAVLink_camera_capture_status_message(
            self._boot_ms, status, 0, interval_s, 0, 0.0, self.images
        )

    def _local_origin(self) -> Message:
        offset = enu_from_ned(self.local_origin_enu_m).tolist()
        return dialect.MAVLink_local_position_ned_system_global_offset_message(
            self._boot_ms, *offset, 0.0, 0.0, 0.0
        )

    @property
    def _boot_ms(self) -> int:
        return round(self._stamp_s * 1000.0) & 0xFFFF_FFFF

    def _act(self, number: int, message: Message) -> int:
        """Execute a command. Return its MAV_RESULT."""
        accepted = True
        if number == dialect.MAV_CMD_IMAGE_START_CAPTURE:
            accepted = self._start_capture(message)
        elif number == dialect.MAV_CMD_IMAGE_STOP_CAPTURE:
            self._frames, self._frames_left = None, 0
        elif number == dialect.MAV_CMD_SET_MESSAGE_INTERVAL:
            accepted = self._set_interval(message)
        elif number == dialect.MAV_CMD_SET_CAMERA_MODE:
            accepted = _whole(message.param2) == dialect.CAMERA_MODE_IMAGE
        else:
            return int(dialect.MAV_RESULT_UNSUPPORTED)
        return int(dialect.MAV_RESULT_ACCEPTED if accepted else dialect.MAV_RESULT_DENIED)

    def _set_interval(self, message: Message) -> bool:
        """Send a range sensor's messages every param2 microseconds (0: at 10 Hz, -1: never).

        Return False if the message id or the interval is invalid.
        """
        number, interval_us = _whole(message.param1), float(message.param2)
        if number not in SENSORS or not (0.0 <= interval_us < math.inf or interval_us == -1.0):
            return False
        self._sensors.pop(number, None)
        if interval_us >= 0.0:
            interval_s = round(interval_us * 1e-6, 6) or _SENSOR_INTERVAL_S
            self._sensors[number] = _Schedule(max(interval_s, 1.0 / MAX_RATE_HZ))
        return True

    def _start_capture(self, message: Message) -> bool:
        """Start to capture param3 frames (0: unlimited), one every param2 seconds (0: default).

        Return False if a parameter is invalid.
        """
        interval_s, count = float(message.param2), _whole(message.param3)
        if count is None or count < 0 or interval_s < 0.0 or math.isinf(interval_s):
            return False
        if math.isnan(interval_s) or interval_s == 0.0:
            interval_s = self._default_interval_s
        interval_s = round(interval_s, 6)  # a float32 of 0.1 would drift against ticks
        self._frames = _Schedule(max(interval_s, 1.0 / MAX_RATE_HZ))
        self._frames_left = count
        return True


def _whole(value: float) -> int | None:
    """Return the integer that a command's float parameter contains.

    NaN counts as 0. The result is None if the integer does not fit into 32 bits.
    """
    if math.isnan(value):
        return 0
    return round(value) if abs(value) < 2**31 else None


_BUILDERS: dict[int | None, Callable[[Camera], Message]] = {
    dialect.MAVLINK_MSG_ID_CAMERA_INFORMATION: Camera._information,
    dialect.MAVLINK_MSG_ID_CAMERA_SETTINGS: lambda camera: dialect.MAVLink_camera_settings_message(
        camera._boot_ms, dialect.CAMERA_MODE_IMAGE, math.nan, math.nan
    ),
    # There is no storage, because frames are sent at once.
    dialect.MAVLINK_MSG_ID_STORAGE_INFORMATION: (
        lambda camera: dialect.MAVLink_storage_information_message(
            camera._boot_ms, 1, 0, dialect.STORAGE_STATUS_NOT_SUPPORTED, 0.0, 0.0, 0.0, 0.0, 0.0
        )
    ),
    dialect.MAVLINK_MSG_ID_CAMERA_CAPTURE_STATUS: Camera._capture_status,
    dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED_SYSTEM_GLOBAL_OFFSET: Camera._local_origin,
}
"""Builders of the messages that can be requested, by message id."""
