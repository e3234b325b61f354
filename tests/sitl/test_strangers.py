"""Who is served: peers after a valid frame, signed where asked; a flood; a restart."""

import select
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from test_realtime import LONG_S, Client, free_port

from mavfi_cli.link.codec import Codec, Signing, dialect, key_from_passphrase
from sitl.world import load_world

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
import itertools

from hostile_frames import flood, running_server

KEY = "a passphrase of this benchmark"
MAVPROXY = Path(sys.executable).with_name("mavproxy.py")
HEARTBEAT = dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3)


def signed():
    return Signing(key_from_passphrase(KEY), clock=time.time)


def connected(port, kind=socket.SOCK_STREAM):
    connection = socket.socket(socket.AF_INET, kind)
    connection.connect(("127.0.0.1", port))
    return connection


def is_answered(connection, wait_s=1.0):
    return bool(select.select([connection], [], [], wait_s)[0])


@pytest.fixture(scope="module")
def open_server():
    with running_server("--speed", "5") as server:
        yield server


@pytest.fixture(scope="module")
def signing_server():
    with running_server("--speed", "5", signed=True) as server:
        yield server


def test_a_udp_stranger_is_served_after_a_valid_frame_only(open_server):
    frame = Codec(245, 190).encode(HEARTBEAT)
    with connected(open_server.udp, socket.SOCK_DGRAM) as stranger:
        for data in (b"\xfd", b"\xfe", frame[:-1], b"\xfd" * 300):
            stranger.send(data)
        assert not is_answered(stranger)
        stranger.send(frame)
        assert is_answered(stranger, LONG_S)


def test_a_signing_server_serves_no_unsigned_and_no_repeated_frame(signing_server):
    frame = Codec(245, 190, signing=signed()).encode(HEARTBEAT)
    with (
        connected(signing_server.udp, socket.SOCK_DGRAM) as unsigned,
        connected(signing_server.udp, socket.SOCK_DGRAM) as trusted,
        connected(signing_server.udp, socket.SOCK_DGRAM) as replay,
    ):
        unsigned.send(Codec(245, 190).encode(HEARTBEAT))
        unsigned.send(
            Codec(51, 68).encode(dialect.MAVLink_radio_status_message(1, 2, 3, 4, 5, 6, 7))
        )
        assert not is_answered(unsigned)
        trusted.send(frame)
        assert is_answered(trusted, LONG_S)
        replay.send(frame)
        assert not is_answered(replay)


def test_pymavlink_signs_for_the_server(signing_server):
    from pymavlink import mavutil

    link = mavutil.mavlink_connection(f"tcp:127.0.0.1:{signing_server.tcp}", source_system=250)
    link.wait_heartbeat(timeout=LONG_S)  # before signing, which the change to MAVLink 2 forgets
    link.setup_signing(key_from_passphrase(KEY), sign_outgoing=True)
    link.mav.param_request_read_send(1, 1, b"MAV_TYPE", -1)
    found = link.recv_match(type="PARAM_VALUE", blocking=True, timeout=LONG_S)
    assert found.param_id == "MAV_TYPE"
    assert found.get_signed()
    link.close()


@pytest.mark.slow
@pytest.mark.skipif(not MAVPROXY.exists(), reason="needs MAVProxy")
def test_mavproxy_signs_for_the_server(signing_server, tmp_path):
    key = "a" + KEY.replace(" ", "")  # MAVProxy takes a word
    path = tmp_path / "key"
    path.write_text(key)
    with running_server("--key-file", str(path)) as server:
        line = [
            sys.executable, str(MAVPROXY), f"--master=tcp:127.0.0.1:{server.tcp}",
            "--non-interactive", f"--cmd=signing key {key}; param fetch",
            f"--state-basedir={tmp_path}",
        ]  # fmt: skip
        with (tmp_path / "said").open("w") as said:
            proxy = subprocess.Popen(line, stdout=said, stderr=said, stdin=subprocess.DEVNULL)
        deadline_s = time.monotonic() + 2 * LONG_S
        while "parameters" not in (tmp_path / "said").read_text().partition("Received")[2]:
            assert time.monotonic() < deadline_s, (tmp_path / "said").read_text()
            time.sleep(0.2)
        proxy.terminate()
        proxy.wait()


