"""Executes single instructions in a traced process, from any state of all registers and memory.

A state is one integer: the general registers, the extended state and a window of memory, one after
the other. So a set of flipped bits, or of changed ones, is an integer too.
"""

from __future__ import annotations

import ctypes
import os
import re
import signal
import struct

import capstone
import numpy as np
from elftools.elf.elffile import ELFFile
from native_programs import all_registers

from mavfi_cli.fi.tracer import linux
from mavfi_cli.fi.tracer.decode import GENERAL, decode
from mavfi_cli.fi.tracer.image import Image
from mavfi_cli.fi.tracer.registers import (
    _SLOT,
    AVX,
    FLAGS,
    NT_PRSTATUS,
    NT_X86_XSTATE,
    OPMASK,
    XSTATE_BV,
    ZMM_HIGH,
    ZMM_UPPER,
    Registers,
    _xsave_offsets,
)

WINDOW = 4096
WORDS = 27
EDGES = np.array([0, *((1 << 64) - 1 >> n for n in range(3)), 1 << 62, 1 << 63], np.uint64)
_WIDE = (n for n in all_registers() if n[0] in "xyzk" or n[:2] == "st")
NAMES = [*GENERAL, "rflags", *(re.sub("^[xy]mm", "zmm", name) for name in _WIDE)]


