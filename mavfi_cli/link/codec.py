"""Encodes, decodes and signs MAVLink frames, using pymavlink's `common` dialect.

This module implements the frame layer (markers, lengths, checksum, signature), because pymavlink's
generic parser is slower and loses the frames that follow a false marker in noise. Message classes,
layouts and constructors come from pymavlink. The caller supplies the clock for signatures.
Sources: https://mavlink.io/en/guide/serialization.html for frames, and
https://mavlink.io/en/guide/message_signing.html for signatures: a block of link id (1 byte),
timestamp (6 bytes, 10 us units since 2015-01-01 UTC) and the first 6 bytes of
SHA-256(key + frame + link id + timestamp).
"""

from __future__ import annotations

import hashlib
import hmac
import re
import struct
from collections.abc import Callable, Iterator, Sequence
from copy import copy
from operator import attrgetter
from typing import Any

from pymavlink.dialects.v20 import common as dialect

SIGNATURE_LENGTH = 13  # bytes: link id, timestamp, truncated digest
EPOCH_UNIX_S = 1_420_070_400  # 2015-01-01 UTC, start of signing time
UNITS_PER_S = 100_000  # one unit is 10 us
NEW_STREAM_SLACK = 60 * UNITS_PER_S  # maximum lag of a new stream's timestamp

_TIMESTAMP_END = 2**48
_LINK_ID = 0  # our channel's
_SECOND_LINK_ID = 255  # of frames that are sent again
_RADIO_STATUS = (
    109  # sent by telemetry radios, which hold no key; the guide recommends accepting it
)

MAX_FRAME_LENGTH = 10 + 255 + 2 + SIGNATURE_LENGTH

_MARKER = re.compile(rb"[\xfd\xfe]")
_SIGNED = 0x01
_INCOMPLETE = -1
_OF_FRAME = ("_header", "_msgbuf", "_crc")  # attributes of a message that its frame determines
_PACKET = "ENCAPSULATED_DATA"  # half of all messages; its array is unpacked in one piece

_KINDS: dict[int, _Kind] = {}


def key_from_passphrase(passphrase: str) -> bytes:
    """Return the 32-byte key for a passphrase: its SHA-256, as ground stations compute it."""
    return hashlib.sha256(passphrase.encode()).digest()


class Signing:
    """Signs the frames that one end of a link sends, and verifies those that it receives.

    The newest timestamp of each stream is stored, so that replayed frames are rejected.

    Args:
        key: 32 secret bytes, see `key_from_passphrase`.
        clock: Returns seconds since 1970 (`time.time`, or a fixed epoch plus simulated time).
    """

    def __init__(self, key: bytes, clock: Callable[[], float]) -> None:
        self._key = key
        self._clock = clock
        self._next_timestamp = 0
        self._streams: dict[tuple[int, int, int], int] = {}

    def sign(self, frame: bytes, link: int = _LINK_ID) -> bytes:
        """Return the 13-byte signature block of a frame, with the link id `link`.

        `frame` must contain all bytes from the marker to the CRC, with the signed flag set.
        """
        timestamp = max(self._now(), self._next_timestamp) % _TIMESTAMP_END
        self._next_timestamp = timestamp + 1
        block = bytes([link]) + timestamp.to_bytes(6, "little")
        return block + self._digest(frame + block)

    def accept(self, frame: bytes, header: int, message_id: int, *, signed: bool) -> bool:
        """Return True if a frame is authentic and not a replay, or is an unsigned RADIO_STATUS.

        `header` is the length of the frame's header in bytes. Only authentic frames update the
        timestamps, so a sender without the key cannot block a stream.
        """
        if not signed:
            return message_id == _RADIO_STATUS
        if not self._is_new(frame, header):
            return False
        timestamp = _timestamp(frame)
        self._streams[_stream(frame, header)] = timestamp
        self._next_timestamp = max(self._next_timestamp, timestamp)
        return True

    def renew(self, frame: bytes, block: bytes) -> bytes:
        """Return a new signature block for a changed frame, keeping `block`'s link id and time."""
        return block[:7] + self._digest(frame + block[:7])

    def authenticates(self, data: bytes) -> bool:
        """Return True if data begins with a signed frame that is authentic and not a replay.

        The frame is not recorded, so a later `accept` does not reject it as a replay.
        """
        if len(data) < 3 or data[0] != _V2 or not data[2] & _SIGNED:
            return False
        length = frame_length(data, 0, len(data))
        return length > 0 and self._is_new(data[:length], _V2_HEADER)

    def _is_new(self, frame: bytes, header: int) -> bool:
        if not hmac.compare_digest(self._digest(frame[:-6]), frame[-6:]):
            return False
        newest = self._streams.get(_stream(frame, header))
        if newest is None:
            now = max(self._now(), self._next_timestamp)
            return _timestamp(frame) + NEW_STREAM_SLACK >= now
        return _timestamp(frame) > newest

    def _now(self) -> int:
        return max(0, int((self._clock() - EPOCH_UNIX_S) * UNITS_PER_S))

    def _digest(self, data: bytes) -> bytes:
        return hashlib.sha256(self._key + data).digest()[:6]


