"""Configuration of a fault at source or instruction level, as plain values for the record."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import Field as Member
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any, TypeVar

from mavfi_cli.core.errors import FaultSpecError, UnknownName, named_member
from mavfi_cli.core.seeds import Stream
from mavfi_cli.core.types import BY_NAME, KERNELS, Stage
from mavfi_cli.fi.bits import Field
from mavfi_cli.fi.fault import (
    GROUPS,
    OF_MESSAGES,
    OF_PROCESSES,
    OF_VALUES,
    Corruption,
    Effect,
    Persistence,
    SourceFault,
    Trigger,
    When,
    draw_fault,
    require_effect,
)

if TYPE_CHECKING:
    from mavfi_cli.link.fields import WireFields

T = TypeVar("T")
_UNIT_S = {When.TIME: 1.0, When.TICK: 0.02}  # unit of a trigger's number
DETECTOR = "detector"  # target: memory of the detector
PROCESS = "process"  # target prefix: process of a node
QUEUE = "queue"  # target prefix: control's copy of the plan
DIRECTIONS = ("output", "input")  # target prefixes: messages from a companion, and to it
_QUEUED = [name for name in dict.fromkeys((*BY_NAME, *GROUPS)) if name.startswith("waypoint_")]


@dataclass(frozen=True, slots=True, kw_only=True)
class FaultConfig:
    """The configuration of one source-level fault of a mission.

    Attributes:
        target: Injection site: a stage, a state or a group of states; `detector` or `detector.PART`
            for the detector's memory, such as `detector.threshold`; `process.NODE` to kill the
            node's process; `queue.STATE` for a waypoint's state in control's copy of the plan. In
            a user's companion: `process.PROGRAM`, MAVLink's `MESSAGE.FIELD`, `MESSAGE.FIELD[INDEX]`
            of an array, or `MESSAGE`; `output.` or `input.` before it selects a direction.
        seed: Root seed of the fault's random streams.
        at: Trigger: "random", "time=SECONDS", "tick=N", "phase=NAME", "foreseen" or "invocation=N".
        together: Corrupt all components of the target's group at once.
        exact_bits: Bits to flip instead of randomly drawn ones.
    """

    target: str
    seed: int = 1
    at: str = "random"
    together: bool = False
    effect: str = "flip"  # flip, zero, random, freeze, drop, late=S, twice, swap, stop, slow=SHARE
    bits: int = 1  # number of distinct bits to flip
    field: str = "any"  # field of the bits: sign, exponent, mantissa or any
    exact_bits: tuple[int, ...] | None = None
    persistence: str = "transient"  # transient, stuck-at or intermittent
    duration_s: float | None = None  # None: until the end of the mission
    period_s: float = 1.0  # time between two strikes of an intermittent fault

    def __post_init__(self) -> None:
        _check_seed(self.seed)

    @property
    def attacks_detector(self) -> bool:
        """True if the injection site is the detector's memory."""
        return self.target.partition(".")[0] == DETECTOR

    @property
    def killed_node(self) -> str | None:
        """Name of the node or program whose process is the target, or None for other targets."""
        what, dot, node = self.target.partition(".")
        return node if what == PROCESS and dot else None

    @property
    def wire_target(self) -> tuple[str | None, str] | None:
        """Direction and MESSAGE[.FIELD] of a fault in MAVLink messages, or None for other faults.

        The direction is "output" or "input", or None if the fault strikes both.
        """
        first, _, rest = self.target.partition(".")
        direction, target = (first, rest) if first in DIRECTIONS else (None, self.target)
        return (direction, target) if direction or target[:1].isupper() else None

    @property
    def strikes_queue(self) -> bool:
        """True if the injection site is control's copy of the plan."""
        return self.target.partition(".")[0] == QUEUE

    @property
    def detector_part(self) -> str | None:
        """Name of the array in the detector's memory to corrupt, or None to draw one at random."""
        return self.target.partition(".")[2] or None

    def describe(self, struck: str | None = None) -> str:
        """Describe the fault for a title, such as "an exponent bit of waypoint x, stuck-at".

        Args:
            struck: state that was drawn from the target, if any.
        """
        where = struck or self.target
        where = where.partition(".")[2] if self.strikes_queue and "." in where else where
        where = f"each component of {where}" if self.together else where
        where = f"{where} in control's queue" if self.strikes_queue else where
        bits = _bits_in_words(self.bits, self.field)
        if self.exact_bits:
            numbers = " and ".join(map(str, self.exact_bits))
            bits = f"bit{'s'[len(self.exact_bits) == 1 :]} {numbers}"
        effect, _, amount = self.effect.partition("=")
        if self.killed_node is not None:
            where = f"the process of {self.killed_node}"
        what = {
            Effect.FLIP.value: f"{bits} of {where}" if self.killed_node is None
                               else f"{where} is killed",
            Effect.ZERO.value: f"{where} set to zero",
            Effect.RANDOM.value: f"{where} drawn anew",
            Effect.FREEZE.value: f"{where} frozen",
            Effect.DROP.value: f"{where} dropped",
            Effect.LATE.value: f"{where} late by {amount} s",
            Effect.TWICE.value: f"{where} sent twice",
            Effect.SWAP.value: f"{where} after the next one",
            Effect.STOP.value: f"{where} is stopped",
            Effect.SLOW.value: f"{where} has {amount} of a processor",
        }[effect]  # fmt: skip
        held = [self.persistence] if self.persistence != Persistence.TRANSIENT.value else []
        when = [f"at {self.at.replace('=', ' ')}"] if self.at != When.RANDOM.value else []
        if self.wire_target is None:
            what = what.replace("_", " ")
        return ", ".join([what, *held, *when])

    def check(self) -> None:
        """Validate the configuration. Raises the same errors as `draw` and `draw_wire`."""
        if self.wire_target is not None:
            self.draw_wire()
        elif self.killed_node is not None:
            self._check_kill(self.killed_node)
        elif self.attacks_detector:  # its memory is only known during the mission
            self.trigger()
            self.corruption()
        else:
            self.draw()

    def _check_kill(self, node: str) -> None:
        if node not in KERNELS:
            raise UnknownName("node", node, KERNELS)
        if replace(self, seed=1, at="random") != FaultConfig(target=self.target):
            raise FaultSpecError(
                f"{self.target}: a fault that kills a process takes only a seed and a trigger"
            )
        self._check_trigger_of_process()

    def _check_trigger_of_process(self) -> None:
        if self.trigger().when in (When.INVOCATION, When.FORESEEN):
            raise FaultSpecError(f"{self.target}: at must be a time, tick or phase, got {self.at}")

    def check_program(self, programs: Collection[str]) -> None:
        """Check that the fault is possible in a process of a companion with these `programs`.

        Raises:
            UnknownName: No program or effect has this name.
            FaultSpecError: A process cannot have this effect, trigger or another setting, or the
                executable is not a file name.
        """
        name, slash, executable = (self.killed_node or "").partition("/")
        if name not in programs:
            raise UnknownName("program", name, programs)
        if slash and (not executable or "/" in executable or not executable.isprintable()):
            raise FaultSpecError(
                f"{self.target}: give the file name of the executable without its folder"
            )
        effect = self.corruption().effect
        require_effect(self.target, effect, OF_PROCESSES)
        if slash and effect is not Effect.FLIP:
            raise FaultSpecError(
                f"{self.target}: the effect {effect.value} strikes a program with all its "
                f"processes; leave out /{executable}"
            )
        self._check_trigger_of_process()
        plain = FaultConfig(
            target=self.target, seed=self.seed, at=self.at, effect=self.effect,
            duration_s=None if effect is Effect.FLIP else self.duration_s,
        )  # fmt: skip
        if self != plain:
            raise FaultSpecError(
                f"{self.target}: a fault in a process takes a seed, a trigger and an effect, and "
                "with the effects stop and slow a duration"
            )

    def draw_wire(self) -> tuple[WireFields, SourceFault | None]:
        """Draw the fields and bits that a fault in MAVLink messages corrupts.

        Returns:
            The fields of the targeted message type, and the drawn fault in them. The fault is None
            if its effect strikes whole messages.

        Raises:
            UnknownName: No message or field has this name. The error suggests the nearest.
            FaultError: Settings contradict each other.
        """
        from mavfi_cli.link.fields import WireFields  # loads pymavlink

        assert self.wire_target is not None
        target = self.wire_target[1]
        trigger, corruption = self.trigger(), self.corruption()
        if trigger.when is When.FORESEEN:
            raise FaultSpecError(
                f"{self.target}: a fault in a MAVLink message cannot have the trigger {self.at}"
            )
        fields = WireFields.of(target.partition(".")[0])
        if corruption.effect in OF_MESSAGES:
            if "." in target:
                raise FaultSpecError(
                    f"{self.target}: the effect {corruption.effect.value} needs a whole message as "
                    "its target, got a field"
                )
            if replace(self, bits=1, field="any", exact_bits=None, together=False) != self:
                raise FaultSpecError(
                    f"{self.target}: the effect {corruption.effect.value} strikes a whole message, "
                    "so it takes no bits, field or components"
                )
            return fields, None
        require_effect(self.target, corruption.effect, (*OF_VALUES, *OF_MESSAGES))
        drawn = draw_fault(
            target, seed=self.seed, trigger=trigger, corruption=corruption,
            together=self.together, bits=self.exact_bits, known=fields.states,
            wholes={fields.name: tuple(fields.states.values())},
        )  # fmt: skip
        return fields, drawn

    def check_within(self, time_limit_s: float) -> None:
        """Reject a trigger beyond the mission's time limit. Also raises the errors of `trigger`.

        Raises:
            FaultSpecError: The time or tick of the trigger is beyond the limit.
        """
        trigger = self.trigger()
        at_s = trigger.number * _UNIT_S.get(trigger.when, 0.0)
        if at_s > time_limit_s:
            raise FaultSpecError(
                f"at {self.at}: must be within the mission's time limit of {time_limit_s:g} s, "
                f"got {at_s:g} s"
            )

    def trigger(self) -> Trigger:
        """Parse `at`, and return the trigger that it describes.

        Raises:
            UnknownName: The kind of trigger or the phase does not exist.
            FaultSpecError: The number is missing or invalid.
        """
        from mavfi_cli.autonomy.pilot import PilotMode

        kind, _, value = self.at.partition("=")
        if not value and kind.replace(".", "", 1).isdigit():
            raise FaultSpecError(
                f"at {kind}: the kind of trigger is missing; write time={kind} for a time in s"
            )
        when = named_member(When, "trigger", kind)
        if when in (When.RANDOM, When.FORESEEN):
            return Trigger(when=when)
        if when is When.PHASE and (self.wire_target or value.isupper()):
            return Trigger(when=when, phase=value)  # flight mode of the autopilot
        if when is When.PHASE:
            return Trigger(when=when, phase=named_member(PilotMode, "phase", value).value)
        try:
            return Trigger(when=when, number=float(value))
        except ValueError:
            raise FaultSpecError(
                f"at {kind}: needs a number, as in {kind}=12, got {self.at!r}"
            ) from None

    def corruption(self) -> Corruption:
        """Build the corruption from the effect, the bits and the persistence.

        Raises:
            UnknownName: No effect, bit field or persistence has this name.
            FaultSpecError: A number is missing or invalid.
        """
        effect, _, amount = self.effect.partition("=")
        try:
            number = float(amount or 0.0)
        except ValueError:
            raise FaultSpecError(f"effect {effect}= needs a number, got {amount!r}") from None
        if not amount and effect in (Effect.LATE.value, Effect.SLOW.value):
            raise FaultSpecError(f"effect {effect}: needs a number, as in {effect}=0.5")
        return Corruption(
            effect=named_member(Effect, "effect", effect),
            amount=number,
            bits=self.bits,
            field=named_member(Field, "field", self.field),
            persistence=named_member(Persistence, "persistence", self.persistence),
            duration_s=math.inf if self.duration_s is None else self.duration_s,
            period_s=self.period_s,
        )

    def draw(self) -> SourceFault:
        """Draw the injection site from the target, and return the fault in that monitored state.

        Raises:
            UnknownName: The target, or another name in the configuration, does not exist.
            FaultError: Settings contradict each other.
        """
        target = self.target
        if self.strikes_queue:
            target = target.partition(".")[2]
            if not target.startswith("waypoint_"):
                raise UnknownName("state of control's queue", target, _QUEUED)
            if self.trigger().when is When.INVOCATION:
                raise FaultSpecError(
                    f"{self.target}: a fault in control's queue cannot have the trigger {self.at}"
                )
        return draw_fault(
            target,
            seed=self.seed,
            trigger=self.trigger(),
            corruption=self.corruption(),
            together=self.together,
            bits=self.exact_bits,
        )


