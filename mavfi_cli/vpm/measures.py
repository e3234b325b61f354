"""Numbers of one flight, from its result.json, as the model has them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from mavfi_cli.vpm.flight_plan import FlightPlan

Result = Mapping[str, Any]


def mean_velocity_mps(result: Result) -> float | None:
    """Along the path, m/s."""
    return _quality(result, "mean_speed_mps")


def top_velocity_mps(result: Result) -> float | None:
    """The fastest moment, m/s."""
    return _quality(result, "max_speed_mps")


def flight_time_s(result: Result) -> float | None:
    """From the companion's taking over at take-off height to the goal, s."""
    return _quality(result, "flight_time_s")


def shaft_energy_j(result: Result) -> float | None:
    """Of the propellers, JSBSim, J."""
    return _quality(result, "energy_propeller_j")


def response_s(result: Result) -> float | None:
    """Median time from a depth frame to the first setpoint that it could influence, s."""
    return _number(result["response_time_s"]["median"])


def straight_m(result: Result) -> float:
    """From the take-off point straight to the edge of the goal's tolerance, m."""
    config, (east, north, up) = result["config"], result["world"]["start"]
    takeoff = (east, north, up + config["takeoff_height_m"])
    return math.dist(takeoff, result["goal_enu_m"]) - float(config["goal_tolerance_m"])


def path_ratio(result: Result) -> float | None:
    """Length of the path over the straight way."""
    distance_m = _quality(result, "distance_m")
    return None if distance_m is None else distance_m / straight_m(result)


def replans(result: Result) -> float | None:
    """Plans that replaced another one in flight."""
    return _number((result["pilot"] or {}).get("replans"))


def alarms(result: Result) -> float | None:
    """Of the detector; None without one."""
    return None if result["detection"] is None else float(result["detection"]["alarm_count"])


def hover_shaft_w(result: Result) -> float | None:
    """Shaft power of the simulated vehicle when it hovers with its boards, W."""
    return _number(((result["referee"] or {}).get("physics") or {}).get("hover_shaft_w"))


def energy_j(result: Result, plan: FlightPlan) -> float | None:
    """Electrical energy of rotors and boards, J.

    Shaft energy times the model's hover power over the simulated vehicle's, which is the same for
    any number of boards; and the boards' power for as long as the flight lasted.
    """
    shaft_j, hover_w, time_s = shaft_energy_j(result), hover_shaft_w(result), flight_time_s(result)
    if shaft_j is None or hover_w is None or time_s is None:
        return None
    return shaft_j * plan.rotors_w / hover_w + plan.boards_w * time_s


def _quality(result: Result, key: str) -> float | None:
    return _number(result["quality_of_flight"].get(key))


def _number(value: Any) -> float | None:
    return None if value is None else float(value)
