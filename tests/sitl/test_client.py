"""Clients of one simulation over links in memory: who gets the camera's frames."""

import contextlib
import dataclasses
import socket

import pytest

from mavfi_cli.link.codec import Codec, dialect
from mavfi_cli.link.transport import memory_pair
from sitl import server
from sitl.autopilot.telemetry import Preset
from sitl.options import parse
from sitl.server import Client
from sitl.simulation import Simulation
from sitl.vehicle.profile import load_profile
from sitl.world import load_world


@pytest.fixture
def simulation():
    return Simulation(load_world("farm", seed=3), load_profile("solo"), logs=False)


@pytest.fixture
def connect(simulation):
    """Return a client's end of a new link, which asks for frames at an interval."""

    def start_capture(interval_s):
        far, end = memory_pair("memory")
        client, codec = Client(simulation, end, preset=Preset.GCS), Codec(245, 190)
        parameters = (0.0, interval_s, 0.0, 0.0, 0.0, 0.0, 0.0)
        command = dialect.MAV_CMD_IMAGE_START_CAPTURE
        order = dialect.MAVLink_command_long_message(1, 100, command, 0, *parameters)
        far.send(codec.encode(order))
        client.receive(0.0)
        return client, lambda: [m.get_type() for m in codec.decode(far.receive(0.0))]

    return start_capture


def test_frames_go_to_those_whose_capture_was_accepted(simulation, connect):
    asking, asked = connect(0.1)
    denied, refused = connect(-1.0)
    simulation.advance()
    for client in (asking, denied):
        client.send_tick()
    assert "CAMERA_IMAGE_CAPTURED" in asked()
    heard = refused()
    assert "COMMAND_ACK" in heard
    assert "CAMERA_IMAGE_CAPTURED" not in heard


def test_a_server_that_is_always_late_serves_every_client(simulation, free_port, monkeypatch):
    """No tick has time for more than one client, and the answer to a reboot is not lost."""
    monkeypatch.setattr(server, "_SHARE", 0.0)
    link = (Preset.GCS, f"tcpin:127.0.0.1:{free_port}")
    options = dataclasses.replace(parse([]), links=[link], speed=1e9)
    realtime = server._Realtime(options, simulation)
    calls, codec = iter(range(400)), Codec(245, 190)
    with contextlib.closing(realtime), contextlib.ExitStack() as stack:
        address = ("127.0.0.1", free_port)
        clients = [stack.enter_context(socket.create_connection(address)) for _ in range(4)]
        command = dialect.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN
        for client in clients:
            order = dialect.MAVLink_command_long_message(1, 1, command, 0, 1, *[0.0] * 6)
            client.sendall(codec.encode(order))
        realtime.run(lambda: next(calls, None) is None)
        for client in clients:
            kinds = {m.get_type() for m in codec.decode(client.recv(1 << 20))}
            assert kinds >= {"COMMAND_ACK", "ATTITUDE"}
