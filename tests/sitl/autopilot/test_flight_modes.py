import math

import numpy as np
import pytest

from mavfi_cli.link.codec import dialect
from sitl.autopilot.commander import FlightMode, Result

TAKEOFF = dialect.MAV_CMD_NAV_TAKEOFF
NAN = math.nan
HOME_AMSL_M = 489.4 + 0.1


def height(bench):
    return -bench.vehicle.position_ned_m[2] - 0.1


def ready(bench):
    bench.run(4.5)
    bench.command(dialect.MAV_CMD_COMPONENT_ARM_DISARM, 1)
    bench.received.clear()
    return bench


@pytest.mark.parametrize(
    ("amsl", "reached", "words"),
    [
        (NAN, 2.5, (6, "Using default takeoff altitude: 2.5 m")),
        (HOME_AMSL_M + 8.0, 8.0, None),
        (10.0, 2.5, (2, "Using minimum takeoff altitude: 2.50 m")),
    ],
)
def test_takeoff_to_a_height_then_hold(bench, amsl, reached, words):
    ready(bench)
    bench.command(TAKEOFF, NAN, NAN, NAN, NAN, NAN, NAN, amsl)
    assert bench.acks()[-1] == (TAKEOFF, Result.ACCEPTED)
    texts = bench.texts()
    assert (words in texts) if words else not [t for t in texts if "Using" in t[1]]
    assert bench.mode is FlightMode.TAKEOFF
    bench.run_until(lambda: bench.mode is FlightMode.LOITER)
    bench.run(3.0)
    assert height(bench) == pytest.approx(reached, abs=0.05)


def test_takeoff_above_home_by_command_int(bench):
    ready(bench)
    bench.send(
        dialect.MAVLink_command_int_message(1, 1, 3, TAKEOFF, 0, 0, NAN, NAN, NAN, NAN, 0, 0, 6.0)
    )
    bench.run(12.0)
    assert height(bench) == pytest.approx(6.0, abs=0.05)


def test_takeoff_while_disarmed_waits_for_arming(bench):
    bench.run(4.5)
    bench.command(TAKEOFF)
    assert bench.acks() == [(TAKEOFF, Result.ACCEPTED)]
    bench.run(3.0)
    assert height(bench) == 0.0
    bench.command(dialect.MAV_CMD_COMPONENT_ARM_DISARM, 1)
    bench.run(12.0)
    assert height(bench) == pytest.approx(2.5, abs=0.05)


def test_motors_spool_up_before_takeoff(bench):
    ready(bench)
    bench.command(TAKEOFF)
    armed_us = bench.stamp_us
    bench.run_until(lambda: bench.autopilot.snapshot.motors_on)
    assert bench.stamp_us - armed_us == pytest.approx(1e6, abs=4e4)


def test_takeoff_height_parameter_acts(bench):
    ready(bench)
    bench.autopilot.set_parameter("MIS_TAKEOFF_ALT", 5.0)
    bench.command(TAKEOFF)
    bench.run(12.0)
    assert height(bench) == pytest.approx(5.0, abs=0.05)


def test_armed_on_the_ground_the_motors_rest(bench, velocity_target):
    bench.run(4.5, velocity_target)
    bench.command(dialect.MAV_CMD_DO_SET_MODE, 1, 6, 0)
    bench.command(dialect.MAV_CMD_COMPONENT_ARM_DISARM, 1)
    bench.run(3.0, lambda: velocity_target(north=2.0))
    assert not bench.autopilot.snapshot.motors_on
    bench.run(2.0, lambda: velocity_target(down=-1.0))
    assert height(bench) > 1.0


@pytest.fixture
def offboard(flying, velocity_target):
    flying.run(0.1, velocity_target)
    flying.command(dialect.MAV_CMD_DO_SET_MODE, 1, 6, 0)
    return flying


def test_offboard_velocity_is_flown_and_echoed(offboard, velocity_target):
    streams = offboard.link
    streams.set_interval(dialect.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED, 1e5, offboard.stamp_us)
    offboard.run(2.0, lambda: velocity_target(2.0, -1.0, 0.0, 0.7))
    assert offboard.vehicle.velocity_ned_mps == pytest.approx([2.0, -1.0, 0.0], abs=0.01)
    target = offboard.take("POSITION_TARGET_LOCAL_NED")[-1]
    assert (target.type_mask, target.coordinate_frame) == (7, 1)
    assert [target.vx, target.vy, target.yaw] == pytest.approx([2.0, -1.0, 0.7])


def test_offboard_speed_is_clipped_to_the_parameter(offboard, velocity_target):
    offboard.run(2.0, lambda: velocity_target(30.0, 40.0))
    assert offboard.vehicle.velocity_ned_mps == pytest.approx([7.2, 9.6, 0.0], abs=0.01)
    offboard.autopilot.set_parameter("MPC_XY_VEL_MAX", 5.0)
    offboard.run(2.0, lambda: velocity_target(30.0, 40.0))
    assert offboard.vehicle.velocity_ned_mps == pytest.approx([3.0, 4.0, 0.0], abs=0.01)


