"""Corruptions arrive, are read back, and their fate is told right."""

import signal

import pytest
from native_programs import register_corruption

from mavfi_cli.core.processes import Ended
from mavfi_cli.fi.tracer.counted import CountedStop
from mavfi_cli.fi.tracer.decode import decode
from mavfi_cli.fi.tracer.fault import InstructionCorruption, InstructionFault, Role, Site
from mavfi_cli.fi.tracer.image import Image
from mavfi_cli.fi.tracer.inject import BitActivation, instruction_at, strike


def stop_at(start, label):
    """The program of labelled instructions, stopped in front of one of them."""
    tracee = start("destinations")
    image = Image(tracee.pid)
    facts = image.named("destinations")
    from elftools.elf.elffile import ELFFile

    with open(facts.path, "rb") as stream:
        (symbol,) = ELFFile(stream).get_section_by_name(".symtab").get_symbol_by_name(label)
        assert tracee.run_to(facts.bias + symbol["st_value"])
    return tracee, instruction_at(tracee, tracee.registers.ip)


def struck(tracee, instruction, corruption, window=0):
    """Injection and fate of a corruption of the instruction in front of which we stand."""
    here = Image(tracee.pid).locate(instruction.address)
    fault = InstructionFault(
        trigger=(CountedStop(here, 1),), execution=1, instruction=instruction.text,
        instruction_bytes=instruction.raw, corruption=corruption,
    )  # fmt: skip
    return strike(tracee, fault, window=window)


def destination(register, bit):
    return register_corruption(register, bit, Role.DESTINATION)


@pytest.mark.parametrize(
    ("label", "register", "written"),
    [("at_mov", "rax", 5), ("at_add", "rax", 8), ("at_load", "rcx", 0x1122), ("at_pop", "rdx", 77)],
)
def test_a_destination_is_corrupted_after_its_write(start, label, register, written):
    tracee, instruction = stop_at(start, label)
    done, _ = struck(tracee, instruction, destination(register, 33))
    assert done.applied
    assert (done.before, done.after) == (written, written ^ (1 << 33))
    assert tracee.registers.read(register) == written ^ (1 << 33)
    assert tracee.registers.ip == instruction.next_address


def test_the_stack_pointer_after_a_call(start):
    tracee, instruction = stop_at(start, "at_call")
    before = tracee.registers.sp
    done, _ = struck(tracee, instruction, destination("rsp", 3))
    assert done.before == before - 8
    assert tracee.registers.sp == (before - 8) ^ 8


def test_the_return_address_that_a_call_wrote(start):
    tracee, instruction = stop_at(start, "at_call")
    stack = tracee.registers.sp
    corruption = InstructionCorruption(
        site=Site.MEMORY, role=Role.DESTINATION, register="", operand="", bits=(2,)
    )
    done, _ = struck(tracee, instruction, corruption)
    assert (done.address, done.before) == (stack - 8, instruction.next_address)
    assert tracee.memory.read(stack - 8, 8) == (instruction.next_address ^ 4).to_bytes(8, "little")


def test_a_repeated_string_instruction_completes_first(start, tmp_path):
    tracee, instruction = stop_at(start, "at_movs")
    target = tracee.registers.read("rdi")
    done, _ = struck(tracee, instruction, destination("rcx", 4))
    assert (done.before, done.after) == (0, 16)
    assert tracee.registers.ip == instruction.next_address
    assert tracee.registers.read("rdi") == target + 36
    tracee.resume()
    assert (tmp_path / "stdout").read_text().startswith("0123456789abcdefghijklmnopqrstuvwxyz ")


def test_a_stored_value_is_corrupted_in_memory(start, tmp_path):
    tracee, instruction = stop_at(start, "at_store")
    corruption = InstructionCorruption(
        site=Site.MEMORY, role=Role.DESTINATION, register="", operand="", bits=(4,)
    )
    assert struck(tracee, instruction, corruption)[0].applied
    tracee.resume()
    assert (tmp_path / "stdout").read_text().endswith(" 25\n")


def test_a_discarded_flag_is_not_injected(start):
    tracee, instruction = stop_at(start, "at_add")
    done, followed = struck(tracee, instruction, register_corruption("rflags", 9), window=10)
    assert not done.applied
    assert done.reason.endswith(": bits [9]")
    assert followed.activation is BitActivation.NOT_INJECTED


def test_a_refused_segment_base_is_not_injected(start):
    tracee, instruction = stop_at(start, "at_add")
    corruption = InstructionCorruption(
        site=Site.GENERAL, role=Role.SOURCE, register="fs_base", operand="fs_base", bits=(60,)
    )
    done, _ = struck(tracee, instruction, corruption)
    assert not done.applied
    assert done.reason.startswith("refused by the operating system")


def test_opcode_bytes_execute_once_and_are_whole_again(start, tmp_path):
    tracee, instruction = stop_at(start, "at_mov")  # mov $5, %rax: bit 24 is bit 0 of the 5
    bit = 8 * instruction.raw.index(5)
    corruption = InstructionCorruption(
        site=Site.OPCODE, role=Role.SOURCE, register="", operand="opcode", bits=(bit,)
    )
    assert struck(tracee, instruction, corruption)[0].applied
    assert tracee.registers.read("rax") == 4
    assert tracee.memory.read(instruction.address, len(instruction.raw)) == instruction.raw


def test_a_wild_instruction_pointer_crashes(start):
    tracee, instruction = stop_at(start, "at_mov")
    corruption = register_corruption("rip", 44, Role.DESTINATION)
    assert struck(tracee, instruction, corruption)[0].applied
    assert tracee.resume() == Ended(exit_code=None, signal=signal.SIGSEGV)


def test_overwritten_before_it_is_read(start):
    tracee, instruction = stop_at(start, "at_pop")  # rdx: nobody reads it in the parade
    corruption = destination("rdi", 3)  # lea into(%rip), %rdi comes
    _, followed = struck(tracee, instruction, corruption, window=10)
    assert followed.activation is BitActivation.OVERWRITTEN
    assert followed.instruction.startswith("lea rdi")


def test_read_by_the_next_instruction(start):
    tracee, instruction = stop_at(start, "at_mov")
    corruption = destination("rax", 3)
    _, followed = struck(tracee, instruction, corruption, window=10)
    assert (followed.activation, followed.after_instructions) == (BitActivation.READ, 1)
    assert followed.instruction.startswith("add rax")


def test_not_read_within_the_window(start):
    tracee, instruction = stop_at(start, "at_pop")
    corruption = destination("r14", 3)
    _, followed = struck(tracee, instruction, corruption, window=4)
    assert (followed.activation, followed.after_instructions) == (
        BitActivation.NOT_READ_IN_WINDOW,
        4,
    )


def test_corrupted_memory_is_followed_to_its_reader(start):
    tracee, instruction = stop_at(start, "at_call")
    tracee.run_to(instruction.next_address)
    load = decode(bytes.fromhex("48890424").ljust(16, b"\x90"), 0)  # mov [rsp], rax
    assert load.memory[0].writes
    tracee2, push = stop_at(start, "at_pushf")
    corruption = InstructionCorruption(
        site=Site.MEMORY, role=Role.DESTINATION, register="", operand="", bits=(0,)
    )
    _, followed = struck(tracee2, push, corruption, window=3)
    assert (followed.activation, followed.instruction) == (BitActivation.READ, "popfq")
