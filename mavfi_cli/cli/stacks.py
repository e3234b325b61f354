"""`mavfi stacks`: the stacks of the companion, and the source of each value."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import Any

import click

_WIDTH = 100
_GROUPS = {  # all keys, in the order of the output
    "Follower": (
        "stretches_clock", "skips_endless_slices", "guards_tracking", "tracking_guard_m",
        "position_gain_per_s", "climb_gain_per_s", "integral_gain_per_s2", "damping_gain",
        "feeds_acceleration_forward", "control_owns_queue",
    ),
    "Collision check": (
        "check_radius_m", "refuses_far_waypoints", "farthest_waypoint_m", "shifts_path_to_vehicle",
    ),
    "What a foreseen collision does": (
        "stops_on_report", "uses_time_to_collision", "acts_on_report_once",
    ),
    "Planning": (
        "planner_radius_m", "plans_in_motion", "rejected_plan_pause_s", "slows_where_blind",
    ),
    "Mission": ("goal_tolerance_m", "arrives_at_rest", "turns_before_departure"),
    "Nodes": ("owns_sequence_numbers", "processes"),
}  # fmt: skip
_KEY = max(len(key) for keys in _GROUPS.values() for key in keys) + 2
_VALUE = 7  # columns of a truth value or a number


@click.command()
@click.argument("names", nargs=-1, metavar="[NAME|FILE]...")
@click.option("--json", "as_json", is_flag=True, help="Print everything as JSON.")
def stacks(names: tuple[str, ...], as_json: bool) -> None:
    """List the stacks, explain the keys of one, or show the keys in which several differ.

    NAME:KEY=VALUE,KEY=VALUE names a variant: that stack with other values of some keys, such as
    mavbench:guards_tracking=true. FILE:KEY=VALUE works in the same way.
    """
    from mavfi_cli.spec.stack import STACKS, load_stack

    found = [load_stack(name) for name in names or STACKS.names]
    if as_json:
        click.echo(json.dumps([asdict(stack) for stack in found], indent=2))
    elif not names:
        click.echo("\n".join([
            *(f"{stack.name:<19}{stack.description}" for stack in found),
            "",
            "`mavfi stacks NAME` explains every key, "
            "`mavfi stacks NAME NAME` shows where stacks differ.",
            "NAME:KEY=VALUE,KEY=VALUE names a variant, such as mavbench:guards_tracking=true.",
        ]))  # fmt: skip
    else:
        click.echo("\n".join(_explained(found[0]) if len(found) == 1 else _compared(found)))


def _explained(stack: Any) -> Iterator[str]:
    """All keys with value and source."""
    base = f"; the other values from {stack.base}" if stack.base else ""
    yield from textwrap.wrap(_title(stack) + base, _WIDTH)
    for group, keys in _GROUPS.items():
        yield group
        for key in keys:
            value = _told(getattr(stack, key))
            head = f"  {key:<{_KEY}}{value:<{_VALUE}}"
            start = 2 + _KEY + _VALUE
            source = textwrap.wrap(stack.sources.get(key, "not given"), _WIDTH - start)
            yield head + source.pop(0) if len(head) == start else head  # else its source is below
            yield from (" " * start + line for line in source)


def _compared(found: Sequence[Any]) -> Iterator[str]:
    """The keys in which stacks differ, one column per stack."""
    for number, stack in enumerate(found, start=1):
        yield from textwrap.wrap(f"{number}  {_title(stack)}", _WIDTH, subsequent_indent="   ",
                                 break_long_words=True)  # fmt: skip
    keys = [key for keys in _GROUPS.values() for key in keys
            if len({getattr(stack, key) for stack in found}) > 1]  # fmt: skip
    yield ""
    if not keys:
        yield "no key differs"
        return
    width = max(8, (_WIDTH - _KEY) // len(found))
    yield _row("", [[str(number)] for number in range(1, len(found) + 1)], width)
    for key in keys:
        cells = [textwrap.wrap(_told(getattr(stack, key)), width - 2) for stack in found]
        yield _row(key, cells, width)


def _row(key: str, cells: Sequence[Sequence[str]], width: int) -> str:
    """One line for a key, or several if a value is wider than its column."""
    lines = [
        f"{'' if line else key:<{_KEY}}"
        + "".join(f"{cell[line] if line < len(cell) else '':<{width}}" for cell in cells)
        for line in range(max(map(len, cells)))
    ]
    return "\n".join(line.rstrip() for line in lines)


def _title(stack: Any) -> str:
    return f"{stack.name}: {stack.description}" if stack.description else stack.name


def _told(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return ", ".join(" + ".join(nodes) for nodes in value) or "none"
    return f"{value:g}"
