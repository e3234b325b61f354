"""Arming, modes, failsafe: what a PX4 v1.17 was seen to do (facts of its wire behaviour)."""

import struct

import pytest

from mavfi_cli.link.codec import dialect
from sitl.autopilot.commander import FlightMode, Result

ARM = dialect.MAV_CMD_COMPONENT_ARM_DISARM
MODE = dialect.MAV_CMD_DO_SET_MODE
PREARM = 1 << 28
OFFBOARD = (1, 6, 0)
DENIED = (2, "Arming denied: Resolve system health failures first")


def prearm(bench):
    bench.run(1.1)
    return bool(bench.take("SYS_STATUS")[-1].onboard_control_sensors_health & PREARM)


def test_boots_into_loiter_and_becomes_ready(bench):
    assert bench.mode is FlightMode.LOITER
    assert bench.commander.system_status == dialect.MAV_STATE_UNINIT
    bench.command(ARM, 1)
    assert bench.acks() == [(ARM, Result.TEMPORARILY_REJECTED)]
    assert bench.texts() == [DENIED]
    assert not prearm(bench)
    bench.run(4.0)
    assert bench.commander.system_status == dialect.MAV_STATE_STANDBY
    assert prearm(bench)


def test_gps_and_home_come_with_the_first_fix(bench):
    bench.run(2.4)
    status = bench.take("SYS_STATUS")[-1]
    assert not status.onboard_control_sensors_present & 0x20
    assert not bench.take("HOME_POSITION")
    bench.run(0.2)
    home = bench.take("HOME_POSITION")
    assert len(home) == 1
    assert home[0].z == pytest.approx(-0.1)
    bench.run(1.1)
    status = bench.take("SYS_STATUS")[-1]
    both = status.onboard_control_sensors_present & status.onboard_control_sensors_health
    assert both & 0x20


def test_arms_once_ready_and_again_without_words(bench):
    bench.run(4.5)
    bench.command(ARM, 1)
    assert bench.acks() == [(ARM, Result.ACCEPTED)]
    assert bench.texts() == [(6, "Armed by external command")]
    bench.command(ARM, 1)
    assert bench.acks() == [(ARM, Result.ACCEPTED)]
    assert bench.texts() == []


def test_disarms_by_itself_when_it_does_not_take_off(bench):
    bench.run(4.5)
    bench.command(ARM, 1)
    bench.run(9.9)
    assert bench.commander.armed
    bench.run(0.2)
    assert not bench.commander.armed
    assert bench.texts()[-1] == (6, "Disarmed by auto preflight disarming")


def test_unknown_arm_parameter_gets_words_and_no_ack(bench):
    bench.run(4.5)
    bench.command(ARM, 2)
    assert bench.acks() == []
    assert bench.texts() == [(2, "Unsupported ARM_DISARM param")]


def test_disarming_in_the_air_is_refused_unless_forced(flying):
    flying.command(ARM, 0)
    assert flying.acks() == [(ARM, Result.TEMPORARILY_REJECTED)]
    assert flying.texts() == [(2, "Disarming denied: not landed")]
    assert flying.commander.armed
    flying.command(ARM, 0, 21196)
    assert flying.acks() == [(ARM, Result.ACCEPTED)]
    assert not flying.commander.armed


def test_offboard_on_the_ground_needs_setpoints_to_arm(bench, velocity_target):
    bench.run(4.5)
    bench.command(MODE, *OFFBOARD)
    assert bench.acks() == [(MODE, Result.ACCEPTED), (MODE, Result.ACCEPTED)]
    assert bench.mode is FlightMode.OFFBOARD
    assert bench.commander.system_status == dialect.MAV_STATE_UNINIT
    assert not prearm(bench)
    bench.command(ARM, 1)
    assert bench.acks() == [(ARM, Result.TEMPORARILY_REJECTED)]
    assert bench.texts() == [DENIED]
    bench.run(1.5, velocity_target)
    bench.command(ARM, 1)
    assert bench.acks() == [(ARM, Result.ACCEPTED)]


