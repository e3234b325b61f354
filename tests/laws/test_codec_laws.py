"""Laws of the codec, with pymavlink's own packer, parser and signing as the oracle."""

from __future__ import annotations

import itertools
import struct
from typing import Any

from hypothesis import assume, given, settings
from hypothesis import strategies as st

from mavfi_cli.link.codec import ADDED, MAX_FRAME_LENGTH, Codec, Message, dialect

_RANGES = {"b": 8, "h": 16, "i": 32, "q": 64}
CLASSES = sorted(dialect.mavlink_map.values(), key=lambda cls: cls.id)
SMALL = [dialect.mavlink_map[number] for number in (0, 30, 32, 84, 131, 253, 263, 109)]


def _scalar(code: str) -> st.SearchStrategy[Any]:
    if code in "fd":
        return st.floats(width=32 if code == "f" else 64, allow_nan=True)
    bits = _RANGES[code.lower()]
    if code.islower():
        return st.integers(-(1 << bits - 1), (1 << bits - 1) - 1)
    return st.integers(0, (1 << bits) - 1)


def _field(code: str, array: int) -> st.SearchStrategy[Any]:
    if code == "c":
        return st.binary(max_size=array)
    if array == 0:
        return _scalar(code)
    return st.one_of(
        st.lists(_scalar(code), min_size=array, max_size=array) if array < 20 else st.nothing(),
        _scalar(code).map(lambda value: [value] * array),
        st.just([0] * array),
    )


@st.composite
def messages(draw: st.DrawFn, classes: list[Any] = CLASSES) -> Message:
    """A message of any class, with any values that its fields can hold."""
    cls = draw(st.sampled_from(classes))
    codes = dict(zip(cls.ordered_fieldnames, cls.native_format.decode()[1:], strict=True))
    arrays = dict(zip(cls.ordered_fieldnames, cls.array_lengths, strict=True))
    return cls(*(draw(_field(codes[name], arrays[name])) for name in cls.fieldnames))


def _pymavlink(system: int = 7, component: int = 9, sequence: int = 0) -> Any:
    mav = dialect.MAVLink(None, system, component)
    mav.seq = sequence
    mav.robust_parsing = True
    return mav


def _decoded(codec: Codec, data: bytes) -> list[Message]:
    """What the codec decodes, with the data of a packet of an image as pymavlink's list."""
    found = codec.decode(data)
    for message in found:
        if isinstance(message, dialect.MAVLink_encapsulated_data_message):
            assert isinstance(message.data, bytes)  # kept in one piece
            message.data = list(message.data)
    return found


def _content(message: Message) -> tuple[Any, ...]:
    """Everything that a message says, comparable."""
    values = tuple(repr(getattr(message, name)) for name in message.get_fieldnames())
    header = message.get_header()
    return (
        message.get_type(),
        *values,
        *(header.mlen, header.seq, header.srcSystem, header.srcComponent, header.msgId),
        *(header.incompat_flags, header.compat_flags),
        message.get_crc(),
        bytes(message.get_msgbuf()),
        message.get_signed(),
        message.get_link_id(),
    )


@settings(max_examples=300)
@given(messages(), st.integers(0, 255))
def test_a_frame_is_the_one_that_pymavlink_packs(message: Message, skipped: int) -> None:
    codec = Codec(7, 9)
    for _ in range(skipped):
        codec.encode(dialect.MAVLink_ping_message(0, 0, 0, 0))
    assert codec.encode(message) == message.pack(_pymavlink(sequence=skipped))


@settings(max_examples=300)
@given(messages(), st.booleans())
def test_a_message_decodes_as_pymavlink_decodes_it(message: Message, version_1: bool) -> None:
    assume(not version_1 or message.get_msgId() < 256)
    frame = message.pack(_pymavlink(), force_mavlink1=version_1)
    (ours,) = _decoded(Codec(1, 1), frame)
    theirs = _pymavlink().decode(bytearray(frame))
    assert _content(ours) == _content(theirs)


def test_every_message_of_the_dialect_goes_there_and_back() -> None:
    for cls in CLASSES:
        codes = cls.native_format.decode()[1:]
        values = dict(zip(cls.ordered_fieldnames, codes, strict=True))
        arrays = dict(zip(cls.ordered_fieldnames, cls.array_lengths, strict=True))
        arguments = []
        for name in cls.fieldnames:
            one: Any = b"a" if values[name] == "c" else 1.5 if values[name] in "fd" else 3
            many = arrays[name] and values[name] != "c"
            arguments.append([one] * arrays[name] if many else one)
        message = cls(*arguments)
        (back,) = _decoded(Codec(1, 1), Codec(1, 1).encode(message))
        assert back.to_dict() == message.to_dict()


def _chunks(data: bytes, cuts: list[int]) -> list[bytes]:
    edges = sorted({0, len(data), *(cut % (len(data) + 1) for cut in cuts)})
    return [data[a:b] for a, b in itertools.pairwise(edges)]


