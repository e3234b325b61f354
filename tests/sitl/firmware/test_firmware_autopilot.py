"""The MAVLink side of a real firmware: what passes between it and the clients."""

from __future__ import annotations

import math
import socket

import pytest
from pymavlink.dialects.v20 import ardupilotmega

from mavfi_cli.core.errors import VehicleProcessError
from mavfi_cli.link import codec
from mavfi_cli.link.codec import Codec, Message, dialect
from mavfi_cli.link.transport import Transport
from sitl.autopilot.telemetry import Preset
from sitl.firmware.autopilot import FirmwareAutopilot
from sitl.vehicle.truth import Truth
from tests.sitl.firmware.recorded import PX4_HEARTBEAT, PX4_POSITION

Wire = tuple[Transport, socket.socket]


@pytest.fixture
def wired(wire: Wire) -> tuple[FirmwareAutopilot, socket.socket]:
    return FirmwareAutopilot(wire[0], echoes=False), wire[1]


def _heard(theirs: socket.socket) -> list[Message]:
    return Codec(1, 1).decode(theirs.recv(1 << 16))


def test_its_messages_reach_every_client(
    wired: tuple[FirmwareAutopilot, socket.socket], resting: Truth
) -> None:
    autopilot, theirs = wired
    links = [autopilot.open_link(preset) for preset in (Preset.GCS, Preset.LOCKSTEP)]
    theirs.sendall(PX4_HEARTBEAT + PX4_POSITION)
    autopilot.observe(20_000, resting)
    for link in links:
        kinds = [message.get_type() for message in autopilot.collect(link)]
        assert kinds == ["HEARTBEAT", "LOCAL_POSITION_NED"]
        assert autopilot.collect(link) == []
    assert autopilot.state_stamp_us == 14_004_000