def test_a_wreck_is_told_and_a_reboot_begins_again(open_server):
    with connected(open_server.tcp) as connection:
        pilot = Client(connection)
        pilot.wait_for("HEARTBEAT", lambda m: m.system_status == 3)
        pilot.command(400, 1)
        pilot.command(22)
        pilot.wait_for("EXTENDED_SYS_STATE", lambda m: m.landed_state == 2)
        pilot.command(400, 0, 21196)  # disarm in the air
        pilot.wait_for("STATUSTEXT", lambda m: m.text.startswith("Collision: ground"))
        pilot.wait_for("HEARTBEAT", lambda m: m.system_status == 8)
        pilot.command(246, 1)
        assert pilot.wait_for("COMMAND_ACK", lambda m: m.command == 246).result == 0
        assert pilot.wait_for("LOCAL_POSITION_NED", lambda m: m.time_boot_ms < 2000)
        pilot.wait_for("HEARTBEAT", lambda m: m.system_status == 3)  # ready for a second flight
    assert "Collision: ground" in open_server.said()
    assert "restarted" in open_server.said()


@pytest.mark.slow
def test_telemetry_of_250_hz(open_server):
    with connected(open_server.tcp) as connection:
        client = Client(connection)
        client.wait_for("HEARTBEAT")
        client.command(511, dialect.MAVLINK_MSG_ID_ATTITUDE, 4000)
        client.wait_for("COMMAND_ACK")
        client.messages.clear()
        client.wait_for("HEARTBEAT")
        client.wait_for("HEARTBEAT")
        stamps = [m.time_boot_ms for m in client.messages if m.get_type() == "ATTITUDE"]
        steps = [after - before for before, after in itertools.pairwise(stamps)]
        assert steps.count(4) > 0.9 * len(steps)


@pytest.mark.slow
def test_the_companion_signs_for_the_server(tmp_path, mavfi):
    """A whole flight, and one with another key, which hears no autopilot."""
    port = free_port(socket.SOCK_DGRAM)
    (tmp_path / "other").write_text("another passphrase")
    link = ["--link", f"udpin:127.0.0.1:{port}"]
    vehicle = ("--link", f"onboard=udpout:127.0.0.1:{port}", "--speed", "2")
    with running_server(*vehicle, signed=True) as server:
        east_m, north_m, _ = load_world("farm", seed=3).start_enu_m
        flight = [
            "fly",
            "--goal",
            f"{east_m},{north_m + 9},5",
            *link,
            "--out",
            str(tmp_path),
            "--quiet",
        ]
        refused = mavfi(*flight, "--key-file", str(tmp_path / "other"))
        assert refused.returncode == 1
        assert "no heartbeat" in refused.stderr
        key = server.output.with_name("key")
        flown = mavfi(*flight, "--key-file", str(key), "--expect", "success")
        assert flown.returncode == 0, flown.stdout + flown.stderr


@pytest.mark.slow
def test_the_camera_signs_for_its_client(tmp_path):
    port = free_port(socket.SOCK_DGRAM)
    with running_server(signed=True) as server:
        line = [
            sys.executable, "-m", "sitl.camera", "--world", "farm",
            "--link", f"udpout:127.0.0.1:{server.udp}", "--link", f"udpin:127.0.0.1:{port}",
            "--key-file", str(server.output.with_name("key")),
        ]  # fmt: skip
        with subprocess.Popen(line, stderr=subprocess.PIPE, text=True) as camera:
            try:
                assert "depth camera in farm" in camera.stderr.readline()
                with connected(port, socket.SOCK_DGRAM) as connection:
                    client = Client(connection, signing=signed())
                    client.send(HEARTBEAT)
                    start = dialect.MAV_CMD_IMAGE_START_CAPTURE
                    client.send(
                        dialect.MAVLink_command_long_message(
                            1, 100, start, 0, 0, 0.1, 0, 0, 0, 0, 0
                        )
                    )
                    client.wait_for("CAMERA_IMAGE_CAPTURED")
            finally:
                camera.terminate()


@pytest.mark.slow
@pytest.mark.parametrize(("frames", "of_signers"), [(100_000, False), (30_000, True)])
def test_a_flood_neither_stops_nor_swells_nor_moves_it(frames, of_signers):
    report = flood(frames, signed=of_signers)
    assert report.problems(signed=of_signers) == []