QUIET = st.binary(max_size=40).map(lambda noise: noise.replace(b"\xfd", b"").replace(b"\xfe", b""))
CUTS = st.lists(st.integers(0, 4000), max_size=8)


@settings(max_examples=200)
@given(st.lists(st.tuples(QUIET, messages(SMALL), st.booleans()), max_size=6), QUIET, CUTS)
def test_a_stream_decodes_as_by_pymavlinks_parser(
    parts: list[tuple[bytes, Message, bool]], tail: bytes, cuts: list[int]
) -> None:
    """Noise without false markers, where pymavlink's parser loses nothing either."""
    sender, stream = _pymavlink(), b""
    for noise, message, version_1 in parts:
        version_1 = version_1 and message.get_msgId() < 256
        stream += noise + message.pack(sender, force_mavlink1=version_1)
        sender.seq = (sender.seq + 1) % 256
    theirs = _pymavlink().parse_buffer(stream + tail) or []
    wanted = [_content(m) for m in theirs if m.get_type() != "BAD_DATA"]
    codec, ours = Codec(1, 1), []
    for chunk in _chunks(stream + tail, cuts):
        ours += _decoded(codec, chunk)
    assert [_content(m) for m in ours] == wanted
    assert len(ours) == len(parts)
    assert codec.bad_bytes == sum(len(noise) for noise, _, _ in parts) + len(tail)


FLUSH = bytes(MAX_FRAME_LENGTH)  # ends any frame that a false marker at the end began


@settings(max_examples=300)
@given(st.lists(st.tuples(st.binary(max_size=60), messages(SMALL)), max_size=6), CUTS)
def test_noise_costs_no_frame(parts: list[tuple[bytes, Message]], cuts: list[int]) -> None:
    """Noise with any bytes, false markers too: every whole frame is found all the same."""
    sender, frames, stream = Codec(7, 9), [], b""
    for noise, message in parts:
        frames.append(sender.encode(message))
        stream += noise + frames[-1]
    codec, found = Codec(1, 1), []
    for chunk in [*_chunks(stream, cuts), FLUSH]:
        found += [bytes(m.get_msgbuf()) for m in codec.decode(chunk)]
    assume(codec.unknown == 0)  # once in 30,000 times noise looks like a whole unknown message
    remaining = iter(found)
    assert all(frame in remaining for frame in frames)


@settings(max_examples=300)
@given(st.lists(st.binary(max_size=300), max_size=8), st.booleans())
def test_hostile_bytes_never_raise_and_never_pile_up(chunks: list[bytes], datagram: bool) -> None:
    codec = Codec(1, 1)
    for chunk in chunks:
        for message in codec.decode(chunk, datagram=datagram):
            assert message.get_msgId() in dialect.mavlink_map
        assert len(codec._rest) < (1 if datagram else MAX_FRAME_LENGTH)


@settings(max_examples=200)
@given(messages(SMALL), st.integers(0, 10_000), st.integers(1, 255))
def test_a_changed_frame_is_never_taken_for_itself(
    message: Message, place: int, change: int
) -> None:
    frame = bytearray(Codec(7, 9).encode(message))
    frame[place % len(frame)] ^= change
    found = Codec(1, 1).decode(bytes(frame) + FLUSH)
    assert bytes(frame) not in [bytes(m.get_msgbuf()) for m in found]


@given(st.binary(max_size=255), st.integers(0, 2**24 - 1).filter(lambda n: not is_known(n)))
def test_unknown_messages_are_counted_and_skipped_whole(payload: bytes, number: int) -> None:
    head = struct.pack(
        "<BBBBBBBHB", 0xFD, len(payload), 0, 0, 0, 1, 1, number & 0xFFFF, number >> 16
    )
    crc = dialect.x25crc(head[1:] + payload + b"\x42").crc
    known = Codec(1, 1).encode(dialect.MAVLink_ping_message(1, 2, 3, 4))
    codec = Codec(1, 1)
    (message,) = codec.decode(head + payload + struct.pack("<H", crc) + known)
    assert message.seq == 2
    assert (codec.unknown, codec.bad_bytes) == (1, 0)


def is_known(number: int) -> bool:
    return number in ADDED or number in dialect.mavlink_map


@given(messages(SMALL), st.binary(min_size=1, max_size=40))
def test_a_datagram_with_a_broken_tail_holds_nothing_back(message: Message, tail: bytes) -> None:
    codec = Codec(1, 1)
    frame = Codec(7, 9).encode(message)
    cut = b"\xfd\xff\x00" + tail
    found = codec.decode(cut + frame, datagram=True)
    assume(codec.unknown == 0)  # once in 30,000 times noise looks like a whole unknown message
    assert len(found) >= 1
    assert len(codec.decode(frame, datagram=True)) == 1
