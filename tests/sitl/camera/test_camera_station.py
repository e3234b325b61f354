from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mavfi_cli.link.codec import Codec, dialect
from mavfi_cli.link.transport import Transport, open_transport
from sitl.camera.__main__ import main
from sitl.camera.component import Camera
from sitl.camera.station import PoseTracker, Station, Witness
from sitl.vehicle.profile import load_profile
from sitl.vehicle.vehicle import regression_power
from sitl.world import load_world

WORLD = load_world("dense", seed=1)


class Peer:
    """The other end of one of the station's links."""

    def __init__(self, system: int, component: int) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        self.link: Transport = open_transport(f"fd:{ours.detach()}")
        self.station_url = f"fd:{theirs.detach()}"
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


@contextlib.contextmanager
def on_links(
    origin_enu_m: tuple[float, float, float], **settings: Any
) -> Iterator[tuple[Station, Peer, Peer, list[float]]]:
    autopilot, client = Peer(7, 1), Peer(255, 190)
    now = [-5.0]
    station = Station(
        Camera(WORLD.boxes_enu_m), PoseTracker(np.array(origin_enu_m)),
        [autopilot.station_url, client.station_url], clock=lambda: now[0], **settings,
    )  # fmt: skip
    client.send(heartbeat(dialect.MAV_AUTOPILOT_INVALID))
    station.serve()
    for peer in (autopilot, client):
        peer.received()
    now[0] = 0.0
    yield station, autopilot, client, now
    station.close()
    for peer in (autopilot, client):
        peer.link.close()


@pytest.fixture
def scene() -> Iterator[Any]:
    witness = Witness(WORLD, load_profile("solo"), logs=False)
    with on_links((0.0, 0.0, 0.0), witness=witness) as made:
        yield made


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
    asked = [m.command for m in autopilot.received() if m.get_type() == "COMMAND_LONG"]
    assert start_capture(7).command not in asked  # it was for the camera, which is here


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