def test_axis_without_target_stands_still(offboard, velocity_target):
    offboard.run(2.0, lambda: velocity_target(NAN, 1.0, 0.0))
    assert offboard.vehicle.velocity_ned_mps == pytest.approx([0.0, 1.0, 0.0], abs=0.01)


def test_loiter_brakes_and_stays(offboard, velocity_target):
    offboard.run(2.0, lambda: velocity_target(5.0))
    offboard.command(dialect.MAV_CMD_DO_SET_MODE, 1, 4, 3)
    offboard.run(3.0)
    place = offboard.vehicle.position_ned_m.copy()
    offboard.run(10.0)
    assert offboard.vehicle.position_ned_m == pytest.approx(place, abs=0.01)


def test_land_comes_down_on_the_spot_slower_near_the_ground(offboard, velocity_target):
    offboard.run(10.0, lambda: velocity_target(0.0, 0.0, -3.0))
    offboard.run(1.0, velocity_target)
    place = offboard.vehicle.position_ned_m[:2].copy()
    offboard.command(dialect.MAV_CMD_NAV_LAND)
    speeds = {}

    def note():
        speeds[round(height(offboard))] = offboard.vehicle.velocity_ned_mps[2]
        return offboard.commander.landed

    offboard.run_until(note)
    assert speeds[20] == pytest.approx(1.5, abs=0.02)
    assert speeds[2] == pytest.approx(0.7, abs=0.02)
    assert offboard.vehicle.position_ned_m[:2] == pytest.approx(place, abs=0.01)


def test_return_climbs_crosses_lands_and_disarms(offboard, velocity_target):
    offboard.autopilot.set_parameter("RTL_RETURN_ALT", 20.0)
    offboard.run(10.0, lambda: velocity_target(4.0, 3.0))
    away = offboard.vehicle.position_ned_m.copy()
    assert math.hypot(away[0], away[1]) > 40.0
    offboard.command(dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH)
    track = []
    offboard.run_until(
        lambda: track.append(offboard.vehicle.position_ned_m.copy()) or not offboard.commander.armed
    )
    track = np.array(track)
    assert track[:, 2].min() == pytest.approx(-20.1, abs=0.6)
    assert track[-1] == pytest.approx([0.0, 0.0, -0.1], abs=0.5)
    crossing = track[np.hypot(track[:, 0], track[:, 1]) > 10.0]
    left = crossing[np.hypot(crossing[:, 0] - away[0], crossing[:, 1] - away[1]) > 5.0]
    assert left[:, 2].max() < -19.0  # high before it goes
    assert "RTL: start return at 510 m (20 m above destination)" in [t for _, t in offboard.texts()]


def test_return_from_nearby_stays_low(offboard):
    offboard.command(dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH)
    offboard.run(5.0)
    assert height(offboard) < 5.0


def test_reposition_goes_there_and_holds(flying):
    latitude, longitude = flying.autopilot.snapshot.origin.geodetic(15.0, -8.0)
    flying.send(
        dialect.MAVLink_command_int_message(
            1, 1, 0, dialect.MAV_CMD_DO_REPOSITION, 0, 0, -1, 0, 0, 1.0,
            round(latitude * 1e7), round(longitude * 1e7), 489.4 + 6.0,
        )
    )  # fmt: skip
    flying.run(15.0)
    assert flying.mode is FlightMode.LOITER
    assert flying.vehicle.position_ned_m == pytest.approx([15.0, -8.0, -6.0], abs=0.1)


def test_position_target_is_flown(offboard, velocity_target):
    offboard.run(6.0, lambda: velocity_target(type_mask=2552, x=3.0, y=-2.0, z=-4.0))
    assert offboard.vehicle.position_ned_m == pytest.approx([3.0, -2.0, -4.0], abs=0.05)


def test_ground_may_be_touched_when_landing_or_asked_straight_down(offboard, velocity_target):
    offboard.run(0.5, lambda: velocity_target(2.0, 0.0, 0.5))
    assert not offboard.autopilot.may_touch_ground
    offboard.run(0.5, lambda: velocity_target(0.0, 0.0, 0.5))
    assert offboard.autopilot.may_touch_ground
    offboard.run(0.5, velocity_target)
    assert not offboard.autopilot.may_touch_ground
    north, east, _ = offboard.vehicle.position_ned_m.tolist()
    for away_m, touches in ((2.0, False), (0.1, True)):
        place = {"type_mask": 2552, "x": north + away_m, "y": east, "z": 0.0}
        offboard.run(0.02, lambda place=place: velocity_target(**place))
        assert offboard.autopilot.may_touch_ground is touches
    offboard.run(0.5, velocity_target)
    assert not offboard.autopilot.may_touch_ground
    offboard.command(dialect.MAV_CMD_NAV_LAND)
    assert offboard.autopilot.may_touch_ground
