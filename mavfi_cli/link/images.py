"""Depth frames out of MAVLink's image transmission protocol, through loss and reordering.

One frame on the wire: CAMERA_IMAGE_CAPTURED (stamp, index, and `depth8:crc32=%08x` of the pixels
in `file_url`), DATA_TRANSMISSION_HANDSHAKE (size), then ENCAPSULATED_DATA packets. A packet says
where it belongs in a frame, but not in which; the checksum of the pixels decides that.
Source of the protocol: https://mavlink.io/en/services/image_transmission.html.
"""

from __future__ import annotations

import re
import zlib
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.frames import rotation_matrix
from mavfi_cli.core.types import DepthFrame, FloatArray, VehicleState
from mavfi_cli.link.camera import hfov_of
from mavfi_cli.link.codec import Message, dialect

MAX_PIXELS = 1 << 20
DEPTH_UNIT_M = 0.1
NOTHING = 255  # pixel value where nothing was in range

_OPEN_FRAMES = 3  # frames that may still become whole at the same time
_SPARE_PACKETS = 16  # packets kept that no announced frame lacks
_TRIALS = 64  # combinations of packets that are tried against the checksum of one frame
_LARGEST_GAP = 10_000  # a bigger jump of the index is a restarted camera
_REMEMBERED = 64  # indices of frames that are done with
_CHECKSUM = re.compile(r"depth8:crc32=([0-9a-fA-F]{8})")


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageFrame:
    """One whole image, as the camera sent it."""

    stamp_s: float  # when it was taken, on the vehicle's boot clock
    index: int
    pixels: NDArray[np.uint8]  # (rows, columns), read-only
    hfov_rad: float | None  # None while the camera has not told


@dataclass(frozen=True, slots=True, kw_only=True)
class _Shape:
    columns: int
    rows: int
    packets: int
    payload: int

    @property
    def size(self) -> int:
        return self.columns * self.rows


class _Assembly:
    """A frame that was announced and is not whole yet."""

    __slots__ = ("checksum", "index", "places", "stamp_s", "trials_left")

    def __init__(self, index: int, stamp_s: float, checksum: int | None) -> None:
        self.index = index
        self.stamp_s = stamp_s
        self.checksum = checksum
        self.places: dict[int, bytes] = {}
        self.trials_left = _TRIALS

    def image(self, shape: _Shape, changes: dict[int, bytes]) -> bytes | None:
        """The pixels with some packets exchanged, if the checksum agrees."""
        if self.trials_left <= 0:
            return None
        self.trials_left -= 1
        chosen = {**self.places, **changes}
        packets = (chosen[place][: shape.payload] for place in range(shape.packets))
        image = b"".join(packets)[: shape.size]
        agreed = self.checksum is None or zlib.crc32(image) == self.checksum
        return image if agreed else None

    def is_full(self, shape: _Shape) -> bool:
        """Whether there is a packet for every place."""
        return len(self.places) >= shape.packets