def _timestamp(frame: bytes) -> int:
    return int.from_bytes(frame[-12:-6], "little")


def _stream(frame: bytes, header: int) -> tuple[int, int, int]:
    """Return the link id, system id and component id of a signed frame."""
    return frame[-13], frame[header - 5], frame[header - 4]


__all__ = ["MAX_FRAME_LENGTH", "Codec", "Message", "Signing", "dialect"]

Message = Any  # an instance of one of pymavlink's generated message classes
frame_of: Callable[[Message], bytes] = attrgetter("_msgbuf")
"""Return the frame of a received message, as its `get_msgbuf` does."""


_MARKERS = _V1, _V2 = 0xFE, 0xFD
_V2_MARKER = bytes([_V2])
_V1_HEADER, _V2_HEADER = 6, 10  # bytes
# Headers after the marker: length, flags (2 bytes), sequence, system, component, message id.
_V1_HEAD, _V2_HEAD = struct.Struct("<BBBBB"), struct.Struct("<BBBBBBHB")


_crc: Callable[..., int] = dialect.mcrf4xx  # CRC-16/MCRF4XX, compiled

# A further byte x changes a checksum c to (c >> 8) ^ table[(c ^ x) & 0xFF]. These are its entries.
_CRC_TABLE = frozenset(_crc(bytes([x]), 0) for x in range(256))


class _Kind:
    """The wire layout of one message class, which packs and unpacks its payloads.

    An array of bytes is packed and unpacked in one piece, which is faster than byte by byte.
    """

    def __init__(self, cls: Any) -> None:
        layout = struct.Struct(re.sub(r"(\d+)B", r"\1s", cls.unpacker.format))
        self.receive: Callable[..., Message] = _received(cls)
        self.number: int = cls.id
        self.crc_extra = bytes([cls.crc_extra])
        self.size: int = layout.size
        self.unpack_from: Callable[[bytes, int], tuple[Any, ...]] = layout.unpack_from
        self.pack: Callable[..., bytes] = layout.pack
        kinds = dict(zip(cls.fieldnames, cls.fieldtypes, strict=True))
        names = cls.ordered_fieldnames
        texts = [kinds[name] == "char" for name in names]
        attributes = [f"_{n}_raw" if text else n for n, text in zip(names, texts, strict=True)]
        get: Callable[[Any], Any] = attrgetter(*attributes)
        self._columns = get if len(names) > 1 else lambda source: (get(source),)
        self._texts = [place for place, text in enumerate(texts) if text]
        self._arrays = [
            (place, length, kinds[name] == "uint8_t")
            for place, (name, length) in enumerate(zip(names, cls.lengths, strict=True))
            if length > 1
        ]  # index of the field, length, and whether it is packed in one piece
        if cls.msgname == _PACKET:
            self._columns, self._arrays = lambda packet: (packet.seqnr, bytes(packet.data)), []

    def payload(self, message: Message) -> bytes:
        """Return a message's payload without trailing zeros, but with at least one byte."""
        values = self._columns(message)
        if self._arrays:
            values = list(values)
            for place, length, whole in reversed(self._arrays):
                part = values[place][:length]
                values[place : place + 1] = [bytes(part)] if whole else part
        return self.pack(*values).rstrip(b"\0") or b"\0"

    def values(self, frame: bytes, start: int, length: int) -> Sequence[Any]:
        """Return a payload's field values in wire order: arrays as lists, texts without padding."""
        size = self.size
        if length != size:  # senders cut trailing zeros, and newer ones add fields
            frame, start = frame[start : start + length].ljust(size, b"\0"), 0
        unpacked = self.unpack_from(frame, start)
        if not (self._arrays or self._texts):
            return unpacked
        values = list(unpacked)
        for place, length, whole in self._arrays:
            end = place + 1 if whole else place + length
            values[place:end] = [list(values[place]) if whole else values[place:end]]
        for place in self._texts:
            values[place] = values[place].rstrip(b"\0")
        return values


