"""`mavfi doctor`, `platforms`, `stacks` and `states`: test this machine, list what mavfi ships."""

from __future__ import annotations

import json
import math
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import click

from mavfi_cli.cli.grouped import GroupedCommand, option
from mavfi_cli.cli.types import PLATFORM, STACK
from mavfi_cli.core.terminal import echo, echo_lines
from mavfi_cli.report.table import WIDTH, Table

if TYPE_CHECKING:
    from mavfi_cli.spec.platform import PlatformProfile
    from mavfi_cli.spec.stack import Stack


def _print_json(rows: Iterable[Any]) -> None:
    echo(json.dumps([asdict(row) for row in rows], indent=2))


def _title(chosen: PlatformProfile | Stack) -> str:
    return f"{chosen.name}: {chosen.description}" if chosen.description else chosen.name


# Doctor -------------------------------------------------------------------------------------------

_FINDING = 29  # column in which a check's finding starts
_MARKS = {"ok": ("green", "ok"), "limited": ("yellow", "limited"), "failed": ("red", "FAILED")}


@click.command(cls=GroupedCommand)
@option("--json", "as_json", is_flag=True, help="Print the checks as JSON.")
def doctor(as_json: bool) -> None:
    """Test this machine: wheels, cores, physics, loopback, ptrace, breakpoints.

    Exits with code 1 if mavfi cannot fly here. Limitations do not change the exit code.
    """
    from mavfi_cli.mission.machine import FAILED, check_machine

    checks = []
    for check in check_machine():
        checks.append(check)
        if not as_json:
            colour, mark = _MARKS[check.verdict]
            first, *rest = textwrap.wrap(check.finding, WIDTH - _FINDING) or [""]
            click.secho(f"{mark:<8}", fg=colour, nl=False)
            echo(f"{check.name:<20} {first}")
            for line in [*rest, *([f"-> {check.remedy}"] if check.remedy else [])]:
                echo(f"{'':<{_FINDING}}{line}")
    if as_json:
        rows = [
            {"name": check.name, "verdict": check.verdict, "found": check.finding,
             "remedy": check.remedy}
            for check in checks
        ]  # fmt: skip
        echo(json.dumps(rows, indent=2))
    if any(check.verdict == FAILED for check in checks):
        raise click.exceptions.Exit(1)


# Platforms ----------------------------------------------------------------------------------------

_P95 = 1.6449  # 95 % quantile of the standard normal distribution
_MORE_PLATFORMS = """\
measured:FACTOR  this host's own kernel times while it flies, times FACTOR; for `mavfi fly \
--realtime` only

`mavfi platforms NAME` shows every kernel; docs/how-to/platform.md explains how to add one."""
_MEASURED = """\
{cores} cores, stays on the ground
Every invocation of {kernels} is
measured on this host, and its output takes effect {factor:g} times that duration later.
result.json has the medians. Such a flight does not repeat, so only
`mavfi fly --realtime` accepts this platform."""


@click.command(cls=GroupedCommand)
@click.argument("names", nargs=-1, metavar="[NAME|FILE]...", type=PLATFORM)
@option("--json", "as_json", is_flag=True, help="Print everything as JSON.")
def platforms(names: tuple[str, ...], as_json: bool) -> None:
    """List the compute platforms, or show the named ones kernel by kernel."""
    from mavfi_cli.spec.platform import PLATFORMS, load_platform

    profiles = [load_platform(name) for name in names or PLATFORMS.names]
    if as_json:
        _print_json(profiles)
    elif names:
        echo("\n\n".join("\n".join(_kernel_lines(profile)) for profile in profiles))
    else:
        for profile in profiles:
            echo(
                f"{profile.name:<12} {profile.cores:>3} cores {profile.power_w:>6.1f} W  "
                f"board {1000 * profile.mass_kg:>3.0f} g  all kernels {_all_s(profile):>6.3f} s  "
                f"{profile.description}"
            )
        echo(_MORE_PLATFORMS)


def _all_s(profile: PlatformProfile) -> float:
    return float(sum(latency.latency_s for latency in profile.kernels.values()))


def _kernel_lines(profile: PlatformProfile) -> Iterator[str]:
    """Yield lines of text about a platform and the latency of each kernel, with their sources."""
    if profile.measured_factor is not None:
        yield _title(profile)
        yield _MEASURED.format(
            cores=profile.cores, kernels=", ".join(profile.kernels), factor=profile.measured_factor
        )
        return
    based = f"; latencies from {profile.base}" if profile.base else ""
    yield f"{_title(profile)}; {'carried' if profile.carried else 'stays on the ground'}{based}"
    rows = [("cores", f"{profile.cores}", "cores"), ("power", f"{profile.power_w:g} W", "power_w")]
    if profile.carried:
        rows += [
            ("board", f"{1000 * profile.mass_kg:g} g", "mass_kg"),
            ("heat sink", f"{1000 * profile.heatsink_kgpw:g} g/W", "heatsink_kgpw"),
        ]
    for title, value, key in rows:
        yield f"{title:<16} {value:>10}  {profile.sources.get(key, 'not given')}"
    yield ""
    yield f"{'kernel':<16} {'median':>10}  {'5 % to 95 %':>22}  source"
    for name, latency in profile.kernels.items():
        factor = math.exp(_P95 * latency.spread)
        low, high = (1000 * latency.latency_s * f for f in (1.0 / factor, factor))
        yield (
            f"{name:<16} {1000 * latency.latency_s:>7.2f} ms  {low:>8.2f} to {high:>8.2f} ms  "
            f"{latency.source or 'not given'}"
        )
    yield f"{'all of them':<16} {1000 * _all_s(profile):>7.2f} ms"
    if "spread" in profile.sources:
        yield f"{'their spread':<53} {profile.sources['spread']}"


