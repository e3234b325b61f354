"""Compares the masks of an instruction with what its execution does.

Bits that an instruction does not read are flipped many at a time: nothing but these bits may change
in the result, and those that it clears may not even remain. Bits that it reads are flipped one by
one until each has changed something in some state.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

import numpy as np
from probe import NAMES, WINDOW, decoded, random_state, relocated, with_immediate

from mavfi_cli.fi.tracer.decode import FLAG_BITS
from mavfi_cli.fi.tracer.registers import FLAGS

STATES, AT_LEAST, ATTEMPTS = 400, 4, 4000
_EVERY = (1 << 512) - 1
# Their masks do not follow the immediate: masking by a value is no matter of operands.
_ANY_IMMEDIATE = re.compile(
    r"(add|sub|and|or|xor|cmp|test|adc|sbb|imul|mov|movabs|sh[lr]|sar|ro[lr]|rc[lr]|shld|v?ps(rl|ll|ra)[wdq])$"
)


@dataclass
class Verdict:
    """What execution contradicts, and what it could not show."""

    text: str
    states: int = 0
    wrong: list[str] = field(default_factory=list)
    never_read: dict[str, int] = field(default_factory=dict)  # bits of the masks, by operand
    never_written: dict[str, int] = field(default_factory=dict)
    raised: set[int] = field(default_factory=set)


@dataclass
class Masks:
    """Bits of a state that an instruction reads, writes and always replaces."""

    reads: int
    writes: int
    clears: int

    @classmethod
    def of_registers(cls, probe, instruction):
        """Those of the registers; the instruction pointer is always replaced."""
        reads, writes, clears = 0, probe.ip_bits, probe.ip_bits
        for use in instruction.reads:
            reads |= probe.bits(use.register, use.mask)
        for use in instruction.writes:
            writes |= probe.bits(use.register, use.mask)
            clears |= probe.bits(use.register, use.clears)
        return cls(reads, writes, clears)

    def with_memory(self, probe, instruction, values):
        """Those and the memory operands'."""
        reads, writes, clears = self.reads, self.writes, self.clears
        for use in instruction.memory:
            bits = probe.memory_bits(use, instruction, values)
            reads |= bits * use.reads
            writes |= bits * use.writes
            clears |= bits * (use.writes and not instruction.mnemonic.endswith("cmpxchg"))
        return Masks(reads, writes, clears)


def check(probe, code, seed=0):
    """Execute an instruction from random states, flip bits before it, and compare the results."""
    return _Check(probe, relocated(code, probe.slot, probe.target), seed).run()


class _Check:
    def __init__(self, probe, code, seed):
        self.probe, self.code, self.rng = probe, code, np.random.default_rng(seed)
        # How many bytes a flip takes depends on the processor's layout: no state depends on it.
        self.flips = np.random.default_rng([seed, 1])
        self.instruction = decoded(code, probe.slot)
        self.verdict = Verdict(text=self.instruction.text)
        flags = probe.bits("rflags", FLAGS)
        registers = sum(probe.bits(name, _EVERY) for name in NAMES if name != "rflags")
        self.flippable = registers | flags | ((1 << 8 * WINDOW) - 1) << probe.memory_at
        undefined = (1 << FLAG_BITS[u.operand] for u in self.instruction.writes if not u.mask
                     and u.operand in FLAG_BITS)  # fmt: skip
        self.compared = (self.flippable | probe.ip_bits) & ~probe.bits("rflags", sum(undefined))
        self.registers = Masks.of_registers(probe, self.instruction)
        self.seen = self.ever = self.changed = 0  # read bits that matter, all, and written ones

    @property
    def unwritten(self):
        return self.registers.writes & self.compared & ~self.probe.ip_bits & ~self.changed

    def run(self):
        verdict = self.verdict
        self.probe.place(self.code)
        for _ in range(ATTEMPTS):
            done = verdict.states >= AT_LEAST and not (self.ever & ~self.seen or self.unwritten)
            if done or verdict.states >= STATES or len(verdict.wrong) > 6:
                break
            self._one_state()
        verdict.never_read = self.probe.described(self.ever & ~self.seen)
        verdict.never_written = self.probe.described(self.unwritten)
        return verdict

    def _one_state(self):
        if _ANY_IMMEDIATE.match(self.instruction.mnemonic):
            self.probe.place(with_immediate(self.code, self.rng))
        values, content = random_state(self.probe, self.rng, self.instruction)
        before = self.probe.state(values, content)
        raised, after = self.probe.execute(before)
        if raised:
            self.verdict.raised.add(raised)
            return
        self.verdict.states += 1
        masks = self.registers.with_memory(self.probe, self.instruction, values)
        self.changed |= before ^ after
        self._wrong("writes", (before ^ after) & ~(masks.writes | masks.clears))
        self._wrong("does not clear", after & masks.clears & ~masks.writes)
        for _ in range(3):
            self._flip_outside(before, after, masks)
        self.ever |= masks.reads
        self._flip_inside(before, after, masks)

    def _wrong(self, what, bits):
        if bits := bits & self.compared:
            told = ", ".join(f"{n} {mask:#x}" for n, mask in self.probe.described(bits).items())
            self.verdict.wrong.append(f"{what} {told}")

    def _flip_outside(self, before, after, masks):
        drawn = int.from_bytes(self.flips.bytes(self.flippable.bit_length() // 8 + 1), "little")
        flipped = drawn & self.flippable & ~masks.reads
        raised, other = self.probe.execute(before ^ flipped)
        if raised:
            self.verdict.wrong.append(f"signal {raised} by bits that it does not read")
            return
        either = flipped & masks.writes & ~masks.clears  # it may write them, or leave them
        self._wrong(
            "depends on others, or keeps", (other ^ after ^ flipped & ~masks.clears) & ~either
        )

    def _flip_inside(self, before, after, masks):
        left = masks.reads & ~self.seen
        while left:
            bit = left & -left
            left ^= bit
            raised, other = self.probe.execute(before ^ bit)
            difference = (other ^ after) & self.compared
            if raised or difference & ~bit or difference & bit & masks.clears:
                self.seen |= bit
