from __future__ import annotations

import math
import zlib
from typing import Any

import numpy as np
import pytest

from mavfi_cli.core.errors import ConfigError
from mavfi_cli.core.frames import quaternion_from_euler, rotation_matrix
from mavfi_cli.link.codec import Codec, dialect
from sitl.camera.component import COMPONENT_ID, Camera
from sitl.camera.depth import render_depth
from sitl.geodesy import Origin
from sitl.world import load_world

BOXES = load_world("dense", seed=1).boxes_enu_m
POSITION = np.array([1.0, 2.0, 5.0])
ATTITUDE = quaternion_from_euler(0.05, -0.1, 0.9)
ACCEPTED, DENIED, UNSUPPORTED = 0, 2, 3


def wire(message: Any, system: int = 255, component: int = 190) -> Any:
    codec = Codec(system, component)
    return codec.decode(codec.encode(message))[0]


def command(number: int, *params: float, component: int = COMPONENT_ID, system: int = 1) -> Any:
    padded = [*params, *[0.0] * (7 - len(params))]
    return wire(dialect.MAVLink_command_long_message(system, component, number, 0, *padded))


def kinds(messages: list[Any]) -> list[str]:
    return [m.get_type() for m in messages]


def fly(camera: Camera, seconds: float, start: float = 0.0) -> list[tuple[float, list[Any]]]:
    ticks = range(round(start * 50), round((start + seconds) * 50))
    return [(k * 0.02, camera.poll(k * 0.02, POSITION, ATTITUDE)) for k in ticks]


def frame_stamps(log: list[tuple[float, list[Any]]]) -> list[float]:
    return [s for s, out in log if "CAMERA_IMAGE_CAPTURED" in kinds(out)]


def capturing(camera: Camera) -> bool:
    return bool(camera.handle(command(512, 262))[0].image_status)


def test_before_it_is_asked_it_only_beats() -> None:
    out = [m for _, messages in fly(Camera(BOXES), 3.0) for m in messages]
    assert kinds(out) == ["HEARTBEAT"] * 3
    assert (out[0].type, out[0].autopilot) == (
        dialect.MAV_TYPE_CAMERA,
        dialect.MAV_AUTOPILOT_INVALID,
    )


def test_capture_starts_at_its_interval_and_stops() -> None:
    camera = Camera(BOXES)
    assert camera.handle(command(2000, 0, 0.1))[0].result == ACCEPTED
    assert frame_stamps(fly(camera, 1.0)) == pytest.approx(np.arange(10) * 0.1)
    assert camera.handle(command(2001))[0].result == ACCEPTED
    assert frame_stamps(fly(camera, 1.0, 1.0)) == []
    assert camera.images == 10


@pytest.mark.parametrize(
    ("interval", "expected"), [(0.0, 20), (math.nan, 20), (1e-9, 50), (0.5, 2)]
)
def test_interval_defaults_to_the_cameras_rate_and_has_a_limit(
    interval: float, expected: int
) -> None:
    camera = Camera(BOXES, rate_hz=20.0)
    camera.handle(command(2000, 0, interval))
    assert len(frame_stamps(fly(camera, 1.0))) == expected


def test_the_wires_rounding_of_the_interval_does_not_shift_frames_in_a_long_flight() -> None:
    camera = Camera(BOXES, columns=1, rows=1)
    camera.handle(command(2000, 0, 0.1))
    assert frame_stamps(fly(camera, 200.0)) == pytest.approx(np.arange(2000) * 0.1)


@pytest.mark.parametrize(("interval", "expected"), [(0.1, 100), (0.02, 500), (0.15, 67), (3.0, 4)])
def test_ten_seconds_of_ticks_hold_as_many_frames_as_intervals(
    interval: float, expected: int
) -> None:
    camera, log, stamp = Camera(BOXES, columns=1, rows=1), [], 7.0
    camera.handle(command(2000, 0, interval))
    for _ in range(500):
        log.append((stamp, camera.poll(stamp, POSITION, ATTITUDE)))
        stamp += 0.02  # summed, with its rounding
    assert len(frame_stamps(log)) == expected


