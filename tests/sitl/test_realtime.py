"""The stand-alone server over real sockets: several clients, strangers, signing, the end."""

import contextlib
import json
import signal
import socket
import subprocess
import sys
import time

import pytest

from mavfi_cli.link.codec import Codec, Signing, dialect, key_from_passphrase

LONG_S = 30.0


class Client:
    """A MAVLink client on any connected socket."""

    def __init__(self, connection, *, system=245, signing=None):
        connection.settimeout(LONG_S)
        self.socket = connection
        self._out = Codec(system, 190, signing=signing)
        self._in = Codec(system, 190, signing=signing)
        self.messages = []

    def send(self, message):
        self.socket.sendall(self._out.encode(message))

    def command(self, number, *parameters):
        given = [*parameters, *([float("nan")] * (7 - len(parameters)))]
        self.send(dialect.MAVLink_command_long_message(1, 1, number, 0, *given))

    def wait_for(self, kind, accept=lambda _message: True):
        deadline = time.monotonic() + LONG_S
        while time.monotonic() < deadline:
            found = self._in.decode(self.socket.recv(1 << 16))
            self.messages += found
            for message in found:
                if message.get_type() == kind and accept(message):
                    return message
        raise AssertionError(f"no {kind}")


def free_port(kind):
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture
def serve():
    with contextlib.ExitStack() as stack:

        def start(*arguments):
            process = subprocess.Popen(
                [sys.executable, "-m", "sitl", "--world", "farm", "--speed", "5", *arguments],
                stderr=subprocess.PIPE, text=True,
            )  # fmt: skip
            stack.callback(process.stderr.close)
            stack.callback(process.wait)
            stack.callback(process.kill)
            said = ""
            while "Ctrl-C" not in said:
                line = process.stderr.readline()
                assert line, said
                said += line
            process.said = said
            return process

        yield start


@pytest.fixture
def dial():
    with contextlib.ExitStack() as stack:

        def connect(port, kind=socket.SOCK_STREAM, **how):
            connection = stack.enter_context(socket.socket(socket.AF_INET, kind))
            connection.connect(("127.0.0.1", port))
            return Client(connection, **how)

        yield connect


def interrupt(process):
    process.send_signal(signal.SIGINT)
    assert process.wait(LONG_S) == 0
    assert process.stderr.read() == ""


@pytest.mark.slow
def test_several_clients_each_with_own_streams_and_answers(serve, dial):
    tcp, udp = free_port(socket.SOCK_STREAM), free_port(socket.SOCK_DGRAM)
    process = serve("--link", f"tcpin:127.0.0.1:{tcp}", "--link", f"udpin:127.0.0.1:{udp}")
    first, second = dial(tcp), dial(tcp, system=246)
    third = dial(udp, socket.SOCK_DGRAM, system=247)
    third.send(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3))
    clients = (first, second, third)
    for client in clients:
        client.wait_for("HEARTBEAT", lambda m: m.get_srcComponent() == 1)
    # One asks for more, and is answered; the others see nothing of it.
    first.command(511, dialect.MAVLINK_MSG_ID_ODOMETRY, 20_000)
    assert first.wait_for("COMMAND_ACK").target_system == 245
    first.wait_for("ODOMETRY")
    second.command(520, 1)
    assert second.wait_for("COMMAND_ACK").target_system == 246
    second.wait_for("HEARTBEAT")
    assert not [m for m in second.messages if m.get_type() == "ODOMETRY"]
    # What one does, all see.
    third.wait_for("HEARTBEAT", lambda m: m.system_status == 3)
    third.command(400, 1)
    assert third.wait_for("COMMAND_ACK").result == 0
    for client in clients:
        client.wait_for("HEARTBEAT", lambda m: m.base_mode & 128)
    first.socket.close()  # one leaves, the others stay
    second.wait_for("HEARTBEAT", lambda m: not m.base_mode & 128)  # disarmed after 10 s
    interrupt(process)


