"""Climb 4 m, fly 10 m north and land, in lockstep: answer every tick of the vehicle.

Argument: the link, such as tcp:127.0.0.1:14540. lockstep.toml beside this file starts it:

    mavfi fly --companion examples/companions/lockstep.toml --world farm
"""

import sys

from pymavlink import mavutil

link = mavutil.mavlink_connection(sys.argv[1], source_system=1, source_component=191)
mav, common = link.mav, mavutil.mavlink
VELOCITY = 0b1101_1100_0111  # ignores positions, accelerations, yaw and the yaw rate
PLAN = (  # until this second: velocity north, east and down, m/s
    (10.0, (0.0, 0.0, -1.0)),
    (15.0, (2.0, 0.0, 0.0)),
    (18.0, (0.0, 0.0, 0.0)),
)


def command(number, *params):
    """Send a command to the autopilot."""
    mav.command_long_send(1, 1, number, 0, *params, *[0] * (7 - len(params)))


while True:
    # The last message of a tick. Whatever came before it belongs to the same tick.
    tick = link.recv_match(type="LOCAL_POSITION_NED", blocking=True)
    now_s = tick.time_boot_ms / 1000
    if tick.time_boot_ms % 1000 == 0:
        mav.heartbeat_send(common.MAV_TYPE_ONBOARD_CONTROLLER, 8, 0, 0, 0)
    if now_s == 5.0:
        command(common.MAV_CMD_DO_SET_MODE, 1, 6)  # OFFBOARD
    if now_s == 6.0:
        command(common.MAV_CMD_COMPONENT_ARM_DISARM, 1)
    if now_s == 18.0:
        command(common.MAV_CMD_NAV_LAND)
    velocity = next((own for until_s, own in PLAN if now_s < until_s), (0.0, 0.0, 0.0))
    # The answer, always the last message: a setpoint with the tick's own stamp.
    mav.set_position_target_local_ned_send(
        tick.time_boot_ms, 1, 1, common.MAV_FRAME_LOCAL_NED, VELOCITY,
        0, 0, 0, *velocity, 0, 0, 0, 0, 0,
    )  # fmt: skip
