"""What imitated injectors strike: the habits of ROSFI, the rule of PINFI and its bugs."""

import itertools
import platform
from collections import Counter

import numpy as np
import pytest

if platform.machine() != "x86_64":
    pytest.skip("x86-64 only", allow_module_level=True)

from test_inject import stop_at
from test_inject import struck as injected

from mavfi_cli.fi.tracer import record
from mavfi_cli.fi.tracer.decode import decode
from mavfi_cli.fi.tracer.fault import JUMP_FLAGS, Role, Site, Strategy
from mavfi_cli.fi.tracer.inject import BitActivation


def of(code):
    return decode(bytes.fromhex(code).ljust(16, b"\x90"), 0x1000)


def struck(code, following="90", compat="pinfi", count=600):
    plan, rng = Strategy.of("", compat=compat), np.random.default_rng(3)
    return [plan.draw_at(of(code), rng, of(following)) for _ in range(count)]


def bits(drawn):
    return {bit for each in drawn for bit in each.bits}


ADDSD = of("f20f58c1")  # addsd xmm0, xmm1
CMP, TEST, JE, JLE, JA = "4839d8", "4885c0", "7405", "7e05", "7705"


def test_rosfi_2021_hits_the_low_byte_of_few_registers():
    plan = Strategy.of("wall-clock", compat="rosfi-2021")
    rng = np.random.default_rng(3)
    hits = [hit for _ in range(200) if (hit := plan.draw_at(ADDSD, rng)) is not None]
    assert len(hits) == 200
    assert {hit.bits[0] for hit in hits} == set(range(8))
    mov = of("4889c7")  # mov rdi, rax
    assert all(plan.draw_at(mov, rng) is None for _ in range(50))
    high = of("4d01c1")  # add r9, r8
    assert {plan.draw_at(high, rng).operand for _ in range(50)} == {"r8", "r9"}


@pytest.mark.parametrize(
    "code", ["eb05", "7405", "e800000000", "c3", "ffe0", "90", "488907", "f30f1efa"]
)
def test_pinfi_leaves_branches_and_what_writes_no_register(code):
    """Of jmp, je, call, ret, jmp rax, nop, a store and endbr64 nothing is struck."""
    assert struck(code, count=1) == [None]


@pytest.mark.parametrize(
    ("code", "register", "width"),
    [
        ("01c3", "rbx", range(32)),  # add ebx, eax: never the flags
        ("4801c3", "rbx", range(64)),
        ("b401", "rax", range(8, 16)),  # mov ah, 1
        ("0f94c0", "rax", range(8)),  # sete al
        ("50", "rsp", range(64)),  # push rax
        ("d9ee", "st0", range(80)),  # fldz
    ],
)
def test_pinfi_strikes_the_written_register_at_its_own_width(code, register, width):
    drawn = struck(code, following=JE)
    assert {(each.role, each.register) for each in drawn} == {(Role.DESTINATION, register)}
    assert bits(drawn) == set(width)


@pytest.mark.parametrize("code", ["f20f58c1", "0f58c1", "660fefc0", "c5fd58c1"])
def test_pinfi_strikes_the_low_half_of_xmm(code):
    """Scalar, packed and integer instructions, and one of YMM, are all taken for doubles."""
    assert bits(struck(code, count=2000)) == set(range(64))


def test_several_written_registers_are_equally_likely():
    counts = Counter(each.register for each in struck("48f7e1", count=2000))  # mul rcx
    assert set(counts) == {"rax", "rdx"}
    assert abs(counts["rax"] - 1000) < 5 * np.sqrt(500)


@pytest.mark.parametrize("code", [CMP, TEST])
def test_flags_alone_invert_the_jump_that_follows(code):
    (drawn,) = struck(code, JE, count=1)
    assert (drawn.site, drawn.role, drawn.bits) == (Site.FLAGS, Role.DESTINATION, (6,))
    assert [struck(code, jump, count=1)[0].inverts for jump in (JLE, JA)] == ["jle", "ja"]


def test_flags_without_a_jump_are_64_bits_of_which_seven_are_flags():
    drawn = struck(CMP, count=4000)
    assert bits(drawn) == {0, 2, 4, 6, 7, 10, 11}
    none = sum(not each.bits for each in drawn) / len(drawn)
    assert abs(none - 57 / 64) < 5 * np.sqrt(57 * 7 / 64**2 / 4000)


