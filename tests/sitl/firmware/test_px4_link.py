"""PX4's simulator link with traffic that PX4 v1.17.0 has sent."""

from __future__ import annotations

import math
import socket
import time

import numpy as np
import pytest

from mavfi_cli.core.errors import VehicleProcessError
from mavfi_cli.link.codec import Codec, Message, dialect
from mavfi_cli.link.transport import Transport
from sitl.firmware.px4 import ANSWER_LIMIT_S, Px4Link
from sitl.firmware.sensors import FIELD_NED_GAUSS, Sensors
from sitl.vehicle.truth import Truth
from tests.sitl.firmware.recorded import PX4_CONTROLS, PX4_HELLO

Wire = tuple[Transport, socket.socket]


def _sent(theirs: socket.socket) -> list[Message]:
    return Codec(1, 1).decode(theirs.recv(1 << 16))


def _link(wire: Wire) -> tuple[Px4Link, socket.socket]:
    return Px4Link(wire[0], Sensors(1)), wire[1]


def test_px4_is_heard_once_it_has_said_hello(wire: Wire) -> None:
    link, theirs = _link(wire)
    assert not link.has_called(0.0)
    theirs.sendall(PX4_HELLO)
    assert link.has_called(0.0)


def test_motor_outputs_are_those_of_the_armed_frames(wire: Wire, resting: Truth) -> None:
    link, theirs = _link(wire)
    outputs = {}
    for stamp_us, frame in PX4_CONTROLS.items():
        theirs.sendall(frame)
        outputs[stamp_us] = link.exchange(stamp_us, resting)
    assert outputs[10_004_000].tolist() == [0.0] * 4
    assert outputs[11_816_000] == pytest.approx([0.297, 0.3, 0.3, 0.295], abs=0.005)
    assert outputs[15_000_000] == pytest.approx([0.619, 0.62, 0.62, 0.619], abs=0.002)


def test_motor_outputs_that_are_no_numbers_turn_nothing(wire: Wire, resting: Truth) -> None:
    link, theirs = _link(wire)
    outputs = [math.nan, math.inf, -math.inf, 0.5, *[math.nan] * 12]
    frame = dialect.MAVLink_hil_actuator_controls_message(4000, outputs, 0x80, 0)
    theirs.sendall(Codec(1, 1).encode(frame))
    assert link.exchange(4000, resting).tolist() == [0.0, 1.0, 0.0, 0.5]


def test_sensors_have_the_rates_and_fields_that_px4_expects(wire: Wire, resting: Truth) -> None:
    link, theirs = _link(wire)
    sent = []
    for step in range(1, 251):
        link._throttles = np.zeros(4)
        _answer(theirs, link, step * 4000, resting)
        sent += _sent(theirs)
    sensors = [message for message in sent if message.get_type() == "HIL_SENSOR"]
    fixes = [message for message in sent if message.get_type() == "HIL_GPS"]
    assert [message.time_usec for message in sensors] == [4000 * n for n in range(1, 251)]
    assert len(fixes) == 10
    assert sum(bool(message.fields_updated & 0x1C0) for message in sensors) == 50
    assert sum(bool(message.fields_updated & 0x1A00) for message in sensors) == 25
    assert all(message.fields_updated & 0x3F == 0x3F for message in sensors)
    first = sensors[0]
    assert first.zacc == pytest.approx(-9.80665, abs=0.2)
    assert (first.xmag, first.ymag, first.zmag) == pytest.approx(tuple(FIELD_NED_GAUSS), abs=0.01)
    assert first.abs_pressure == pytest.approx(955.7, abs=1.0)
    assert first.pressure_alt == pytest.approx(489.4, abs=2.0)
    assert (fixes[0].lat / 1e7, fixes[0].lon / 1e7) == pytest.approx(
        (47.397742, 8.545594), abs=1e-4
    )
    assert fixes[0].fix_type == 3


def _answer(theirs: socket.socket, link: Px4Link, stamp_us: int, truth: Truth) -> None:
    """Exchange with a PX4 that always answers, with the recorded frame under another stamp."""
    codec = Codec(1, 1)
    [recorded] = codec.decode(PX4_CONTROLS[15_000_000])
    recorded.time_usec = stamp_us
    theirs.sendall(codec.encode(recorded))
    link.exchange(stamp_us, truth)


def test_a_px4_without_a_controller_does_not_stop_the_clock(wire: Wire, resting: Truth) -> None:
    link, theirs = _link(wire)
    _answer(theirs, link, 4000, resting)
    begun_s = time.monotonic()
    for step in range(2, 12):
        link.exchange(step * 4000, resting)
    assert time.monotonic() - begun_s < ANSWER_LIMIT_S + 1.0
    _answer(theirs, link, 48_000, resting)


def test_a_px4_that_has_gone_is_told(wire: Wire, resting: Truth) -> None:
    link, theirs = _link(wire)
    theirs.close()
    with pytest.raises(VehicleProcessError, match="PX4 closed the simulator link"):
        link.exchange(4000, resting)
