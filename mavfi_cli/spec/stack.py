"""Stacks: structure, checks and gains of the companion. One TOML file per stack.

A file either gives every key, or names a shipped stack as its `base` and gives the differences. For
an ablation, the name of a stack may include differences: `mavbench:guards_tracking=true`.
"""

from __future__ import annotations

import hashlib
import json
import re
import tomllib
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Any

from mavfi_cli.autonomy import SMOOTHERS
from mavfi_cli.core.config import Shipped, read_toml, structure
from mavfi_cli.core.errors import ConfigError, UnknownName
from mavfi_cli.core.types import KERNELS, StackMark

DEFAULT = "mavbench"
FIRST = "hardened"  # stack of records that name none
STACKS = Shipped("stack", Path(__file__).parent / "stacks")
_ABOUT = ("name", "description", "base", "sources")
_PAIR = re.compile(r",(?=\s*\w+\s*=)")  # separator of KEY=VALUE pairs; arrays contain commas too
_LIMITS = {  # minimum and maximum of each number
    "tracking_guard_m": (0.1, 1000.0),
    "farthest_waypoint_m": (10.0, 1.0e6),
    "position_gain_per_s": (0.01, 10.0),
    "climb_gain_per_s": (0.0, 10.0),
    "integral_gain_per_s2": (0.0, 10.0),
    "damping_gain": (0.0, 1.0),
    "check_radius_m": (0.1, 10.0),
    "planner_radius_m": (0.1, 10.0),
    "goal_tolerance_m": (0.1, 50.0),
    "rejected_plan_pause_s": (0.0, 60.0),
    "slice_period_s": (0.01, 1.0),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Stack:
    """The structure, checks and gains of mavfi's companion, as in docs/reference/stacks.md.

    Attributes:
        stretches_clock: A waypoint lasts until its distance is covered. If the speed limit clips a
            command, the trajectory's clock slows down by the ratio of clipped to demanded speed.
        skips_endless_slices: A waypoint ends at once if its slice of 10 ms is stretched to 2^63 s
            or more.
        guards_tracking: The vehicle stops and replans if it is farther than `tracking_guard_m`
            from the reference.
        refuses_far_waypoints: The collision check reports a waypoint as a collision if it is not
            finite, or farther than `farthest_waypoint_m` from the first one.
        shifts_path_to_vehicle: The collision check translates the path so that it begins at the
            vehicle.
        owns_sequence_numbers: Planner, check and pilot keep their own counters and reject lower
            numbers. Otherwise they continue each other's numbers.
        stops_on_report: A predicted collision ends the plan and the vehicle stops. Otherwise it
            flies on, slows down or stops along the plan.
        uses_time_to_collision: The time to collision delays a stop until braking must begin, or
            decides between flying on, slowing down and stopping. Otherwise the vehicle stops at
            once.
        acts_on_report_once: Only the first of several reports with the same number counts.
        plans_in_motion: Plans begin at the vehicle's future position. Otherwise the vehicle hovers
            while it plans.
        processes: Nodes that share a process, run one after the other and die together.
        control_owns_queue: Control gets a plan once and keeps it. Otherwise it gets the plan in
            every tick.
        position_gain_per_s, climb_gain_per_s: P gain of horizontal and vertical position.
        integral_gain_per_s2, damping_gain: I and D gain of position.
        feeds_acceleration_forward: The reference uses the waypoints' accelerations. Otherwise it
            keeps each waypoint's velocity, and no node reads accelerations.
        check_radius_m, planner_radius_m: Clearance of the collision check and of the planner.
        goal_tolerance_m: Distance from the goal that counts as reached.
        arrives_at_rest: The vehicle has arrived only when it is at rest.
        turns_before_departure: The vehicle makes one full turn before the first plan.
        rejected_plan_pause_s: Pause between a rejected plan and the next request.
        slows_where_blind: The vehicle flies at half speed outside its field of view.
        smoother: Smoothing of planned paths: `ours` (straight flight at 0.9 v_max with blended
            corners) or `release` (minimum snap with the release's segment times).
        slice_period_s: Time that the follower takes for a slice of 10 ms of the trajectory. The
            trajectory's clock slows down by the ratio; the commanded velocity does not change.
        restores_counters: A supervisor gives a restarted node the sequence numbers of the last
            message that left it. Otherwise the node counts from 0.
        standby: Nodes whose process has a hot standby, which works on the same inputs and takes
            over when the process dies or hangs.
        sources: Sources of the values, by key.
    """

    name: str  # name of the stack; by default that of the file
    stretches_clock: bool
    skips_endless_slices: bool
    guards_tracking: bool
    tracking_guard_m: float  # see guards_tracking
    refuses_far_waypoints: bool
    farthest_waypoint_m: float  # see refuses_far_waypoints
    shifts_path_to_vehicle: bool
    owns_sequence_numbers: bool
    stops_on_report: bool
    uses_time_to_collision: bool
    acts_on_report_once: bool
    plans_in_motion: bool
    processes: tuple[tuple[str, ...], ...]
    control_owns_queue: bool
    position_gain_per_s: float
    climb_gain_per_s: float
    integral_gain_per_s2: float
    damping_gain: float
    feeds_acceleration_forward: bool
    check_radius_m: float
    planner_radius_m: float
    goal_tolerance_m: float
    arrives_at_rest: bool
    turns_before_departure: bool
    rejected_plan_pause_s: float
    slows_where_blind: bool
    # Files and models of older versions lack the keys that have a default.
    smoother: str = SMOOTHERS[0]
    slice_period_s: float = 0.01
    restores_counters: bool = False
    standby: tuple[str, ...] = ()
    description: str = ""  # text that `mavfi stacks` prints
    base: str = ""  # name of a shipped stack that supplies the other values
    sources: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        ConfigError.check_limits(self, _LIMITS)
        self._check_processes()
        for node in self.standby:
            _require_node("standby", node)
            if node == "control":
                raise ValueError(
                    "standby: must not name control, because a standby would not have its queue"
                )
        if self.smoother not in SMOOTHERS:
            raise UnknownName("smoother", self.smoother, SMOOTHERS)
        if self.planner_radius_m < self.check_radius_m:
            raise ValueError(
                f"planner_radius_m: must be at least check_radius_m ({self.check_radius_m:g}), or "
                "the collision check would reject every plan; "
                f"got {self.planner_radius_m:g}"
            )
        if self.acts_on_report_once and not (self.stops_on_report or self.plans_in_motion):
            raise ValueError(
                "acts_on_report_once: needs stops_on_report or plans_in_motion, or the vehicle "
                "would fly on into the obstacle"
            )
        for key in self.sources:
            if key not in KEYS:
                raise ValueError(f"sources.{key}: unknown key")

    def _check_processes(self) -> None:
        seen: set[str] = set()
        for nodes in self.processes:
            if len(nodes) < 2:
                raise ValueError(
                    f"processes: a shared process must have at least two nodes, got {list(nodes)}"
                )
            for node in nodes:
                _require_node("processes", node)
                if node == "control":
                    raise ValueError(
                        "processes: control runs in every tick, so it must have its own process"
                    )
                if node in seen:
                    raise ValueError(f"processes: must not name {node} twice")
                seen.add(node)

    @staticmethod
    def split(text: str) -> tuple[str, dict[str, Any]]:
        """Return the stack's name or file that a text for `load_stack` gives, and its changes.

        Raises:
            ConfigError: the changes are not KEY=VALUE,KEY=VALUE. Keys and values are not checked.
        """
        name, _, changes = text.partition(":")
        try:
            return name, tomllib.loads("\n".join(_quoted(pair) for pair in _PAIR.split(changes)))
        except tomllib.TOMLDecodeError:
            raise ConfigError(
                f"must have KEY=VALUE,KEY=VALUE after the stack's name, got {changes!r}",
                key="stack",
            ) from None

    def settings_of(self, params: type) -> dict[str, Any]:
        """Return the stack's value for each key that is also a field of the dataclass `params`."""
        return {key.name: getattr(self, key.name) for key in fields(params) if key.name in KEYS}

    @property
    def mark(self) -> StackMark:
        """The identity of the stack that a detector's model stores: its name, and a digest.

        The digest excludes keys with their default value, so a key added later does not change it.
        """
        settings = self.settings_of(Stack)
        same = [key for key, value in _DEFAULTS.items() if settings[key] == value]
        for key in same:
            del settings[key]
        text = json.dumps(settings, sort_keys=True)
        return StackMark(name=self.name, digest=hashlib.sha256(text.encode()).hexdigest())


def _quoted(pair: str) -> str:
    """Return KEY=VALUE with quotes around the value if it is a word, as in `smoother=ours`."""
    key, equals, value = pair.partition("=")
    word = value.strip().isidentifier() and value.strip() not in ("true", "false", "inf", "nan")
    return f'{key}{equals}"{value.strip()}"' if word else pair


def _require_node(key: str, node: str) -> None:
    if node not in KERNELS:
        raise ValueError(f"{key}: no node {node!r}; known: {', '.join(KERNELS)}")


KEYS: tuple[str, ...] = tuple(key.name for key in fields(Stack) if key.name not in _ABOUT)
_DEFAULTS = {
    key.name: key.default
    for key in fields(Stack)
    if key.name in KEYS and key.default is not MISSING
}


def load_stack(text: str) -> Stack:
    """Load a stack from `NAME` or `FILE.toml`, or from either with `:KEY=VALUE,KEY=VALUE` appended.

    NAME is a shipped stack. The given values replace those of the stack. They have TOML syntax,
    except that a word needs no quotes.

    Raises:
        UnknownName: No shipped stack has this name, and it is not a path to a TOML file.
        ConfigError: No stack has this key, the file or a value cannot be used, a key is missing, or
            the stack is inconsistent.
    """
    name, changed = Stack.split(text)
    path = STACKS.path(name)
    values, source = _values(path)
    stack = structure(values, Stack, path=path, text=source)
    if ":" not in text:
        return stack
    sources = {**values.get("sources", {}), **dict.fromkeys(changed, "this variant's name")}
    about = {"name": text, "base": name, "description": "", "sources": sources}
    return structure({**values, **changed, **about}, Stack)  # its errors are not the file's


def _values(path: Path) -> tuple[dict[str, Any], str]:
    """Return the values in a stack file, completed with those of its base, and the file's text."""
    values, text = read_toml(path)
    own = {} if path.parent == STACKS.folder else dict.fromkeys(KEYS, f"set in {path.name}")
    about = {"name": path.stem, "description": ""}
    inherited: dict[str, Any] = {}
    if values.get("base", ""):
        base = STACKS.base(values["base"], path)
        inherited, _ = _values(STACKS.folder / f"{base}.toml")
    elif values.keys() <= {*KEYS, *_ABOUT} and (
        missing := [k for k in KEYS if k not in values and k not in _DEFAULTS]
    ):
        raise ConfigError(
            f"{', '.join(missing[:3])}{', ...' if missing[3:] else ''}: missing; "
            f"base = NAME takes missing values from a stack: {', '.join(STACKS.names)}",
            path=path,
        )
    kept = {key: why for key, why in inherited.pop("sources", {}).items() if key not in values}
    given = {key: why for key, why in own.items() if key in values}
    sources = {**kept, **given, **values.get("sources", {})}
    return {**inherited, **about, **values, "sources": sources}, text
