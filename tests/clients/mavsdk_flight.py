"""A MAVSDK user's script, run as its own process: connect, arm, take off, offboard, land.

Prints one JSON object of what MAVSDK saw.
"""

import asyncio
import json
import math
import sys

from mavsdk import System
from mavsdk.offboard import PositionNedYaw, VelocityBodyYawspeed, VelocityNedYaw


async def first(stream, accept=lambda _item: True):
    async for item in stream:
        if accept(item):
            return item
    raise RuntimeError("the stream ended")


async def reached(drone, north, east, tolerance=0.3):
    def near(p):
        return math.hypot(p.position.north_m - north, p.position.east_m - east) < tolerance

    return await first(drone.telemetry.position_velocity_ned(), near)


async def moving(drone, north, east, tolerance=0.15):
    def as_asked(p):
        return (
            abs(p.velocity.north_m_s - north) < tolerance
            and abs(p.velocity.east_m_s - east) < tolerance
        )

    return await first(drone.telemetry.position_velocity_ned(), as_asked)


async def heading(drone, degrees, tolerance=4.0):
    def turned(h):
        return abs(math.remainder(h.heading_deg - degrees, 360.0)) < tolerance

    return await first(drone.telemetry.heading(), turned)


async def fly_offboard(drone, seen):
    await drone.offboard.set_velocity_ned(VelocityNedYaw(0.0, 0.0, 0.0, 0.0))
    await drone.offboard.start()
    seen["mode_offboard"] = str(
        await first(drone.telemetry.flight_mode(), lambda m: str(m) == "OFFBOARD")
    )
    await drone.offboard.set_velocity_ned(VelocityNedYaw(2.0, 1.0, 0.0, 90.0))
    state = await moving(drone, 2.0, 1.0)
    seen["velocity_ned"] = [state.velocity.north_m_s, state.velocity.east_m_s]
    seen["heading"] = (await heading(drone, 90.0)).heading_deg
    # Forward in the body frame, with the nose east.
    await drone.offboard.set_velocity_body(VelocityBodyYawspeed(1.5, 0.0, 0.0, 0.0))
    state = await moving(drone, 0.0, 1.5)
    seen["velocity_body"] = [state.velocity.north_m_s, state.velocity.east_m_s]
    await drone.offboard.set_position_ned(PositionNedYaw(0.0, 0.0, -4.0, 180.0))
    state = await reached(drone, 0.0, 0.0)
    seen["back"] = [state.position.north_m, state.position.east_m]
    await drone.offboard.stop()
    seen["mode_after"] = str(await first(drone.telemetry.flight_mode(), lambda m: str(m) == "HOLD"))


async def fly(address, port):
    seen = {}
    drone = System(port=port)
    await drone.connect(system_address=address)
    await first(drone.core.connection_state(), lambda s: s.is_connected)
    health = await first(drone.telemetry.health(), lambda h: h.is_armable)
    health = await first(
        drone.telemetry.health(),
        lambda h: h.is_armable and h.is_global_position_ok and h.is_home_position_ok,
    )
    seen["health"] = {name: getattr(health, name) for name in dir(health) if name.startswith("is_")}
    seen["all_ok"] = await first(drone.telemetry.health_all_ok(), bool)
    version = await drone.info.get_version()
    seen["version"] = [version.flight_sw_major, version.flight_sw_minor]
    await drone.action.set_takeoff_altitude(4.0)
    seen["takeoff_altitude"] = await drone.action.get_takeoff_altitude()
    seen["parameter"] = await drone.param.get_param_int("COM_OBL_RC_ACT")
    parameters = await drone.param.get_all_params()
    seen["parameters"] = len(parameters.int_params) + len(parameters.float_params)
    await drone.action.arm()
    seen["armed"] = await first(drone.telemetry.armed(), bool)
    await drone.action.takeoff()
    await first(drone.telemetry.in_air(), bool)
    up = await first(drone.telemetry.position(), lambda p: p.relative_altitude_m > 3.7)
    seen["altitude"] = up.relative_altitude_m
    await first(drone.telemetry.flight_mode(), lambda m: str(m) == "HOLD")
    await drone.telemetry.set_rate_distance_sensor(5.0)
    seen["longest_range"] = (await first(drone.telemetry.distance_sensor())).maximum_distance_m
    await fly_offboard(drone, seen)
    await drone.action.land()
    await first(drone.telemetry.landed_state(), lambda s: str(s) == "ON_GROUND")
    seen["disarmed"] = not await first(drone.telemetry.armed(), lambda armed: not armed)
    return seen


if __name__ == "__main__":
    sys.stdout.write(json.dumps(asyncio.run(fly(sys.argv[1], int(sys.argv[2])))) + "\n")
