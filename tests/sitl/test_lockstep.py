"""Lockstep over a real socket pair with a real child process."""

import contextlib
import json
import re
import time

import numpy as np
import pytest

WALL = """
name = "wall"
description = "one thin wall across the way east"
bounds_enu_m = [-20.0, -20.0, 0.0, 40.0, 20.0, 20.0]
start_enu_m = [0.0, 0.0, 0.0]
goal_enu_m = [30.0, 0.0, 3.0]
[[box]]
min_enu_m = [8.0, -10.0, 0.0]
max_enu_m = [8.2, 10.0, 10.0]
"""


def test_ticks_wait_for_the_answer_and_count_by_twenty_ms(companion):
    vehicle = companion()
    stamps = []
    for _ in range(30):
        stamps.append(vehicle.receive_tick().time_boot_ms)
        vehicle.socket.settimeout(0.05)
        with pytest.raises(TimeoutError):
            vehicle.socket.recv(1)
        vehicle.socket.settimeout(60.0)
        vehicle.answer(time_boot_ms=vehicle.stamp_ms - 20 & 0xFFFFFFFF)  # another tick's
        vehicle.answer()
    assert stamps == list(range(0, 600, 20))
    assert vehicle.finish() == (0, "")


def test_offboard_flight_and_the_truth_about_it(companion, take_off, tmp_path):
    vehicle = companion("--truth", str(tmp_path / "truth"))
    vehicle.fly(900, take_off, lambda tick: {"vx": 2.0 if tick > 560 else 0.0, "yaw": 0.3})
    position = vehicle.take("LOCAL_POSITION_NED")[-1]
    assert vehicle.finish() == (0, "")

    assert [position.vx, position.vy, position.vz] == pytest.approx([2.0, 0.0, 0.0], abs=0.1)
    assert vehicle.take("HEARTBEAT")[-1].custom_mode == 393216
    report = json.loads((tmp_path / "truth" / "truth.json").read_text())
    assert report["collision"] is None
    assert report["energies_j"]["propeller"] > 100.0
    with np.load(tmp_path / "truth" / "truth.npz") as log:
        # The last position sent is the last but one row of truth, in the other frame.
        east, north, up = log["position_enu_m"][len(vehicle.take("LOCAL_POSITION_NED")) - 1]
        assert [north, east, -up] == pytest.approx([position.x, position.y, position.z], abs=1e-4)
        assert np.diff(log["stamp_s"]) == pytest.approx(0.02)


@pytest.mark.slow
def test_same_messages_give_the_same_bytes(companion, take_off, order):
    orders = {**take_off, 230: [order(2000, 0, 0.1, 0, component=100)]}

    def fly():
        vehicle = companion("--seed", "5")
        vehicle.fly(700, orders, lambda tick: {"vx": 1.5, "vy": -0.5, "yaw": 0.01 * tick})
        assert vehicle.finish() == (0, "")
        return vehicle.raw

    first, second = fly(), fly()
    assert len(first) > 100_000
    assert first == second


def test_camera_frames_come_only_when_asked_for(companion, order):
    vehicle = companion("--camera-size", "32x24")
    vehicle.fly(60)
    assert not vehicle.take("CAMERA_IMAGE_CAPTURED")
    cameras = {m.get_srcComponent() for m in vehicle.take("HEARTBEAT")}
    assert cameras == {1, 100}
    vehicle.fly(100, {0: [order(2000, 0, 0.2, 0, component=100)]})
    captured = vehicle.take("CAMERA_IMAGE_CAPTURED")
    assert len(captured) == 10
    handshake = vehicle.take("DATA_TRANSMISSION_HANDSHAKE")[0]
    assert (handshake.width, handshake.height, handshake.size) == (32, 24, 768)
    assert len(vehicle.take("ENCAPSULATED_DATA")) == 10 * handshake.packets
    vehicle.fly(5, {0: [order(2001, component=100)]})
    count = len(vehicle.take("CAMERA_IMAGE_CAPTURED"))
    vehicle.fly(60)
    assert len(vehicle.take("CAMERA_IMAGE_CAPTURED")) == count


@pytest.mark.slow
def test_collision_is_told_and_stops_the_motors(companion, take_off, tmp_path):
    scene = tmp_path / "wall.toml"
    scene.write_text(WALL)
    vehicle = companion("--world", str(scene), "--truth", str(tmp_path / "truth"))
    vehicle.fly(1100, take_off, lambda _tick: {"vy": 3.0})  # east, into the wall
    texts = [m.text for m in vehicle.take("STATUSTEXT") if m.severity == 0]
    assert vehicle.finish() == (0, "")
    assert len(texts) == 1
    assert texts[0].startswith("Collision: box 0 at ")
    report = json.loads((tmp_path / "truth" / "truth.json").read_text())
    hit = report["collision"]
    assert hit["box_index"] == 0
    assert hit["position_enu_m"][0] == pytest.approx(7.75, abs=0.15)
    last = vehicle.take("LOCAL_POSITION_NED")[-1]
    assert last.z > -1.0  # it fell


def test_interrupt_saves_the_truth(companion, tmp_path):
    vehicle = companion("--truth", str(tmp_path / "truth"))
    vehicle.fly(20)
    vehicle.receive_tick()
    vehicle.interrupt()
    assert vehicle.process.wait(30) == 0
    assert json.loads((tmp_path / "truth" / "truth.json").read_text())["collision"] is None


def test_an_answer_for_another_system_ends_the_tick_and_commands_nothing(companion, take_off):
    vehicle = companion()
    vehicle.fly(900, take_off, lambda _tick: {"target_system": 255, "vx": 2.0})
    assert vehicle.stamp_ms == 899 * 20
    modes = {m.custom_mode for m in vehicle.take("HEARTBEAT") if m.get_srcComponent() == 1}
    assert 6 << 16 not in modes  # OFFBOARD needs setpoints of its own
    assert vehicle.finish() == (0, "")


def test_silent_companion_is_an_error_in_one_line(companion):
    vehicle = companion("--answer-limit", "0.3")
    vehicle.receive_tick()
    _, errors = vehicle.process.communicate(timeout=30)
    assert vehicle.process.returncode == 1
    assert re.fullmatch("error: .* 0 ms within 0.3 s\n", errors)


def test_a_companion_that_talks_but_never_answers_is_an_error(companion):
    vehicle = companion("--answer-limit", "0.3")
    vehicle.receive_tick()
    with contextlib.suppress(OSError):  # the vehicle ends
        while vehicle.process.poll() is None:
            vehicle.answer(time_boot_ms=999)
            time.sleep(0.05)
    _, errors = vehicle.process.communicate(timeout=30)
    assert re.fullmatch("error: .* 0 ms within 0.3 s\n", errors)


@pytest.mark.slow
def test_garbage_between_frames_changes_nothing(companion):
    def fly(noise):
        vehicle = companion()
        for _ in range(40):
            vehicle.receive_tick()
            if noise:
                vehicle.socket.sendall(noise)
            vehicle.answer()
        assert vehicle.finish() == (0, "")
        return vehicle.raw

    assert fly(b"\x00\xff garbage \x01") == fly(b"")


def test_speed_paces_lockstep(companion):
    import time

    vehicle = companion("--speed", "2")
    vehicle.fly(5)
    start = time.monotonic()
    vehicle.fly(100)
    assert time.monotonic() - start >= 0.5  # 2 s of flight; 0.5 s of an earlier stall are made good
    assert vehicle.finish() == (0, "")
