"""Sampling rules: the population from which a fault is drawn. Every result names its rule."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np

from mavfi_cli.core.errors import FaultError, UnknownName, named_member
from mavfi_cli.fi.tracer.arch import Instruction, decode
from mavfi_cli.fi.tracer.fault import (
    FaultModel,
    InstructionCorruption,
    InstructionFault,
    Site,
    draw_corruption,
)
from mavfi_cli.fi.tracer.image import Location
from mavfi_cli.fi.tracer.windows import Stratum, plan_trigger


class Rule(Enum):
    """How the moment of a fault is drawn."""

    INSTRUCTION = "instruction-uniform"  # every executed instruction in scope is equally likely
    CPU_TIME = "cpu-time"  # a moment of the CPU time of the fault-free run
    WALL_CLOCK = "wall-clock"  # a moment of the duration of the fault-free run


@dataclass(frozen=True, slots=True, kw_only=True)
class Strategy:
    """A sampling rule with its peculiarities."""

    name: str
    rule: Rule
    model: FaultModel
    refused: frozenset[str] = frozenset()  # operands whose draw is discarded
    attempts: int = 1  # time rules: how many moments are tried
    retry_s: float = 0.0  # time rules: how much later
    whole_process: bool = False  # hits code out of scope as well
    in_system_calls: bool = False  # hits a thread that waits in the operating system as well
    bit_of: Callable[[InstructionCorruption, np.random.Generator], InstructionCorruption] = field(
        default=lambda corruption, _rng: corruption
    )

    def draw_at(
        self, instruction: Instruction, rng: np.random.Generator
    ) -> InstructionCorruption | None:
        """Draw a corruption at a stop; None gives up this moment."""
        drawn = draw_corruption(instruction, self.model, rng)
        if drawn is None or drawn.operand in self.refused:
            return None
        return self.bit_of(drawn, rng)


# The released ROSFI injector refuses these registers, so that r8 to r13 and XMM get nearly all
# faults (MAVBench/MAV_apps, branch mavfi, regManip.cpp and rosfi.cpp).
_ROSFI_REFUSED = frozenset(
    "rip rax rbx rcx rdx rsi rdi rbp rsp r14 r15 esi edi eax ecx edx bl cl dl".split()  # noqa: SIM905
)


def _rosfi_bit(
    corruption: InstructionCorruption, rng: np.random.Generator
) -> InstructionCorruption:
    """Move bits 52 to 62 (110 to 126 of XMM) to byte 0, where ROSFI writes them."""
    wide = corruption.site is Site.VECTOR
    bit = int(rng.integers(110, 127) if wide else rng.integers(52, 63))
    return replace(corruption, bits=(bit % 8,))


def strategy(name: str, model: FaultModel | None = None, *, compat: str | None = None) -> Strategy:
    """The strategy of a sampling rule, or of another injector that is imitated.

    Raises:
        UnknownName: no such rule or compatibility mode; names the nearest.
    """
    if compat is not None:
        if compat != "rosfi-2021":
            raise UnknownName("compatibility mode", compat, ["rosfi-2021"])
        return Strategy(
            name="rosfi-2021 (wall-clock, low byte only, most registers refused)",
            rule=Rule.WALL_CLOCK,
            model=FaultModel(sites=frozenset((Site.GENERAL, Site.VECTOR))),
            refused=_ROSFI_REFUSED,
            attempts=100,
            retry_s=500e-6,
            whole_process=True,
            in_system_calls=True,
            bit_of=_rosfi_bit,
        )
    rule = named_member(Rule, "sampling rule", name)
    return Strategy(name=rule.value, rule=rule, model=model or FaultModel())


def draw_fault(
    stratum: Stratum,
    plan: Strategy,
    rng: np.random.Generator,
    *,
    code_at: Callable[[int], bytes],
    locate: Callable[[int], Location],
) -> InstructionFault:
    """Draw a fault, uniformly over the executed instructions with an operand the model allows.

    If an instruction has no such operand, another is drawn, so that the rest stay equally likely.

    Args:
        stratum: windows of the golden run.
        plan: a strategy whose rule is instruction-uniform.
        rng: the fault's own generator.
        code_at: 16 bytes of code at an address.
        locate: the location of an address.

    Raises:
        FaultError: no executed instruction in scope has such an operand.
    """
    if not stratum.executed:
        raise FaultError("no instruction in scope was executed")
    for _ in range(10_000):
        segment, index = stratum.at(int(rng.integers(stratum.executed)))
        address = int(segment.trace[index])
        instruction = decode(code_at(address), address)
        if instruction is None:
            continue
        corruption = plan.draw_at(instruction, rng)
        if corruption is None:
            continue
        trigger, k = plan_trigger(segment, index, locate)
        return InstructionFault(
            trigger=trigger,
            execution=k,
            instruction=instruction.text,
            instruction_bytes=instruction.raw,
            corruption=corruption,
        )
    raise FaultError("no executed instruction in scope has an operand that the fault model allows")
