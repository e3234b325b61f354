"""Client of the MAVLink camera protocol: finds the camera, starts it, reads its field of view."""

from __future__ import annotations

import math

from mavfi_cli.link.codec import Message, dialect
from mavfi_cli.link.commands import CommandChannel, Ticket

_CAMERA = dialect.MAV_COMP_ID_CAMERA


class CameraClient:
    """Client of the camera component (MAV_COMP_ID_CAMERA) of one system.

    Args:
        commands: Command channel of that system.

    Attributes:
        heard: True once the camera has sent a HEARTBEAT.
        hfov_rad: Horizontal field of view; None if unknown.
    """

    def __init__(self, commands: CommandChannel) -> None:
        self._commands = commands
        self.heard = False
        self.hfov_rad: float | None = None

    def handle(self, message: Message) -> None:
        """Handle a message of the camera and request its information at the first HEARTBEAT."""
        if isinstance(message, dialect.MAVLink_heartbeat_message) and not self.heard:
            self.heard = True
            self._commands.submit(
                dialect.MAV_CMD_REQUEST_MESSAGE,
                dialect.MAVLINK_MSG_ID_CAMERA_INFORMATION,
                component=_CAMERA,
            )
        hfov_rad = hfov_of(message)
        if hfov_rad is not None:
            self.hfov_rad = hfov_rad

    def start(self, interval_s: float) -> Ticket:
        """Request a frame every `interval_s` without end. The ticket holds the answer."""
        return self._commands.submit(
            dialect.MAV_CMD_IMAGE_START_CAPTURE, 0.0, interval_s, 0.0, 0.0,
            component=_CAMERA, unused=math.nan, refusals=3,
        )  # fmt: skip

    def stop(self) -> Ticket:
        """Request the end of the frames."""
        return self._commands.submit(
            dialect.MAV_CMD_IMAGE_STOP_CAPTURE, 0.0, component=_CAMERA, unused=math.nan
        )


def hfov_of(message: Message) -> float | None:
    """Return the horizontal field of view in a camera's message, rad; None if there is none.

    CAMERA_INFORMATION gives 2 atan(sensor width / 2 focal length), CAMERA_FOV_STATUS degrees.
    """
    if isinstance(message, dialect.MAVLink_camera_information_message):
        if message.focal_length > 0.0 and 0.0 < message.sensor_size_h < math.inf:
            return 2.0 * math.atan(message.sensor_size_h / (2.0 * message.focal_length))
        return None
    if isinstance(message, dialect.MAVLink_camera_fov_status_message) and 0 < message.hfov < 180:
        return math.radians(message.hfov)
    return None
