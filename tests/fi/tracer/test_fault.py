"""What a fault model draws: operands, fields and roles."""

import platform
from collections import Counter

import numpy as np
import pytest

if platform.machine() != "x86_64":
    pytest.skip("x86-64 only", allow_module_level=True)

from mavfi_cli.fi.bits import Field
from mavfi_cli.fi.tracer.decode import decode
from mavfi_cli.fi.tracer.fault import FaultModel, Role, Site, Strategy


def of(code):
    return decode(bytes.fromhex(code).ljust(16, b"\x90"), 0x1000)


def drawn(instruction, model, count=300, seed=1):
    plan, rng = Strategy.of("instruction-uniform", model), np.random.default_rng(seed)
    return [plan.draw_at(instruction, rng) for _ in range(count)]


ADD = of("01c3")  # add ebx, eax
ADDSD = of("f20f58c1")  # addsd xmm0, xmm1
VADDPD = of("c5fd58c1")  # vaddpd ymm0, ymm0, ymm1


def test_operands_are_equally_likely():
    counts = Counter((c.role, c.register) for c in drawn(ADD, FaultModel(), 4000))
    assert set(counts) == {
        (Role.SOURCE, "rax"),
        (Role.SOURCE, "rbx"),
        (Role.DESTINATION, "rbx"),
        (Role.DESTINATION, "rflags"),
    }
    assert all(abs(count - 1000) < 5 * np.sqrt(750) for count in counts.values())


def test_bits_stay_inside_the_operand_and_cover_it():
    bits = {c.bits[0] for c in drawn(ADD, FaultModel(sites=frozenset((Site.GENERAL,))), 1500)}
    assert bits == set(range(32))


def test_flags_are_those_that_the_instruction_writes():
    model = FaultModel(sites=frozenset((Site.FLAGS,)))
    assert {c.bits[0] for c in drawn(ADD, model)} == {0, 2, 4, 6, 7, 11}


def test_roles_can_be_restricted():
    model = FaultModel(roles=frozenset((Role.DESTINATION,)))
    assert {c.role for c in drawn(ADD, model)} == {Role.DESTINATION}


def test_implicit_operands_can_be_left_out():
    multiply = of("48f7e1")  # mul rcx
    assert {c.register for c in drawn(multiply, FaultModel(implicit=False))} == {"rcx"}
    assert {c.register for c in drawn(multiply, FaultModel())} == {"rax", "rcx", "rdx", "rflags"}


@pytest.mark.parametrize(
    ("field", "lane"), [(Field.SIGN, {63}), (Field.EXPONENT, set(range(52, 63)))]
)
def test_a_field_of_a_scalar_double(field, lane):
    assert {c.bits[0] for c in drawn(ADDSD, FaultModel(field=field))} == lane


def test_a_field_of_packed_doubles_is_in_every_lane():
    bits = {c.bits[0] for c in drawn(VADDPD, FaultModel(field=Field.SIGN), 100)}
    assert bits == {63, 127, 191, 255}


def test_an_instruction_without_the_field_is_not_drawn():
    assert drawn(ADD, FaultModel(field=Field.EXPONENT), 1) == [None]


def fields(code, role, field=Field.EXPONENT):
    model = FaultModel(field=field, roles=frozenset((role,)))
    return {bit for each in drawn(of(code), model) if each for bit in each.bits}


EXPONENT = {"double": set(range(52, 63)), "single": set(range(23, 31))}


@pytest.mark.parametrize(
    ("code", "read", "written"),
    [
        ("f20f5ac1", EXPONENT["double"], EXPONENT["single"]),  # cvtsd2ss xmm0, xmm1
        ("f30f5ac1", EXPONENT["single"], EXPONENT["double"]),  # cvtss2sd xmm0, xmm1
        ("f20f2cc1", EXPONENT["double"], set()),  # cvttsd2si eax, xmm1
        ("f20f2ac0", set(), EXPONENT["double"]),  # cvtsi2sd xmm0, eax
        ("660f383dc1", set(), set()),  # pmaxsd xmm0, xmm1: integers
        ("660f381ec1", set(), set()),  # pabsd xmm0, xmm1
    ],
)
def test_a_field_is_that_of_the_float_that_is_read_or_written(code, read, written):
    assert fields(code, Role.SOURCE) == read
    assert fields(code, Role.DESTINATION) == written


def test_a_broadcast_writes_a_float_to_every_lane():
    assert fields("c4e27918c1", Role.SOURCE, Field.SIGN) == {31}  # vbroadcastss xmm0, xmm1
    assert fields("c4e27918c1", Role.DESTINATION, Field.SIGN) == {31, 63, 95, 127}


def test_several_bits_are_distinct():
    for corruption in drawn(ADDSD, FaultModel(count=3), 50):
        assert len(set(corruption.bits)) == 3


def test_sites_beyond_data_registers_are_asked_for():
    model = FaultModel(sites=frozenset((Site.OPCODE, Site.INSTRUCTION_POINTER, Site.MEMORY)))
    push = of("50")
    seen = {c.site for c in drawn(push, model)}
    assert seen == {
        Site.OPCODE,
        Site.INSTRUCTION_POINTER,
        Site.MEMORY,
    }
    assert all(c.bits[0] < 8 for c in drawn(push, model) if c.site is Site.OPCODE)
    assert all(c.bits[0] < 64 for c in drawn(push, model) if c.site is Site.MEMORY)


def test_the_flags_of_an_instruction_are_one_operand():
    add = decode(bytes.fromhex("4801d8"), 0)  # add rax, rbx
    model = FaultModel(sites=frozenset((Site.FLAGS,)))
    found = drawn(add, model, 200)
    assert {(c.operand, c.register, c.role) for c in found} == {
        ("rflags", "rflags", Role.DESTINATION)
    }
    assert {c.bits for c in found} == {(bit,) for bit in (0, 2, 4, 6, 7, 11)}
