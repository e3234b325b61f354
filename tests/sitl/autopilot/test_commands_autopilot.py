import math

import pytest

from mavfi_cli.link.codec import dialect as d
from sitl.autopilot.telemetry import Preset

NAN = math.nan
REQUEST, SET, GET = (
    d.MAV_CMD_REQUEST_MESSAGE, d.MAV_CMD_SET_MESSAGE_INTERVAL, d.MAV_CMD_GET_MESSAGE_INTERVAL,
)  # fmt: skip
ACCEPTED, DENIED, UNSUPPORTED, FAILED = 0, 2, 3, 4


@pytest.mark.parametrize("number", [148, 242, 49, 0, 1, 30, 32, 33, 24, 147, 331, 245])
def test_requested_message_comes_before_its_ack(bench, number):
    bench.run(4.0)
    bench.received.clear()
    bench.command(REQUEST, number)
    order = [m.get_msgId() for m in bench.link.take()]
    assert order == [number, d.MAVLINK_MSG_ID_COMMAND_ACK]


@pytest.mark.parametrize("number", [259, 9999, -1, NAN, math.inf, 0.5])
def test_unknown_message_is_denied(bench, number):
    bench.command(REQUEST, number)
    assert bench.acks() == [(REQUEST, DENIED)]


def test_home_is_denied_before_it_is_known(bench):
    bench.command(REQUEST, 242)
    bench.command(d.MAV_CMD_GET_HOME_POSITION)
    assert bench.acks() == [(REQUEST, DENIED), (410, DENIED)]


def test_legacy_version_request(bench):
    bench.command(520, 1)
    assert bench.acks() == [(520, ACCEPTED)]
    version = bench.take("AUTOPILOT_VERSION")
    assert version[0].flight_sw_version == 0x011100FF
    assert version[0].capabilities & d.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
    assert not version[0].capabilities & d.MAV_PROTOCOL_CAPABILITY_FTP


@pytest.mark.parametrize("number", [31010, 1000, 16])
def test_unknown_command_is_unsupported(bench, number):
    bench.command(number)
    assert bench.acks() == [(number, UNSUPPORTED)]


@pytest.mark.parametrize(
    ("system", "component", "heard"),
    [(1, 1, True), (1, 0, True), (0, 1, False), (0, 0, False), (2, 1, False), (1, 100, False)],
)
def test_only_what_is_addressed_to_it_is_answered(bench, system, component, heard):
    bench.command(520, 1, system=system, component=component)
    assert bool(bench.acks()) is heard


def test_command_int_works_alike(bench):
    bench.send(d.MAVLink_command_int_message(1, 1, 0, 520, 0, 0, 1, 0, 0, 0, 0, 0, 0))
    bench.send(d.MAVLink_command_int_message(0, 1, 0, 520, 0, 0, 1, 0, 0, 0, 0, 0, 0))
    assert bench.acks() == [(520, ACCEPTED)]


def test_interval_is_set_read_stopped_and_restored(bench):
    def interval():
        bench.command(GET, 30)
        bench.tick()
        return [m.interval_us for m in bench.take("MESSAGE_INTERVAL")]

    assert interval() == [-1]  # known, not streamed on this link
    bench.command(SET, 30, 100_000)
    assert interval() == [100_000]
    bench.run(1.0)
    assert len(bench.take("ATTITUDE")) == 11  # ten, and the one at once
    bench.command(SET, 30, 1000)  # faster than the control loop
    assert interval() == [20_000]
    bench.command(SET, 30, -1)
    assert interval() == [-1]
    bench.command(SET, 32, -1)
    bench.command(SET, 32, 0)
    bench.command(GET, 32)
    bench.tick()
    assert bench.take("MESSAGE_INTERVAL")[-1].interval_us == 20_000


def test_interval_of_the_unknown_fails(bench):
    for number, interval in ((9999, 1e5), (NAN, 1e5), (30, NAN)):
        bench.command(SET, number, interval)
        assert bench.acks() == [(SET, FAILED)]


def test_rates_belong_to_one_client(bench):
    other = bench.autopilot.open_link(Preset.LOCKSTEP)
    bench.command(SET, 30, 100_000)
    assert bench.link.interval_us(30) == 100_000
    assert other.interval_us(30) == 0


def test_answers_go_to_who_asked_and_texts_to_all(bench):
    other = bench.autopilot.open_link(Preset.LOCKSTEP)
    bench.command(d.MAV_CMD_COMPONENT_ARM_DISARM, 1)
    kinds = [m.get_type() for m in other.take()]
    assert set(kinds) == {"STATUSTEXT"}
    assert bench.acks() == [(400, 1)]


def test_home_can_be_moved(bench):
    bench.run(4.5)
    latitude, longitude = bench.autopilot.snapshot.origin.geodetic(12.0, 5.0)
    bench.command(d.MAV_CMD_DO_SET_HOME, 0, 0, 0, 0, latitude, longitude, 489.4)
    assert bench.acks() == [(179, ACCEPTED)]
    home = bench.take("HOME_POSITION")[-1]
    # A float holds degrees to about half a metre here.
    assert [home.x, home.y, home.z] == pytest.approx([12.0, 5.0, 0.0], abs=0.5)
    bench.command(d.MAV_CMD_DO_SET_HOME, 0, 0, 0, 0, NAN, NAN, NAN)
    assert bench.acks() == [(179, DENIED)]


def test_speed_change_is_the_cruise_parameter(flying):
    flying.command(d.MAV_CMD_DO_CHANGE_SPEED, 1, 2.0)
    assert flying.autopilot.parameters.value("MPC_XY_CRUISE") == 2.0
    flying.command(d.MAV_CMD_DO_CHANGE_SPEED, 1, NAN)
    assert flying.acks() == [(178, ACCEPTED), (178, DENIED)]


def test_termination_by_command(flying):
    flying.command(d.MAV_CMD_DO_FLIGHTTERMINATION, 1)
    flying.run(0.1)
    assert not flying.autopilot.snapshot.motors_on