class Probe:
    """A stopped process that executes one instruction at a time."""

    def __init__(self, tracee):
        self.tid, self.memory = tracee.tid, tracee.memory
        self.registers = Registers(self.tid)
        facts = Image(tracee.pid).named("probe")
        with open(facts.path, "rb") as stream:
            symbols = ELFFile(stream).get_section_by_name(".symtab")
            found = {n: symbols.get_symbol_by_name(n)[0]["st_value"] for n in ("page", "slot")}
        self.slot = facts.bias + found["slot"]
        self.target = facts.bias + found["page"] + (1 << 16)  # where memory operands are
        self.start = self.target - WINDOW // 2
        self.words = list(self.registers.general())
        self.area = bytearray(self.registers.extended())
        # All components that there are are in use, so that the kernel takes every value.
        present = int.from_bytes(self.area[XSTATE_BV : XSTATE_BV + 8], "little") | 0b11
        for component in _xsave_offsets().keys() & {AVX, OPMASK, ZMM_HIGH, ZMM_UPPER}:
            present |= 1 << component
        self.area[XSTATE_BV : XSTATE_BV + 8] = present.to_bytes(8, "little")
        self.area_at = 64 * WORDS
        self.memory_at = self.area_at + 8 * len(self.area)
        self.ip_bits = ((1 << 64) - 1) << 64 * _SLOT["rip"]
        self.places = {name: self._pieces(name) for name in NAMES}

    def _pieces(self, name):
        """(state bit, register bit, width) of each part of a register."""
        if name in GENERAL or name == "rflags":
            return [(64 * _SLOT[name], 0, 64)]
        pieces, done = [], 0
        for span in self.registers._spans(name):
            pieces.append((self.area_at + 8 * span.offset, done, 8 * span.size))
            done += 8 * span.size
        return pieces

    def bits(self, register, mask):
        """Bits of a register as bits of the state."""
        return sum(
            (mask >> shift & (1 << width) - 1) << place
            for place, shift, width in self.places[register]
        )

    def memory_bits(self, use, instruction, values):
        """Bits of a memory operand as bits of the state."""
        address = use.address(instruction, lambda name: values.get(name, 0))
        return use.mask << self.memory_at + 8 * (address - self.start)

    def state(self, values, content):
        """A state from the values of registers and the window of memory."""
        words = list(self.words)
        state = int.from_bytes(struct.pack("<27Q", *words), "little")
        state |= int.from_bytes(self.area, "little") << self.area_at
        everything = 0
        for name in NAMES:
            if name != "rflags":
                everything |= self.bits(name, (1 << 512) - 1)
        state &= ~everything
        for name, value in values.items():
            if name == "rflags":
                state = state & ~self.bits(name, FLAGS) | self.bits(name, value & FLAGS)
            else:
                state |= self.bits(name, value)
        state = state & ~self.ip_bits | self.slot << 64 * _SLOT["rip"]
        return state | int.from_bytes(content, "little") << self.memory_at

    def described(self, bits):
        """Bits of a state by the names of registers; memory from 64 bytes before the operand."""
        found = {}
        for name in NAMES:
            mask = 0
            for place, shift, width in self.places[name]:
                mask |= (bits >> place & (1 << width) - 1) << shift
            if mask:
                found[name] = mask
        if memory := bits >> self.memory_at:
            found["memory"] = memory >> 8 * (WINDOW // 2 - 64)
        return found | ({"rip": 1} if bits & self.ip_bits else {})

    def place(self, code):
        """Put the instruction into its slot."""
        self.memory.write(self.slot, code.ljust(32, b"\x90"))

    def execute(self, state):
        """Execute the instruction once: the signal that it raised, or 0, and the state after it."""
        data = state.to_bytes(self.memory_at // 8 + WINDOW, "little")
        linux.set_registers(self.tid, NT_PRSTATUS, data[: self.area_at // 8])
        linux.set_registers(self.tid, NT_X86_XSTATE, data[self.area_at // 8 : self.memory_at // 8])
        self.memory.write(self.start, data[self.memory_at // 8 :])
        linux.request(linux.SINGLESTEP, self.tid)
        _, status = os.waitpid(self.tid, linux.WALL)
        assert os.WIFSTOPPED(status), status
        raised = os.WSTOPSIG(status)
        words = ctypes.create_string_buffer(8 * WORDS)
        area = ctypes.create_string_buffer(len(self.area))
        linux.get_registers(self.tid, NT_PRSTATUS, words)
        linux.get_registers(self.tid, NT_X86_XSTATE, area)
        after = words.raw + area.raw + self.memory.read(self.start, WINDOW)
        return (0 if raised == signal.SIGTRAP else raised), int.from_bytes(after, "little")


# -- states


def _floats(rng, count, kind):
    """Patterns of doubles or singles as numbers of 64 bits."""
    if kind == "double":
        mantissa, bias, width = 52, 1023, 64
    else:
        mantissa, bias, width = 23, 127, 32
    number = count * 64 // width
    top = int(rng.choice([3, 10, 40, 62]))
    exponent = bias + rng.integers(-2, top, number)
    fraction = rng.integers(0, 1 << mantissa, number, dtype=np.uint64)
    cut = int(rng.choice([0, 0, 29, mantissa, rng.integers(0, mantissa + 1)]))
    cut = min(cut, mantissa)
    fraction = fraction >> np.uint64(cut) << np.uint64(cut)
    if cut and rng.random() < 0.5:  # exactly between two shorter numbers
        fraction |= np.uint64(1 << cut - 1)
    sign = rng.integers(0, 2, number).astype(np.uint64)
    pattern = sign << np.uint64(width - 1) | exponent.astype(np.uint64) << np.uint64(mantissa)
    pattern |= fraction
    return pattern if width == 64 else pattern[::2] | pattern[1::2] << np.uint64(32)


def _general(rng, count):
    values = rng.integers(0, 1 << 64, count, dtype=np.uint64)
    shifts = rng.integers(0, 64, count).astype(np.uint64)
    kind = rng.integers(8)
    if kind == 1:
        values >>= np.uint64(rng.integers(17, 62))
    elif kind == 2:
        values >>= shifts
    elif kind == 3:
        values[:] = values[0] >> np.uint64(rng.integers(0, 40))
    elif kind == 4:
        values = np.uint64(1) << shifts
    elif kind == 5:
        values[:] = 0
    elif kind == 6:
        values = ~np.uint64(0) >> shifts
    elif kind == 7:
        values = rng.choice(EDGES, count)
    return values


def _vector(rng, count):
    kind = rng.integers(6)
    if kind < 2:
        values = _floats(rng, count, "double")
    elif kind < 4:
        values = _floats(rng, count, "single")
    else:
        values = _general(rng, count)
    if rng.random() < 0.35:
        values = np.resize(values[:8] if rng.random() < 0.5 else values[:1], count)
    return values


def random_state(probe, rng, instruction):
    """Values of all registers and a window of memory, with memory operands inside of it."""
    values = dict(zip(GENERAL, (int(v) for v in _general(rng, 16)), strict=True))
    values["rflags"] = int(rng.integers(0, 1 << 12)) & ~(1 << 10)
    wide = _vector(rng, 8 * 40)
    for index, name in enumerate(NAMES[17:]):
        own = wide[8 * (index % 40) : 8 * (index % 40) + 8]
        width = 512 if name[0] == "z" else 256 if name[0] == "y" else 64
        if name[0] in "zyx":
            values[name] = int.from_bytes(own.tobytes(), "little") & (1 << width) - 1
        elif name[0] == "k":
            values[name] = int(rng.integers(0, 1 << 64, dtype=np.uint64))
    content = bytearray((_vector if rng.random() < 0.6 else _general)(rng, WINDOW // 8).tobytes())
    if rng.random() < 0.3 and instruction.memory:  # as in a register, for comparisons
        for use in instruction.reads:
            if use.explicit and use.register in values:
                own = values[use.register].to_bytes(64, "little")[:32]
                content[WINDOW // 2 : WINDOW // 2 + len(own)] = own
    for use in instruction.memory:
        _aim(probe, rng, use, values)
    return values, bytes(content)


def _aim(probe, rng, use, values):
    base = use.base if use.base in GENERAL else None
    index = use.index if use.index in GENERAL else None
    goal = probe.target - use.displacement
    if base and index and base == index:
        values[base] = goal // (1 + use.scale)
    elif base:
        offset = 0
        if index:
            values[index] = int(rng.integers(0, 32))
            offset = values[index] * use.scale
        values[base] = goal - offset
    elif index:
        values[index] = goal // use.scale


def _disassembled(code, slot=0):
    engine = capstone.Cs(capstone.CS_ARCH_X86, capstone.CS_MODE_64)
    engine.detail = True
    return next(engine.disasm(code, slot, 1))


def relocated(code, slot, target):
    """The instruction with an operand relative to the instruction pointer moved to the window."""
    found = _disassembled(code)
    operands = [op.mem for op in found.operands if op.type == capstone.x86.X86_OP_MEM]
    if not any(found.reg_name(memory.base) == "rip" for memory in operands):
        return code
    at = found.disp_offset
    moved = (target - slot - len(code)).to_bytes(4, "little", signed=True)
    return code[:at] + moved + code[at + 4 :]


def with_immediate(code, rng):
    """The instruction with another immediate, if it has one; no shift by a multiple of 16."""
    found = _disassembled(code)
    if not found.imm_offset or rng.random() < 0.3:
        return code
    small, any_high = int(rng.integers(1, 16)), int(rng.integers(0, 16)) << 4
    # A small one shifts hardly anything out, the longest ones nearly everything.
    low = int(rng.choice([small, small | any_high, 31, 63]))
    value = bytes([low]) + rng.bytes(found.imm_size - 1)
    return code[: found.imm_offset] + value + code[found.imm_offset + found.imm_size :]


def decoded(code, slot):
    """The instruction as it is in the slot."""
    return decode(code.ljust(16, b"\x90"), slot)