def heartbeats(stamps: list[float]) -> list[float]:
    camera = Camera(BOXES)
    return [s for s in stamps if "HEARTBEAT" in kinds(camera.poll(s, POSITION, ATTITUDE))]


def test_a_late_poll_neither_shifts_the_phase_nor_is_made_up_for() -> None:
    assert heartbeats([0.0, 0.5, 3.7, 3.9, 4.0, 4.9, 5.0]) == [0.0, 3.7, 4.0, 5.0]


def test_after_a_restart_it_is_due_at_once() -> None:
    assert heartbeats([100.0, 1.0, 1.5, 2.0]) == [100.0, 1.0, 2.0]


def test_a_counted_capture_ends_by_itself() -> None:
    camera = Camera(BOXES)
    camera.handle(command(2000, 0, 0.1, 3))
    assert len(frame_stamps(fly(camera, 2.0))) == 3
    assert not capturing(camera)


@pytest.mark.slow
def test_a_frame_on_the_wire_is_the_rendered_image() -> None:
    mount = (0.2, -0.1, 0.3)
    camera = Camera(BOXES, columns=70, rows=31, mount_offset_flu_m=mount)
    camera.handle(command(2000))
    out = [wire(m, 1, COMPONENT_ID) for m in camera.poll(12.5, POSITION, ATTITUDE)]
    assert kinds(out[:3]) == ["HEARTBEAT", "CAMERA_IMAGE_CAPTURED", "DATA_TRANSMISSION_HANDSHAKE"]
    captured, shake, packets = out[1], out[2], out[3:]
    lens = POSITION + rotation_matrix(ATTITUDE) @ np.array(mount)
    expected = render_depth(BOXES, lens, ATTITUDE, 70, 31, math.pi / 2.0)
    pixels = b"".join(bytes(p.data) for p in packets)[: shake.size]
    assert pixels == expected.tobytes()
    assert (shake.width, shake.height, shake.size, shake.payload) == (70, 31, 2170, 253)
    assert shake.type == dialect.MAVLINK_DATA_STREAM_IMG_RAW8U
    assert [p.seqnr for p in packets] == list(range(shake.packets)) == list(range(9))
    assert captured.file_url == f"depth8:crc32={zlib.crc32(pixels):08x}"
    assert (captured.time_boot_ms, captured.image_index, captured.capture_result) == (12500, 0, 1)


def test_where_the_picture_was_taken() -> None:
    camera, home = Camera(BOXES), Origin()
    camera.handle(command(2000))
    captured = camera.poll(0.0, np.array([1000.0, 2000.0, 5.0]), ATTITUDE)[1]
    # 1 degree of latitude is 111.195 km on the sphere of 6371 km
    assert captured.lat == pytest.approx((home.latitude_deg + 2000 / 111194.93) * 1e7, abs=200)
    east = 111194.93 * math.cos(math.radians(home.latitude_deg + 1000 / 111194.93))
    assert captured.lon == pytest.approx((home.longitude_deg + 1000 / east) * 1e7, abs=200)
    assert captured.relative_alt == 5000
    # attitude: nose of the vehicle in NED, from the wire's quaternion and from ours
    nose_enu = rotation_matrix(ATTITUDE)[:, 0]
    nose_ned = rotation_matrix(np.array(captured.q))[:, 0]
    assert nose_ned == pytest.approx([nose_enu[1], nose_enu[0], -nose_enu[2]], abs=1e-6)


def test_information_comes_before_its_acknowledgement() -> None:
    for ask in (command(512, 259), command(521, 1)):
        info, ack = Camera(BOXES, columns=80, hfov_rad=1.2).handle(ask)
        info = wire(info)
        assert (info.get_type(), ack.result) == ("CAMERA_INFORMATION", ACCEPTED)
        assert bytes(info.vendor_name).rstrip(b"\0") == b"mavfi"
        assert (info.resolution_h, info.resolution_v) == (80, 48)
        hfov = 2.0 * math.atan(info.sensor_size_h / 2.0 / info.focal_length)
        assert hfov == pytest.approx(1.2, rel=1e-6)
        assert info.flags == dialect.CAMERA_CAP_FLAGS_CAPTURE_IMAGE
        assert (ack.target_system, ack.target_component) == (255, 190)