def test_offboard_in_the_air_without_setpoints_is_accepted_first_and_then_refused(flying):
    flying.command(MODE, *OFFBOARD)
    assert flying.acks() == [(MODE, Result.ACCEPTED), (MODE, Result.TEMPORARILY_REJECTED)]
    assert flying.texts() == [(2, "Switching to Offboard is currently not available")]
    assert flying.mode is FlightMode.LOITER


@pytest.mark.parametrize("parameters", [(1, 77, 0), (0, 6, 0), (1, 4, 99)])
def test_impossible_mode_is_accepted_first_too(flying, parameters):
    flying.command(MODE, *parameters)
    assert flying.acks() == [(MODE, Result.ACCEPTED), (MODE, Result.TEMPORARILY_REJECTED)]
    assert flying.mode is FlightMode.LOITER


def test_set_mode_message_is_answered_once(flying):
    flying.send(dialect.MAVLink_set_mode_message(1, 1, FlightMode.LAND.custom_mode))
    assert flying.acks() == [(MODE, Result.ACCEPTED)]
    assert flying.mode is FlightMode.LAND


def test_guided_enable_enters_offboard_and_goes_back_as_px4_up_to_v1_13_does(
    flying, velocity_target
):
    guided = dialect.MAV_CMD_NAV_GUIDED_ENABLE
    flying.command(guided, 1)
    assert flying.acks() == [(guided, Result.TEMPORARILY_REJECTED)]  # there are no setpoints
    flying.run(0.5, velocity_target)
    for value, mode in ((1, FlightMode.OFFBOARD), (1, FlightMode.OFFBOARD), (0, FlightMode.LOITER)):
        flying.command(guided, value)
        assert flying.acks() == [(guided, Result.ACCEPTED)]
        assert flying.mode is mode


@pytest.fixture
def offboard(flying, velocity_target):
    flying.run(0.5, velocity_target)
    flying.command(MODE, *OFFBOARD)
    flying.run(0.5, velocity_target)
    assert flying.mode is FlightMode.OFFBOARD
    flying.received.clear()
    return flying


def test_losing_the_stream_triggers_return_after_its_time(offboard):
    offboard.run(0.96)
    assert offboard.mode is FlightMode.OFFBOARD
    offboard.run(0.1)
    assert offboard.mode is FlightMode.RTL
    assert offboard.commander.system_status == dialect.MAV_STATE_CRITICAL
    texts = offboard.texts()
    assert texts[0] == (2, "Failsafe activated")
    assert texts[1][1].startswith("RTL: start return at ")
    assert texts[1][1].endswith("m above destination)")


def test_stream_that_returns_gives_offboard_back(offboard, velocity_target):
    offboard.run(1.5)
    assert offboard.mode is FlightMode.RTL
    offboard.run(0.5, velocity_target)
    assert offboard.mode is FlightMode.RTL
    offboard.run(1.5, velocity_target)
    assert offboard.mode is FlightMode.OFFBOARD
    assert offboard.commander.system_status == dialect.MAV_STATE_ACTIVE


def test_one_setpoint_a_second_is_just_enough(offboard, velocity_target):
    offboard.run(10.0, velocity_target, every=50)
    assert set(offboard.modes[-500:]) == {FlightMode.OFFBOARD}


def test_parameter_sets_the_patience(offboard):
    assert offboard.autopilot.parameters.write("COM_OF_LOSS_T", 3.0, 9) is True
    offboard.run(2.9)
    assert offboard.mode is FlightMode.OFFBOARD
    offboard.run(0.3)
    assert offboard.mode is FlightMode.RTL


@pytest.mark.parametrize(
    ("action", "mode"), [(3, FlightMode.RTL), (4, FlightMode.LAND), (5, FlightMode.LOITER)]
)
def test_parameter_chooses_the_failsafe(offboard, action, mode):
    wire = struct.unpack("<f", struct.pack("<i", action))[0]
    offboard.send(dialect.MAVLink_param_set_message(1, 1, b"COM_OBL_RC_ACT", wire, 6))
    offboard.run(1.2)
    assert offboard.mode is mode


