"""Receives depth frames despite loss and reordering.

A frame consists of CAMERA_IMAGE_CAPTURED (stamp, index, and `depth8:crc32=%08x` of the pixels in
`file_url`), DATA_TRANSMISSION_HANDSHAKE (size), and ENCAPSULATED_DATA packets. A packet contains
its place in its frame, but nothing that identifies the frame. The checksum of the pixels does.
Source of the protocol: https://mavlink.io/en/services/image_transmission.html.
"""

from __future__ import annotations

import math
import re
import zlib
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.frames import rotate, rotation_matrix
from mavfi_cli.core.types import DepthFrame, FloatArray, VehicleState
from mavfi_cli.link.codec import Message, dialect

MAX_PIXELS = 1 << 20
DEPTH_UNIT_M = 0.1
NOTHING = 255  # pixel value where nothing was in range

_NARROWEST_RAD, _WIDEST_RAD = 0.005, 3.13  # accepted fields of view
_OPEN_FRAMES = 3  # newest frames, by index, that may still be completed
_FIRST_PLACES = 16  # places whose packets are kept before the size of a frame is known
_COPY = 4  # largest distance, in messages, from a packet to its duplicate
_STRAY = 8  # maximum number of other frames' messages among those of a frame
_TRIALS = 64  # combinations of packets that are tried against the checksum of one frame
_LARGEST_GAP = 10_000  # a larger jump of the index means a restarted camera
_REMEMBERED = 64  # indices of finished frames

# Depth of each pixel value.
_DEPTH_M = np.array([*(DEPTH_UNIT_M * level for level in range(NOTHING)), math.inf])

_CHECKSUM = re.compile(r"depth8:crc32=([0-9a-fA-F]{8})")


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageFrame:
    """A complete depth image from the camera."""

    stamp_s: float  # time of capture on the vehicle's boot clock
    index: int
    pixels: NDArray[np.uint8]  # (rows, columns), read-only; steps of 0.1 m, 255: nothing in range
    hfov_rad: float | None  # None until the camera reports it

    def depth_frame(
        self, state: VehicleState, *, hfov_rad: float, mount_offset_flu_m: FloatArray
    ) -> DepthFrame:
        """Return the image in metres with the camera's pose at the time of capture.

        `state` is the vehicle's state at the image's stamp. `hfov_rad` is used if the image has no
        field of view. `mount_offset_flu_m` (3,) is the offset of the optical centre from the
        vehicle's position. The camera looks along the vehicle's x axis.
        """
        offset_m = rotate(rotation_matrix(state.quaternion), mount_offset_flu_m)
        return DepthFrame(
            stamp_s=self.stamp_s,
            depth_m=_DEPTH_M.take(self.pixels),
            hfov_rad=hfov_rad if self.hfov_rad is None else self.hfov_rad,
            position_enu_m=state.position_enu_m + offset_m,
            quaternion=state.quaternion,
        )


class _Shape(NamedTuple):
    columns: int
    rows: int
    packets: int
    payload: int


@dataclass(slots=True)
class _Announced:
    """A frame that was announced and is not complete yet."""

    index: int
    stamp_s: float
    checksum: int | None
    due: int  # count of messages at which its first packet is due
    trials_left: int = _TRIALS
    waits_until: int = 0  # count of messages before which it is not tried


_Packet = tuple[int, bytes]  # count of messages at its arrival, data


