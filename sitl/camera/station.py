"""Runs a stand-alone depth camera and referee for the vehicle of a foreign autopilot."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mavfi_cli.core.frames import (
    FARTHEST_M,
    FASTEST_MPS,
    Vector,
    enu_from_ned,
    flu_enu_from_frd_ned,
    is_within,
    norm,
    quaternion_from_euler,
)
from mavfi_cli.link.codec import Codec, Signing, dialect, text_messages
from mavfi_cli.link.endpoint import TWO_AUTOPILOTS, SenderSlot, parse_endpoint
from mavfi_cli.link.peers import Peer, Peers
from mavfi_cli.link.transport import Transport
from sitl.camera.component import COMPONENT_ID, Camera
from sitl.firmware.autopilot import TouchdownWatch
from sitl.referee import Collision, Referee
from sitl.vehicle.profile import VehicleProfile
from sitl.vehicle.vehicle import regression_power
from sitl.world import World

_TURN_S = 0.02  # time for the messages of all peers, after which the camera acts
_TEXT_ID = 2  # of texts about two autopilots; the referee's texts have another id


class _Linked(Peer):
    """An autopilot, companion or ground station on one of the links.

    Args:
        slots: Slots of the autopilots at the peer's endpoint, by system id.
        awaits_frames: False for a companion that started this process and has sent no message yet.
    """

    def __init__(
        self,
        transport: Transport,
        *,
        station: Station,
        slots: dict[int, SenderSlot[_Linked]],
        awaits_frames: bool,
    ) -> None:
        super().__init__(transport)
        self.slots, self.awaits_frames, self._station = slots, awaits_frames, station
        self._codec = Codec(0, 0, signing=station.signing)

    def take(self, data: bytes) -> list[Any]:
        messages = self._codec.decode(data, datagram=self.transport.datagram)
        self.awaits_frames = self.awaits_frames or bool(messages)
        for message in messages:
            self._station.receive(message, self)
        return messages

    def forward(self, *, frame: bytes, sender: Peer) -> bool:
        return self.awaits_frames and super().forward(frame=frame, sender=sender)

    def close(self) -> None:
        super().close()
        for slot in self.slots.values():
            slot.leave(self)


_REBOOT_S = 1.0
_LONGEST_EXTRAPOLATION_S = 0.5

_WAIT_S = 0.2
_REQUEST_AGAIN_S = 2.0
_POSE_INTERVAL_US = 20_000.0
_ANNOUNCE_S = 1.0
_PLACE_S = 1.0
_MOST_HELD = 64  # maximum commands held until the camera has its origin
_POSE = "the autopilot's own pose"
_ACCELERATION_S = 0.2  # time over which velocities are differentiated
_GROUND = dialect.MAV_LANDED_STATE_ON_GROUND
_INTERVAL = (dialect.MAV_COMP_ID_AUTOPILOT1, dialect.MAV_CMD_SET_MESSAGE_INTERVAL, 0)
_REQUESTS = (  # component, command, confirmation and message id
    (*_INTERVAL, dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION),
    (*_INTERVAL, dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED),
    (
        COMPONENT_ID, dialect.MAV_CMD_REQUEST_MESSAGE, 0,
        dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED_SYSTEM_GLOBAL_OFFSET,
    ),
)  # fmt: skip


class PoseTracker:
    """Combines an autopilot's attitude and position messages, whose stamps differ, into poses.

    Every new attitude gives a pose. The newest position is extrapolated to the attitude's stamp
    with the velocity, for 0.5 s at most, so that a slow position stream does not blur frames.
    """

    def __init__(self, origin_enu_m: Vector) -> None:
        self.origin_enu_m = np.asarray(origin_enu_m, dtype=np.float64)  # in the world (3,)
        self._position: tuple[float, Vector, Vector] | None = None  # stamp, NED m, NED m/s
        self._attitude: tuple[float, Vector] | None = None
        self.has_quaternion = False  # ATTITUDE_QUATERNION has arrived; preferred to ATTITUDE

    @property
    def has_position(self) -> bool:
        """True once a LOCAL_POSITION_NED message has arrived since the autopilot's last reboot."""
        return self._position is not None

    @property
    def attitude_stamp_s(self) -> float | None:
        """Stamp of the newest attitude on the autopilot's clock, s, or None before the first."""
        return None if self._attitude is None else self._attitude[0]

    def take(self, message: Any) -> bool:
        """Handle a message of the autopilot. Return True if it gives a new pose.

        Impossible values are ignored.
        """
        kind = message.get_type()
        if kind == "LOCAL_POSITION_NED":
            position = np.array([message.x, message.y, message.z], dtype=np.float64)
            velocity = np.array([message.vx, message.vy, message.vz], dtype=np.float64)
            if is_within(FARTHEST_M, position):
                velocity[~(np.abs(velocity) <= FASTEST_MPS)] = 0.0
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
            self.has_quaternion = True
        elif kind == "ATTITUDE" and not self.has_quaternion:
            angles = message.roll, message.pitch, message.yaw
            if not all(map(math.isfinite, angles)):
                return None
            quaternion = quaternion_from_euler(*angles)
        else:
            return None
        length = norm(quaternion)
        return quaternion / length if 0.5 < length < math.inf else None

    def pose(self) -> tuple[float, Vector, Vector, Vector]:
        """Return the stamp, the position, the attitude and the velocity of the newest pose.

        The stamp is in seconds on the autopilot's clock. The position (3,) is in world ENU m, the
        attitude (4,) is a quaternion from FLU to ENU, and the velocity (3,) is in ENU m/s. Raises
        LookupError if attitude and position have not both arrived yet.
        """
        if self._position is None or self._attitude is None:
            raise LookupError("cannot give a pose before both attitude and position have arrived")
        stamp_s, quaternion = self._attitude
        since_s, position, velocity = self._position
        ahead_s = max(0.0, min(stamp_s - since_s, _LONGEST_EXTRAPOLATION_S))
        place = self.origin_enu_m + enu_from_ned(position + ahead_s * velocity)
        return stamp_s, place, flu_enu_from_frd_ned(quaternion), enu_from_ned(velocity)


