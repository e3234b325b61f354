"""Masks of operands, held against execution: bits are flipped and the results compared.

`masks.check` executes an instruction from random states. It finds a bit outside the masks that
matters or changes, and a bit inside that never does. The lists hold every form of instruction that
our kernels execute, and others.
"""

import re
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("capstone")
if pytest.importorskip("platform").machine() != "x86_64":
    pytest.skip("x86-64 only", allow_module_level=True)

import masks
import probe

from mavfi_cli.fi.tracer.registers import widest_vector

FOLDER = Path(__file__).parent
ANY = (1 << 512) - 1
SIGNS_32, SIGNS_16 = (sum(1 << bit for bit in range(n - 1, 512, n)) for n in (32, 16))
EDGES = sum(1 << bit | 1 << bit + 15 for bit in range(0, 512, 16))
SHIFTED = "is shifted out by every count but zero"
ROUNDED = "is rounded off: it changes the inexact flag of MXCSR at most"
MOVES = "moves by a constant, and what it points to has to stay in the window of memory"
ITSELF = "copies a value onto itself"
ARITHMETIC = "keeps this bit whatever the value is"
REMAINDER = "has the dividend's sign, which was in the same place, unless the remainder is zero"
SQUARE = "changes only for a value from the root of 2 to 2, which random states hardly ever have"

# Bits of a mask that no execution shows: instruction, operand, bits, and why they stay in it.
NEVER_READ = [
    (r"v?cvtt?s[sd]2si ", "zmm", (1 << 23) - 1, ROUNDED),
    (r"vcvttsd2usi ", "zmm", 1, ROUNDED),
    (r"shld .*, [0-9]", "rbx", 1, SHIFTED),
    (r"v?ps(ll|rl|ra)[wdq] .*, [0-9]", "zmm", EDGES, SHIFTED),
]
NEVER_WRITTEN = [
    (r"push|pop|call|ret", "rsp", ANY, MOVES),
    (r"(movs|stos|lods|scas)[bwdq] ", "r[sd]i", ANY, MOVES),
    (r"mov (\w+), \1$|movsx|cdqe|cwde|cbw", "r", (1 << 32) - 1, ITSELF),
    (r"movq (\w+), \1$", "zmm", (1 << 64) - 1, ITSELF),
    (r"neg ", "r", 1, ARITHMETIC),
    (r"sar ", "r", 1 << 63 | 1 << 31, ARITHMETIC),
    (r"v?psra[wd] ", "zmm", SIGNS_32 | SIGNS_16, ARITHMETIC),
    (r"v?sqrts[sd] ", "zmm", 1 << 63 | 1 << 31, ARITHMETIC),
    (r"sbb (\w+), \1$", "rflags", 1, ARITHMETIC),
    (r"idiv r", "rdx", 1 << 63, REMAINDER),
    (r"muls[sd] (\w+), \1$", "zmm", 1 << 62 | 1 << 30, SQUARE),
]


def forms(name):
    """The opcodes of a list: of AVX-512, and all others."""
    codes = {True: [], False: []}
    for line in (FOLDER / name).read_text().splitlines():
        if not line.startswith("#"):
            code = bytes.fromhex(line.split()[0])
            text = probe.decoded(code, 0).text
            codes[code[0] == EVEX or bool(re.search(r"\bk[0-7]\b", text))].append(code)
    return codes[True], codes[False]


EVEX = 0x62
(_, KERNELS), (_, OTHERS) = LISTS = forms("kernel_opcodes.txt"), forms("other_opcodes.txt")
AVX512 = [*LISTS[0][0], *LISTS[1][0]]
FEW = KERNELS[::16]
PARTS = 8


def twice(text):
    """True if an instruction reads the same register twice, so that bits may cancel."""
    names = re.findall(r"\b(?:[xyz]mm\d+|k\d|r\w+|e\w\w)\b", text.partition(" ")[2])
    return len(set(names)) < len(names)


def unexplained(text, found, exceptions):
    left = dict(found)
    for pattern, operand, mask, _why in exceptions:
        if re.match(pattern, text):
            left = {n: m & ~mask if re.match(operand, n) else m for n, m in left.items()}
    return {name: hex(mask) for name, mask in left.items() if mask}


def disagreements(start, codes):
    place, found = probe.Probe(start("probe")), []
    for code in codes:
        verdict = masks.check(place, code)
        unread = {} if twice(verdict.text) else verdict.never_read
        odd = (
            verdict.wrong,
            unexplained(verdict.text, unread, NEVER_READ),
            unexplained(verdict.text, verdict.never_written, NEVER_WRITTEN),
        )
        if any(odd) or not verdict.states:
            found.append((code.hex(), verdict.text, verdict.states, *odd))
    return found


def test_masks_of_some_opcodes_agree_with_execution(start):
    assert disagreements(start, FEW) == []


@pytest.mark.skipif(widest_vector() != "zmm", reason="this processor has no AVX-512")
@pytest.mark.parametrize("code", AVX512, ids=lambda code: probe.decoded(code, 0).text)
@pytest.mark.slow
def test_masks_of_an_opcode_of_avx512_agree_with_execution(start, code):
    assert disagreements(start, [code]) == []


@pytest.mark.slow
@pytest.mark.parametrize("part", range(PARTS))
def test_masks_of_every_opcode_of_our_kernels_agree_with_execution(start, part):
    assert disagreements(start, KERNELS[part::PARTS]) == []


@pytest.mark.slow
@pytest.mark.parametrize("part", range(PARTS))
def test_masks_of_other_opcodes_agree_with_execution(start, part):
    assert disagreements(start, OTHERS[part::PARTS]) == []


@pytest.mark.parametrize(("width", "wrong", "never_read"), [(64, 0, 0), (128, 0, 64), (63, 1, 0)])
def test_the_check_finds_masks_that_are_too_wide_or_too_narrow(
    start, monkeypatch, width, wrong, never_read
):
    """Of `addsd xmm0, xmm1`; capstone has it read all 128 bits."""

    def decoded(code, slot):
        found = probe.decoded(code, slot)
        reads = (
            replace(u, mask=(1 << width) - 1) if u.operand == "xmm1" else u for u in found.reads
        )
        return replace(found, reads=tuple(reads))

    monkeypatch.setattr(masks, "decoded", decoded)
    verdict = masks.check(probe.Probe(start("probe")), bytes.fromhex("f20f58c1"))
    assert bool(verdict.wrong) == wrong
    assert sum(mask.bit_count() for mask in verdict.never_read.values()) == never_read