def _received(cls: Any) -> Any:
    """Return a subclass of `cls` for received messages. Only its constructor differs.

    The constructor takes _OF_FRAME and the fields in wire order. It is generated as source text, as
    in dataclasses. With pymavlink's constructor, decoding a frame takes a third longer, because
    each message gets an empty header and attributes that are the same for the whole class.
    """
    kinds = dict(zip(cls.fieldnames, cls.fieldtypes, strict=True))
    blank = vars(cls(*(b"" if kind == "char" else 0 for kind in cls.fieldtypes)))
    lines = [f"self.{name} = {name}" for name in _OF_FRAME]
    for name in cls.ordered_fieldnames:
        if kinds[name] == "char":
            lines.append(f"self._{name}_raw = {name}")
            lines.append(f"self.{name} = {name}.split(b'\\0', 1)[0].decode('ascii', 'replace')")
        else:
            lines.append(f"self.{name} = {name}")
    defined: dict[str, Any] = {}
    arguments = ", ".join(["self", *_OF_FRAME, *cls.ordered_fieldnames])
    exec(f"def __init__({arguments}):\n    " + "\n    ".join(lines), defined)
    constants = {name: blank[name] for name in blank if name[0] == "_" and name not in _OF_FRAME}
    return type(cls.__name__, (cls,), {**constants, "__init__": defined["__init__"]})


def _kind(message_id: int) -> _Kind | None:
    kind = _KINDS.get(message_id)
    cls = ADDED.get(message_id) or dialect.mavlink_map.get(message_id)
    if kind is None and cls is not None:
        kind = _KINDS[message_id] = _Kind(cls)
    return kind


class Codec:
    """Encodes and decodes frames at one end of a link, and numbers the frames that it encodes.

    Args:
        keeps_unknown: Decode frames whose id the dialect lacks as `MAVLink_unknown`, so that they
            can be passed on.
    """

    def __init__(
        self,
        system: int,
        component: int,
        *,
        signing: Signing | None = None,
        keeps_unknown: bool = False,
    ) -> None:
        self.system = system
        self.component = component
        self._signing = signing
        self._keeps_unknown = keeps_unknown
        self._sequence = 0
        self._rest = b""
        self.bad_bytes = 0  # received bytes that belong to no frame
        self.unknown = 0  # skipped frames whose id the dialect lacks
        self.refused = 0  # frames that signing rejected

    @staticmethod
    def add_ardupilot() -> None:
        """Let all codecs of this process encode and decode ArduPilot's own messages, too."""
        from pymavlink.dialects.v20 import ardupilotmega  # slow to load

        for number, kind in ardupilotmega.mavlink_map.items():
            if number not in dialect.mavlink_map:
                ADDED.setdefault(number, kind)

    def encode(self, message: Message) -> bytes:
        """Encode a message as a MAVLink 2 frame. The message itself does not change.

        Raises:
            struct.error, OverflowError: A field does not fit its type.
            ValueError: The message does not belong to the dialect.
        """
        kind = _KINDS.get(type(message).id) or _kind(type(message).id)
        if kind is None:
            raise ValueError(f"{type(message).__name__} is not a message of the `common` dialect")
        payload = kind.payload(message)
        flags = 0 if self._signing is None else _SIGNED
        head = _V2_HEAD.pack(
            len(payload), flags, 0, self._sequence, self.system, self.component,
            kind.number & 0xFFFF, kind.number >> 16,
        )  # fmt: skip
        self._sequence = (self._sequence + 1) & 0xFF
        checked = head + payload
        frame = _V2_MARKER + checked + _crc(checked + kind.crc_extra).to_bytes(2, "little")
        return frame if self._signing is None else frame + self._signing.sign(frame)

    def decode(self, data: bytes, *, datagram: bool = False) -> list[Message]:
        """Return the messages that `data` completes, oldest first. Never raises.

        Only one byte is skipped at a false marker, so the frames after it are found. A frame may
        continue in the next call, unless `datagram` is set, which means that `data` holds whole
        frames.
        """
        buffer = self._rest + data if self._rest else bytes(data)
        messages: list[Message] = []
        position, end = 0, len(buffer)
        while position < end:
            if buffer[position] not in _MARKERS:
                marker = _MARKER.search(buffer, position)
                following = marker.start() if marker else end
                self.bad_bytes += following - position
                position = following
                continue
            length = frame_length(buffer, position, end)
            if length == _INCOMPLETE and not datagram:
                break
            if length > 0 and self._take(buffer, position, position + length, messages):
                position += length
            else:
                self.bad_bytes += 1
                position += 1
        self._rest = buffer[position:]
        return messages

    def _take(self, buffer: bytes, start: int, end: int, messages: list[Message]) -> bool:
        """Append the message of the candidate frame `buffer[start:end]` to `messages`.

        Return False if the frame is not valid. A valid frame may have no message: its id may be
        unknown, or its signature may be rejected.

        The checksum includes a byte that depends on the message definition. If the dialect lacks
        the id, any value of that byte is accepted, so one in 256 frames of noise passes. Such a
        frame must therefore also be followed by a marker or the end of the data.
        """
        frame = buffer[start:end]
        if frame[0] == _V2:
            header = _V2_HEADER
            length, flags, compat, sequence, system, component, low, high = _V2_HEAD.unpack_from(
                frame, 1
            )
            number = low | high << 16
        else:
            header, flags, compat = _V1_HEADER, 0, 0
            length, sequence, system, component, number = _V1_HEAD.unpack_from(frame, 1)
        crc_at = header + length
        crc = frame[crc_at] | frame[crc_at + 1] << 8
        kind = _KINDS.get(number) or _kind(number)
        if kind is None:
            # Test whether any extra byte makes the checksum right.
            bounded = buffer[end : end + 1] in (b"", b"\xfd", b"\xfe")
            if not bounded or crc ^ (_crc(frame[1:crc_at]) >> 8) not in _CRC_TABLE:
                return False
            self.unknown += 1
            if self._keeps_unknown:
                signed = flags != 0
                if self._signing and not self._signing.accept(frame, header, number, signed=signed):
                    self.refused += 1
                    return True
                unknown = dialect.MAVLink_unknown(number, frame[header:crc_at])
                unknown._header = dialect.MAVLink_header(
                    number, flags, compat, length, sequence, system, component
                )
                unknown._msgbuf = frame
                messages.append(unknown)
            return True
        if _crc(frame[1:crc_at] + kind.crc_extra) != crc:
            return False
        if self._signing and not self._signing.accept(frame, header, number, signed=flags != 0):
            self.refused += 1
            return True
        head = dialect.MAVLink_header(number, flags, compat, length, sequence, system, component)
        message = kind.receive(head, frame, crc, *kind.values(frame, header, length))
        if flags and self._signing is not None:
            message._signed = True
            message._link_id = frame[-SIGNATURE_LENGTH]
        messages.append(message)
        return True