class Witness:
    """Derives collision, clearance and energy of a foreign autopilot's vehicle from its poses.

    The record begins when the vehicle arms. The energy comes from the regression; the power of the
    propellers is unknown. The profile's body box and regression stand in for the vehicle's own.
    """

    def __init__(self, world: World, profile: VehicleProfile, *, logs: bool) -> None:
        self._world, self._profile, self._logs = world, profile, logs
        self._coefficients = profile.energy.coefficients(profile.extra_payload_kg)
        self._armed = self._on_ground = False
        self._touchdown = TouchdownWatch()
        self._begin()

    def _begin(self) -> None:
        self._referee = Referee(
            self._world, self._profile.body_box_m, vehicle=self._profile.name, pose=_POSE,
            logs=self._logs,
        )  # fmt: skip
        self._velocities: deque[tuple[float, Vector]] = deque()
        self._stamp_s: float | None = None
        self._energy_j = 0.0

    def take(self, message: Any) -> None:
        """Take arming, mode, landed state and setpoint from a message of the autopilot."""
        self._touchdown.take(message)
        if isinstance(message, dialect.MAVLink_heartbeat_message):
            armed = bool(message.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED)
            if armed and not self._armed:
                self._begin()
            self._armed = armed
        elif isinstance(message, dialect.MAVLink_extended_sys_state_message):
            self._on_ground = message.landed_state == _GROUND

    def observe(
        self, stamp_s: float, position_enu_m: Vector, quaternion_flu_enu: Vector, velocity: Vector
    ) -> Collision | None:
        """Judge a pose at a boot-clock stamp, in seconds.

        Return the first collision of the flight in the call that detects it, otherwise None.
        """
        if self._stamp_s is not None and stamp_s <= self._stamp_s:
            if stamp_s > self._stamp_s - 1.0:
                return None
            self._begin()  # the autopilot has rebooted
        power_w = self._power_w(stamp_s, velocity)
        if self._stamp_s is not None:
            self._energy_j += power_w * (stamp_s - self._stamp_s)
        self._stamp_s = stamp_s
        return self._referee.observe(
            stamp_s, position_enu_m, quaternion_flu_enu, velocity,
            armed=self._armed, on_ground=self._on_ground,
            may_land=self._touchdown.may_touch_ground,
            power_regression_w=power_w, power_propeller_w=np.nan,
        )  # fmt: skip

    def _power_w(self, stamp_s: float, velocity: Vector) -> float:
        past = self._velocities
        past.append((stamp_s, velocity))
        while len(past) > 2 and past[1][0] <= stamp_s - _ACCELERATION_S:
            past.popleft()
        since_s = stamp_s - past[0][0]
        acceleration = (velocity - past[0][1]) / since_s if since_s > 0.0 else np.zeros(3)
        if not self._armed:
            return 0.0
        return float(regression_power(velocity, acceleration, self._coefficients))

    def save(self, folder: Path) -> None:
        """Write the referee's log and verdict to a folder, but nothing if no pose was judged.

        Raises RecordError if a file cannot be written.
        """
        if self._stamp_s is not None:
            self._referee.save(folder, {"regression": self._energy_j})