def test_messages_that_only_ardupilot_has_pass_both_ways(
    wired: tuple[FirmwareAutopilot, socket.socket],
    resting: Truth,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(codec, "ADDED", codec.ADDED.copy())
    monkeypatch.setattr(codec, "_KINDS", codec._KINDS.copy())
    Codec.add_ardupilot()
    autopilot, theirs = wired
    link = autopilot.open_link(Preset.ONBOARD)
    sender = ardupilotmega.MAVLink(None, srcSystem=1, srcComponent=1)
    report = ardupilotmega.MAVLink_ekf_status_report_message(831, 0.1, 0.2, 0.3, 0.4, 0.5)
    theirs.sendall(PX4_HEARTBEAT + report.pack(sender))
    autopilot.observe(20_000, resting)
    told = autopilot.collect(link)[-1]
    assert (told.get_type(), told.flags) == ("EKF_STATUS_REPORT", 831)
    _heard(theirs)
    wish = ardupilotmega.MAVLink_autopilot_version_request_message(1, 1)
    (heard,) = Codec(0, 0).decode(wish.pack(ardupilotmega.MAVLink(None, 255, 190)))
    autopilot.handle(heard, link)
    autopilot.deliver()
    (passed,) = _heard(theirs)
    assert (passed.get_type(), passed.get_srcSystem()) == ("AUTOPILOT_VERSION_REQUEST", 255)


@pytest.mark.parametrize("stranger", [(1, 190), (7, 1)])
def test_a_stranger_on_its_link_tells_neither_position_nor_mode(
    wired: tuple[FirmwareAutopilot, socket.socket], resting: Truth, stranger: tuple[int, int]
) -> None:
    autopilot, theirs = wired
    (heartbeat,) = Codec(1, 1).decode(PX4_HEARTBEAT)
    (position,) = Codec(1, 1).decode(PX4_POSITION)
    heartbeat.custom_mode = 6 << 16
    codec = Codec(*stranger)
    theirs.sendall(codec.encode(heartbeat) + codec.encode(position))
    autopilot.observe(20_000, resting)
    assert (autopilot.state_stamp_us, autopilot.may_touch_ground) == (-1, True)


def test_its_origin_is_that_of_the_world(
    wired: tuple[FirmwareAutopilot, socket.socket], resting: Truth
) -> None:
    autopilot, theirs = wired
    theirs.sendall(PX4_HEARTBEAT)
    autopilot.observe(20_000, resting)
    origin, *requests = _heard(theirs)
    assert origin.get_type() == "SET_GPS_GLOBAL_ORIGIN"
    assert (origin.latitude, origin.longitude) == (473977420, 85455940)
    assert origin.altitude == 489_400
    assert {request.command for request in requests} == {dialect.MAV_CMD_SET_MESSAGE_INTERVAL}
    assert 32 in {int(request.param1) for request in requests}


def test_it_is_asked_until_positions_arrive(
    wired: tuple[FirmwareAutopilot, socket.socket], resting: Truth
) -> None:
    autopilot, theirs = wired
    for frame in (PX4_HEARTBEAT, PX4_HEARTBEAT, PX4_POSITION, PX4_HEARTBEAT):
        theirs.sendall(frame)
        autopilot.observe(20_000, resting)
    asked = [message.get_type() for message in _heard(theirs)]
    assert asked.count("SET_GPS_GLOBAL_ORIGIN") == 3
    theirs.sendall(PX4_HEARTBEAT)
    autopilot.observe(40_000, resting)
    with pytest.raises(BlockingIOError):
        theirs.recv(1)


def test_a_client_speaks_under_its_own_ids(
    wired: tuple[FirmwareAutopilot, socket.socket], resting: Truth
) -> None:
    autopilot, theirs = wired
    link = autopilot.open_link(Preset.ONBOARD)
    codec = Codec(245, 190)
    [command] = codec.decode(
        codec.encode(dialect.MAVLink_command_long_message(1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0))
    )
    autopilot.handle(command, link)
    autopilot.deliver()
    [heard] = _heard(theirs)
    assert (heard.get_srcSystem(), heard.get_srcComponent()) == (245, 190)
    assert (heard.command, heard.param1) == (400, 1.0)


def _target(mask: int, *place_and_velocity: float) -> bytes:
    """Return a frame of PX4's POSITION_TARGET_LOCAL_NED."""
    rest = 0.0, 0.0, 0.0, 0.0, 0.0
    message = dialect.MAVLink_position_target_local_ned_message(
        20, 1, mask, *place_and_velocity, *rest
    )
    return Codec(1, 1).encode(message)


@pytest.mark.parametrize(
    ("target", "lands"),
    [
        (_target(63, *[math.nan] * 6), False),
        (_target(7, *[math.nan] * 3, 0.0, 0.0, 1.0), True),
        (_target(7, *[math.nan] * 3, 0.0, 0.4, 1.0), False),
        (_target(7, *[0.0] * 3, 0.0, 0.0, 0.0), False),
        (_target(56, 4.3, 2.0, 0.0, 0.0, 0.0, 0.0), True),
        (_target(56, 4.6, 2.0, 0.0, 0.0, 0.0, 0.0), False),
        (_target(59, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), False),
    ],
)
def test_a_gentle_touchdown_counts_as_a_landing_unless_a_companion_flies_on(
    wired: tuple[FirmwareAutopilot, socket.socket], resting: Truth, target: bytes, *, lands: bool
) -> None:
    autopilot, theirs = wired
    theirs.sendall(PX4_HEARTBEAT)  # in AUTO.TAKEOFF
    autopilot.observe(20_000, resting)
    assert autopilot.may_touch_ground
    place = dialect.MAVLink_local_position_ned_message(20, 4.0, 2.0, -0.3, 0.0, 0.0, 0.0)
    offboard = dialect.MAVLink_heartbeat_message(2, 12, 0x91, 6 << 16, 4, 3)
    theirs.sendall(b"".join(map(Codec(1, 1).encode, (place, offboard))))
    autopilot.observe(40_000, resting)
    assert not autopilot.may_touch_ground
    theirs.sendall(target)
    autopilot.observe(60_000, resting)
    assert autopilot.may_touch_ground is lands


def test_a_collision_is_told_once_and_for_good(
    wired: tuple[FirmwareAutopilot, socket.socket],
) -> None:
    autopilot, _ = wired
    link = autopilot.open_link(Preset.LOCKSTEP)
    autopilot.terminate("Collision: box 3 at 1.0 2.0 3.0")
    autopilot.terminate("Collision: ground at 1.0 2.0 0.0")
    [text] = autopilot.collect(link)
    assert text.text == "Collision: box 3 at 1.0 2.0 3.0"
    assert autopilot.terminated


def test_a_silent_firmware_is_told(
    wired: tuple[FirmwareAutopilot, socket.socket], resting: Truth
) -> None:
    autopilot, theirs = wired
    theirs.sendall(PX4_HEARTBEAT)
    autopilot.observe(20_000, resting)
    autopilot.observe(60_000_000, resting)
    with pytest.raises(VehicleProcessError, match="sent no MAVLink for 60 s"):
        autopilot.observe(60_100_000, resting)


def test_an_echo_proves_that_a_frame_was_read(wire: Wire) -> None:
    transport, theirs = wire
    autopilot = FirmwareAutopilot(transport)
    link = autopilot.open_link(Preset.LOCKSTEP)
    codec = Codec(1, 1)
    # The answer to the first question, which lies ready: `deliver` must find it.
    theirs.sendall(codec.encode(dialect.MAVLink_timesync_message(14_000_000_000, 1)))
    [text] = codec.decode(codec.encode(dialect.MAVLink_statustext_message(6, b"hello")))
    autopilot.handle(text, link)
    autopilot.deliver()
    assert [message.get_type() for message in _heard(theirs)] == ["STATUSTEXT", "TIMESYNC"]
    assert autopilot.collect(link) == []
