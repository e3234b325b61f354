"""A companion in few lines: climbs, flies north, lands.

Arguments: link, speed, how it ends, and its component id (191). It takes its time from
the autopilot, so that load on the machine does not change its path. It signs its frames with
the passphrase HOP_KEY, if that is set.
"""

import hashlib
import os
import struct
import sys
import time

from pymavlink import mavutil

own = int(sys.argv[4]) if len(sys.argv) > 4 else 191
link = mavutil.mavlink_connection(sys.argv[1], source_system=1, source_component=own)
if passphrase := os.environ.get("HOP_KEY"):
    link.setup_signing(hashlib.sha256(passphrase.encode()).digest())
speed, end = float(sys.argv[2]), sys.argv[3]
mav, common = link.mav, mavutil.mavlink
VELOCITY = 0b1001_1100_0111  # ignores positions, accelerations and the yaw rate
PREARM = common.MAV_SYS_STATUS_PREARM_CHECK
LAND = struct.unpack("<f", struct.pack("<i", 4))[0]  # an integer parameter, as PX4 sends it
now_s, armed, offboard = 0.0, False, False


def step(north, down):
    """Send a heartbeat and a setpoint, and read what has arrived."""
    global now_s, armed, offboard
    mav.heartbeat_send(18, 8, 0, 0, 0)
    mav.set_position_target_local_ned_send(
        0, 1, 1, 1, VELOCITY, 0, 0, 0, north, 0, down, 0, 0, 0, 0, 0
    )
    while message := link.recv_msg():
        if message.get_type() == "LOCAL_POSITION_NED":
            now_s = message.time_boot_ms / 1e3
        elif message.get_type() == "HEARTBEAT" and message.get_srcComponent() == 1:
            armed = bool(message.base_mode & 128)
            offboard = message.custom_mode == 6 << 16
    time.sleep(0.05 / speed)


def fly(seconds, north, down):
    until_s = now_s + seconds
    while now_s < until_s:
        step(north, down)


sys.stdout.write("ready\n")
sys.stdout.flush()
if end == "waits":
    time.sleep(600)
while now_s == 0.0:
    step(0, 0)
while not (armed and offboard):
    mav.command_long_send(1, 1, common.MAV_CMD_DO_SET_MODE, 0, 1, 6, 0, 0, 0, 0, 0)
    mav.command_long_send(1, 1, common.MAV_CMD_COMPONENT_ARM_DISARM, 0, 1, 0, 0, 0, 0, 0, 0)
    fly(1, 0, 0)
if end == "hangs":  # the failsafe is to land at once
    mav.param_set_send(1, 1, b"COM_OBL_RC_ACT", LAND, common.MAV_PARAM_TYPE_INT32)
fly(4, 0, -1)
fly(4, 2, 0)
if end == "hangs":
    time.sleep(600)
if end == "dies":
    os.kill(os.getpid(), 9)
if end == "crashes":
    fly(30, 6, 3)
while True:
    mav.command_long_send(1, 1, common.MAV_CMD_NAV_LAND, 0, *[0] * 7)
    mav.heartbeat_send(18, 8, 0, 0, 0)
    heard = link.recv_match(type="SYS_STATUS", blocking=True, timeout=0.2)
    if end == "leaves" and heard and not heard.onboard_control_sensors_health & PREARM:
        break
