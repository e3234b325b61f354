"""A MAVSDK script: takes off, flies north in OFFBOARD, lands. FAULT=dies or wild spoils it."""

import asyncio
import os
import signal
import sys

from mavsdk import System
from mavsdk.offboard import VelocityNedYaw

FAULT = os.environ.get("FAULT", "")


async def until(stream, accepted):
    async for item in stream:
        if accepted(item):
            return


def beyond(north_m):
    return lambda state: state.position.north_m > north_m


async def main(address, port):
    drone = System(port=port)
    await drone.connect(system_address=address)
    await until(drone.telemetry.health(), lambda h: h.is_armable and h.is_home_position_ok)
    await drone.action.set_takeoff_altitude(4.0)
    await drone.action.arm()
    await drone.action.takeoff()
    await until(drone.telemetry.position(), lambda p: p.relative_altitude_m > 3.7)
    await drone.offboard.set_velocity_ned(VelocityNedYaw(0.0, 0.0, 0.0, 0.0))
    await drone.offboard.start()
    await drone.offboard.set_velocity_ned(VelocityNedYaw(2.0, 0.0, 0.0, 0.0))
    begun_m = (await anext(drone.telemetry.position_velocity_ned())).position.north_m
    await until(drone.telemetry.position_velocity_ned(), beyond(begun_m + 5.0))
    if FAULT == "dies":
        os.kill(os.getpid(), signal.SIGKILL)
    if FAULT == "wild":  # once; mavsdk_server repeats it until the next one
        await drone.offboard.set_velocity_ned(VelocityNedYaw(-1000.0, 0.0, 0.0, 0.0))
        await asyncio.sleep(float(os.environ["WILD_S"]))
        await drone.offboard.set_velocity_ned(VelocityNedYaw(2.0, 0.0, 0.0, 0.0))
    await until(drone.telemetry.position_velocity_ned(), beyond(begun_m + 20.0))
    await drone.offboard.set_velocity_ned(VelocityNedYaw(0.0, 0.0, 0.0, 0.0))
    await asyncio.sleep(2.0)
    await drone.offboard.stop()
    await drone.action.land()
    await until(drone.telemetry.armed(), lambda armed: not armed)


asyncio.run(main(sys.argv[1], int(sys.argv[2])))
