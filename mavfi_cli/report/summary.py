"""Text summary of a run, printed by `mavfi fly` and `mavfi show`."""

from __future__ import annotations

import textwrap
from typing import Any

from mavfi_cli.core.columns import WIDTH
from mavfi_cli.fi.tracer.symbols import short_name
from mavfi_cli.mission.record.detection_cost import detection_cost
from mavfi_cli.mission.record.run_folder import Run
from mavfi_cli.mission.replay import first_difference, largest_deviation_m

_INDENT = 12 * " "
_OUTCOMES = {
    "success": "SUCCESS: reached the goal",
    "collision": "COLLISION",
    "no_path": "NO PATH: the planner gave up",
    "timeout": "TIMEOUT: the time limit passed before the goal was reached",
    "failsafe": "FAILSAFE: the flight controller took over",
    "link_lost": "LINK LOST: no more messages arrived from the vehicle",
    "crash": "CRASH: the companion software stopped with an error",
    "hang": "HANG: the companion software stopped responding",
    "interrupted": "INTERRUPTED",
}


def _number(value: Any, unit: str, digits: int = 1) -> str:
    return "not known" if value is None else f"{value:.{digits}f} {unit}"


def outcome_line(result: dict[str, Any]) -> str:
    """Return the outcome and its reason in one line."""
    text = _OUTCOMES.get(result["outcome"], result["outcome"])
    reason = result.get("reason") or ""
    return f"{text} ({reason})" if reason else text


def summary_lines(result: dict[str, Any]) -> list[str]:
    """Return outcome, quality of flight, pipeline figures and cost on this machine."""
    config = result["config"]
    flown = f"{config['vehicle']} in {config['world']}, seed {config['seed']}"
    if config["link"] is not None:
        flown = f"foreign autopilot at {config['link']}, seed {config['seed']}"
    lines = [
        outcome_line(result),
        "",
        f"Mission     {flown}; planner {config['planner']}, platform {config['platform']}",
        *_flight_lines(result),
    ]
    lines += fault_lines(result)
    lines += node_lines(result)
    lines += detection_lines(result)
    response = result.get("response_time_s") or {}
    if response.get("median") is not None:
        lines.append(
            f"Response    {response['median'] * 1e3:.0f} ms from depth frame to setpoint "
            f"(median), {response['p95'] * 1e3:.0f} ms (95th percentile)"
        )
    lines += measured_lines(result)
    lines += _host_lines(result)
    return [part for line in lines for part in _folded(line)]


def _folded(line: str) -> list[str]:
    """Wrap a line at the screen width. Continuation lines align with its text."""
    return textwrap.wrap(
        line, WIDTH, subsequent_indent=_INDENT, break_long_words=False, break_on_hyphens=False
    ) or [""]


def _host_lines(result: dict[str, Any]) -> list[str]:
    """Return the host time of the flight."""
    host = result["host"]
    if host.get("flight_wall_s"):
        factor = result["simulated_s"] / host["flight_wall_s"]
        return [
            f"Host        {host['flight_wall_s']:.2f} s for {result['simulated_s']:.1f} simulated "
            f"seconds: {factor:.0f} times real time, after {host['startup_s']:.1f} s of start-up"
        ]
    return []


def _flight_lines(result: dict[str, Any]) -> list[str]:
    """Return quality of flight and counts of plans, or one line if there was no flight."""
    qof, counters = result["quality_of_flight"], result["pilot"]
    if qof["flight_time_s"] is None:
        return ["Flight      none: the mission ended before the companion took over"]
    flown = counters["replans"] + any(e["kind"] in ("plan", "replan") for e in result["events"])
    asked, failed = counters["plans_requested"], counters["plans_failed"]
    return [
        f"Flight      {_number(qof['flight_time_s'], 's')}, "
        f"{_number(qof['distance_m'], 'm')} flown, "
        f"{_number(qof['goal_distance_m'], 'm', 2)} from the goal",
        *_clearance_and_energy(qof),
        f"Plans       {asked} requested: {flown} flown ({counters['replans']} replans), "
        f"{failed} failed, {asked - flown - failed} not used",
        f"Obstacles   {counters['collisions_foreseen']} collisions predicted, "
        f"{counters['slowdowns']} slowdowns, {counters['stops']} stops",
    ]


def _clearance_and_energy(qof: dict[str, Any]) -> list[str]:
    """Return clearance and energy, which are unknown for a foreign autopilot."""
    clearance, energy = "not known", "not known"
    if qof["min_clearance_m"] is not None:
        clearance = f"{_number(qof['min_clearance_m'], 'm', 2)} minimum"
    if qof["energy_regression_j"] is not None or qof["energy_propeller_j"] is not None:
        energy = (
            f"{_number(_kilo(qof['energy_regression_j']), 'kJ')} (paper's regression), "
            f"{_number(_kilo(qof['energy_propeller_j']), 'kJ')} (propeller shafts)"
        )
    return [f"Clearance   {clearance}", f"Energy      {energy}"]