class Station:
    """Runs the depth camera, the referee and the links of one autopilot.

    It connects the peers of several endpoints, and is the camera component among them. Two
    autopilots with the same system id at one endpoint would look like one vehicle that jumps, so
    the second one's frames are dropped and a STATUSTEXT names both senders. Forwarded frames keep
    their signatures.

    Args:
        urls: Endpoints to open. LinkError is raised if one of them cannot be opened.
        witness: Referee of the poses, or None for no referee.
        origin_given: Whether the tracker's origin is final. If not, the camera of a simulated
            vehicle on the link may replace it.
        clock: Monotonic clock in seconds for repeated requests, never for frames.
    """

    def __init__(
        self,
        camera: Camera,
        tracker: PoseTracker,
        urls: Sequence[str],
        *,
        witness: Witness | None = None,
        origin_given: bool = True,
        signing: Signing | None = None,
        allow_unsigned: bool = False,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.camera = camera
        self.frames_sent = 0
        self._tracker, self._witness = tracker, witness
        self.signing, self._clock = signing, clock
        self._codec = Codec(1, COMPONENT_ID, signing=signing)
        self.peers: Peers[_Linked] = Peers(
            signing=signing, allow_unsigned=allow_unsigned, clock=clock
        )
        for url in urls:
            waits = parse_endpoint(url).scheme != "fd"
            self.peers.open(url, partial(_Linked, station=self, slots={}, awaits_frames=waits))
        self._autopilot: int | None = None  # system id; None before its first heartbeat
        self._placed = False
        self._unplaced_since_s: float | None = None  # by the autopilot's clock
        self._held: dict[tuple[int, int, int], Any] = {}
        if origin_given:
            self._place_at(tracker.origin_enu_m)
        self._request_at_s = self._announce_at_s = 0.0

    def run(self, keep_on: Callable[[], bool]) -> None:
        """Serve until `keep_on` returns False, or until an inherited connection closes.

        Raises LinkLost if the peer of a link closed it.
        """
        while keep_on() and not self.peers.over:
            self.peers.wait(_WAIT_S)
            self.serve()

    def serve(self) -> None:
        """Handle waiting messages for a bounded time, then send the messages that are due.

        Raises LinkLost if the peer of a link closed it.
        """
        self.peers.serve(self._clock() + _TURN_S)
        if self.peers.lost is not None:
            raise self.peers.lost
        self._announce()
        self._place()
        self._request()

    def receive(self, message: Any, source: _Linked) -> None:
        """Handle a message from a peer, and forward it to the other peers if they need it.

        The messages of a second autopilot with the same system id are dropped.
        """
        if self._is_of_holder(message, source) and self.take(message):
            frame = bytes(message.get_msgbuf())
            self.peers.send_in_turn(partial(_Linked.forward, frame=frame, sender=source))

    def _is_of_holder(self, message: Any, source: _Linked) -> bool:
        if message.get_srcComponent() != dialect.MAV_COMP_ID_AUTOPILOT1:
            return True
        slot = source.slots.setdefault(message.get_srcSystem(), SenderSlot(self._clock))
        if slot.refresh(source):
            if slot.rival is not None:
                addresses = f"{source.transport.address} and {slot.rival.transport.address}"
                slot.rival = None
                self._send_text(f"{TWO_AUTOPILOTS}, {addresses}", _TEXT_ID)
        elif slot.is_free:
            slot.take(source)
        else:
            if isinstance(message, dialect.MAVLink_heartbeat_message):  # once a second
                slot.challenge(source)
            return False
        return True

    def take(self, message: Any) -> bool:
        """Handle a message. Return True if it is to be forwarded to the other peers.

        Messages to the camera, or from another camera, are not forwarded, so that peers see only
        one camera.
        """
        component = message.get_srcComponent()
        if component == COMPONENT_ID and message.get_srcSystem() == self._autopilot:
            if isinstance(message, dialect.MAVLink_local_position_ned_system_global_offset_message):
                origin_enu_m = enu_from_ned(np.array([message.x, message.y, message.z]))
                if is_within(FARTHEST_M, origin_enu_m):
                    self._place_at(origin_enu_m)
            return False
        if self._is_autopilot(message):
            if self._witness is not None:
                self._witness.take(message)
            if self._tracker.take(message) and self._placed:
                self._look()
        for_camera = getattr(message, "target_component", 0) == COMPONENT_ID
        if self._placed:
            self._send(self.camera.handle(message))
        elif for_camera and isinstance(message, dialect.MAVLink_command_long_message):
            self._hold(message)
        return not for_camera

    def _hold(self, command: Any) -> None:
        """Keep a command until the camera has its origin, and answer that it is in progress."""
        sender, number = (command.get_srcSystem(), command.get_srcComponent()), command.command
        if len(self._held) < _MOST_HELD or (*sender, number) in self._held:
            self._held[*sender, number] = command
            progress = dialect.MAV_RESULT_IN_PROGRESS
            self._send([dialect.MAVLink_command_ack_message(number, progress, 0, 0, *sender)])

    def _look(self) -> None:
        """Send the camera's messages due at the newest pose, and let the referee judge the pose."""
        pose = self._tracker.pose()
        self._send(self.camera.poll(*pose[:3]))
        collision = None if self._witness is None else self._witness.observe(*pose)
        if collision is not None:
            self._send_text(collision.text, 1)

    def _is_autopilot(self, message: Any) -> bool:
        """Return True for a message from the autopilot, which its first heartbeat identifies."""
        if message.get_srcComponent() != dialect.MAV_COMP_ID_AUTOPILOT1:
            return False
        if self._autopilot is None:
            is_heartbeat = isinstance(message, dialect.MAVLink_heartbeat_message)
            if not is_heartbeat or message.autopilot == dialect.MAV_AUTOPILOT_INVALID:
                return False
            self._autopilot = self.camera.system = self._codec.system = message.get_srcSystem()
        return bool(message.get_srcSystem() == self._autopilot)

    def _announce(self) -> None:
        """Send a heartbeat on all links while there is no pose, so that an autopilot answers."""
        tracker = self._tracker
        has_pose = tracker.has_position and tracker.attitude_stamp_s is not None
        if self._clock() >= self._announce_at_s and not has_pose:
            self._announce_at_s = self._clock() + _ANNOUNCE_S
            self._send(self.camera.idle())

    def _place(self) -> None:
        """Use the tracker's origin if no simulated camera has sent another within a second.

        The second is measured by the autopilot's clock, which may run much faster than real time.
        """
        stamp_s = self._tracker.attitude_stamp_s
        if self._placed or stamp_s is None:
            return
        if self._unplaced_since_s is None or stamp_s < self._unplaced_since_s:
            self._unplaced_since_s = stamp_s
        if stamp_s >= self._unplaced_since_s + _PLACE_S:
            self._place_at(self._tracker.origin_enu_m)

    def _place_at(self, origin_enu_m: Vector) -> None:
        if not self._placed:
            self._placed = True
            held, self._held = self._held, {}
            self._tracker.origin_enu_m = self.camera.local_origin_enu_m = origin_enu_m
            for command in held.values():
                self._send(self.camera.handle(command))

    def _request(self) -> None:
        """Request attitude, position and origin until they arrive."""
        if self._autopilot is None or self._clock() < self._request_at_s:
            return
        self._request_at_s = self._clock() + _REQUEST_AGAIN_S
        present = self._tracker.has_quaternion, self._tracker.has_position, self._placed
        values = _POSE_INTERVAL_US, *[0.0] * 5
        requests = [
            dialect.MAVLink_command_long_message(self._autopilot, *request, *values)
            for request, is_present in zip(_REQUESTS, present, strict=True)
            if not is_present
        ]
        self._send(requests)

    def _send_text(self, text: str, text_id: int) -> None:
        self._send([*text_messages(dialect.MAV_SEVERITY_CRITICAL, text.encode(), text_id)])

    def _send(self, messages: Sequence[Any]) -> None:
        self.frames_sent += sum(m.get_type() == "CAMERA_IMAGE_CAPTURED" for m in messages)
        if data := b"".join(self._codec.encode(message) for message in messages):
            self.peers.send_in_turn(lambda peer: peer.transport.send(data))

    def close(self) -> None:
        """Close every link."""
        self.peers.close()
