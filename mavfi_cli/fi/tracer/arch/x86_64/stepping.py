"""Stepping and stopping on x86-64: the recording loop, the trap flag's traces, debug registers."""

from __future__ import annotations

import contextlib

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.fi.tracer import linux
from mavfi_cli.fi.tracer.arch.interface import Instruction, StepEnd
from mavfi_cli.fi.tracer.arch.x86_64.registers import TRAP_FLAG, Registers

_USER_OFFSETS = (128, 152)  # of rip and rsp in `struct user`
_DEBUG_REGISTERS = 848  # offset of debug register 0 in `struct user`


def record_steps(
    tid: int, spans: NDArray[np.int64], trace: NDArray[np.int64], stop: NDArray[np.int64]
) -> tuple[int, StepEnd, int]:
    """Single-step a stopped thread and record the address of each instruction in scope.

    Args:
        spans: (n, 2) addresses in scope.
        trace: (m,) filled from the start; a repeated string instruction is one entry.
        stop: (2 + n,) the window ends at the first address once the stack pointer is above the
            second number, and at each of the other addresses.

    Returns:
        The number of recorded addresses, why the recording ended, and the last wait status.
    """
    from mavfi_cli.fi.tracer.arch.x86_64 import stepper  # numba takes half a second to import

    status = np.zeros(1, np.int32)
    offsets = np.array(_USER_OFFSETS, np.int64)
    count, why = stepper.run(tid, spans, trace, stop, offsets, status)
    return int(count), StepEnd(int(why)), int(status[0])


def erase_trap(registers: Registers, memory: linux.Memory, instruction: Instruction) -> None:
    """Remove the trap flag that a single step of `instruction` left in the target.

    `pushf` has pushed the trap flag, and a system call has saved it in r11.
    """
    if instruction.mnemonic in ("pushfq", "pushf"):
        stack = registers.sp
        size = 2 if instruction.mnemonic == "pushf" else 8
        image = int.from_bytes(memory.read(stack, size), "little")
        memory.write(stack, (image & ~TRAP_FLAG).to_bytes(size, "little"))
    elif instruction.mnemonic == "syscall":
        saved = registers.read("r11")
        if saved & TRAP_FLAG:
            registers.write("r11", saved & ~TRAP_FLAG)


def return_address(registers: Registers, memory: linux.Memory) -> int:
    """Return address of the function; the target is stopped at its first instruction."""
    return int.from_bytes(memory.read(registers.sp, 8), "little")


class DebugBreakpoint:
    """A debug register of a *stopped* thread: traps before every execution at `address`.

    Intel SDM volume 3, section 18.2. A thread has four.

    Args:
        slot: number of the register, 0 to 3.
    """

    def __init__(self, tid: int, address: int, slot: int = 0) -> None:
        self._tid = tid
        self._enabled = 1 << 2 * slot  # for the thread; type execute, length 1: zeros
        self._taken = 3 << 2 * slot | 0xF << 16 + 4 * slot
        self._enable(0)
        self._poke(slot, address)
        self._enable(self._enabled)

    def close(self) -> None:
        """Remove the breakpoint; the thread must be stopped or gone."""
        with contextlib.suppress(ProcessLookupError):
            self._enable(0)

    def _enable(self, bits: int) -> None:
        others = linux.request(linux.PEEKUSER, self._tid, _DEBUG_REGISTERS + 8 * 7) & ~self._taken
        self._poke(7, others | bits)

    def _poke(self, register: int, value: int) -> None:
        linux.request(linux.POKEUSER, self._tid, _DEBUG_REGISTERS + 8 * register, value)
