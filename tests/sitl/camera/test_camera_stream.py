"""Depth frames over a Unix domain socket, for one reader, slow ones, many, and hostile ones."""

from __future__ import annotations

import contextlib
import math
import socket
import struct
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pytest

from mavfi_cli.core.errors import LinkError
from mavfi_cli.core.frames import quaternion_from_euler, rotate, rotation_matrix
from mavfi_cli.link.transport import MAX_PEERS
from sitl.camera.component import Camera
from sitl.camera.depth import render_depth
from sitl.camera.stream import DepthStream
from sitl.world import load_world

BOXES = load_world("dense", seed=1).boxes_enu_m
POSITION = np.array([1.0, 2.0, 5.0])
ATTITUDE = quaternion_from_euler(0.05, -0.1, 0.9)
SIZE = 64, 48
HEADER = struct.Struct("<8sQIIf3f4f")


@pytest.fixture
def stream(tmp_path: Path) -> Iterator[DepthStream]:
    with contextlib.closing(DepthStream(tmp_path / "depth", SIZE)) as opened:
        yield opened


@pytest.fixture
def readers(tmp_path: Path) -> Iterator[Any]:
    """A function that connects another reader: its socket, and the file of its frames."""
    with contextlib.ExitStack() as opened:

        def reader() -> tuple[socket.socket, BinaryIO]:
            made = opened.enter_context(socket.socket(socket.AF_UNIX))
            made.settimeout(10.0)
            made.connect(str(tmp_path / "depth"))
            return made, opened.enter_context(made.makefile("rb"))

        yield reader


def read(file: BinaryIO) -> tuple[int, np.ndarray, tuple[float, ...]] | None:
    """Stamp, depth, and field of view, position and quaternion; None at the end."""
    head = file.read(HEADER.size)
    if not head:
        return None
    magic, stamp_us, columns, rows, *view = HEADER.unpack(head)
    assert magic == b"MAVFI-D1"
    depth_m = np.frombuffer(file.read(4 * columns * rows), "<f4").reshape(rows, columns)
    return stamp_us, depth_m, tuple(view)


def poll(camera: Camera, ticks: range) -> None:
    for tick in ticks:
        camera.poll(tick * 0.02, POSITION, ATTITUDE)


def test_a_frame_is_the_image_in_metres_with_the_pose_of_the_lens(
    stream: DepthStream, readers: Any
) -> None:
    mount = (0.2, -0.1, 0.3)
    camera = Camera(
        BOXES, columns=32, rows=24, hfov_rad=1.2, mount_offset_flu_m=mount, depth=stream
    )
    _, file = readers()
    camera.poll(7.5, POSITION, ATTITUDE)
    found = read(file)
    assert found is not None
    stamp_us, depth_m, view = found
    lens = POSITION + rotate(rotation_matrix(ATTITUDE), np.array(mount))
    pixels = render_depth(BOXES, lens, ATTITUDE, 32, 24, 1.2)
    nothing = pixels == 255
    assert nothing.any()
    assert stamp_us == 7_500_000
    np.testing.assert_allclose(depth_m[~nothing], pixels[~nothing] / 10.0, rtol=1e-6)
    assert (depth_m[nothing] == math.inf).all()
    np.testing.assert_allclose(view, [1.2, *lens, *ATTITUDE], rtol=1e-6)


def test_frames_come_at_the_cameras_rate_without_a_command(
    stream: DepthStream, readers: Any
) -> None:
    camera = Camera(BOXES, columns=8, rows=6, rate_hz=10.0, depth=stream)
    poll(camera, range(100))  # nobody reads
    _, file = readers()
    poll(camera, range(100, 150))
    stream.close()
    stamps = [found[0] for found in iter(lambda: read(file), None)]
    assert stamps == [2_000_000 + 100_000 * count for count in range(10)]


def test_a_frame_is_rendered_whether_mavlink_clients_ask_or_not(
    stream: DepthStream, readers: Any
) -> None:
    camera, plain = (Camera(BOXES, columns=8, rows=6, depth=own) for own in (stream, None))
    readers()
    ours, theirs = (
        [[m.to_dict() for m in own.poll(tick * 0.02, POSITION, ATTITUDE)] for tick in range(100)]
        for own in (camera, plain)
    )
    assert ours == theirs


def test_a_slow_reader_misses_whole_frames_and_delays_nobody(
    stream: DepthStream, readers: Any
) -> None:
    camera = Camera(BOXES, columns=64, rows=48, rate_hz=50.0, depth=stream)
    (slow, _), (_, file) = readers(), readers()
    for tick in range(300):  # 3.7 MB
        camera.poll(tick * 0.02, POSITION, ATTITUDE)
        found = read(file)
        assert found is not None
        assert found[0] == tick * 20_000
    received = bytearray()
    slow.setblocking(False)  # noqa: FBT003
    for tick in range(300, 400):
        with contextlib.suppress(BlockingIOError):
            while data := slow.recv(1 << 20):
                received += data
        camera.poll(tick * 0.02, POSITION, ATTITUDE)
    whole, frame = 0, HEADER.size + 64 * 48 * 4
    stamps = []
    while whole + frame <= len(received):
        magic, stamp_us, columns, rows, *_ = HEADER.unpack_from(received, whole)
        assert (magic, columns, rows) == (b"MAVFI-D1", 64, 48)
        stamps.append(stamp_us)
        whole += frame
    assert stamps == sorted(set(stamps))
    assert 1 <= sum(stamp_us < 300 * 20_000 for stamp_us in stamps) <= 5  # those that waited
    assert stamps[-1] >= 390 * 20_000  # it has caught up


def test_frames_larger_than_the_buffers_arrive_whole(stream: DepthStream, readers: Any) -> None:
    camera = Camera(BOXES, columns=640, rows=480, rate_hz=10.0, depth=stream)
    _, file = readers()
    found: list[Any] = []
    reading = threading.Thread(target=lambda: found.extend(read(file) for _ in range(3)))
    reading.start()
    tick = 0
    while reading.is_alive():
        camera.poll(tick * 0.02, POSITION, ATTITUDE)
        tick += 1
        reading.join(0.002)
    pixels = render_depth(BOXES, POSITION, ATTITUDE, 640, 480, math.pi / 2.0)
    for _, depth_m, _ in found:
        assert (np.isinf(depth_m) == (pixels == 255)).all()


def test_readers_come_and_go_and_say_what_they_like(stream: DepthStream, readers: Any) -> None:
    camera = Camera(BOXES, columns=8, rows=6, rate_hz=50.0, depth=stream)
    (loud, noise), (_, file) = readers(), readers()
    loud.setblocking(False)  # noqa: FBT003
    for tick in range(100):
        if tick < 50:
            with contextlib.suppress(BlockingIOError):
                loud.send(b"\xfe" * 100_000)
        elif tick == 50:
            noise.close()
            loud.close()
        camera.poll(tick * 0.02, POSITION, ATTITUDE)
        assert read(file) is not None
    assert len([readers() for _ in range(MAX_PEERS)]) == MAX_PEERS
    camera.poll(2.0, POSITION, ATTITUDE)  # one of them is too many
    assert read(file) is not None


def test_a_socket_that_cannot_be_made_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "depth"
    with contextlib.closing(DepthStream(path, SIZE)), pytest.raises(LinkError, match="exists; rem"):
        DepthStream(path, SIZE)
    assert not path.exists()
    with pytest.raises(LinkError, match="too long"):
        DepthStream(tmp_path / ("x" * 200), SIZE)
    with pytest.raises(LinkError, match="No such file"):
        DepthStream(tmp_path / "none" / "depth", SIZE)
