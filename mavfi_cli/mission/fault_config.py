"""What a user asks to be injected, as plain values that a record can hold."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Any

from mavfi_cli.core.errors import FaultSpecError, UnknownName
from mavfi_cli.core.states import BY_NAME
from mavfi_cli.fi.bits import Field
from mavfi_cli.fi.source.draw import GROUPS, draw_fault
from mavfi_cli.fi.source.fault import (
    Corruption,
    Effect,
    Persistence,
    SourceFault,
    Trigger,
    When,
)
from mavfi_cli.mission.platform import KERNELS

_UNIT_S = {When.TIME: 1.0, When.TICK: 0.02}  # of a trigger's number
DETECTOR = "detector"  # the target that is no state: what the detector keeps
PROCESS = "process"  # and the one that is no value: the process in which a node works
QUEUE = "queue"  # before a state of a waypoint: the copy of the plan that control has
_QUEUED = [name for name in dict.fromkeys((*BY_NAME, *GROUPS)) if name.startswith("waypoint_")]


@dataclass(frozen=True, slots=True, kw_only=True)
class FaultConfig:
    """One source-level fault of a mission.

    Attributes:
        target: a stage, a state, or a group of states; or `detector`, `detector.PART`: its own
            memory, such as `detector.threshold`; or `process.NODE`: the node's process is killed;
            or `queue.STATE`: a waypoint's state in control's own copy of the plan.
        seed: root of the fault's own random streams.
        at: "random", "time=SECONDS", "tick=N", "phase=NAME", "foreseen" or "invocation=N".
        together: strike all components of the group at once.
        exact_bits: these bits instead of drawn ones.
    """

    target: str
    seed: int = 1
    at: str = "random"
    together: bool = False
    effect: str = "flip"
    bits: int = 1
    field: str = "any"
    exact_bits: tuple[int, ...] | None = None
    persistence: str = "transient"
    duration_s: float | None = None  # None: to the end
    period_s: float = 1.0

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for the record of the run."""
        return asdict(self)

    @property
    def attacks_detector(self) -> bool:
        """Whether the detector's own memory is hit, not a state between kernels."""
        return self.target.partition(".")[0] == DETECTOR

    @property
    def killed_node(self) -> str | None:
        """The node whose process is killed; None for a fault in a value."""
        what, dot, node = self.target.partition(".")
        return node if what == PROCESS and dot else None

    @property
    def strikes_queue(self) -> bool:
        """Whether control's own copy of the plan is hit."""
        return self.target.partition(".")[0] == QUEUE

    @property
    def detector_part(self) -> str | None:
        """The array of the detector's memory that is hit; None draws one."""
        return self.target.partition(".")[2] or None

    def check(self) -> None:
        """Say now what is wrong with it; raises as `draw`."""
        if self.killed_node is not None:
            self._check_kill(self.killed_node)
        elif self.attacks_detector:  # its memory is known in the mission only
            self.trigger()
            self.corruption()
        else:
            self.draw()

    def _check_kill(self, node: str) -> None:
        if node not in KERNELS:
            raise UnknownName("node", node, KERNELS)
        if replace(self, seed=1, at="random") != FaultConfig(target=self.target):
            raise FaultSpecError(f"{self.target}: a process that is killed has no bits")
        if self.trigger().when is When.INVOCATION:
            raise FaultSpecError(f"{self.target}: a process is killed at a time, tick or phase")

    def check_within(self, time_limit_s: float) -> None:
        """Refuse a trigger that no mission of this length reaches; raises also as `trigger`.

        Raises:
            FaultSpecError: the time or the tick lies beyond the limit.
        """
        trigger = self.trigger()
        at_s = trigger.number * _UNIT_S.get(trigger.when, 0.0)
        if at_s > time_limit_s:
            raise FaultSpecError(
                f"at {self.at}: {at_s:g} s into the flight lies beyond the mission's time limit "
                f"of {time_limit_s:g} s"
            )

    def trigger(self) -> Trigger:
        """When it strikes; raises as `parse_trigger`."""
        return parse_trigger(self.at)

    def corruption(self) -> Corruption:
        """What is done to a value; raises UnknownName and FaultSpecError."""
        return Corruption(
            effect=_member(Effect, "effect", self.effect),
            bits=self.bits,
            field=_member(Field, "field", self.field),
            persistence=_member(Persistence, "persistence", self.persistence),
            duration_s=math.inf if self.duration_s is None else self.duration_s,
            period_s=self.period_s,
        )

    def draw(self) -> SourceFault:
        """The fault in a state between kernels, its site drawn.

        Raises:
            UnknownName: a name that does not exist.
            FaultError: values that do not fit.
        """
        target = self.target
        if self.strikes_queue:
            target = target.partition(".")[2]
            if not target.startswith("waypoint_"):
                raise UnknownName("state of control's queue", target, _QUEUED)
            if self.trigger().when is When.INVOCATION:
                raise FaultSpecError(f"{self.target}: a queue is no message, so it has no number")
        return draw_fault(
            target,
            seed=self.seed,
            trigger=self.trigger(),
            corruption=self.corruption(),
            together=self.together,
            bits=self.exact_bits,
        )


def parse_trigger(text: str) -> Trigger:
    """The trigger that a text like `time=12.5` stands for.

    Raises:
        UnknownName: no such kind of trigger, or no such phase.
        FaultSpecError: a number that is none.
    """
    from mavfi_cli.autonomy.orders import Mode

    kind, _, value = text.partition("=")
    if not value and kind.replace(".", "", 1).isdigit():
        raise FaultSpecError(f"at {text}: a number needs its kind, as in time={text} (s)")
    when: When = _member(When, "trigger", kind)
    if when in (When.RANDOM, When.FORESEEN):
        return Trigger(when=when)
    if when is When.PHASE:
        return Trigger(when=when, phase=_member(Mode, "phase", value).value)
    try:
        return Trigger(when=when, number=float(value))
    except ValueError:
        raise FaultSpecError(f"{text!r}: {kind} needs a number, as in {kind}=12") from None


def _member(kind: Any, what: str, name: str) -> Any:
    try:
        return kind(name)
    except ValueError:
        raise UnknownName(what, name, [member.value for member in kind]) from None
