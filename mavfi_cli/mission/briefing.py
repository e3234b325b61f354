"""Mission briefing: goal, flight bounds and camera mounting, known before the flight.

The simulated vehicle writes `briefing.json` before its first message, because only the vehicle has
the world. For a foreign autopilot the briefing comes from the command line.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from mavfi_cli.core.errors import ConfigError, VehicleProcessError
from mavfi_cli.core.types import Briefing, FloatArray
from mavfi_cli.spec.mission import MissionConfig

FILE = "briefing.json"
LOWEST_M, HIGHEST_M = 2.0, 10.0  # flight levels above home
FARTHEST_M = 200.0  # maximum goal distance; limits the memory of the obstacle grid
MOUNT_FLU_M = (0.1, 0.0, 0.0)  # of the stand-alone camera, unless it is told another one
MARGIN_M = 30.0  # flight bounds round home and goal without a known world


def of_simulation(folder: Path) -> Briefing:
    """Read the briefing of the simulated vehicle.

    Raises:
        VehicleProcessError: There is no briefing.
    """
    try:
        data = json.loads((folder / FILE).read_text())
        return Briefing(
            start_enu_m=np.array(data["start_enu_m"], dtype=np.float64),
            goal_enu_m=np.array(data["goal_enu_m"], dtype=np.float64),
            bounds_enu_m=_flight_bounds(data["bounds_enu_m"]),
            camera_offset_flu_m=np.array(data["camera_offset_flu_m"], dtype=np.float64),
        )
    except (OSError, ValueError, KeyError) as error:
        raise VehicleProcessError(f"the vehicle process left no briefing ({error})") from None


def of_config(config: MissionConfig, start_enu_m: FloatArray) -> Briefing:
    """Build the briefing for a foreign autopilot without a known world, from its place (3,)."""
    goal = np.array(config.goal)
    low, high = np.minimum(goal, start_enu_m) - MARGIN_M, np.maximum(goal, start_enu_m) + MARGIN_M
    return Briefing(
        start_enu_m=start_enu_m,
        goal_enu_m=goal,
        bounds_enu_m=_flight_bounds([*low, *high]),
        camera_offset_flu_m=np.array(MOUNT_FLU_M),
    )


def require_flyable(briefing: Briefing, takeoff_height_m: float, tolerance_m: float) -> None:
    """Reject a goal that is too near, too far, or outside the flight levels.

    Raises:
        ConfigError: The goal is invalid. Says why.
    """
    start, goal = briefing.start_enu_m, briefing.goal_enu_m
    takeoff = np.add(start, (0.0, 0.0, takeoff_height_m))
    problem = ""
    if float(np.linalg.norm(goal - takeoff)) <= tolerance_m:
        problem = f"is within {tolerance_m:g} m of the take-off point"
    elif not LOWEST_M <= float(goal[2]) <= HIGHEST_M:
        problem = f"is {goal[2]:g} m high; flight levels are {LOWEST_M:g} to {HIGHEST_M:g} m"
    elif float(np.linalg.norm(goal[:2] - start[:2])) > FARTHEST_M:
        problem = f"is farther than {FARTHEST_M:g} m away"
    if problem:
        raise ConfigError(f"the goal {problem}", key="goal")


def _flight_bounds(bounds_enu_m: list[float]) -> FloatArray:
    """Return the bounds with the flight levels in z; MAVBench plans between 1 and 10 m."""
    bounds = np.array(bounds_enu_m, dtype=np.float64)
    bounds[2], bounds[5] = LOWEST_M, HIGHEST_M
    return bounds
