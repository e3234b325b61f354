from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from mavfi_cli.link.codec import Codec, dialect
from mavfi_cli.link.transport import Transport, open_transport
from sitl.camera.__main__ import main
from sitl.camera.component import Camera
from sitl.camera.station import PoseTracker, Station
from sitl.world import load_world

WORLD = load_world("dense", seed=1)


class Peer:
    """The other end of one of the station's links."""

    def __init__(self, system: int, component: int) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        self.link: Transport = open_transport(f"fd:{ours.detach()}")
        self.station_link: Transport = open_transport(f"fd:{theirs.detach()}")
        self.codec = Codec(system, component)

    def send(self, *messages: Any) -> None:
        self.link.send(b"".join(self.codec.encode(m) for m in messages))

    def received(self) -> list[Any]:
        messages: list[Any] = []
        while data := self.link.receive(0.0):
            messages += self.codec.decode(data)
        return messages


def heartbeat(autopilot: int = dialect.MAV_AUTOPILOT_PX4) -> Any:
    return dialect.MAVLink_heartbeat_message(2, autopilot, 0, 0, 4, 3)


def pose(ms: int) -> list[Any]:
    return [
        dialect.MAVLink_local_position_ned_message(ms, 0, 0, -5, 0, 0, 0),
        dialect.MAVLink_attitude_quaternion_message(ms, 1, 0, 0, 0, 0, 0, 0),
    ]


def start_capture(system: int) -> Any:
    return dialect.MAVLink_command_long_message(system, 100, 2000, 0, 0, 0.1, 0, 0, 0, 0, 0)


@pytest.fixture
def scene() -> Iterator[tuple[Station, Peer, Peer, list[float]]]:
    autopilot, client = Peer(7, 1), Peer(255, 190)
    now = [0.0]
    station = Station(
        Camera(WORLD.boxes_enu_m),
        PoseTracker(np.zeros(3)),
        [autopilot.station_link, client.station_link],
        clock=lambda: now[0],
    )
    yield station, autopilot, client, now
    for peer in (autopilot, client):
        peer.link.close()
        peer.station_link.close()


def test_it_asks_a_silent_autopilot_for_its_pose_until_it_comes(scene: Any) -> None:
    station, autopilot, _, now = scene
    autopilot.send(heartbeat())

    def asked() -> list[int]:
        station.serve()
        return [
            round(m.param1)
            for m in autopilot.received()
            if m.get_type() == "COMMAND_LONG" and (m.command, m.target_system) == (511, 7)
        ]

    assert asked() == [31, 32]
    assert asked() == []
    autopilot.send(pose(0)[0])
    now[0] = 2.5
    assert asked() == [31]
    autopilot.send(*pose(20))
    now[0] = 5.0
    assert asked() == []


def test_a_client_on_another_link_gets_frames_and_hears_the_autopilot(scene: Any) -> None:
    station, autopilot, client, _ = scene
    autopilot.send(heartbeat(), *pose(0))
    station.serve()
    client.send(start_capture(7))
    station.serve()
    for k in range(1, 51):
        autopilot.send(*pose(20 * k))
        station.serve()
    heard = client.received()
    kinds = [m.get_type() for m in heard]
    assert kinds.count("CAMERA_IMAGE_CAPTURED") == station.frames_sent == 10
    assert kinds.count("ENCAPSULATED_DATA") == 130
    assert kinds.count("LOCAL_POSITION_NED") == 51
    camera = [m for m in heard if m.get_srcComponent() == 100 and m.get_type() == "COMMAND_ACK"]
    assert camera[0].get_srcSystem() == 7
    assert start_capture(7).command in [
        m.command for m in autopilot.received() if m.get_type() == "COMMAND_LONG"
    ]


def test_another_components_pose_is_not_the_vehicles(scene: Any) -> None:
    station, autopilot, client, _ = scene
    autopilot.send(heartbeat(), *pose(0))
    client.send(start_capture(7), *pose(500))
    autopilot.codec.system = 8
    autopilot.send(*pose(900))
    station.serve()
    assert station.frames_sent == 0


def test_a_ground_station_is_no_autopilot(scene: Any) -> None:
    station, autopilot, _, _ = scene
    autopilot.send(heartbeat(dialect.MAV_AUTOPILOT_INVALID), *pose(0), *pose(20))
    station.serve()
    assert "COMMAND_LONG" not in [m.get_type() for m in autopilot.received()]


def test_without_a_pose_it_still_makes_itself_known(scene: Any) -> None:
    station, autopilot, _, now = scene
    for second in range(3):
        now[0] = float(second)
        station.serve()
    assert [m.get_type() for m in autopilot.received()] == ["HEARTBEAT"] * 3


def test_garbage_on_a_link_does_no_harm(scene: Any) -> None:
    station, autopilot, client, _ = scene
    autopilot.link.send(bytes(range(256)) * 20)
    autopilot.send(heartbeat(), *[m for _ in range(20) for m in pose(0)])
    station.serve()
    client.link.send(b"\xfe\x09" * 99)
    client.send(*[start_capture(7)] * 20)
    station.serve()
    autopilot.link.send(b"\xfd" * 500)
    autopilot.send(*[m for k in range(1, 60) for m in pose(20 * k)])
    station.serve()
    assert station.frames_sent > 0


def test_as_a_process_over_udp_until_it_is_stopped() -> None:
    autopilot = open_transport("udpin:127.0.0.1:0")
    url = f"udpout:127.0.0.1:{autopilot.port}"  # type: ignore[attr-defined]
    process = subprocess.Popen(
        [sys.executable, "-m", "sitl.camera", "--world", "dense", "--link", url],
        stderr=subprocess.PIPE, text=True, env=os.environ,
    )  # fmt: skip
    try:
        codec, frames, stamp = Codec(1, 1), 0, 0
        while frames < 3:
            data = autopilot.receive(30.0)
            assert data, "the camera fell silent"
            heard = [m.get_type() for m in codec.decode(data, datagram=True)]
            frames += heard.count("CAMERA_IMAGE_CAPTURED")
            if "COMMAND_ACK" not in heard and frames == 0:
                autopilot.send(codec.encode(heartbeat()) + codec.encode(start_capture(1)))
            for _ in range(5):
                stamp += 20
                autopilot.send(b"".join(codec.encode(m) for m in pose(stamp)))
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=30.0)
        assert process.returncode == 0
        assert "frames sent" in errors
    finally:
        process.kill()
        process.wait()
        autopilot.close()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--world", "dnse"], "did you mean 'dense'"),
        (["--link", "udpin:1.2.3.4:99"], "signing is required"),
        (["--link", "carrier-pigeon:1"], "unknown kind of endpoint"),
        (["--size", "5000x3"], "camera size"),
        (["--rate", "900"], "camera rate"),
        (["--key-file", "/nonexistent"], "No such file"),
    ],
)
def test_a_known_error_is_one_line(
    capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    assert main(arguments) == (2 if "did you mean" in message else 1)
    err = capsys.readouterr().err
    assert err.startswith("error: ")
    assert message in err
    assert err.count("\n") == 1


@pytest.mark.parametrize("arguments", [["--size", "64"], ["--mount", "1,2"], ["--seed", "x"]])
def test_wrong_usage_is_exit_2(arguments: list[str]) -> None:
    assert main(arguments) == 2
