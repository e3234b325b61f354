"""Stand-alone depth camera: tracks a foreign autopilot's vehicle and serves frames.

With several links it also forwards every MAVLink frame between them, so that an autopilot on the
first and a companion on the second receive each other's messages and the camera's.
"""

from __future__ import annotations

import math
import selectors
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from mavfi_cli.core.frames import Vector, enu_from_ned, flu_enu_from_frd_ned, quaternion_from_euler
from mavfi_cli.link.codec import Codec, Signing, dialect
from mavfi_cli.link.transport import Transport
from sitl.camera.component import COMPONENT_ID, Camera

_REBOOT_S = 1.0
_LONGEST_EXTRAPOLATION_S = 0.5

_WAIT_S = 0.2
_ASK_AGAIN_S = 2.0
_POSE_INTERVAL_US = 20_000.0
_ANNOUNCE_S = 1.0


class PoseTracker:
    """Combines attitude and local position, which have different stamps.

    There is a pose at each new attitude. The newest position is extrapolated to its stamp with the
    velocity, for 0.5 s at most, so that a slow position stream does not blur frames.

    Args:
        origin_enu_m: Autopilot's local origin in the world (3,).
    """

    def __init__(self, origin_enu_m: Vector) -> None:
        self._origin_enu_m = np.asarray(origin_enu_m, dtype=np.float64)
        self._position: tuple[float, Vector, Vector] | None = None  # stamp, NED m, NED m/s
        self._attitude: tuple[float, Vector] | None = None
        self._has_quaternions = False

    @property
    def has_position(self) -> bool:
        """True once LOCAL_POSITION_NED has arrived."""
        return self._position is not None

    @property
    def has_attitude(self) -> bool:
        """True once ATTITUDE_QUATERNION has arrived, which is preferred to ATTITUDE."""
        return self._has_quaternions

    def take(self, message: Any) -> bool:
        """Handle a message with finite values. Return True if there is a new pose."""
        kind = message.get_type()
        if kind == "LOCAL_POSITION_NED":
            position = np.array([message.x, message.y, message.z], dtype=np.float64)
            velocity = np.array([message.vx, message.vy, message.vz], dtype=np.float64)
            if np.isfinite(position).all():
                velocity = np.nan_to_num(velocity, nan=0.0, posinf=0.0, neginf=0.0)
                self._position = (message.time_boot_ms / 1e3, position, velocity)
            return False
        quaternion = self._quaternion(kind, message)
        if quaternion is None:
            return False
        self._attitude = (message.time_boot_ms / 1e3, quaternion)
        if self._position is not None and self._position[0] > self._attitude[0] + _REBOOT_S:
            self._position = None
        return self._position is not None

    def _quaternion(self, kind: str, message: Any) -> Vector | None:
        if kind == "ATTITUDE_QUATERNION":
            quaternion = np.array([message.q1, message.q2, message.q3, message.q4])
            self._has_quaternions = True
        elif kind == "ATTITUDE" and not self._has_quaternions:
            quaternion = quaternion_from_euler(message.roll, message.pitch, message.yaw)
        else:
            return None
        length = float(np.linalg.norm(quaternion))
        return quaternion / length if math.isfinite(length) and length > 0.5 else None

    def pose(self) -> tuple[float, Vector, Vector]:
        """Return stamp, s, position (3,) in the world and attitude (4,) FLU to ENU.

        Raises:
            LookupError: There is no pose yet.
        """
        if self._position is None or self._attitude is None:
            raise LookupError("no pose yet")
        stamp_s, quaternion = self._attitude
        since_s, position, velocity = self._position
        ahead_s = max(0.0, min(stamp_s - since_s, _LONGEST_EXTRAPOLATION_S))
        local = enu_from_ned(position + ahead_s * velocity)
        return stamp_s, self._origin_enu_m + local, flu_enu_from_frd_ned(quaternion)


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
                    *[0.0] * 5,
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
