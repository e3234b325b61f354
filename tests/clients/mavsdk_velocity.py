"""Fly 10 m north with MAVSDK-Python, then land: a companion for campaigns."""

import asyncio
import sys

from mavsdk import System
from mavsdk.offboard import VelocityNedYaw


async def run():
    drone = System(port=int(sys.argv[2]))
    await drone.connect(system_address=sys.argv[1])
    async for state in drone.core.connection_state():
        if state.is_connected:
            break
    async for health in drone.telemetry.health():
        if health.is_global_position_ok and health.is_home_position_ok:
            break
    await drone.action.arm()
    await drone.offboard.set_velocity_ned(VelocityNedYaw(0, 0, 0, 0))
    await drone.offboard.start()
    await drone.offboard.set_velocity_ned(VelocityNedYaw(0, 0, -1, 0))
    await asyncio.sleep(4)
    await drone.offboard.set_velocity_ned(VelocityNedYaw(2, 0, 0, 0))
    await asyncio.sleep(5)
    await drone.action.land()
    async for air in drone.telemetry.in_air():
        if not air:
            break


asyncio.run(run())