def test_refused_setpoints_do_not_feed_the_watchdog(offboard, velocity_target):
    offboard.run(1.2, lambda: velocity_target(coordinate_frame=9))
    assert offboard.mode is FlightMode.RTL
    texts = [text for _, text in offboard.texts()]
    assert texts.count("SET_POSITION_TARGET_LOCAL_NED coordinate frame 9 unsupported") >= 50


def test_setpoints_for_another_system_are_not_heard(offboard, velocity_target):
    offboard.run(1.2, lambda: velocity_target(target_system=2))
    assert offboard.mode is FlightMode.RTL


def test_nan_velocity_keeps_the_watchdog_fed(offboard, velocity_target):
    offboard.run(3.0, lambda: velocity_target(float("nan"), float("nan"), float("nan")))
    assert offboard.mode is FlightMode.OFFBOARD


def test_landing_after_a_failsafe_leaves_it_in_offboard(offboard):
    offboard.run_until(lambda: not offboard.commander.armed)
    assert offboard.mode is FlightMode.OFFBOARD
    assert [text for _, text in offboard.texts()][-2:] == [
        "Landing detected",
        "Disarmed by landing",
    ]


def test_landing_disarms_two_seconds_later_and_shows_every_state(bench):
    bench.run(4.5)
    states = [bench.commander.landed_state]
    bench.command(ARM, 1)
    bench.command(dialect.MAV_CMD_NAV_TAKEOFF)

    def note():
        if bench.commander.landed_state is not states[-1]:
            states.append(bench.commander.landed_state)

    for _ in range(600):
        bench.tick()
        note()
    bench.command(dialect.MAV_CMD_NAV_LAND)
    bench.run_until(lambda: note() or bench.commander.landed)
    landed_us = bench.stamp_us
    note()
    bench.run_until(lambda: not bench.commander.armed)
    assert bench.stamp_us - landed_us == pytest.approx(2e6, abs=4e4)
    assert states == [
        dialect.MAV_LANDED_STATE_ON_GROUND,
        dialect.MAV_LANDED_STATE_TAKEOFF,
        dialect.MAV_LANDED_STATE_IN_AIR,
        dialect.MAV_LANDED_STATE_LANDING,
        dialect.MAV_LANDED_STATE_ON_GROUND,
    ]
    assert bench.mode is FlightMode.LOITER  # so that the next arming is not refused


def test_termination_stops_the_motors_for_good(flying):
    flying.commander.terminate("Collision: box 3 at 1.0 2.0 3.0")
    flying.run(0.1)
    assert not flying.autopilot.snapshot.motors_on
    assert flying.texts() == [(0, "Collision: box 3 at 1.0 2.0 3.0")]
    assert flying.commander.system_status == dialect.MAV_STATE_FLIGHT_TERMINATION
    flying.run_until(lambda: not flying.commander.armed)
    flying.command(ARM, 1, 21196)
    assert flying.acks()[-1] == (ARM, Result.TEMPORARILY_REJECTED)


def test_sticks_fly_position_mode_and_their_loss_returns(flying):
    flying.command(MODE, 1, 3, 0)
    assert flying.acks()[-1] == (MODE, Result.TEMPORARILY_REJECTED)

    def sticks():
        return dialect.MAVLink_manual_control_message(1, 200, 0, 500, 0, 0)

    flying.run(0.2, sticks)
    flying.command(MODE, 1, 3, 0)
    flying.run(2.0, sticks)
    assert flying.mode is FlightMode.POSCTL
    assert flying.vehicle.velocity_ned_mps[0] == pytest.approx(2.0, abs=0.01)  # of 10 m/s
    flying.run(0.7)
    assert flying.mode is FlightMode.RTL


def test_low_battery_is_told_once(flying):
    flying.vehicle.battery_remaining = 0.1
    flying.run(1.0)
    assert flying.texts() == [(4, "Low battery level")]
    flying.vehicle.battery_remaining = 0.05
    flying.run(1.0)
    assert flying.texts() == [(4, "Critical battery level")]
