"""Text summary of a run, printed by `mavfi fly` and `mavfi show`."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping
from pathlib import Path

from mavfi_cli.core.flight_record import (
    Change,
    Detection,
    MeasuredPlatform,
    MissionInstructionFault,
    NodeEnds,
    ProgramEnds,
    QualityOfFlight,
    RecordedActivation,
    StateFault,
)
from mavfi_cli.core.types import Scalar
from mavfi_cli.fi.bits import format_distinct
from mavfi_cli.fi.tracer.image import short_name
from mavfi_cli.mission.measures import DetectionCost, FlightRecord
from mavfi_cli.mission.run_folder import Run
from mavfi_cli.report.table import folded

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


def _number(value: float | None, unit: str, digits: int = 1, per: float = 1.0) -> str:
    return "not known" if value is None else f"{value / per:.{digits}f} {unit}"


def outcome_line(flight: FlightRecord) -> str:
    """Return one line with the outcome of a flight, and the reason for it if one is recorded."""
    text = _OUTCOMES.get(flight.outcome, flight.outcome)
    if flight.programs:  # a user's companion has its own reasons for success and failure
        text = text.partition(":")[0]
    return f"{text} ({flight.reason})" if flight.reason else text


def summary_lines(flight: FlightRecord) -> list[str]:
    """Return the lines of text that summarise a flight, folded at 100 characters.

    They cover outcome, mission, flight, faults, nodes, detection, response time and host time.
    """
    config = flight.config
    with_what = f"planner {config['planner']}, platform {config['platform']}"
    with_what += f", stack {config['stack']}"
    flown = f"{config['vehicle']} in {config['world']}, seed {config['seed']}"
    if config["link"] is not None:
        where = f" in {config['world']}" if config["world"] else ""
        flown = f"foreign autopilot at {config['link']}{where}, seed {config['seed']}"
    if config.get("companion"):
        time = "in lockstep" if flight.in_lockstep else f"{config['speed']:g} x real time"
        with_what = f"companion {config['companion']}, {time}"
    lines = [outcome_line(flight), "", f"Mission     {flown}; {with_what}", *_flight_lines(flight)]
    if pose := (flight.referee or {}).get("pose"):
        lines.append(f"Referee     on {pose}")
    lines += _fault_lines(flight)
    lines += _node_lines(flight.nodes)
    lines += _program_lines(flight.programs)
    lines += _detection_lines(flight.detection, DetectionCost.of(flight))
    response = flight.response_time_s
    if response.median is not None and response.p95 is not None:
        lines.append(
            f"Response    {response.median * 1e3:.0f} ms from depth frame to setpoint "
            f"(median), {response.p95 * 1e3:.0f} ms (95th percentile)"
        )
    lines += _measured_lines(flight.measured_platform)
    lines += _host_lines(flight)
    return [part for line in lines for part in folded(line, _INDENT)]


def _host_lines(flight: FlightRecord) -> list[str]:
    host, simulated_s = flight.host, flight.simulated_s
    if host.get("flight_wall_s") and simulated_s is not None:
        factor = simulated_s / host["flight_wall_s"]
        return [
            f"Host        {host['flight_wall_s']:.2f} s for {simulated_s:.1f} simulated "
            f"seconds: {factor:.0f} times real time, after {host['startup_s']:.1f} s of start-up"
        ]
    return []


def _flight_lines(flight: FlightRecord) -> list[str]:
    qof, counters = flight.quality_of_flight, flight.pilot
    if qof.flight_time_s is None:
        return ["Flight      none: the mission ended before the companion took over"]
    lines = [
        f"Flight      {_number(qof.flight_time_s, 's')} from take-over, "
        f"{_number(qof.distance_m, 'm')} flown, "
        f"{_number(qof.goal_distance_m, 'm', 2)} from the goal",
        *_clearance_and_energy(qof),
    ]
    if counters is None:  # a user's companion has none
        return lines
    flown = counters.replans + any(e.kind in ("plan", "replan") for e in flight.events)
    wanted, failed, again = counters.plans_requested, counters.plans_failed, counters.replans
    why = ", ".join(f"{reason} {n}x" for reason, n in flight.plan_failures.items())
    return [
        *lines,
        f"Plans       {wanted} requested: {flown} flown{f' ({again} replans)' if again else ''}, "
        f"{failed} failed{f' ({why})' if why else ''}, {wanted - flown - failed} not used",
        f"Obstacles   {counters.collisions_foreseen} collisions predicted, "
        f"{counters.slowdowns} slowdowns, {counters.stops} stops",
    ]


def _clearance_and_energy(qof: QualityOfFlight) -> list[str]:
    clearance, energy = "not known", "not known"
    if qof.min_clearance_m is not None:
        clearance = f"{_number(qof.min_clearance_m, 'm', 2)} minimum"
    if qof.energy_regression_j is not None or qof.energy_propeller_j is not None:
        energy = (
            f"{_number(qof.energy_regression_j, 'kJ', per=1e3)} (paper's regression), "
            f"{_number(qof.energy_propeller_j, 'kJ', per=1e3)} (propeller shafts)"
        )
    return [f"Clearance   {clearance}", f"Energy      {energy}"]


def _measured_lines(measured: MeasuredPlatform | None) -> list[str]:
    if measured is None:
        return []
    medians = ", ".join(
        f"{name} {1e3 * times.host_median_s:.2f} ms" for name, times in measured.kernels.items()
    )
    return [f"Measured    {medians} (medians on this host), x {measured.factor:g} in the flight"]


def _node_lines(nodes: Mapping[str, NodeEnds]) -> list[str]:
    lines = []
    for name, node in nodes.items():
        ends = [f"{crash.how} at {crash.stamp_s:.2f} s" for crash in node.crashes[:3]]
        if len(node.crashes) > 3:
            ends.append(f"{len(node.crashes) - 3} more crashes")
        if node.hangs:
            ends.append(f"hung {node.hangs} times" if node.hangs > 1 else "hung once")
        if ends:
            lines.append(f"Node        {name}: {'; '.join(ends)}; restarted {node.restarts}x")
    return lines


def _program_lines(programs: Mapping[str, ProgramEnds]) -> list[str]:
    lines = []
    for name, program in programs.items():
        ends = ", ".join(map(str, program.codes)) or "still running at the end"
        lines.append(f"Program     {name}: started {program.starts}x; exit codes: {ends}")
    return lines


def _detection_lines(detection: Detection | None, cost: DetectionCost | None) -> list[str]:
    if detection is None:
        return []
    responses, alarms = detection.responses, detection.alarm_count
    lines = [
        f"Detector    {detection.detector} on {', '.join(detection.protect)}: "
        f"{sum(detection.checks.values())} checks, {alarms} alarm{'' if alarms == 1 else 's'}"
    ]
    for alarm in detection.alarms[:3]:
        where = ", ".join(alarm.states[:2]) or "all states together"
        lines.append(
            f"            at {alarm.stamp_s:.2f} s: {alarm.stage}, {where}: {alarm.response}"
        )
    if "setpoint" in detection.checks:  # the gate for a user's companion
        doing = {"none": "setpoints reported: {}", "stale": "stale setpoints: {}"}
        return lines + [
            "            " + doing.get(name, f"setpoints withheld: {{}} {name}").format(count)
            for name, count in responses.items()
            if count
        ]
    if alarms:
        recovered = [
            f"{stage} {recovery.count}x, {recovery.total_s * 1e3:.1f} ms"
            for stage, recovery in detection.recoveries.items()
            if recovery.count
        ]
        lines.append(
            f"            recovered {'; '.join(recovered)}; {responses['hold']} holds, "
            f"{responses['accept']} accepted after all"
        )
    if cost is not None:
        lines.append(
            f"            {1e6 * cost.check_host_s:.1f} us a check here, "
            f"{100.0 * cost.detection_share:.4f} % of the flight time"
        )
    return lines


def folder_lines(run: Run, picture: Path | None) -> list[str]:
    """Return lines with the paths of a run folder and, if they exist, its traceback and picture."""
    inside = "" if picture != run.folder.picture else f"  (see {run.folder.picture.name})"
    return [
        "",
        f"Run folder  {run.folder.path}" + inside,
        *([f"Traceback   {run.folder.crash}"] if run.folder.crash.is_file() else []),
        *([f"Picture     {picture}"] if picture is not None and not inside else []),
    ]


def run_html(run: Run) -> str:
    """Return the summary and the picture of a run as HTML.

    The text is escaped, because the record is not trusted. The picture is drawn from the record and
    embedded as an image, in which browsers run no script.
    """
    from mavfi_cli.report.drawing import svg
    from mavfi_cli.report.top_view import draw_top_view

    text = html.escape("\n".join([*summary_lines(run.record), *folder_lines(run, None)]))
    data = base64.b64encode(svg(draw_top_view(run)).encode()).decode()
    return (
        f'<pre style="white-space: pre-wrap">{text}</pre><img alt="the flight from above" '
        f'style="max-width: 100%; background: white" src="data:image/svg+xml;base64,{data}">'
    )


def event_lines(flight: FlightRecord) -> list[str]:
    """Return one line per event of a flight, with its simulated time, kind and text."""
    return [f"{e.stamp_s:9.2f} s  {e.kind:<10} {e.text}" for e in flight.events]


_MESSAGES = {
    "message": "message",
    "output": "message from the companion,",
    "input": "message to the companion,",
}


def _fault_lines(flight: FlightRecord) -> list[str]:
    if flight.instruction_fault is not None:
        return _instruction_lines(flight.instruction_fault)
    fault = flight.state_fault
    if fault is None or fault.trigger is None:
        return []
    trigger = fault.trigger
    when = {
        "random": f"at a random moment ({_number(trigger.drawn_time_s, 's', 2)} after take-over)",
        "time": f"{trigger.number:g} s after take-over",
        "tick": f"at control tick {trigger.number:g}",
        "phase": f"once the pilot is in the phase {trigger.phase}",
        "foreseen": "once a collision is foreseen",
        "invocation": f"at invocation {trigger.number:g} of the kernel",
    }[trigger.when]
    request, states = fault.request, ", ".join(fault.states)
    place = _MESSAGES.get(fault.stage, f"{fault.stage} stage,")
    what = f"{place} {states}: {request['persistence']} {request['effect']}"
    if fault.stage == "process":
        effect, _, share = request["effect"].partition("=")
        struck = {
            "flip": "is killed",
            "stop": "is stopped",
            "slow": f"is slowed to {share} of a processor",
        }
        lasts_s = request.get("duration_s")
        lasting = "" if lasts_s is None else f" for {lasts_s:g} s"
        what = f"{states} {struck[effect]}{lasting}"
    lines = [f"Fault       {what}, {when}"]
    if fault.state == "not_injected":
        lines.append(f"            not injected: {fault.reason}")
    for strike in fault.strikes[:3]:
        lines += [_change_line(strike.stamp_s, change) for change in strike.changes]
    if fault.strike_count and fault.strike_count > 3:
        lines.append(f"            and {fault.strike_count - 3} more strikes")
    if fault.state == "applied" and "" not in fault.units[:1] and fault.activation is not None:
        lines.append(f"            {_activation(fault.activation)}")
    return lines


def _activation(activation: RecordedActivation) -> str:
    """Describe which node first read the corrupted value, or why no node read it."""
    reader = activation.first_reader
    if reader is not None:
        return f"first read by {reader.name} at {reader.stamp_s:.2f} s ({reader.state})"
    return {
        "withheld": "withheld by the detector's gate before any node read it",
        "overwritten": "overwritten before any node read it",
        "not_read": "never read before the mission ended",
        "unchanged": "changed nothing: the state already had that value",
    }[activation.activation]


def _instruction_lines(fault: MissionInstructionFault) -> list[str]:
    at = f"at {_number(fault.stamp_s, 's', 2)}; {fault.sampling}"
    if fault.invocation is None:
        lines = [f"Fault       process {fault.kernel} of {fault.node}, {at}"]
        where = f"before execution {fault.k} of the code in scope, {fault.instruction}"
    else:
        lines = [
            f"Fault       node {fault.node}, invocation {fault.invocation} of "
            f"{fault.invocations} of {fault.kernel}, {at}, windows {fault.windows}"
        ]
        where = f"before execution {fault.k} of {fault.instruction}"
    if fault.instruction:
        lines.append(f"            {where} ({_place(fault)})")
    if fault.state == "null":
        return [*lines, "            null injection: nothing was flipped"]
    if fault.state == "not_injected":
        return [*lines, f"            not injected: {fault.reason}"]
    corruption, injection, activation = fault.corruption, fault.injection, fault.activation
    if corruption is None or injection is None or activation is None:  # cut off
        return lines
    bits = f"bit{'s'[len(corruption.bits) == 1 :]} {', '.join(map(str, corruption.bits))}"
    what = corruption.register or corruption.site
    return [
        *lines,
        f"            {bits} of {corruption.role} {what}: {injection.before} -> "
        f"{injection.after}; {activation.activation.replace('_', ' ')}",
    ]


def _place(fault: MissionInstructionFault) -> str:
    """Describe the location of the struck instruction: offset in a function, or in an object."""
    if not fault.symbol:
        return f"{fault.object}+{fault.offset:#x}"
    name, _, offset = fault.symbol.partition("+")
    return f"{short_name(name)}{offset and '+'}{offset} in {fault.object}"


def _change_line(stamp_s: float, change: Change) -> str:
    place = f"[{change.index}]" if change.state.startswith("waypoint") else ""
    bits = ", ".join(map(str, change.bits)) or "none: the state already had that value"
    plural = "s" if len(change.bits) > 1 else ""
    before = _formatted(change.before, change.before_hex, change.after)
    after = _formatted(change.after, change.after_hex, change.before)
    return (
        f"            at {stamp_s:.2f} s: {change.state}{place} {before} -> {after} "
        f"(bit{plural} {bits})"
    )


def _formatted(value: Scalar | None, pattern: str, other: Scalar | None) -> str:
    """Format a value so that it can be distinguished from `other`.

    JSON has no infinities and NaN, so the record holds None for them. They are decoded from their
    bits, `pattern`.
    """
    if value is None:
        return {"0x7ff0000000000000": "inf", "0xfff0000000000000": "-inf"}.get(
            pattern, f"nan {pattern}"
        )
    return format_distinct(value, *([] if other is None else [other]))[0]


def difference_lines(run: Run, golden: Run) -> list[str]:
    """Describe how a run differs from its golden run: first difference, path, time and outcome."""
    parting = run.first_difference(golden)
    ours, theirs = run.record, golden.record
    fault = ours.fault
    struck = () if ours.state_fault is None else ours.state_fault.states
    if parting is None or run.first_difference(golden, leave_out=struck) is None:
        why = "none" if fault is None else _no_effect(fault)
        return [f"Effect      {why}: nothing else ever differs from the golden flight"]
    sides = ["not finite" if v is None else v for v in (parting.this, parting.other)]
    lines = [
        f"Effect      first at {parting.stamp_s:.2f} s in {parting.column}: "
        f"{' instead of '.join(format_distinct(*sides))}",
        f"            at most {run.largest_deviation_m(golden):.2f} m from the golden vehicle",
    ]
    our_s, their_s = (record.quality_of_flight.flight_time_s for record in (ours, theirs))
    if our_s and their_s:
        change = 100.0 * (our_s / their_s - 1.0)
        lines.append(
            f"            {our_s:.1f} s and {ours.outcome} instead of "
            f"{their_s:.1f} s and {theirs.outcome} ({change:+.1f} %)"
        )
    return lines


def _no_effect(fault: StateFault | MissionInstructionFault) -> str:
    """Return the reason why a fault had no effect: not injected, not activated, or masked."""
    if fault.state == "not_injected":
        return "none, not injected"
    activation = "" if fault.activation is None else fault.activation.activation
    return "masked" if activation == "read" else f"none, {activation.replace('_', ' ')}"