def test_an_instruction_that_writes_memory_and_flags_has_its_memory_struck():
    drawn = struck("480107")  # add [rdi], rax
    assert {(each.site, each.role) for each in drawn} == {(Site.MEMORY, Role.SOURCE)}
    assert bits(drawn) == set(range(64))
    assert struck("480107", JE, count=1)[0].site is Site.FLAGS


@pytest.mark.parametrize(
    ("code", "register", "low"),
    [
        ("f2440f58d1", "0", 0),  # addsd xmm10, xmm1
        ("f2440f58c9", "9", 0),
        ("c4413d58f8", "5", 128),  # vaddpd ymm15, ymm8, ymm8
    ],
)
def test_pinfi_with_bugs_takes_the_last_digit_and_the_upper_half_of_ymm(code, register, low):
    drawn = struck(code, compat="pinfi-bugs", count=1500)
    assert {each.register.lstrip("xyzm") for each in drawn} == {register}
    assert bits(drawn) == set(range(low, low + 64))


CONDITIONS = {
    "o": lambda f: f["of"], "s": lambda f: f["sf"], "p": lambda f: f["pf"], "e": lambda f: f["zf"],
    "b": lambda f: f["cf"], "l": lambda f: f["sf"] != f["of"],
    "be": lambda f: f["cf"] or f["zf"], "le": lambda f: f["zf"] or f["sf"] != f["of"],
}  # fmt: skip
INVERSES = {"ae": "b", "a": "be", "ge": "l", "g": "le"}
PLACES = {"cf": 0, "pf": 2, "zf": 6, "sf": 7, "of": 11}


def taken(jump, flags):
    name = jump[1:]
    positive = INVERSES.get(name, name.removeprefix("n"))
    held = CONDITIONS[positive]({flag: flags >> bit & 1 for flag, bit in PLACES.items()})
    return bool(held) == (positive == name)


def test_every_conditional_jump_is_inverted_whatever_the_flags_are():
    assert len(JUMP_FLAGS) == 16
    codes = {of(code).mnemonic: code for code in (f"{0x70 + n:x}05" for n in range(16))}
    for jump, ones in itertools.product(JUMP_FLAGS, itertools.product((0, 1), repeat=5)):
        flags = sum(one << bit for one, bit in zip(ones, PLACES.values(), strict=True))
        (corruption,) = struck(CMP, codes[jump], count=1)
        inverted = corruption.struck(flags)
        changed = flags ^ sum(1 << bit for bit in inverted)
        assert taken(jump, changed) != taken(jump, flags), (jump, flags)
        assert set(inverted) <= set(JUMP_FLAGS[jump])


def test_the_flags_are_chosen_at_the_stop(start):
    tracee, instruction = stop_at(start, "at_add")  # add $3, %rax: 8, no flag but AF at most
    (corruption,) = struck(CMP, JLE, count=1)
    done, _ = injected(tracee, instruction, corruption)
    assert done.applied
    assert done.before ^ done.after == 1 << 6  # neither less nor equal: becomes equal


def test_a_bit_that_is_no_flag_changes_nothing(start):
    tracee, instruction = stop_at(start, "at_add")
    nothing = next(each for each in struck(CMP) if not each.bits)
    injection, followed = injected(tracee, instruction, nothing, window=3)
    assert injection.applied
    assert injection.before == injection.after
    assert followed.activation is BitActivation.NOT_READ_IN_WINDOW


def test_a_record_names_the_inverted_jump_and_gives_it_back():
    (corruption,) = struck(CMP, JLE, count=1)
    told = corruption.to_json()
    assert (told["inverts"], told["bits"]) == ("jle", [6, 7])
    entry = {
        "version": record.VERSION, "trigger": [{"object": "a", "offset": 0, "count": 1}], "k": 1,
        "instruction": "cmp", "instruction_bytes": CMP, "corruption": told, "build_ids": {},
    }  # fmt: skip
    assert record.fault_of(entry).corruption == corruption
    assert "inverts" not in struck(CMP, JE, count=1)[0].to_json()