def renewed(message: Message, signing: Signing | None = None) -> Message | None:
    """Rebuild the frame of a message whose fields were changed, or that takes another's frame.

    Length, message id, checksum and signature are recomputed, and the rest of the header is kept.
    Fields that the dialect lacks are lost.

    Returns:
        The message with its new frame, or None if its frame is signed and `signing` is None.
    """
    old, kind = frame_of(message), _kind(type(message).id)
    assert kind is not None
    payload, signed = kind.payload(message), _is_signed(old)
    if signed and signing is None:
        return None
    number = kind.number.to_bytes(3, "little")
    if old[0] == _V1:  # it has no extensions, and keeps its trailing zeros
        size = old[1] if old[5] == kind.number else kind.size
        payload = payload.ljust(size, b"\0")[:size]
        header = old[2:5] + number[:1]
    else:
        header = old[2:7] + number
    checked = bytes([len(payload)]) + header + payload
    frame = old[:1] + checked + _crc(checked + kind.crc_extra).to_bytes(2, "little")
    if signed and signing is not None:
        frame += signing.renew(frame, old[-SIGNATURE_LENGTH:])
    message._msgbuf = frame
    return message


def sent_again(message: Message, signing: Signing | None) -> Message | None:
    """Return a message whose frame a receiver accepts after the original or after later frames.

    A receiver rejects a signed frame whose time is not later than the newest of its stream. The
    frame therefore gets a signature of the present with another link id, which is another stream.

    Returns:
        The message itself if its frame is not signed, otherwise a copy with the new signature; None
        if the frame is signed and `signing` is None.
    """
    frame = frame_of(message)
    if not _is_signed(frame):
        return message
    if signing is None:
        return None
    again, unsigned = copy(message), frame[:-SIGNATURE_LENGTH]
    again._msgbuf = unsigned + signing.sign(unsigned, _SECOND_LINK_ID)
    return again


def _is_signed(frame: bytes) -> bool:
    return frame[0] == _V2 and bool(frame[2] & _SIGNED)