@pytest.mark.parametrize(("heartbeat_hz", "beats"), [(0.0, 0), (1.0, 3)])
def test_its_heartbeat_is_the_cameras_with_and_without_a_pose(
    heartbeat_hz: float, beats: int
) -> None:
    autopilot, now = Peer(7, 1), [0.0]
    camera = Camera(WORLD.boxes_enu_m, heartbeat_hz=heartbeat_hz)
    made = Station(camera, PoseTracker(np.zeros(3)), [autopilot.station_url], clock=lambda: now[0])
    with contextlib.closing(autopilot.link), contextlib.closing(made) as station:

        def heard(*messages: Any) -> int:
            count = 0
            for tick in range(150):
                now[0] += 0.02
                autopilot.send(*(m for m in messages if setattr(m, "time_boot_ms", 20 * tick) or 1))
                station.serve()
                count += [m.get_type() for m in autopilot.received()].count("HEARTBEAT")
            return count

        assert heard() == beats
        autopilot.send(heartbeat())
        position = pose(0)[0]
        # An autopilot may send ATTITUDE only.
        assert heard(position, dialect.MAVLink_attitude_message(0, 0, 0, 0, 0, 0, 0)) == beats


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
        (["--link", "udpin:1.2.3.4:99"], "the link must be signed"),
        (["--link", "carrier-pigeon:1"], "unknown kind of endpoint"),
        (["--size", "5000x3"], "camera size"),
        (["--rate", "900"], "camera rate"),
        (["--key-file", "/nonexistent"], "No such file"),
    ],
)
def test_a_known_error_is_one_line(
    capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    usage = ("did you mean", "unknown kind")
    assert main(arguments) == (2 if message.startswith(usage) else 1)
    err = capsys.readouterr().err
    assert err.startswith("error: ")
    assert message in err
    assert err.count("\n") == 1


@pytest.mark.parametrize("arguments", [["--size", "64"], ["--mount", "1,2"], ["--seed", "x"]])
def test_wrong_usage_is_exit_2(arguments: list[str]) -> None:
    assert main(arguments) == 2


# Where the autopilot's origin is ---------------------------------------------------------------


def offset_answer(system: int) -> Any:
    return dialect.MAVLink_command_long_message(system, 100, 512, 0, 89, 0, 0, 0, 0, 0, 0)


def told_offsets(client: Peer) -> list[tuple[float, float, float]]:
    kind = "LOCAL_POSITION_NED_SYSTEM_GLOBAL_OFFSET"
    return [(m.x, m.y, m.z) for m in client.received() if m.get_type() == kind]


@pytest.fixture
def unplaced() -> Iterator[Any]:
    """A station that does not know the origin of the autopilot. Its guess is the start."""
    with on_links((3.0, 4.0, 0.0), origin_given=False) as made:
        yield made


def test_the_origin_is_the_start_if_nobody_knows_a_better_one(unplaced: Any) -> None:
    station, autopilot, client, _ = unplaced
    autopilot.send(heartbeat(), *pose(0))
    station.serve()
    assert 89 in [round(m.param1) for m in autopilot.received() if m.get_type() == "COMMAND_LONG"]
    client.send(offset_answer(7))
    station.serve()
    told = client.received()
    assert [m.result for m in told if m.get_type() == "COMMAND_ACK"] == [5]  # in progress
    autopilot.send(*pose(980))
    station.serve()
    assert told_offsets(client) == []
    autopilot.send(*pose(1000))
    station.serve()
    assert told_offsets(client) == [(4.0, 3.0, 0.0)]


def test_a_simulated_vehicle_of_ours_tells_its_origin(unplaced: Any) -> None:
    station, autopilot, client, _ = unplaced
    autopilot.send(heartbeat())
    station.serve()
    autopilot.codec.component = 100
    kind = dialect.MAVLink_local_position_ned_system_global_offset_message
    autopilot.send(kind(0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    autopilot.codec.component = 1
    station.serve()
    client.send(offset_answer(7))
    station.serve()
    assert told_offsets(client) == [(0.0, 0.0, 0.0)]


# The referee -----------------------------------------------------------------------------------


def flying_pose(ms: int, east_m: float, north_m: float) -> list[Any]:
    return [
        dialect.MAVLink_local_position_ned_message(ms, north_m, east_m, -5, 0, 3, 0),
        dialect.MAVLink_attitude_quaternion_message(ms, 1, 0, 0, 0, 0, 0, 0),
    ]


def test_a_flight_through_a_tower_is_a_collision(scene: Any) -> None:
    station, autopilot, client, _ = scene
    west, south, _, east, north, _ = WORLD.boxes_enu_m[0]
    autopilot.send(dialect.MAVLink_heartbeat_message(2, 12, 0x80, 6 << 16, 4, 3))
    heard: list[Any] = []
    for k, x in enumerate(np.arange(west - 3.0, east + 3.0, 0.06)):
        autopilot.send(*flying_pose(20 * (k + 1), float(x), (south + north) / 2))
        station.serve()
        heard += client.received()
    texts = [m.text for m in heard if m.get_type() == "STATUSTEXT"]
    assert len(texts) == 1
    assert texts[0].startswith("Collision: box 0 at ")


def test_the_verdict_is_saved_with_whose_pose_it_was(tmp_path: Path) -> None:
    witness = Witness(WORLD, load_profile("solo"), logs=True)
    witness.take(dialect.MAVLink_heartbeat_message(2, 12, 0x80, 6 << 16, 4, 3))
    level, velocity = np.array([1.0, 0.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0])
    for k in range(51):
        witness.observe(0.02 * k, np.array([0.02 * k, 0.0, 5.0]), level, velocity)
    witness.save(tmp_path)
    report = json.loads((tmp_path / "truth.json").read_text())
    assert report["pose"] == "the autopilot's own pose"
    assert report["collision"] is None
    assert report["distance_m"] == pytest.approx(1.0)
    steady_w = regression_power(velocity, np.zeros(3), load_profile("solo").energy.coefficients(0))
    assert report["energies_j"] == {"regression": pytest.approx(steady_w, rel=1e-6)}


def test_nothing_is_saved_of_a_vehicle_that_was_never_seen(tmp_path: Path) -> None:
    Witness(WORLD, load_profile("solo"), logs=True).save(tmp_path)
    assert list(tmp_path.iterdir()) == []


# Peers of a listening link ---------------------------------------------------------------------


def listening(**settings: Any) -> Station:
    camera = Camera(WORLD.boxes_enu_m, heartbeat_hz=0.0)
    return Station(camera, PoseTracker(np.zeros(3)), ["udpin:127.0.0.1:0"], **settings)


def test_a_second_companion_joins_where_the_first_was(tmp_path: Path) -> None:
    """Neither takes the other's place, and a stranger's bytes are no peer."""
    with contextlib.closing(listening()) as station:
        port = station.peers._endpoints[0][1].port  # type: ignore[attr-defined]
        heard: list[Any] = []
        station.take = lambda message: bool(heard.append(message.get_srcSystem()))
        for name in (1, 2):
            far = open_transport(f"udpout:127.0.0.1:{port}")
            far.send(b"\xfd no frame")
            far.send(Codec(name, 191).encode(heartbeat(8)))
            station.peers.wait(1.0)
            station.serve()
            far.close()
        assert heard == [1, 2]
        assert len(list(station.peers)) == 2


def test_a_second_autopilot_of_an_endpoint_is_told_and_not_followed() -> None:
    """Until the first has been silent for 5 s."""
    now_s, heard = [0.0], []
    with contextlib.ExitStack() as stack:
        station = stack.enter_context(contextlib.closing(listening(clock=lambda: now_s[0])))
        station.take = lambda message: bool(heard.append(message.custom_mode))
        port = station.peers._endpoints[0][1].port  # type: ignore[attr-defined]
        first, second = (
            stack.enter_context(contextlib.closing(open_transport(f"udpout:127.0.0.1:{port}")))
            for _ in range(2)
        )
        for far, mode in ((first, 1), (second, 2), (first, 1)):
            far.send(Codec(7, 1).encode(dialect.MAVLink_heartbeat_message(2, 12, 0, mode, 4, 3)))
            station.peers.wait(1.0)
            station.serve()
        assert heard == [1, 1]
        told, codec = "", Codec(255, 190)
        while data := first.receive(0.1):
            told += "".join(m.text for m in codec.decode(data) if m.get_type() == "STATUSTEXT")
        ports = [far._socket.getsockname()[1] for far in (first, second)]  # type: ignore[attr-defined]
        assert told == "two autopilots send here, 127.0.0.1:{} and 127.0.0.1:{}".format(*ports)
        now_s[0] = 5.0
        second.send(Codec(7, 1).encode(dialect.MAVLink_heartbeat_message(2, 12, 0, 2, 4, 3)))
        station.peers.wait(1.0)
        station.serve()
        assert heard == [1, 1, 2]
