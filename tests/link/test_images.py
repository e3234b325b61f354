from __future__ import annotations

import math
import random
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mavfi_cli.core.frames import quaternion_from_euler
from mavfi_cli.core.types import VehicleState
from mavfi_cli.link import images as images_module
from mavfi_cli.link.codec import Codec, Message, dialect
from mavfi_cli.link.images import MAX_PIXELS, ImageFrame, ImageReceiver

ROWS, COLUMNS, PAYLOAD = 48, 64, 253


def _pixels(index: int, rows: int = ROWS, columns: int = COLUMNS) -> NDArray[np.uint8]:
    generator = np.random.default_rng(index)
    picture = generator.integers(0, 256, (rows, columns), dtype=np.uint8)
    picture[: rows // 3] = 255  # sky, the same in every picture
    return picture


def _captured(index: int, checksum: int, url: str = "depth8:crc32=%08x") -> Message:
    return dialect.MAVLink_camera_image_captured_message(
        100 * index, 0, 1, 0, 0, 0, 0, [1, 0, 0, 0], index, 1, (url % checksum).encode()
    )


def _handshake(rows: int = ROWS, columns: int = COLUMNS, **changes: int) -> Message:
    values = {
        "type": dialect.MAVLINK_DATA_STREAM_IMG_RAW8U,
        "size": rows * columns,
        "width": columns,
        "height": rows,
        "packets": math.ceil(rows * columns / PAYLOAD),
        "payload": PAYLOAD,
        "jpg_quality": 0,
    }
    return dialect.MAVLink_data_transmission_handshake_message(**{**values, **changes})


def _frame(index: int, rows: int = ROWS, columns: int = COLUMNS) -> list[Message]:
    return _sent(index, _pixels(index, rows, columns))


def _sent(index: int, pixels: NDArray[np.uint8]) -> list[Message]:
    (rows, columns), data = pixels.shape, pixels.tobytes()
    packets = [
        dialect.MAVLink_encapsulated_data_message(
            k, list(data[at : at + PAYLOAD].ljust(PAYLOAD, b"\0"))
        )
        for k, at in enumerate(range(0, len(data), PAYLOAD))
    ]
    return [_captured(index, zlib.crc32(data)), _handshake(rows, columns), *packets]


def _feed(receiver: ImageReceiver, messages: list[Message]) -> list[ImageFrame]:
    return [frame for message in messages for frame in receiver.feed(message)]


def _check(frames: list[ImageFrame]) -> list[int]:
    """Every returned frame is right, pixel by pixel; their indices."""
    for frame in frames:
        assert np.array_equal(frame.pixels, _pixels(frame.index))
        assert frame.stamp_s == frame.index / 10
    return [frame.index for frame in frames]


def test_a_packet_that_a_large_picture_lost_costs_no_other_picture() -> None:
    pictures = np.random.default_rng(1).integers(0, 255, (9, 120, 160), dtype=np.uint8)
    sent = [_sent(index, pixels) for index, pixels in enumerate(pictures)]
    del sent[1][4], sent[4][40], sent[6][-2]
    frames = _feed(ImageReceiver(), [message for each in sent for message in each])
    assert [frame.index for frame in frames] == [0, 2, 3, 5, 7, 8]
    assert all(np.array_equal(each.pixels, pictures[each.index]) for each in frames)


def test_frames_come_out_as_they_were_sent_over_the_wire() -> None:
    receiver, sender, decoder = ImageReceiver(), Codec(1, 100), Codec(1, 191)
    stream = b"".join(sender.encode(m) for index in range(5) for m in _frame(index))
    assert _check(_feed(receiver, decoder.decode(stream))) == [0, 1, 2, 3, 4]
    assert (receiver.received, receiver.lost) == (5, 0)


def test_frames_in_order_are_compared_with_their_checksums_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    messages, sizes = [m for index in range(5) for m in _frame(index)], []
    checksum = zlib.crc32
    monkeypatch.setattr(zlib, "crc32", lambda data: sizes.append(len(data)) or checksum(data))
    assert _check(_feed(ImageReceiver(), messages)) == [0, 1, 2, 3, 4]
    assert sizes == [ROWS * COLUMNS] * 5


@pytest.mark.parametrize(("rows", "columns"), [(1, 1), (1, 253), (2, 253), (3, 100), (240, 320)])
def test_any_size(rows: int, columns: int) -> None:
    (frame,) = _feed(ImageReceiver(), _frame(1, rows, columns))
    assert np.array_equal(frame.pixels, _pixels(1, rows, columns))


@settings(max_examples=100, deadline=None)
@given(st.permutations(range(15)), st.permutations(range(15)))
def test_any_order_within_frames(first: list[int], second: list[int]) -> None:
    receiver = ImageReceiver()
    frames = [_feed(receiver, _frame(0))]
    for index, order in ((1, first), (2, second)):
        messages = _frame(index)
        frames.append(_feed(receiver, [messages[place] for place in order]))
    assert [_check(each) for each in frames] == [[0], [1], [2]]
    assert receiver.lost == 0


@settings(max_examples=100, deadline=None)
@given(st.sets(st.integers(0, 6 * 15 - 1), max_size=20))
def test_loss_costs_only_the_frames_that_it_hits(lost: set[int]) -> None:
    receiver = ImageReceiver()
    sent = [m for index in range(6) for m in _frame(index)]
    frames = _feed(receiver, [m for place, m in enumerate(sent) if place not in lost])
    got = _check(frames)
    # The size is known from any handshake before; losing a later one costs nothing.
    sized = min((i for i in range(6) if 15 * i + 1 not in lost), default=6)
    whole = [
        i
        for i in range(6)
        if not any(15 * i + k in lost for k in range(15) if k != 1)
        and (15 * i + 1 not in lost or i > sized)
    ]
    assert set(whole) <= set(got)


@settings(max_examples=100, deadline=None)
@given(st.randoms(use_true_random=False), st.integers(1, 6), st.integers(0, 3))
def test_reordering_across_frames(order: random.Random, reach: int, loss: int) -> None:
    """Every message is delayed by up to `reach` places, over frame borders; some are lost."""
    receiver = ImageReceiver()
    sent = [m for index in range(6) for m in _frame(index)]
    for _ in range(loss):
        del sent[order.randrange(2, len(sent))]
    late = sorted(enumerate(sent), key=lambda pair: pair[0] + order.uniform(0, reach))
    got = _check(_feed(receiver, [message for _, message in late]))
    assert len(got) == len(set(got)) >= 6 - loss
    assert receiver.lost >= 0


def test_duplicates_are_harmless() -> None:
    receiver = ImageReceiver()
    twice = [m for index in range(4) for m in _frame(index) for _ in range(2)]
    assert _check(_feed(receiver, twice)) == [0, 1, 2, 3]
    assert receiver.lost == 0


def test_a_wrong_checksum_is_discarded_and_counted() -> None:
    receiver = ImageReceiver()
    bad = _frame(0)
    bad[0] = _captured(0, 12345)
    assert _feed(receiver, bad) == []
    assert _check([f for i in range(1, 6) for f in _feed(receiver, _frame(i))]) == [1, 2, 3, 4, 5]
    assert (receiver.received, receiver.lost) == (5, 1)


def test_skipped_frames_are_counted() -> None:
    receiver = ImageReceiver()
    for index in (3, 4, 7, 8):
        _feed(receiver, _frame(index))
    assert (receiver.received, receiver.lost) == (4, 2)


def test_a_restarted_camera_counts_anew() -> None:
    receiver = ImageReceiver()
    _feed(receiver, _frame(500_000))
    _feed(receiver, _frame(0))
    assert (receiver.received, receiver.lost) == (2, 0)


def _stamped(index: int, stamp_ms: int) -> list[Message]:
    captured, *rest = _frame(index)
    captured.time_boot_ms = stamp_ms
    return [captured, *rest]


def test_a_camera_that_restarts_early_counts_anew_too() -> None:
    """Its vehicle's clock goes on, while the index begins again."""
    receiver = ImageReceiver()
    for index in range(200):
        _feed(receiver, _frame(index))
    later = [frame for k in range(3) for frame in _feed(receiver, _stamped(k, 20_000 + 100 * k))]
    assert [frame.index for frame in later] == [0, 1, 2]
    assert (receiver.received, receiver.lost) == (203, 0)


def test_a_camera_without_checksums_is_taken_at_its_word() -> None:
    messages = _frame(0)
    messages[0] = _captured(0, 0, "file%d.raw")
    assert _check(_feed(ImageReceiver(), messages)) == [0]


@pytest.mark.parametrize(
    "changes",
    [
        {"type": dialect.MAVLINK_DATA_STREAM_IMG_JPEG},
        {"size": ROWS * COLUMNS + 1},
        {"packets": 12},
        {"packets": 65_535},
        {"payload": 0},
        {"payload": 254},
        {"width": 0, "size": 0, "packets": 0},
        {"width": 65_535, "height": 65_535, "size": 0xFFFE0001, "packets": 65_535},
    ],
)
def test_sizes_that_do_not_add_up_are_not_believed(changes: dict[str, int]) -> None:
    receiver = ImageReceiver()
    messages = _frame(0)
    messages[1] = _handshake(**changes)
    assert _feed(receiver, messages) == []
    assert _check(_feed(receiver, [_handshake()])) == [0]  # the true one, late


def test_the_field_of_view_is_learnt() -> None:
    receiver = ImageReceiver()
    (before,) = _feed(receiver, _frame(0))
    name = [0] * 32
    receiver.feed(
        dialect.MAVLink_camera_information_message(
            0, name, name, 1, 2.0, 4.0, 3.0, 64, 48, 0, 0, 0, b""
        )
    )
    (after,) = _feed(receiver, _frame(1))
    assert before.hfov_rad is None
    assert after.hfov_rad == pytest.approx(math.pi / 2)


@settings(max_examples=30, deadline=None)
@given(st.randoms(use_true_random=False))
def test_hostile_streams_stay_within_bounds(noise: random.Random) -> None:
    receiver = ImageReceiver()
    for _ in range(600):
        choice = noise.randrange(3)
        if choice == 0:
            index, checksum = noise.randrange(-(2**31), 2**31), noise.randrange(2**32)
            _feed(receiver, [_captured(index % 3000 - 1500 if choice else index, checksum)])
        elif choice == 1:
            rows, columns = noise.choice([(1, 1), (30, 40), (1024, 1024), (65_535, 65_535)])
            packets = math.ceil(rows * columns / PAYLOAD) & 0xFFFF
            _feed(receiver, [_handshake(rows, columns, packets=packets)])
        else:
            data = [noise.randrange(256)] * PAYLOAD
            place = noise.choice([noise.randrange(65_536), noise.randrange(20)])
            _feed(receiver, [dialect.MAVLink_encapsulated_data_message(place, data)])
        limit = images_module._OPEN_FRAMES * (MAX_PIXELS // PAYLOAD + 1)
        assert sum(map(len, receiver._packets.values())) <= limit
        assert len(receiver._open) <= images_module._OPEN_FRAMES


def test_the_depth_frame_in_metres_and_in_the_world() -> None:
    pixels = np.array([[0, 1], [254, 255]], dtype=np.uint8)
    image = ImageFrame(stamp_s=1.5, index=0, pixels=pixels, hfov_rad=None)
    facing_north = quaternion_from_euler(0.0, 0.0, math.pi / 2)
    state = VehicleState(
        stamp_s=1.5,
        position_enu_m=np.array([10.0, 20.0, 5.0]),
        velocity_enu_mps=np.zeros(3),
        quaternion=facing_north,
        yaw_rad=math.pi / 2,
    )
    offset = np.array([0.2, 0.05, -0.1])  # forward, left, up
    frame = image.depth_frame(state, hfov_rad=1.2, mount_offset_flu_m=offset)
    assert frame.depth_m == pytest.approx(np.array([[0.0, 0.1], [25.4, np.inf]]))
    assert frame.position_enu_m == pytest.approx([10.0 - 0.05, 20.2, 4.9])
    assert frame.quaternion == pytest.approx(facing_north)
    assert (frame.stamp_s, frame.hfov_rad) == (1.5, 1.2)
    known = ImageFrame(stamp_s=1.5, index=0, pixels=pixels, hfov_rad=0.9)
    assert known.depth_frame(state, hfov_rad=1.2, mount_offset_flu_m=offset).hfov_rad == 0.9
