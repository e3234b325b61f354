"""What no client should send: NaN, values out of range, frames of another size."""

import math

import pytest

from mavfi_cli.link.codec import Codec, dialect
from sitl.autopilot.services import handle


def framed(cls, payload):
    """A frame with a right checksum round any payload."""
    head = bytes([len(payload), 0, 0, 0, 245, 190]) + cls.id.to_bytes(3, "little")
    checksum = dialect.x25crc(head + payload + bytes([cls.crc_extra])).crc
    return b"\xfd" + head + payload + checksum.to_bytes(2, "little")


def test_a_longer_frame_is_read_as_far_as_it_is_known(bench):
    order = dialect.MAVLink_command_long_message(1, 1, 520, 0, 1, 0, 0, 0, 0, 0, 0)
    payload = Codec(245, 190).encode(order)[10:-2].ljust(33, b"\0")
    for extra in (b"", b"\xff" * 7, b"\xff" * 222):
        for message in Codec(1, 1).decode(framed(type(order), payload + extra)):
            handle(bench.autopilot, message, bench.link)
        assert bench.acks() == [(520, 0)]


@pytest.mark.parametrize("length", [0, 1, 27, 29])
def test_a_shorter_frame_ends_in_zeros_and_is_for_nobody(bench, length):
    order = dialect.MAVLink_command_long_message(1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0)
    payload = Codec(245, 190).encode(order)[10:-2][:length]
    (message,) = Codec(1, 1).decode(framed(type(order), payload))
    handle(bench.autopilot, message, bench.link)
    bench.run(5.0)
    assert bench.acks() == []
    assert not bench.commander.armed


def test_nan_moves_no_flying_vehicle(flying, velocity_target):
    north, east, _ = flying.vehicle.position_ned_m
    nan = math.nan
    for number in (179, 192, 178, 511):
        flying.command(number, nan, nan, nan, nan, nan, nan, nan)
    flying.run(3.0, stream=lambda: velocity_target(nan, nan, nan, nan))
    assert abs(flying.vehicle.position_ned_m[0] - north) < 0.5
    assert abs(flying.vehicle.position_ned_m[1] - east) < 0.5
    assert flying.commander.armed


@pytest.mark.parametrize(("value", "kept"), [(math.nan, 12.0), (math.inf, 12.0), (1e9, 1e9)])
def test_a_parameter_out_of_range_never_reaches_the_flight(bench, value, kept):
    """A finite one is stored, as in PX4, but the flight uses it within its limits."""
    bench.send(dialect.MAVLink_param_set_message(1, 1, b"MPC_XY_VEL_MAX", value, 9))
    store = bench.autopilot.parameters
    assert store.value("MPC_XY_VEL_MAX") == kept
    assert 0.1 <= store.effective("MPC_XY_VEL_MAX") <= 20.0
