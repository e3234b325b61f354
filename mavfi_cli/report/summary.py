"""A run in words: the lines that `mavfi fly` and `mavfi show` print."""

from __future__ import annotations

from typing import Any

_OUTCOMES = {
    "success": "SUCCESS: reached the goal",
    "collision": "COLLISION",
    "no_path": "NO PATH: the planner gave up",
    "timeout": "TIMEOUT: the time limit passed before the goal was reached",
    "failsafe": "FAILSAFE: the flight controller took over",
    "link_lost": "LINK LOST: the vehicle fell silent",
    "crash": "CRASH: the companion software stopped with an error",
    "hang": "HANG: the companion software stopped answering",
    "interrupted": "INTERRUPTED",
}


def _number(value: Any, unit: str, digits: int = 1) -> str:
    return "not known" if value is None else f"{value:.{digits}f} {unit}"


def outcome_line(result: dict[str, Any]) -> str:
    """The outcome and its reason in one line."""
    text = _OUTCOMES.get(result["outcome"], result["outcome"])
    reason = result.get("reason") or ""
    return f"{text} ({reason})" if reason else text


def summary_lines(result: dict[str, Any]) -> list[str]:
    """Outcome, quality of flight, perception-planning-control figures, cost on this machine."""
    config, qof = result["config"], result["quality_of_flight"]
    counters, host = result["pilot"], result["host"]
    flown = f"{config['vehicle']} in {config['world']}, seed {config['seed']}"
    if config["link"] is not None:
        flown = f"foreign autopilot at {config['link']}, seed {config['seed']}"
    lines = [
        outcome_line(result),
        "",
        f"Mission     {flown}; planner {config['planner']}, platform {config['platform']}",
        f"Flight      {_number(qof['flight_time_s'], 's')}, "
        f"{_number(qof['distance_m'], 'm')} flown, "
        f"{_number(qof['goal_distance_m'], 'm', 2)} from the goal",
        f"Clearance   {_number(qof['min_clearance_m'], 'm', 2)} at the closest",
        f"Energy      {_number(_kilo(qof['energy_regression_j']), 'kJ')} (paper's regression), "
        f"{_number(_kilo(qof['energy_propeller_j']), 'kJ')} (propeller shafts)",
        f"Plans       {counters['plans_requested']} asked for, {counters['replans']} replans, "
        f"{counters['plans_failed']} failed; {counters['collisions_foreseen']} collisions "
        f"foreseen, {counters['slowdowns']} slow-downs, {counters['stops']} stops",
    ]
    response = result.get("response_time_s") or {}
    if response.get("median") is not None:
        lines.append(
            f"Response    {response['median'] * 1e3:.0f} ms from depth frame to setpoint "
            f"(median), {response['p95'] * 1e3:.0f} ms (95th percentile)"
        )
    if host.get("flight_wall_s"):
        factor = result["simulated_s"] / host["flight_wall_s"]
        lines.append(
            f"Host        {host['flight_wall_s']:.2f} s for {result['simulated_s']:.1f} simulated "
            f"seconds: {factor:.0f} times real time, after {host['startup_s']:.1f} s of start-up"
        )
    return lines


def _kilo(value: float | None) -> float | None:
    return None if value is None else value / 1e3


def event_lines(result: dict[str, Any]) -> list[str]:
    """One line an event, with its simulated time."""
    return [f"{e['stamp_s']:9.2f} s  {e['kind']:<10} {e['text']}" for e in result["events"]]
