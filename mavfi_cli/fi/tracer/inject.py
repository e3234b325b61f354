"""Corrupts a stopped thread, verifies the corruption and follows its effect."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from enum import Enum

from mavfi_cli.core.errors import FaultError
from mavfi_cli.core.processes import Ended
from mavfi_cli.fi import bits
from mavfi_cli.fi.tracer.decode import Instruction, decode
from mavfi_cli.fi.tracer.fault import InstructionCorruption, InstructionFault, Role, Site
from mavfi_cli.fi.tracer.image import Image
from mavfi_cli.fi.tracer.registers import TRAP_FLAG, VECTOR_BITS, width_of
from mavfi_cli.fi.tracer.tracee import Tracee


class BitActivation(Enum):
    """What happened to the corrupted bits while they were followed."""

    READ = "read"
    OVERWRITTEN = "overwritten"
    NOT_READ_IN_WINDOW = "not_read_in_window"
    ENDED_BEFORE_READ = "ended_before_read"
    NOT_FOLLOWED = "not_followed"
    NOT_INJECTED = "not_injected"


@dataclass(frozen=True, slots=True, kw_only=True)
class Injection:
    """The result of corrupting the stopped target."""

    applied: bool
    reason: str  # why it was not applied; empty if it was
    address: int  # address of the corrupted memory or opcode, otherwise of the instruction
    before: int  # the full register, the opcode bytes or the memory operand
    after: int  # as read back
    stop_s: float  # time that the corruption took


@dataclass(frozen=True, slots=True, kw_only=True)
class Followed:
    """The activation of the corrupted bits, and the instruction that decided it."""

    activation: BitActivation
    after_instructions: int  # 0: the attacked instruction itself
    instruction: str = ""


NOTHING = Followed(activation=BitActivation.NOT_INJECTED, after_instructions=0)


def reach(tracee: Tracee, image: Image, fault: InstructionFault) -> str:
    """Run the target to the exact execution that the trigger names.

    Returns:
        The reason why the execution was not reached; empty if it was.
    """
    for stage in fault.trigger:
        address = image.address(stage.location)
        if not tracee.run_to(address, stage.count, stage.detour):
            return f"the program ended before execution {stage.count} of {stage.location}"
    return ""


def instruction_at(tracee: Tracee, address: int) -> Instruction | None:
    """Decode the instruction at an address of the target, or return None if there is none."""
    try:
        return decode(tracee.memory.read(address, 16), address)
    except OSError:
        return None


def clean_step(tracee: Tracee, instruction: Instruction | None) -> Ended | None:
    """Execute one whole instruction and leave no trap flag in the target.

    Returns:
        How the program ended, or None if it has not ended.
    """
    if instruction is not None and instruction.run_over:
        tracee.run_to(instruction.next_address)
    elif tracee.step() is None and instruction is not None:
        _erase_trap(tracee, instruction)
    return tracee.ended


def _erase_trap(tracee: Tracee, instruction: Instruction) -> None:
    """Remove the trap flag that a single step of `instruction` left in the target.

    A `pushf` has pushed the flag onto the stack, and a system call has saved it in r11.
    """
    registers, memory = tracee.registers, tracee.memory
    if instruction.mnemonic in ("pushfq", "pushf"):
        stack = registers.sp
        size = 2 if instruction.mnemonic == "pushf" else 8
        image = int.from_bytes(memory.read(stack, size), "little")
        memory.write(stack, (image & ~TRAP_FLAG).to_bytes(size, "little"))
    elif instruction.mnemonic == "syscall":
        saved = registers.read("r11")
        if saved & TRAP_FLAG:
            registers.write("r11", saved & ~TRAP_FLAG)


def _apply(
    tracee: Tracee, instruction: Instruction, corruption: InstructionCorruption
) -> Injection:
    """Apply a corruption at the stop before `instruction`, and verify it.

    A destination is corrupted after the instruction has executed. The result is read back. A
    change that the operating system discards or refuses counts as not applied.
    """
    start = time.perf_counter_ns()
    place = instruction.address
    if corruption.site is Site.MEMORY:
        use = instruction.memory[corruption.memory_operand]
        place = use.address(instruction, tracee.registers.read)
    before = after = 0
    if corruption.role is Role.DESTINATION and clean_step(tracee, instruction) is not None:
        reason = "the program ended in the instruction"
    else:
        try:
            before, after = _invert(tracee, instruction, corruption, place)
            lost = [bit for bit in corruption.struck(before) if not (before ^ after) >> bit & 1]
            reason = f"discarded by the operating system: bits {lost}" if lost else ""
        except OSError as error:
            reason = f"refused by the operating system: {error.strerror}"
    return Injection(
        applied=not reason,
        reason=reason,
        address=place,
        before=before,
        after=after,
        stop_s=(time.perf_counter_ns() - start) * 1e-9,
    )


def _invert(
    tracee: Tracee, instruction: Instruction, corruption: InstructionCorruption, place: int
) -> tuple[int, int]:
    if corruption.site is Site.OPCODE:
        return _execute_corrupted(tracee, instruction, corruption)
    if corruption.site is Site.MEMORY:
        size = instruction.memory[corruption.memory_operand].size
        data = tracee.memory.read(place, size)
        tracee.memory.write(place, bits.flip_bytes(data, corruption.bits))
        return _number(data), _number(tracee.memory.read(place, size))
    registers = tracee.registers
    before = registers.read(corruption.register)
    kind = bits.BitType.raw(width_of(corruption.register) // 8)
    struck = corruption.struck(before)
    registers.write(corruption.register, before ^ kind.mask(struck))
    return before, registers.read(corruption.register)


def _execute_corrupted(
    tracee: Tracee, instruction: Instruction, corruption: InstructionCorruption
) -> tuple[int, int]:
    """Emulate a transient fetch error: execute the corrupted bytes once, then restore the code.

    Returns the original and the corrupted bytes, each as a number.
    """
    corrupted = bits.flip_bytes(instruction.raw, corruption.bits)
    tracee.memory.write(instruction.address, corrupted)
    seen = tracee.memory.read(instruction.address, len(corrupted))
    decoded = decode(tracee.memory.read(instruction.address, 16), instruction.address)
    if clean_step(tracee, decoded) is None:
        tracee.memory.write(instruction.address, instruction.raw)
    return _number(instruction.raw), _number(seen)


def _number(data: bytes) -> int:
    return int.from_bytes(data, "little")


def _follow(
    tracee: Tracee,
    instruction: Instruction,
    corruption: InstructionCorruption,
    injection: Injection,
    *,
    window: int,
    patience_s: float,
) -> Followed:
    """Step until the corrupted bits are read or overwritten, or the window or time runs out."""
    if not injection.applied:
        return NOTHING
    if corruption.role is Role.SOURCE or corruption.site is Site.INSTRUCTION_POINTER:
        return Followed(
            activation=BitActivation.READ, after_instructions=0, instruction=instruction.text
        )
    remaining = bits.BitType.raw(VECTOR_BITS).mask(corruption.bits)
    until_s = time.monotonic() + patience_s
    for distance in range(1, window + 1):
        current = instruction_at(tracee, tracee.registers.ip)
        if current is None:
            break
        if time.monotonic() > until_s:
            window = distance - 1
            break
        read, remaining = _touch(tracee, current, corruption, injection.address, remaining)
        if read or (corruption.bits and not remaining):
            what = BitActivation.READ if read else BitActivation.OVERWRITTEN
            return Followed(activation=what, after_instructions=distance, instruction=current.text)
        if clean_step(tracee, current) is not None:
            return Followed(activation=BitActivation.ENDED_BEFORE_READ, after_instructions=distance)
    what = BitActivation.NOT_READ_IN_WINDOW if window else BitActivation.NOT_FOLLOWED
    return Followed(activation=what, after_instructions=window)


def strike(
    tracee: Tracee, fault: InstructionFault, *, window: int, patience_s: float = math.inf
) -> tuple[Injection | None, Followed]:
    """Corrupt the target at the stop before the attacked instruction, and follow the bits.

    Args:
        tracee: the process, stopped before that instruction.
        fault: the fault; if it has no corruption, nothing is done.
        window: largest number of instructions for which a destination fault is followed.
        patience_s: longest wall-clock time for which it is followed.

    Raises:
        FaultError: the location holds another instruction.
    """
    instruction = instruction_at(tracee, tracee.registers.ip)
    if instruction is None or instruction.raw != fault.instruction_bytes:
        text = "nothing" if instruction is None else instruction.text
        raise FaultError(f"{fault.target} must hold {fault.instruction!r}, but it holds {text!r}")
    if fault.corruption is None:
        return None, NOTHING
    injection = _apply(tracee, instruction, fault.corruption)
    steps = window if tracee.ended is None else 0
    return injection, _follow(
        tracee, instruction, fault.corruption, injection, window=steps, patience_s=patience_s
    )


def _touch(
    tracee: Tracee,
    current: Instruction,
    corruption: InstructionCorruption,
    place: int,
    remaining: int,
) -> tuple[bool, int]:
    """Return whether `current` reads corrupted bits, and which of them remain after it.

    `remaining` holds the corrupted bits that have not been overwritten yet.
    """
    if corruption.site is Site.MEMORY:
        return _touch_memory(tracee, current, place, remaining)
    register = corruption.register
    for use in current.reads:
        if use.register == register and use.mask & remaining:
            return True, remaining
    for use in current.writes:
        if use.register == register:
            remaining &= ~use.clears
    return False, remaining


def _touch_memory(
    tracee: Tracee, current: Instruction, place: int, remaining: int
) -> tuple[bool, int]:
    for reads in (True, False):
        for use in current.memory:
            if not (use.reads if reads else use.writes):
                continue
            start = use.address(current, tracee.registers.read) - place
            mask = use.mask
            mask = mask << 8 * min(start, 64) if start >= 0 else mask >> min(-8 * start, 1024)
            if mask & remaining:
                if reads:
                    return True, remaining
                remaining &= ~mask
    return False, remaining