def measured_lines(result: dict[str, Any]) -> list[str]:
    """Return the kernel medians of a platform measured on the host."""
    measured = result.get("measured_platform")
    if not measured:
        return []
    medians = ", ".join(
        f"{name} {1e3 * each['host_median_s']:.2f} ms" for name, each in measured["kernels"].items()
    )
    return [f"Measured    {medians} (medians on this host), x {measured['factor']:g} in the flight"]


def node_lines(result: dict[str, Any]) -> list[str]:
    """Return the crashes and hangs of each node."""
    lines = []
    for name, node in (result.get("nodes") or {}).items():
        ends = [f"{c['how']} at {c['stamp_s']:.2f} s" for c in node["crashes"][:3]]
        if len(node["crashes"]) > 3:
            ends.append(f"{len(node['crashes']) - 3} more crashes")
        if node["hangs"]:
            ends.append(f"hung {node['hangs']} times" if node["hangs"] > 1 else "hung once")
        if ends:
            lines.append(f"Node        {name}: {'; '.join(ends)}; restarted {node['restarts']}x")
    return lines


def detection_lines(result: dict[str, Any]) -> list[str]:
    """Return the detector's alarms, its recomputations, and the host time of its checks."""
    detection = result.get("detection")
    if not detection:
        return []
    responses = detection["responses"]
    lines = [
        f"Detector    {detection['detector']} on {', '.join(detection['protect'])}: "
        f"{sum(detection['checks'].values())} checks, {detection['alarm_count']} alarms"
    ]
    for alarm in detection["alarms"][:3]:
        where = ", ".join(alarm["states"][:2]) or "all states together"
        lines.append(
            f"            at {alarm['stamp_s']:.2f} s: {alarm['stage']}, {where}: "
            f"{alarm['response']}"
        )
    if detection["alarm_count"]:
        recovered = [
            f"{stage} {entry['count']}x, {entry['total_s'] * 1e3:.1f} ms"
            for stage, entry in detection["recoveries"].items()
            if entry["count"]
        ]
        lines.append(
            f"            recovered {'; '.join(recovered)}; {responses['hold']} holds, "
            f"{responses['accept']} accepted after all"
        )
    cost = detection_cost(result)
    if cost is not None:
        lines.append(
            f"            {1e6 * cost.check_host_s:.1f} us a check here, "
            f"{100.0 * cost.detection_share:.4f} % of the flight time"
        )
    return lines


def _kilo(value: float | None) -> float | None:
    return None if value is None else value / 1e3


def event_lines(result: dict[str, Any]) -> list[str]:
    """Return one line per event with its simulated time."""
    return [f"{e['stamp_s']:9.2f} s  {e['kind']:<10} {e['text']}" for e in result["events"]]


def fault_lines(result: dict[str, Any]) -> list[str]:
    """Return the requested fault and its strikes."""
    fault = result.get("fault")
    if not fault:
        return []
    if fault["level"] == "instruction":
        return _instruction_lines(fault)
    trigger = fault["trigger"]
    when = {
        "random": f"at a random moment ({trigger['drawn_time_s']:.2f} s into the flight)",
        "time": f"{trigger['number']:g} s into the flight",
        "tick": f"at control tick {trigger['number']:g}",
        "phase": f"once the pilot is in the phase {trigger['phase']}",
        "foreseen": "once a collision is foreseen",
        "invocation": f"at invocation {trigger['number']:g} of the kernel",
    }[trigger["when"]]
    request, states = fault["request"], ", ".join(fault["states"])
    what = f"{fault['stage']} stage, {states}: {request['persistence']} {request['effect']}"
    if fault["stage"] == "process":
        what = f"{states} is killed"
    lines = [f"Fault       {what}, {when}"]
    if fault["state"] == "not_injected":
        lines.append(f"            not injected: {fault['reason']}")
    for strike in fault["strikes"][:3]:
        lines += [_change_line(strike["stamp_s"], change) for change in strike["changes"]]
    if fault["strike_count"] > 3:
        lines.append(f"            and {fault['strike_count'] - 3} more strikes")
    if fault["state"] == "applied" and fault["stage"] != "process":
        lines.append(f"            {_activation(fault)}")
    return lines


def _activation(fault: dict[str, Any]) -> str:
    """Return the activation: whether any node read the corrupted value."""
    reader = fault["activation"]["first_reader"]
    if reader is not None:
        return f"first read by {reader['name']} at {reader['stamp_s']:.2f} s ({reader['state']})"
    return {
        "withheld": "withheld by the detector's gate before anybody read it",
        "overwritten": "overwritten before anybody read it",
        "not_read": "never read: the mission ended before",
        "unchanged": "changed nothing: the value was that already",
    }[fault["activation"]["activation"]]