def target_names(*, instruction: bool = False) -> list[str]:
    """Return the names of all source-level injection sites.

    If `instruction` is true, return those of the instruction level instead.
    """
    if instruction:
        return [*_NODES]
    stages = [stage.value for stage in Stage]
    return [
        *stages, *dict.fromkeys((*BY_NAME, *GROUPS)), DETECTOR,
        *(f"{QUEUE}.{name}" for name in _QUEUED), *(f"{PROCESS}.{node}" for node in KERNELS),
    ]  # fmt: skip


def _check_seed(seed: int) -> None:
    if seed < 0:
        raise FaultSpecError(f"the seed of a fault must be at least 0, got {seed}")


def _bits_in_words(count: int, field: str) -> str:
    """Describe `count` bits of a field in words, such as "a bit", "an exponent bit", "3 bits"."""
    kind = "bit" if field == Field.ANY.value else f"{field} bit"
    if count > 1:
        return f"{count} {kind}s"
    return f"{'an' if kind[0] in 'aeiou' else 'a'} {kind}"


UNIFORM = "instruction-uniform"  # the only sampling rule whose draws are repeatable
_NODES = {
    "perception": ("point_cloud", "octomap", "collision_check"),
    "planning": ("planner",),
    **{node: (node,) for node in KERNELS},
}