@pytest.mark.parametrize(
    ("ask", "kind"),
    [
        (command(512, 260), "CAMERA_SETTINGS"),
        (command(522, 1), "CAMERA_SETTINGS"),
        (command(512, 262), "CAMERA_CAPTURE_STATUS"),
        (command(527, 1), "CAMERA_CAPTURE_STATUS"),
        (command(525, 1), "STORAGE_INFORMATION"),
    ],
)
def test_what_can_be_requested(ask: Any, kind: str) -> None:
    camera = Camera(BOXES)
    camera.poll(1.0, POSITION, ATTITUDE)
    answer, ack = camera.handle(ask)
    assert (wire(answer).get_type(), ack.result) == (kind, ACCEPTED)


def test_capture_status_tells_whether_it_captures() -> None:
    camera = Camera(BOXES)
    assert camera.handle(command(512, 262))[0].image_status == 0
    camera.handle(command(2000, 0, 0.2))
    camera.poll(0.0, POSITION, ATTITUDE)
    status = camera.handle(command(512, 262))[0]
    assert (status.image_status, status.image_interval, status.image_count) == (3, 0.2, 1)


@pytest.mark.parametrize(
    ("ask", "result"),
    [
        (command(400, 1), UNSUPPORTED),
        (command(31010), UNSUPPORTED),
        (command(512, 9999), DENIED),
        (command(512, math.inf), DENIED),
        (command(511, 262, 1000), DENIED),
        (command(2000, 0, -1), DENIED),
        (command(2000, 0, math.inf), DENIED),
        (command(2000, 0, 1, -1), DENIED),
        (command(530, 0, 1), DENIED),
        (command(530, 0, 0), ACCEPTED),
    ],
)
def test_what_it_cannot_do_it_says(ask: Any, result: int) -> None:
    camera = Camera(BOXES)
    assert [m.result for m in camera.handle(ask)] == [result]
    assert not capturing(camera)


def test_what_is_meant_for_others_is_left_to_them() -> None:
    camera = Camera(BOXES)
    assert camera.handle(command(2000, system=2)) == []
    assert camera.handle(command(2000, component=1)) == []
    assert camera.handle(command(400, 1, component=0)) == []
    assert camera.handle(command(512, 148, component=0)) == []
    assert camera.handle(wire(dialect.MAVLink_ping_message(0, 0, 1, 100))) == []
    assert not capturing(camera)
    assert kinds(camera.handle(command(512, 259, component=0)))[0] == "CAMERA_INFORMATION"


def test_command_int_works_alike() -> None:
    camera = Camera(BOXES)
    ask = dialect.MAVLink_command_int_message(1, 100, 0, 2000, 0, 0, 0, 0.1, 0, 0, 0, 0, 0)
    assert camera.handle(wire(ask))[0].result == ACCEPTED
    assert capturing(camera)


def test_the_same_stamps_and_commands_give_the_same_bytes() -> None:
    def flight() -> bytes:
        camera, codec = Camera(BOXES), Codec(1, COMPONENT_ID)
        camera.handle(command(2000, 0, 0.1))
        return b"".join(codec.encode(m) for _, ms in fly(camera, 2.0) for m in ms)

    assert flight() == flight()


def test_it_goes_on_after_the_vehicle_rebooted() -> None:
    camera = Camera(BOXES)
    camera.handle(command(2000, 0, 0.1))
    fly(camera, 1.0, 500.0)
    assert len(frame_stamps(fly(camera, 1.0))) == 10


@pytest.mark.parametrize(
    "wrong",
    [{"columns": 0}, {"rows": 5000}, {"rate_hz": 0.0}, {"rate_hz": 51.0}, {"hfov_rad": 4.0},
     {"rate_hz": math.nan}],
)  # fmt: skip
def test_a_camera_that_cannot_be_is_refused_in_one_line(wrong: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match="camera"):
        Camera(BOXES, **wrong)