class ImageReceiver:
    """Assembles depth frames from the camera's MAVLink messages.

    A lost packet costs only its own frame. A frame whose checksum never matches is dropped. For any
    input, memory is bounded by a few frames of MAX_PIXELS.

    Once every place has a packet, two candidates are checked against the checksum of each announced
    frame. The first candidate takes, for each place, the packet that arrived nearest to its due
    time after the announcement. It is correct if neighbouring frames interleave only slightly. The
    second takes the newest packet of each place. It is correct for any reordering within one frame.
    """

    def __init__(self) -> None:
        self.hfov_rad: float | None = None  # None until the camera reports it
        self.received = 0  # complete frames
        self._shape: _Shape | None = None
        self._places = _FIRST_PLACES  # packets in a frame of this shape
        self._packets: dict[
            int, deque[_Packet]
        ] = {}  # by place; the newest that belong to no complete frame
        self._open: list[_Announced] = []  # oldest first
        self._count = 0  # messages of the protocol so far
        self._closed: deque[int] = deque(maxlen=_REMEMBERED)
        self._first: int | None = None  # first and newest index since the camera's start
        self._newest = 0
        self._newest_s = 0.0  # stamp of the newest
        self._received_before = 0
        self._lost_before = 0

    @property
    def lost(self) -> int:
        """Number of frames that can no longer be completed.

        It includes the frames whose index was skipped.
        """
        if self._first is None:
            return self._lost_before
        counted = self._newest - self._first + 1
        whole = self.received - self._received_before
        return self._lost_before + counted - whole - len(self._open)

    def feed(self, message: Message) -> list[ImageFrame]:
        """Handle a message whose id is in IMAGE_MESSAGES, and return the frames that it completes.

        Most messages complete no frame.
        """
        return _HANDLERS[type(message).id](self, message)

    def _field_of_view(self, message: Message) -> list[ImageFrame]:
        """Set the field of view from CAMERA_INFORMATION: 2 atan(sensor width/(2 focal length))."""
        if message.focal_length > 0.0:
            hfov_rad = 2.0 * math.atan(message.sensor_size_h / (2.0 * message.focal_length))
            if _NARROWEST_RAD <= hfov_rad <= _WIDEST_RAD:
                self.hfov_rad = hfov_rad
        return []

    def _captured(self, message: Message) -> list[ImageFrame]:
        """Handle CAMERA_IMAGE_CAPTURED, which announces a frame.

        Packets that arrived shortly before may belong to the frame.
        """
        self._count += 1
        stamp_s = message.time_boot_ms / 1e3
        if not self._follow(message.image_index, stamp_s):
            return []
        match = _CHECKSUM.fullmatch(message.file_url)
        checksum = int(match[1], 16) if match else None
        self._open.append(_Announced(message.image_index, stamp_s, checksum, self._count + 2))
        self._open.sort(key=lambda frame: frame.index)
        while self._open and self._open[0].index <= self._newest - _OPEN_FRAMES:
            self._close(self._open[0])
        return self._finish()

    def _follow(self, index: int, stamp_s: float) -> bool:
        """Track the index of announced frames. Return False if this frame is known or too old.

        The camera has restarted if the index is lower and the stamp newer than before, or if the
        index has jumped by more than _LARGEST_GAP.
        """
        restarted = index < self._newest and stamp_s > self._newest_s
        if self._first is None or restarted or abs(index - self._newest) > _LARGEST_GAP:
            self._open.clear()
            self._lost_before = self.lost
            self._received_before = self.received
            self._closed.clear()
            self._first = self._newest = index
            self._newest_s = stamp_s
            return True
        if index in self._closed or any(frame.index == index for frame in self._open):
            return False
        if index <= self._newest - _REMEMBERED:
            return False
        self._first = min(self._first, index)
        if index > self._newest:
            self._newest, self._newest_s = index, stamp_s
        return True

    def _handshake(self, message: Message) -> list[ImageFrame]:
        self._count += 1
        shape = _shape_of(message)
        if shape is None:
            return []
        if shape != self._shape:
            self._shape, self._places = shape, shape.packets
            self._packets = {p: held for p, held in self._packets.items() if p < shape.packets}
        return self._finish()

    def _packet(self, message: Message) -> list[ImageFrame]:
        place, data = message.seqnr, bytes(message.data)
        self._count += 1
        if place >= self._places:
            return []
        held = self._packets.get(place)
        if held is None:
            held = self._packets[place] = deque(maxlen=_OPEN_FRAMES)
        elif self._count - held[-1][0] <= _COPY and held[-1][1] == data:
            held.pop()  # a duplicate packet
        held.append((self._count, data))
        return self._finish() if len(self._packets) >= self._places else []

    def _finish(self) -> list[ImageFrame]:
        """Return the open frames that have become complete, and close them."""
        done = []
        for frame in list(self._open):
            shape = self._shape
            if shape is None or len(self._packets) < shape.packets:
                break
            tried = frame.trials_left > 0 and self._count >= frame.waits_until
            image = self._solve(frame, shape) if tried else None
            if image is None:
                continue
            self._close(frame)
            self.received += 1
            pixels = np.frombuffer(image, dtype=np.uint8).reshape(shape.rows, shape.columns)
            done.append(
                ImageFrame(
                    stamp_s=frame.stamp_s, index=frame.index, pixels=pixels, hfov_rad=self.hfov_rad
                )
            )
        return done

    def _solve(self, frame: _Announced, shape: _Shape) -> bytes | None:
        """Return a frame's pixels if its nearest or its newest packets match its checksum.

        Return None if neither do. Without a checksum, packets match if they arrived close to each
        other.
        """
        newest = [self._packets[place][-1] for place in range(shape.packets)]
        nearby = [
            min((abs(packet[0] - frame.due - place), packet) for packet in self._packets[place])
            for place in range(shape.packets)
        ]
        end = frame.due + shape.packets - 1
        early = frame.due <= self._count < end
        if early and frame.trials_left <= _TRIALS // 2 and max(off for off, _ in nearby) > _STRAY:
            frame.waits_until = end - _STRAY
            return None  # half of the trials are reserved for packets that have not arrived
        nearest = [packet for _, packet in nearby]
        for packets in (nearest,) if nearest == newest else (nearest, newest):
            frame.trials_left -= 1
            data = b"".join([data[: shape.payload] for _, data in packets])
            image = data[: shape.columns * shape.rows]
            if frame.checksum is None:
                arrivals = [count for count, _ in packets]
                agreed = max(arrivals) - min(arrivals) < shape.packets + _STRAY
            else:
                agreed = zlib.crc32(image) == frame.checksum
            if agreed:
                self._forget(frame, packets)
                return image
        return None

    def _forget(self, frame: _Announced, packets: list[_Packet]) -> None:
        """Remove a complete frame's packets, except those whose arrival fits another frame better.

        A frame may be completed with another's packets if their pixels are equal, as in the sky.
        """
        for place, packet in enumerate(packets):
            held, since = self._packets[place], packet[0] - place
            if abs(since - frame.due) <= min(abs(since - other.due) for other in self._open):
                held.remove(packet)
            if not held:
                del self._packets[place]

    def _close(self, frame: _Announced) -> None:
        self._open.remove(frame)
        self._closed.append(frame.index)


_HANDLERS: dict[int, Callable[[ImageReceiver, Message], list[ImageFrame]]] = {
    dialect.MAVLINK_MSG_ID_ENCAPSULATED_DATA: ImageReceiver._packet,
    dialect.MAVLINK_MSG_ID_DATA_TRANSMISSION_HANDSHAKE: ImageReceiver._handshake,
    dialect.MAVLINK_MSG_ID_CAMERA_IMAGE_CAPTURED: ImageReceiver._captured,
    dialect.MAVLINK_MSG_ID_CAMERA_INFORMATION: ImageReceiver._field_of_view,
}
IMAGE_MESSAGES = frozenset(_HANDLERS)  # ids of the messages that a receiver handles


def _shape_of(message: Message) -> _Shape | None:
    """Return the image size in a handshake, or None if it is inconsistent or too large."""
    columns, rows, payload = message.width, message.height, message.payload
    if message.type != dialect.MAVLINK_DATA_STREAM_IMG_RAW8U or not 1 <= payload <= 253:
        return None
    if not 0 < columns * rows <= MAX_PIXELS or message.size != columns * rows:
        return None
    if message.packets != -(-message.size // payload):
        return None
    return _Shape(columns, rows, message.packets, payload)