def _instruction_lines(fault: dict[str, Any]) -> list[str]:
    """Return the drawn instruction-level fault, its population and its effect."""
    lines = [
        f"Fault       node {fault['node']}, invocation {fault['invocation']} of "
        f"{fault['invocations']} of {fault['kernel']}, at {fault['stamp_s']:.2f} s; "
        f"{fault['sampling']}, windows {fault['windows']}",
        f"            before execution {fault['k']} of {fault['instruction']} ({_place(fault)})",
    ]
    if fault["state"] == "null":
        return [*lines, "            null injection: nothing was flipped"]
    corruption, injection = fault["corruption"], fault["injection"]
    if fault["state"] == "not_injected":
        return [*lines, f"            not injected: {fault['reason']}"]
    bits = ", ".join(map(str, corruption["bits"]))
    what = corruption["register"] or corruption["site"]
    activation = fault["activation"]["activation"].replace("_", " ")
    return [
        *lines,
        f"            bit {bits} of {corruption['role']} {what}: "
        f"{injection['before']} -> {injection['after']}; {activation}",
    ]


def _place(fault: dict[str, Any]) -> str:
    """Return the place of an instruction: function and offset, or offset in its object."""
    if not fault["symbol"]:
        return f"{fault['object']}+{fault['offset']:#x}"
    name, _, offset = fault["symbol"].partition("+")
    return f"{short_name(name)}{offset and '+'}{offset} in {fault['object']}"


def _change_line(stamp_s: float, change: dict[str, Any]) -> str:
    place = f"[{change['index']}]" if change["state"].startswith("waypoint") else ""
    bits = ", ".join(map(str, change["bits"])) or "none: the value was that already"
    plural = "s" if len(change["bits"]) > 1 else ""
    return (
        f"            at {stamp_s:.2f} s: {change['state']}{place} "
        f"{_formatted(change, 'before')} -> {_formatted(change, 'after')} (bit{plural} {bits})"
    )


def _formatted(change: dict[str, Any], when: str) -> str:
    """Format a value. Infinities and NaN, which JSON lacks, are decoded from their bits."""
    value, pattern = change[when], change[f"{when}_hex"]
    if value is None:
        return {"0x7ff0000000000000": "inf", "0xfff0000000000000": "-inf"}.get(
            pattern, f"nan {pattern}"
        )
    if not isinstance(value, float):
        return str(value)
    short = [f"{change[name]:.6g}" for name in ("before", "after") if change[name] is not None]
    return repr(value) if len(short) == 2 and short[0] == short[1] else f"{value:.6g}"


def difference_lines(run: Run, golden: Run) -> list[str]:
    """Compare a run with its golden run: first difference, deviation and outcome."""
    parting = first_difference(run, golden)
    fault = run.result["fault"] or {}
    if parting is None or first_difference(run, golden, leave_out=fault.get("states", ())) is None:
        why = _no_effect(fault) if fault else "none"
        return [f"Effect      {why}: nothing else ever differs from the golden flight"]
    lines = [
        f"Effect      first at {parting.stamp_s:.2f} s in {parting.column}: "
        f"{_pair(parting.this, parting.other)}",
        f"            at most {largest_deviation_m(run, golden):.2f} m off the golden path",
    ]
    ours, theirs = run.result["quality_of_flight"], golden.result["quality_of_flight"]
    if ours["flight_time_s"] and theirs["flight_time_s"]:
        change = 100.0 * (ours["flight_time_s"] / theirs["flight_time_s"] - 1.0)
        lines.append(
            f"            {ours['flight_time_s']:.1f} s and {run.result['outcome']} instead of "
            f"{theirs['flight_time_s']:.1f} s and {golden.result['outcome']} ({change:+.1f} %)"
        )
    return lines


def _no_effect(fault: dict[str, Any]) -> str:
    """Return why a fault had no effect: not injected, not activated, or masked."""
    if fault["state"] == "not_injected":
        return "none, not injected"
    activation = fault["activation"]["activation"]
    return "masked" if activation == "read" else f"none, {activation.replace('_', ' ')}"


def _pair(this: Any, other: Any) -> str:
    """Format two different values with enough digits to tell them apart."""
    short = [_value(this), _value(other)]
    if short[0] == short[1]:
        short = [repr(this), repr(other)]
    return " instead of ".join(short)


def _value(value: Any) -> str:
    if value is None:
        return "inf or nan"
    return f"{value:.6g}" if isinstance(value, float) else str(value)