class ImageReceiver:
    """Feed it every message; it returns the frames that become whole.

    A lost packet loses its frame and no other; a frame whose checksum never fits is dropped.
    Memory is bounded by a few frames of MAX_PIXELS, whatever comes in.

    Every announced frame takes the packets it lacks. One that no frame lacks is kept a while: its
    frame may be announced later, or hold a packet of a neighbour in its place.

    Attributes:
        hfov_rad: the camera's horizontal field of view, None until it told.
        received: frames returned.
    """

    def __init__(self) -> None:
        self.hfov_rad: float | None = None
        self.received = 0
        self._shape: _Shape | None = None
        self._open: list[_Assembly] = []  # oldest first
        self._spare: deque[tuple[int, bytes]] = deque(maxlen=_SPARE_PACKETS)
        self._closed: deque[int] = deque(maxlen=_REMEMBERED)
        self._first: int | None = None  # first and newest index since the camera started
        self._newest = 0
        self._received_before = 0
        self._lost_before = 0

    @property
    def lost(self) -> int:
        """Frames announced, or skipped by the index, that did not and will not become whole."""
        if self._first is None:
            return self._lost_before
        counted = self._newest - self._first + 1
        whole = self.received - self._received_before
        return self._lost_before + counted - whole - len(self._open)

    def feed(self, message: Message) -> list[ImageFrame]:
        """Take a message; the frames that it completes, mostly none, at most a few."""
        if isinstance(message, dialect.MAVLink_encapsulated_data_message):
            return self._packet(message.seqnr, bytes(message.data))
        if isinstance(message, dialect.MAVLink_data_transmission_handshake_message):
            return self._handshake(message)
        if isinstance(message, dialect.MAVLink_camera_image_captured_message):
            return self._captured(message)
        hfov_rad = hfov_of(message)
        if hfov_rad is not None:
            self.hfov_rad = hfov_rad
        return []

    def _captured(self, message: Message) -> list[ImageFrame]:
        """Open a frame; spare packets may belong to it."""
        if not self._count(message.image_index):
            return []
        match = _CHECKSUM.fullmatch(message.file_url)
        checksum = int(match[1], 16) if match else None
        frame = _Assembly(message.image_index, message.time_boot_ms / 1e3, checksum)
        frame.places.update(p for p in self._spare if self._fits(p[0]))
        self._spare.clear()
        self._open.append(frame)
        self._open.sort(key=lambda each: each.index)
        if len(self._open) > _OPEN_FRAMES:
            self._close(self._open[0])
        return self._finish(self._open)

    def _count(self, index: int) -> bool:
        """Follow the index; False for a frame that is known or too old."""
        if self._first is None or abs(index - self._newest) > _LARGEST_GAP:
            self._open.clear()
            self._lost_before = self.lost
            self._received_before = self.received
            self._closed.clear()
            self._first = self._newest = index
            return True
        if index in self._closed or any(frame.index == index for frame in self._open):
            return False
        if index <= self._newest - _REMEMBERED:
            return False
        self._first = min(self._first, index)
        self._newest = max(self._newest, index)
        return True

    def _handshake(self, message: Message) -> list[ImageFrame]:
        shape = _shape_of(message)
        if shape is None or shape == self._shape:
            return []
        self._shape = shape
        for frame in self._open:
            frame.places = {p: data for p, data in frame.places.items() if p < shape.packets}
        return self._finish(self._open)

    def _fits(self, place: int) -> bool:
        """Whether a frame has such a place, as far as is known."""
        return place < (_SPARE_PACKETS if self._shape is None else self._shape.packets)

    def _packet(self, place: int, data: bytes) -> list[ImageFrame]:
        if not self._fits(place):
            return []
        lacking = [frame for frame in self._open if place not in frame.places]
        for frame in lacking:
            frame.places[place] = data
        if lacking:
            done = self._finish(lacking)
            for frame in self._open[:-1]:  # an older frame lacks this place still
                if frame in lacking and self._shape and frame.is_full(self._shape):
                    del frame.places[place]
            return done
        if any(frame.places[place] == data for frame in self._open):
            return []  # a copy of a packet that is in its place already
        self._spare.append((place, data))
        return self._finish(self._open)

    def _finish(self, frames: list[_Assembly]) -> list[ImageFrame]:
        """Close and return those of some open frames that are whole."""
        shape = self._shape
        done = []
        for frame in list(frames):
            if shape is None or not frame.is_full(shape):
                continue
            image = self._solve(frame, shape)
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

    def _solve(self, frame: _Assembly, shape: _Shape) -> bytes | None:
        """The frame as it is, with all spare packets in place, or with one of them."""
        spare = [(place, data) for place, data in self._spare if place < shape.packets]
        options = [{}, *([dict(spare)] if len(spare) > 1 else []), *({p: d} for p, d in spare)]
        for changes in options:
            image = frame.image(shape, changes)
            if image is not None:
                used = changes.items()
                kept = [packet for packet in self._spare if packet not in used]
                self._spare = deque(kept, maxlen=_SPARE_PACKETS)
                return image
        return None

    def _close(self, frame: _Assembly) -> None:
        self._open.remove(frame)
        self._closed.append(frame.index)


def _shape_of(message: Message) -> _Shape | None:
    """The announced size, if it is one that adds up and is no larger than we take."""
    columns, rows, payload = message.width, message.height, message.payload
    if message.type != dialect.MAVLINK_DATA_STREAM_IMG_RAW8U or not 1 <= payload <= 253:
        return None
    if not 0 < columns * rows <= MAX_PIXELS or message.size != columns * rows:
        return None
    if message.packets != -(-message.size // payload):
        return None
    return _Shape(columns=columns, rows=rows, packets=message.packets, payload=payload)


_DEPTH_M = np.arange(256, dtype=np.float64) * DEPTH_UNIT_M
_DEPTH_M[NOTHING] = np.inf


def depth_frame(
    image: ImageFrame, state: VehicleState, *, hfov_rad: float, mount_offset_flu_m: FloatArray
) -> DepthFrame:
    """An image in metres, with the pose of the camera when it was taken.

    Args:
        image: 0.1 m a pixel step, 255 for nothing in range.
        state: the vehicle at the image's stamp.
        hfov_rad: horizontal field of view, where the image does not know it.
        mount_offset_flu_m: (3,) of the optical centre from the vehicle's centre; the camera looks
            along the vehicle's x axis.
    """
    offset_enu_m = rotation_matrix(state.quaternion) @ np.asarray(mount_offset_flu_m, np.float64)
    return DepthFrame(
        stamp_s=image.stamp_s,
        depth_m=_DEPTH_M[image.pixels],
        hfov_rad=hfov_rad if image.hfov_rad is None else image.hfov_rad,
        position_enu_m=state.position_enu_m + offset_enu_m,
        quaternion=state.quaternion,
    )
