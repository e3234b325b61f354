"""Stand-alone depth camera: reads a foreign autopilot's pose and serves frames.

With several links it also forwards every MAVLink frame between them, so that an autopilot on the
first and a companion on the second receive each other's messages and the camera's.
"""

from __future__ import annotations

import selectors
import time
from collections.abc import Callable, Sequence
from typing import Any

from mavfi_cli.link.codec import Codec, Signing, dialect
from mavfi_cli.link.transport import Transport
from sitl.camera.component import COMPONENT_ID, Camera
from sitl.camera.pose import PoseTracker

_WAIT_S = 0.2
_ASK_AGAIN_S = 2.0
_POSE_INTERVAL_US = 20_000.0
_ANNOUNCE_S = 1.0


class Station:
    """Camera, pose and links of one autopilot.

    Args:
        camera: Camera component, whose system id is set to the autopilot's.
        tracker: Tracker of the vehicle's pose.
        links: Open transports. The autopilot may be on any of them.
        signing: One object with the same key for each link, or none.
        clock: Monotonic clock in seconds for repeated requests, never for frames.
    """

    def __init__(
        self,
        camera: Camera,
        tracker: PoseTracker,
        links: Sequence[Transport],
        *,
        signing: Callable[[], Signing | None] = lambda: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.camera = camera
        self.frames_sent = 0
        self._tracker = tracker
        self._links = [
            (link, Codec(camera.system, COMPONENT_ID, signing=signing())) for link in links
        ]
        self._clock = clock
        self._autopilot: int | None = None  # system id; None before its first heartbeat
        self._ask_at_s = 0.0
        self._announce_at_s = 0.0

    def run(self, keep_on: Callable[[], bool]) -> None:
        """Serve until `keep_on` returns False.

        Raises:
            LinkLost: The peer of a link closed it.
        """
        with selectors.DefaultSelector() as selector:
            for link in self._links:
                selector.register(link[0].fileno(), selectors.EVENT_READ)
            while keep_on():
                selector.select(_WAIT_S)
                self.serve()

    def serve(self) -> None:
        """Handle all waiting messages and send the due ones."""
        for link, codec in self._links:
            while data := link.receive(0.0):
                for message in codec.decode(data, datagram=link.datagram):
                    self._take(message, link)
        self._announce()
        self._ask()

    def _take(self, message: Any, source: Transport) -> None:
        for link, _ in self._links:
            if link is not source:
                link.send(bytes(message.get_msgbuf()))
        if self._is_autopilot(message) and self._tracker.take(message):
            self._send(self.camera.poll(*self._tracker.pose()))
        self._send(self.camera.handle(message))

    def _is_autopilot(self, message: Any) -> bool:
        """Return True for a message of the autopilot, which its first heartbeat identifies."""
        if message.get_srcComponent() != dialect.MAV_COMP_ID_AUTOPILOT1:
            return False
        if self._autopilot is None:
            if (
                message.get_type() != "HEARTBEAT"
                or message.autopilot == dialect.MAV_AUTOPILOT_INVALID
            ):
                return False
            self._autopilot = self.camera.system = message.get_srcSystem()
            for _, codec in self._links:
                codec.system = self._autopilot
        return bool(message.get_srcSystem() == self._autopilot)

    def _announce(self) -> None:
        """Send a heartbeat on all links while there is no pose, so that an autopilot answers."""
        if self._clock() >= self._announce_at_s and not self._has_pose():
            self._announce_at_s = self._clock() + _ANNOUNCE_S
            self._send(self.camera.idle())

    def _has_pose(self) -> bool:
        return self._tracker.has_position and self._tracker.has_attitude

    def _ask(self) -> None:
        """Request attitude and position from the autopilot until both arrive."""
        if self._autopilot is None or self._clock() < self._ask_at_s:
            return
        self._ask_at_s = self._clock() + _ASK_AGAIN_S
        missing = []
        if not self._tracker.has_attitude:
            missing.append(dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION)
        if not self._tracker.has_position:
            missing.append(dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED)
        self._send(
            [
                dialect.MAVLink_command_long_message(
                    self._autopilot,
                    dialect.MAV_COMP_ID_AUTOPILOT1,
                    dialect.MAV_CMD_SET_MESSAGE_INTERVAL,
                    0,
                    float(message_id),
                    _POSE_INTERVAL_US,
                    0.0,
                    0.0,
                    0.0,
                    0.0,
                    0.0,
                )
                for message_id in missing
            ]
        )

    def _send(self, messages: Sequence[Any]) -> None:
        if not messages:
            return
        self.frames_sent += sum(m.get_type() == "CAMERA_IMAGE_CAPTURED" for m in messages)
        for link, codec in self._links:
            link.send(b"".join(codec.encode(message) for message in messages))
