"""A MAVSDK script: climbs with a thrust, rolls to the right, and lands."""

import asyncio
import sys

from mavsdk import System
from mavsdk.offboard import Attitude


async def main(address, port):
    drone = System(port=port)
    await drone.connect(system_address=address)
    async for health in drone.telemetry.health():
        if health.is_armable and health.is_home_position_ok:
            break
    await drone.action.arm()
    await drone.offboard.set_attitude(Attitude(0.0, 0.0, 0.0, 0.0))
    await drone.offboard.start()
    for roll_deg, thrust in ((0.0, 0.7), (20.0, 0.62), (-20.0, 0.62)):
        await drone.offboard.set_attitude(Attitude(roll_deg, 0.0, 0.0, thrust))
        await asyncio.sleep(1.5)
    await drone.offboard.stop()
    await drone.action.land()
    async for armed in drone.telemetry.armed():
        if not armed:
            break


asyncio.run(main(sys.argv[1], int(sys.argv[2])))