def test_the_ways_to_an_endpoint_are_told_for_any_form_of_its_url(serve):
    port = free_port(socket.SOCK_DGRAM)
    process = serve("--link", f"udp://127.0.0.1:{port}")
    assert f"MAVSDK    udpout://127.0.0.1:{port}\n" in process.said
    assert f"MAVProxy  --master=udpout:127.0.0.1:{port}\n" in process.said
    interrupt(process)


def test_what_one_client_tells_people_goes_to_all_others_as_it_is(serve, dial):
    tcp = free_port(socket.SOCK_STREAM)
    process = serve("--link", f"tcpin:127.0.0.1:{tcp}")
    companion, ground = dial(tcp, system=1), dial(tcp, system=255)
    for client in (companion, ground):
        client.wait_for("HEARTBEAT")
    companion.send(dialect.MAVLink_statustext_message(4, b"aad alarm in control"))
    heard = ground.wait_for("STATUSTEXT", lambda m: "alarm" in m.text)
    assert (heard.get_srcSystem(), heard.get_srcComponent()) == (1, 190)
    assert (heard.severity, heard.text) == (4, "aad alarm in control")
    companion.wait_for("HEARTBEAT")
    assert not [m for m in companion.messages if m.get_type() == "STATUSTEXT" and "alarm" in m.text]
    interrupt(process)


@pytest.mark.slow
def test_hostile_bytes_do_not_stop_it(serve, dial):
    tcp, udp = free_port(socket.SOCK_STREAM), free_port(socket.SOCK_DGRAM)
    process = serve("--link", f"tcpin:127.0.0.1:{tcp}", "--link", f"udpin:127.0.0.1:{udp}")
    stranger = dial(udp, socket.SOCK_DGRAM)
    for data in (b"", b"\xfd", b"\xfd\xff\xff" + b"\xff" * 300, b"GET / HTTP/1.1\r\n\r\n", b"\0"):
        stranger.socket.send(data)
    rude = dial(tcp)
    rude.socket.sendall(b"\xfd\x00\xfe" * 50_000)
    honest = dial(tcp)
    honest.command(520, 1)
    assert honest.wait_for("COMMAND_ACK").result == 0
    honest.wait_for("HEARTBEAT")
    interrupt(process)


def test_timesync_is_answered_between_ticks(serve, dial):
    tcp = free_port(socket.SOCK_STREAM)
    process = serve("--speed", "1", "--link", f"tcpin:127.0.0.1:{tcp}")
    client = dial(tcp)
    client.wait_for("HEARTBEAT")
    waits = []
    for number in range(20):
        sent = time.monotonic()
        client.send(dialect.MAVLink_timesync_message(0, number + 1))
        client.wait_for("TIMESYNC", lambda m, n=number: m.tc1 and m.ts1 == n + 1)
        waits.append(time.monotonic() - sent)
    assert sorted(waits)[len(waits) // 2] < 0.015  # a tick is 20 ms
    interrupt(process)


def test_signed_link_hears_only_who_signs(serve, dial, tmp_path):
    secret = tmp_path / "passphrase"
    secret.write_text("correct horse\n")
    tcp = free_port(socket.SOCK_STREAM)
    process = serve("--key-file", str(secret), "--link", f"tcpin:127.0.0.1:{tcp}")
    key = key_from_passphrase("correct horse")
    trusted = dial(tcp, signing=Signing(key, clock=time.time))
    stranger = dial(tcp)
    stranger.command(520, 1)
    trusted.command(520, 1)
    assert trusted.wait_for("COMMAND_ACK").result == 0
    stranger.wait_for("HEARTBEAT")
    assert not [m for m in stranger.messages if m.get_type() == "COMMAND_ACK"]
    interrupt(process)


def test_inherited_connection_in_real_time_ends_with_it(tmp_path):
    ours, theirs = socket.socketpair()
    process = subprocess.Popen(
        [sys.executable, "-m", "sitl", "--world", "farm", "--speed", "5",
         "--truth", str(tmp_path), "--fd", str(theirs.fileno())],
        pass_fds=[theirs.fileno()], stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    theirs.close()
    with ours, process:
        Client(ours).wait_for("HEARTBEAT")
        ours.close()
        assert process.wait(LONG_S) == 0
    assert json.loads((tmp_path / "truth.json").read_text())["collision"] is None