def _omitted(default: T) -> T:
    """Return a dataclass field that records omit if it has its default value."""
    return field(default=default, metadata={"omitted": True})


def is_omitted(config: object, own: Member[Any]) -> bool:
    """Return True if records omit the field `own` of `config`, because it has its default value."""
    return bool(own.metadata) and getattr(config, own.name) == own.default


@dataclass(frozen=True, slots=True, kw_only=True)
class InstructionConfig:
    """The configuration of one instruction-level fault of a mission.

    Attributes:
        target: Injection site: a node, or a stage from which a node is drawn. In a user's
            companion: `PROGRAM`, or `PROGRAM/EXECUTABLE` for a process that the program has
            started, such as `fly/mavsdk_server`.
        seed: Root seed of the fault's random streams.
        sampling: Sampling rule. Missions reject rules by time because they are not repeatable.
        compat: Injector whose choice of registers and bits is copied. In mavfi's own nodes the time
            remains uniformly distributed over executed instructions.
        sites, roles: Kinds of operands; empty for the default.
        bits: Number of distinct bits to flip.
        null: Null injection, which does everything except the flip.
        invocation_seed: Seed with which node and invocation are drawn; None for `seed`. Faults with
            the same seed strike the same invocation.
        at: In a user's companion: the moment from which instructions are counted, as in
            `FaultConfig`.
        objects: In a user's companion: the shared objects and executables that may be struck;
            empty for all.
        function: In a user's companion: only code that executes during calls of this function may
            be struck.
    """

    target: str
    seed: int = 1
    sampling: str = UNIFORM
    compat: str | None = None
    sites: tuple[str, ...] = ()
    roles: tuple[str, ...] = ()
    field: str = "any"  # field of the bits: sign, exponent, mantissa or any
    bits: int = 1
    null: bool = False
    invocation_seed: int | None = _omitted(None)
    at: str = _omitted("random")
    objects: tuple[str, ...] = _omitted(())
    function: str | None = _omitted(None)

    def __post_init__(self) -> None:
        _check_seed(self.seed)

    def as_dict(self) -> dict[str, Any]:
        """Return the configuration as a dict for a record, without the fields that records omit."""
        unset = {name for name, own in self.__dataclass_fields__.items() if is_omitted(self, own)}
        return {name: value for name, value in asdict(self).items() if name not in unset}

    @property
    def place_seed(self) -> int:
        """Seed for drawing the node and the invocation: `invocation_seed`, or else `seed`."""
        return self.seed if self.invocation_seed is None else self.invocation_seed

    @property
    def program(self) -> str:
        """Name of the program of a user's companion that the fault strikes."""
        return self.target.partition("/")[0]

    @property
    def executable(self) -> str | None:
        """Name of the struck process's executable, or None for the program's own process."""
        return self.target.partition("/")[2] or None

    def moment(self) -> FaultConfig:
        """Return a process fault, triggered at the moment from which instructions are counted."""
        return FaultConfig(target=f"{PROCESS}.{self.target}", seed=self.seed, at=self.at)

    def check_program(self, programs: Collection[str]) -> None:
        """Check that the fault is possible in a user's companion with these `programs`.

        Raises:
            UnknownName: No program has this name.
            FaultSpecError: A process cannot have this trigger, or the executable is not a file
                name.
        """
        self.moment().check_program(programs)

    def describe(self, struck: str | None = None) -> str:
        """Describe the fault for a title, such as "a bit in an instruction of octomap".

        Args:
            struck: node that was drawn from the target, if any.
        """
        bits = "no bit" if self.null else _bits_in_words(self.bits, self.field)
        where = f" ({', '.join((*self.sites, *self.roles))})" if self.sites or self.roles else ""
        return f"{bits} in an instruction of {struck or self.target}{where}".replace("_", " ")

    def node(self) -> str:
        """Return the target node. If the target is a stage, draw one of its nodes.

        Raises:
            UnknownName: The node or stage does not exist.
            FaultSpecError: `at`, `objects` or `function` is set, which needs a user's companion.
        """
        for name in ("at", "objects", "function"):
            if not is_omitted(self, self.__dataclass_fields__[name]):
                raise FaultSpecError(f"{name} needs --companion")
        if self.target not in _NODES:
            raise UnknownName("node or stage", self.target, _NODES)
        nodes = _NODES[self.target]
        return nodes[int(Stream.FAULT.generator(self.place_seed, "node").integers(len(nodes)))]

    def sampling_name(self) -> str:
        """Return the sampling rule in words for reports, including the injector in `compat`."""
        if self.compat is not None:
            return f"{UNIFORM} with the operands and bits of {self.compat}"
        return self.sampling
