"""ArduPilot's JSON backend with frames that ArduCopter 4.5 has sent, and the state in return."""

from __future__ import annotations

import json
import re
import socket
import struct
from collections.abc import Iterator

import numpy as np
import pytest

from mavfi_cli.core.errors import VehicleProcessError
from sitl.firmware import ardupilot
from sitl.firmware.ardupilot import ArduPilotLink
from sitl.firmware.sensors import Sensors
from sitl.vehicle.truth import T_POSITION, T_QUATERNION, TRUTH_SIZE, Truth
from tests.sitl.firmware.recorded import ARDUPILOT_CLIMB, ARDUPILOT_FIRST

MAGIC = 18458


def frame(number: int, *pulses_us: int, magic: int = MAGIC) -> bytes:
    """A servo frame: magic, rate, number, sixteen pulse widths."""
    return struct.pack("<HHI16H", magic, 1200, number, *pulses_us, *[1000] * (16 - len(pulses_us)))


class ArduPilot:
    """ArduPilot's end: sends servo frames to the link, and receives states."""

    def __init__(self, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.settimeout(2.0)
        self._port = port

    def send(self, data: bytes) -> None:
        self._socket.sendto(data, ("127.0.0.1", self._port))

    def state(self) -> bytes:
        return self._socket.recv(1 << 16)

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def ends() -> Iterator[tuple[ArduPilotLink, ArduPilot]]:
    link = ArduPilotLink(Sensors(1), 0)
    firmware = ArduPilot(link.port)
    yield link, firmware
    firmware.close()
    link.close()


def test_it_is_heard_once_it_sends_its_outputs(ends: tuple[ArduPilotLink, ArduPilot]) -> None:
    link, firmware = ends
    assert not link.has_called(0.01)
    firmware.send(frame(0, 1000, 1000, 1000, 1000))
    assert link.has_called(2.0)


def test_pulses_are_throttles(ends: tuple[ArduPilotLink, ArduPilot], resting: Truth) -> None:
    link, firmware = ends
    firmware.send(frame(0))
    assert link.has_called(2.0)
    firmware.send(frame(1, 1000, 1250, 1500, 2100))
    assert link.exchange(2500, resting).tolist() == [0.0, 0.25, 0.5, 1.0]


def test_recorded_frames_are_answers_in_their_order(
    ends: tuple[ArduPilotLink, ArduPilot], resting: Truth
) -> None:
    link, firmware = ends
    firmware.send(ARDUPILOT_FIRST[0])
    assert link.has_called(2.0)
    outputs = []
    for data in (ARDUPILOT_FIRST[1], *ARDUPILOT_CLIMB):
        firmware.send(data)
        outputs.append(link.exchange(2500, resting).tolist())
    assert outputs == [
        [0.0, 0.0, 0.0, 0.0],
        [0.582, 0.583, 0.582, 0.582],
        [0.582, 0.583, 0.582, 0.583],
    ]


def test_a_repeated_frame_is_no_answer(
    ends: tuple[ArduPilotLink, ArduPilot], resting: Truth
) -> None:
    """ArduPilot repeats its outputs once a second while it gets no state."""
    link, firmware = ends
    for data in (frame(0), frame(0), frame(0)):
        firmware.send(data)
    assert link.has_called(2.0)
    firmware.send(frame(1, 1500))
    assert link.exchange(2500, resting)[0] == 0.5


def test_other_datagrams_are_ignored(ends: tuple[ArduPilotLink, ArduPilot], resting: Truth) -> None:
    link, firmware = ends
    firmware.send(frame(0))
    assert link.has_called(2.0)
    for data in (b"", b"hello", frame(1, 1900)[:-1], frame(1, 1900, magic=29569)):
        firmware.send(data)
    firmware.send(frame(1, 1500))
    assert link.exchange(2500, resting)[0] == 0.5


def test_the_state_is_what_its_parser_reads(ends: tuple[ArduPilotLink, ArduPilot]) -> None:
    flat = np.zeros(TRUTH_SIZE)
    flat[T_POSITION : T_POSITION + 3] = (3.0, -4.0, -5.0)
    flat[T_QUATERNION : T_QUATERNION + 4] = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))
    link, firmware = ends
    firmware.send(frame(0))
    assert link.has_called(2.0)
    firmware.send(frame(1))
    link.exchange(1_002_500, Truth(flat))
    text = firmware.state()
    assert text.startswith(b"\n{")
    assert text.endswith(b"}\n")
    assert not re.search(rb'":\s', text)  # its parser counts characters after a key
    state = json.loads(text)
    assert state["timestamp"] == pytest.approx(1.0025)
    assert state["position"] == [3.0, -4.0, -5.0]
    assert state["attitude"] == pytest.approx([0.0, 0.0, np.pi / 2.0])
    assert state["imu"]["accel_body"] == pytest.approx([0.0, 0.0, -9.80665], abs=0.2)
    assert state["no_time_sync"] == 1


def test_an_ardupilot_that_stops_is_told(
    ends: tuple[ArduPilotLink, ArduPilot], resting: Truth, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ardupilot, "ANSWER_LIMIT_S", 0.05)
    link, firmware = ends
    firmware.send(frame(0))
    assert link.has_called(2.0)
    with pytest.raises(VehicleProcessError, match="sent no outputs"):
        link.exchange(2500, resting)