def begins_with_frame(data: bytes) -> bool:
    """Return True if data begins with a complete, valid frame of a message of the dialect."""
    length = frame_length(data, 0, len(data)) if data[:1] in (b"\xfd", b"\xfe") else 0
    return length > 0 and bool(Codec(0, 0).decode(data[:length], datagram=True))


def frame_length(buffer: bytes, position: int, end: int) -> int:
    """Return the length in bytes of the frame that starts at `position`.

    The result is _INCOMPLETE if the frame continues beyond `end`, and 0 if no frame can start at
    `position`.
    """
    if end - position < 3:
        return _INCOMPLETE
    length = buffer[position + 1] + 8
    if buffer[position] == _V2:
        flags = buffer[position + 2]
        if flags & ~_SIGNED:
            return 0
        length += 4 + (SIGNATURE_LENGTH if flags else 0)
    return length if position + length <= end else _INCOMPLETE


# Messages from newer MAVLink definitions that pymavlink's `common` dialect lacks. Fields are in
# wire order. Source: https://mavlink.io/en/messages/common.html.

_TYPES = {"B": "uint8_t", "H": "uint16_t", "I": "uint32_t", "s": "char"}


def _message_class(number: int, name: str, crc_extra: int, **layout: str) -> Any:
    """Return a message class that the codec treats like those of the dialect.

    `layout` maps each field's name to its `struct` code, in wire order.
    """
    names = list(layout)
    types = [_TYPES[code[-1]] for code in layout.values()]
    counts = [int(code[:-1] or 0) for code in layout.values()]

    def build(self: Any, *values: Any) -> None:
        dialect.MAVLink_message.__init__(self, number, name)
        for field, kind, value in zip(names, types, values, strict=True):
            setattr(self, f"_{field}_raw" if kind == "char" else field, value)

    attributes = {
        "id": number,
        "msgname": name,
        "fieldnames": names,
        "ordered_fieldnames": names,
        "fieldtypes": types,
        "lengths": [1 if t == "char" else n or 1 for t, n in zip(types, counts, strict=True)],
        "array_lengths": counts,
        "orders": list(range(len(names))),
        "crc_extra": crc_extra,
        "unpacker": struct.Struct("<" + "".join(layout.values())),
        "__init__": build,
    }
    return type(f"MAVLink_{name.lower()}_message", (dialect.MAVLink_message,), attributes)


ProtocolVersion = _message_class(
    300, "PROTOCOL_VERSION", 217, version="H", min_version="H", max_version="H",
    spec_version_hash="8B", library_version_hash="8B",
)  # fmt: skip
ComponentMetadata = _message_class(
    397, "COMPONENT_METADATA", 182, time_boot_ms="I", file_crc="I", uri="100s"
)
AvailableModes = _message_class(
    435, "AVAILABLE_MODES", 134, custom_mode="I", properties="I", number_modes="B", mode_index="B",
    standard_mode="B", mode_name="35s",
)  # fmt: skip

ADDED: dict[int, Any] = {
    message.id: message for message in (ProtocolVersion, ComponentMetadata, AvailableModes)
}
"""The message classes besides those of the dialect, keyed by message id."""

SLOW_STREAMS_US = {
    dialect.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: 2e5,
    dialect.MAVLINK_MSG_ID_SYS_STATUS: 5e5,
    dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 5e5,
}
"""Intervals, in microseconds, of the streams that a flight needs besides the vehicle state.

The keys are message ids.
"""
STATE_STREAMS = (
    dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
)  # fmt: skip

CHUNK_LENGTH = 50  # characters per STATUSTEXT


def text_messages(severity: int, data: bytes, text_id: int) -> Iterator[Message]:
    """Yield the STATUSTEXT messages that carry the ASCII text `data`.

    A text that fits into one message gets id 0. A longer one is split into chunks that share
    `text_id`. The last chunk is shorter than CHUNK_LENGTH, and may be empty.
    Source: https://mavlink.io/en/messages/common.html#STATUSTEXT.

    Args:
        severity: MAV_SEVERITY.
        text_id: 1 .. 65535.
    """
    if len(data) <= CHUNK_LENGTH:
        yield dialect.MAVLink_statustext_message(severity, data)
        return
    for number, start in enumerate(range(0, len(data) + 1, CHUNK_LENGTH)):
        chunk = data[start : start + CHUNK_LENGTH]
        yield dialect.MAVLink_statustext_message(severity, chunk, text_id, number)
