"""The companion's side of the MAVLink camera protocol: find it, start it, learn its view."""

from __future__ import annotations

import math

from mavfi_cli.link.codec import Message, dialect
from mavfi_cli.link.commands import CommandChannel, Ticket

_CAMERA = dialect.MAV_COMP_ID_CAMERA


class CameraClient:
    """Talks to the camera component (MAV_COMP_ID_CAMERA) of one system.

    Args:
        commands: the channel of that system.

    Attributes:
        heard: whether it sent a HEARTBEAT.
        hfov_rad: its horizontal field of view, None when unknown.
    """

    def __init__(self, commands: CommandChannel) -> None:
        self._commands = commands
        self.heard = False
        self.hfov_rad: float | None = None

    def handle(self, message: Message) -> None:
        """Take a message of the component; its first HEARTBEAT makes us ask what it is."""
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
        """Ask for a frame every `interval_s`, without end; the ticket tells the answer."""
        return self._commands.submit(
            dialect.MAV_CMD_IMAGE_START_CAPTURE, 0.0, interval_s, 0.0, 0.0,
            component=_CAMERA, unused=math.nan, refusals=3,
        )  # fmt: skip

    def stop(self) -> Ticket:
        """Ask for no more frames."""
        return self._commands.submit(
            dialect.MAV_CMD_IMAGE_STOP_CAPTURE, 0.0, component=_CAMERA, unused=math.nan
        )


def hfov_of(message: Message) -> float | None:
    """The horizontal field of view that a camera's message tells, rad; None where it does not.

    CAMERA_INFORMATION: 2 atan(sensor width / 2 focal length); CAMERA_FOV_STATUS: in degrees.
    """
    if isinstance(message, dialect.MAVLink_camera_information_message):
        if message.focal_length > 0.0 and 0.0 < message.sensor_size_h < math.inf:
            return 2.0 * math.atan(message.sensor_size_h / (2.0 * message.focal_length))
        return None
    if isinstance(message, dialect.MAVLink_camera_fov_status_message) and 0 < message.hfov < 180:
        return math.radians(message.hfov)
    return None