# Stacks -------------------------------------------------------------------------------------------

_GROUPS = {  # all keys, in the order of the output
    "Follower": (
        "stretches_clock", "skips_endless_slices", "guards_tracking", "tracking_guard_m",
        "position_gain_per_s", "climb_gain_per_s", "integral_gain_per_s2", "damping_gain",
        "feeds_acceleration_forward", "control_owns_queue", "slice_period_s",
    ),
    "Collision check": (
        "check_radius_m", "refuses_far_waypoints", "farthest_waypoint_m", "shifts_path_to_vehicle",
    ),
    "What a foreseen collision does": (
        "stops_on_report", "uses_time_to_collision", "acts_on_report_once",
    ),
    "Planning": (
        "planner_radius_m", "plans_in_motion", "rejected_plan_pause_s", "slows_where_blind",
        "smoother",
    ),
    "Mission": ("goal_tolerance_m", "arrives_at_rest", "turns_before_departure"),
    "Nodes": ("owns_sequence_numbers", "restores_counters", "standby", "processes"),
}  # fmt: skip
_KEY = max(len(key) for keys in _GROUPS.values() for key in keys) + 2
_VALUE = 8  # columns for a boolean, a number or a short word
_MORE_STACKS = """
`mavfi stacks NAME` explains every key, `mavfi stacks NAME NAME` shows where stacks differ.
NAME:KEY=VALUE,KEY=VALUE names a variant, such as mavbench:guards_tracking=true."""


@click.command(cls=GroupedCommand)
@click.argument("names", nargs=-1, metavar="[NAME|FILE]...", type=STACK)
@option("--json", "as_json", is_flag=True, help="Print everything as JSON.")
def stacks(names: tuple[str, ...], as_json: bool) -> None:
    """List the stacks, explain the keys of one, or show the keys in which several differ.

    NAME:KEY=VALUE,KEY=VALUE names a variant: that stack with other values of some keys, such as
    mavbench:guards_tracking=true. FILE:KEY=VALUE works in the same way.
    """
    from mavfi_cli.spec.stack import STACKS, load_stack

    loaded = [load_stack(name) for name in names or STACKS.names]
    if as_json:
        _print_json(loaded)
    elif not names:
        echo_lines(f"{stack.name:<19}{stack.description}" for stack in loaded)
        echo(_MORE_STACKS)
    else:
        echo_lines(_explained(loaded[0]) if len(loaded) == 1 else _compared(loaded))


def _explained(stack: Stack) -> Iterator[str]:
    base = f"; the other values from {stack.base}" if stack.base else ""
    yield from textwrap.wrap(_title(stack) + base, WIDTH)
    start = 2 + _KEY + _VALUE
    for group, keys in _GROUPS.items():
        yield group
        for key in keys:
            head = f"  {key:<{_KEY}}{_format_value(getattr(stack, key)):<{_VALUE}}"
            source = textwrap.wrap(stack.sources.get(key, "not given"), WIDTH - start)
            yield (
                head + source.pop(0) if len(head) == start else head
            )  # the source of a long value starts on the next line
            yield from (" " * start + line for line in source)


def _compared(stacks: Sequence[Stack]) -> Iterator[str]:
    """Yield the lines of a table of the keys in which stacks differ, with one column per stack."""
    for number, stack in enumerate(stacks, start=1):
        yield from textwrap.wrap(f"{number}  {_title(stack)}", WIDTH, subsequent_indent="   ",
                                 break_long_words=True)  # fmt: skip
    keys = [key for keys in _GROUPS.values() for key in keys
            if len({getattr(stack, key) for stack in stacks}) > 1]  # fmt: skip
    yield ""
    if not keys:
        yield "no key differs"
        return
    width = max(8, (WIDTH - _KEY) // len(stacks))
    rows = [("", [[str(number)] for number in range(1, len(stacks) + 1)])]
    rows += [
        (key, [textwrap.wrap(_format_value(getattr(stack, key)), width - 2) for stack in stacks])
        for key in keys
    ]
    for key, cells in rows:  # several lines if a value is wider than its column
        for line in range(max(map(len, cells))):
            columns = [f"{cell[line] if line < len(cell) else '':<{width}}" for cell in cells]
            yield f"{'' if line else key:<{_KEY}}{''.join(columns)}".rstrip()


def _format_value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        names = (node if isinstance(node, str) else " + ".join(node) for node in value)
        return ", ".join(names) or "none"
    return value if isinstance(value, str) else f"{value:g}"


# States -------------------------------------------------------------------------------------------


@click.command(cls=GroupedCommand)
@option("--json", "as_json", is_flag=True, help="Print the table as JSON.")
def states(as_json: bool) -> None:
    """List the monitored states, which are the injection sites of source-level faults."""
    from mavfi_cli.core.types import STATES

    rows = [
        {
            "name": state.name,
            "stage": state.stage.value,
            "group": state.group,
            "type": state.dtype.value,
            "unit": state.unit,
        }
        for state in STATES
    ]
    if as_json:
        echo(json.dumps(rows, indent=2))
        return
    echo_lines(Table.of_records(rows).lines())
