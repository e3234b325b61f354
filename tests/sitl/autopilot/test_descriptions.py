"""Messages that PX4 sends on request only, as a client with a newer dialect reads them."""

import struct

import pytest

from mavfi_cli.link.codec import dialect
from sitl.autopilot.commander import FlightMode
from sitl.autopilot.telemetry import STEP_US, TICK_US, Preset


def requested(bench, number, *parameters):
    bench.run(0.02)
    bench.received.clear()
    bench.command(512, number, *parameters)
    return bench.acks()


@pytest.mark.parametrize(
    ("number", "name"),
    [
        (264, "FLIGHT_INFORMATION"),
        (300, "PROTOCOL_VERSION"),
        (397, "COMPONENT_METADATA"),
    ],
)
def test_px4s_descriptions_are_accepted(bench, number, name):
    assert requested(bench, number) == [(512, 0)]
    assert len(bench.take(name)) == 1


@pytest.mark.parametrize("number", [42, 259, 9999])
def test_what_px4_denies_is_denied(bench, number):
    assert requested(bench, number) == [(512, 2)]


def test_modes_are_listed_all_or_one(bench):
    assert requested(bench, 435, 0) == [(512, 0)]
    modes = bench.take("AVAILABLE_MODES")
    assert [mode.mode_index for mode in modes] == list(range(1, 8))
    assert {mode.number_modes for mode in modes} == {7}
    assert [mode.custom_mode for mode in modes] == [mode.custom_mode for mode in FlightMode]
    assert modes[2]._mode_name_raw == b"Takeoff"
    assert requested(bench, 435, 3) == [(512, 0)]
    assert len(bench.take("AVAILABLE_MODES")) == 1
    assert requested(bench, 435, 8) == [(512, 2)]


def test_the_wire_of_a_protocol_version(bench):
    """Fields by their offsets, and the checksum with MAVLink's extra byte."""
    assert requested(bench, 300) == [(512, 0)]
    (message,) = bench.take("PROTOCOL_VERSION")
    frame = bytes(message.get_msgbuf())
    assert struct.unpack_from("<HHH", frame[10:-2].ljust(22, b"\0")) == (200, 100, 200)
    assert int.from_bytes(frame[7:10], "little") == 300
    checksum = dialect.x25crc(frame[1:-2] + bytes([217])).crc
    assert frame[-2:] == checksum.to_bytes(2, "little")


def test_the_capabilities_have_px4s_bit_for_float_parameters(bench):
    assert requested(bench, 148) == [(512, 0)]
    (version,) = bench.take("AUTOPILOT_VERSION")
    assert version.capabilities & dialect.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT


def test_a_stream_may_have_250_hz(make_bench):
    bench = make_bench(Preset.ONBOARD)
    bench.run(1.0)
    bench.command(511, dialect.MAVLINK_MSG_ID_ATTITUDE, 1000)  # 1 kHz is asked
    assert bench.acks() == [(511, 0)]
    assert bench.link.interval_us(dialect.MAVLINK_MSG_ID_ATTITUDE) == STEP_US
    assert bench.link.is_fast
    bench.tick()
    stamps = [
        message.time_boot_ms
        for step in range(1, 5)
        for message in bench.autopilot.collect_between(bench.link, bench.stamp_us + step * STEP_US)
    ]
    assert stamps == [bench.stamp_us // 1000 + 4 * step for step in range(1, 5)]
    bench.command(511, dialect.MAVLINK_MSG_ID_ATTITUDE, 0)
    assert not bench.link.is_fast


def test_in_lockstep_a_tick_is_the_shortest_interval(bench):
    bench.command(511, dialect.MAVLINK_MSG_ID_ATTITUDE, 1000)
    assert bench.link.interval_us(dialect.MAVLINK_MSG_ID_ATTITUDE) == TICK_US
    assert not bench.link.is_fast
