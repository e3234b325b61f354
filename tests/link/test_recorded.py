"""What goes through a link is in its tlog, in the order in which it went."""

import socket

import pytest
from pymavlink import mavutil

from mavfi_cli.link.codec import Codec, dialect
from mavfi_cli.link.tlog import EPOCH_UNIX_S, RecordedLink
from mavfi_cli.link.transport import open_transport

OWN, VEHICLE = 191, 1


def position(number):
    return dialect.MAVLink_local_position_ned_message(20 * number, 1, 2, -3, 0, 0, 0)


@pytest.fixture
def ends():
    """The link under test, and the socket and codec of the vehicle at its other end."""
    ours, theirs = socket.socketpair()
    transport = open_transport(f"fd:{ours.detach()}")
    with theirs:
        yield RecordedLink(transport, 1, OWN), theirs, Codec(1, VEHICLE)
    transport.close()


def told(path):
    """Stamp in s, component and time_boot_ms of every record, as pymavlink reads them."""
    log = mavutil.mavlink_connection(str(path))
    found = []
    while (message := log.recv_match()) is not None:
        stamp_s = round(message._timestamp - EPOCH_UNIX_S, 6)
        found.append((stamp_s, message.get_srcComponent(), message.time_boot_ms))
    log.close()
    return found


def exchange(ends, number):
    link, vehicle, codec = ends
    vehicle.sendall(codec.encode(position(2 * number)))
    came = [each.time_boot_ms for each in link.messages(link.receive(5.0), float(number))]
    link.send([position(2 * number + 1)], number + 0.5)
    assert came == [40 * number]
    assert [each.time_boot_ms for each in codec.decode(vehicle.recv(4096))] == [40 * number + 20]


def records(number):
    return [(float(number), VEHICLE, 40 * number), (number + 0.5, OWN, 40 * number + 20)]


def test_both_directions_are_recorded_and_what_came_early_comes_first(ends, tmp_path):
    exchange(ends, 0)
    with ends[0].recording(tmp_path / "flight.tlog"):
        exchange(ends, 1)
    assert told(tmp_path / "flight.tlog") == records(0) + records(1)


def test_a_clock_is_recorded_in_place_of_the_stamps(tmp_path):
    ours, theirs = socket.socketpair()
    transport = open_transport(f"fd:{ours.detach()}")
    clock = iter([1.7e9, 1.7e9 + 0.25, 1.7e9 + 0.5, 1.7e9 + 7.125]).__next__
    link = RecordedLink(transport, 1, OWN, clock=clock)
    with theirs:
        exchange((link, theirs, Codec(1, VEHICLE)), 0)
        with link.recording(tmp_path / "flight.tlog"):
            exchange((link, theirs, Codec(1, VEHICLE)), 1)
    transport.close()
    stamps = [EPOCH_UNIX_S + stamp_s for stamp_s, *_ in told(tmp_path / "flight.tlog")]
    assert stamps == [1.7e9, 1.7e9 + 0.25, 1.7e9 + 0.5, 1.7e9 + 7.125]
