"""The bits that vector instructions read and write in explicit operands (Intel SDM volume 2).

Capstone's access flags are wrong for many VEX and EVEX forms and do not distinguish elements. As a
rule, this module therefore treats the first operand as the destination and the others as sources.
The tables below give the bits that are used: the lowest element of scalar instructions, the
elements that a shuffle moves, the half that a conversion reads. A bit that only keeps its value is
neither read nor written.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import capstone
from capstone import x86

ALL = (1 << 512) - 1
VECTOR = re.compile(r"([xyz])mm(\d+)$")
_OPMASK = re.compile(r"k\d$")
_LANE = {"sd": 64, "ss": 32, "sh": 16, "si": 0}
_OPERATION = re.compile(r"v?(add|sub|mul|div|min|max|scalef|cmp\w*)(s[dsh])$")
_FUSED = re.compile(r"vfn?m(?:add|sub)(?:132|213|231)(s[dsh])$")
_FUNCTION = re.compile(
    r"v?(sqrt|rsqrt|rcp|round|rsqrt14|rcp14|rndscale|getexp|getmant|reduce)(s[dsh])$"
)
_CONVERSION = re.compile(r"v?cvtt?u?(s[dshi])2u?(s[dshi])$")
_COMPARISON = re.compile(r"v?u?comi(s[dsh])$")
_LOADED = re.compile(r"v?mov(sd|ss|sh|d|q)$")
_ACCUMULATES = re.compile(r"vf\w+(132|213|231)|vpdp|vperm[ti]2|vpternlog|vpmadd52|vdpbf16")
_TESTS = re.compile(r"v?p?test(p[sd])?$")
_WIDENS = re.compile(r"v?(?:cvtps2pd|cvtu?dq2pd|cvtph2ps|pmov[sz]x(bw|bd|bq|wd|wq|dq))$")
_RATIO = {"bd": 4, "bq": 8, "wq": 4}
_NARROWS = re.compile(r"v?cvtt?pd2(ps|u?dq)$")
_SIGNS = re.compile(r"v?p?movmsk(pd|ps|b)$")
_SHIFT = re.compile(r"v?ps(ll|rl|ra)[wdq]$")
_ELEMENT = {"b": 8, "w": 16, "d": 32, "q": 64, "s": 32}
_ZEROING = re.compile(r"v?(xorp[sd]|andnp[sd]|pxor[dq]?|pandn[dq]?|psub[bwdq]|pcmp(gt|eq)[bwdq])$")

_SCALAR_MOVES = {"movsd": 64, "movss": 32}

Piece = tuple[str, int] | None  # operand "a" (first source) or "b" (last), its element; None: zero


@dataclass(slots=True)
class Touched:
    """The bits of one explicit operand that are read, written, or (`clears`) always replaced."""

    reads: int = 0
    writes: int = 0
    clears: int = 0


def low(count: int) -> int:
    """Return a mask of the `count` lowest bits."""
    return (1 << count) - 1


class _VectorForm:
    """The operands of one vector instruction, by role."""

    def __init__(self, decoded: Any) -> None:
        self.mnemonic = decoded.mnemonic
        self.vex = self.mnemonic.startswith("v")
        self.bare = self.mnemonic.removeprefix("v")
        operands = list(decoded.operands)
        self.names = [
            decoded.reg_name(op.reg) if op.type == x86.X86_OP_REG else "" for op in operands
        ]
        self.widths = [_width(name, op.size) for name, op in zip(self.names, operands, strict=True)]
        self.writemask = next(
            (i for i, name in enumerate(self.names) if i and _OPMASK.match(name)), None
        )
        self.zeroes = any(op.avx_zero_opmask for op in operands)
        immediates = [op.imm for op in operands if op.type == x86.X86_OP_IMM]
        self.immediate = immediates[0] & 0xFF if immediates else None
        data = [
            i for i, op in enumerate(operands)
            if op.type != x86.X86_OP_IMM and i != self.writemask
        ]  # fmt: skip
        self.target, self.sources = data[0], data[1:]
        self.last = data[-1]
        self.first = self.target if not self.vex else self.sources[0] if self.sources else 0
        reads = bool(operands[self.target].access & capstone.CS_AC_READ)
        self.reads_target = reads and not self.vex and bool(self.names[self.target])
        self.touched = [Touched() for _ in operands]

    def source(self, name: str) -> int:
        """Return the position of operand "a", the first source, or "b", the last operand."""
        return self.first if name == "a" else self.last

    def is_vector(self, position: int) -> bool:
        """Return True if the operand is a vector register."""
        return bool(VECTOR.match(self.names[position]))

    def read(self, position: int, mask: int) -> None:
        """Add `mask` to the bits of an operand that are read."""
        self.touched[position].reads |= mask

    def write(self, mask: int, kept: int = 0) -> None:
        """Set the written bits of the destination; all bits but the kept ones are replaced."""
        target = self.touched[self.target]
        target.writes = mask
        if self.is_vector(self.target):
            target.clears = (ALL if self.vex else low(128)) & ~kept
        else:
            target.clears = low(64)  # a mask, or a general register of 32 bits or more

    def same(self, one: int, other: int) -> bool:
        """Return True if two operands are the same register."""
        return bool(self.names[one]) and self.names[one] == self.names[other]


def _width(name: str, size: int) -> int:
    match = VECTOR.match(name)
    return {"x": 128, "y": 256, "z": 512}[match[1]] if match else 8 * size


def vector_bits(decoded: Any) -> tuple[Touched, ...] | None:
    """Return which bits of each explicit operand a vector instruction reads and writes.

    Returns:
        None if no explicit operand is a vector register.
    """
    registers = [decoded.reg_name(op.reg) for op in decoded.operands if op.type == x86.X86_OP_REG]
    if not any(map(VECTOR.match, registers)):
        return None
    form = _VectorForm(decoded)
    scalar = _scalar(form)
    if not (scalar or _permuted(form)):
        _packed(form)
    if form.writemask is not None:
        _mask(form, scalar or _SCALAR_MOVES.get(form.bare, 0))
    return tuple(form.touched)


# -- the lowest element


def _scalar(form: _VectorForm) -> int:
    """Mark the bits that a scalar instruction uses.

    Returns the width of its element in bits, or 0 if the instruction is not scalar.
    """
    name = form.mnemonic
    if match := _COMPARISON.match(name):
        for position in (form.target, form.last):
            form.read(position, low(_LANE[match[1]]))
        return _LANE[match[1]]
    if match := _OPERATION.match(name):
        return _operation(form, _LANE[match[2]])
    if match := _FUSED.match(name):
        lane = _LANE[match[1]]
        for position in (form.target, *form.sources):
            form.read(position, low(lane))
        form.write(low(lane), kept=low(128) & ~low(lane))
        return lane
    if match := _FUNCTION.match(name):
        return _merged(form, _LANE[match[2]], _LANE[match[2]])
    if match := _CONVERSION.match(name):
        return _merged(form, _LANE[match[1]], _LANE[match[2]])
    return _move(form)


def _operation(form: _VectorForm, lane: int) -> int:
    form.read(form.first, low(lane))
    form.read(form.last, low(lane))
    if _OPMASK.match(form.names[form.target]):
        form.write(1)
    else:
        _write_lane(form, lane)
    return lane


def _merged(form: _VectorForm, source: int, lane: int) -> int:
    """Mark the bits of a scalar function of the last operand, and return the written width.

    The other elements come from the first source.
    """
    if lane and form.is_vector(form.target):
        _write_lane(form, lane)
    else:
        form.write(low(form.widths[form.target]))
    form.read(form.last, low(source or form.widths[form.last]))
    return lane or form.widths[form.target]


def _write_lane(form: _VectorForm, lane: int) -> None:
    """Mark the lowest element as written.

    VEX forms copy the rest of the lowest 128 bits from the first source.
    """
    rest = low(128) & ~low(lane)
    if form.same(form.first, form.target):
        form.write(low(lane), kept=rest if form.vex else ALL & ~low(lane))
    else:
        form.read(form.first, rest)
        form.write(low(128))


def _move(form: _VectorForm) -> int:
    match = _LOADED.match(form.mnemonic)
    if match is None or (len(form.sources) == 2 or (match[1] in _LANE and _between(form))):
        return 0
    lane = {"d": 32, "q": 64}.get(match[1]) or _LANE[match[1]]
    form.read(form.last, low(lane))
    form.write(low(lane))
    return lane


def _between(form: _VectorForm) -> bool:
    return form.is_vector(form.target) and form.is_vector(form.last)


# -- instructions that move elements


def _permuted(form: _VectorForm) -> bool:
    """Mark the bits used by an instruction that moves elements. Return False for any other."""
    moved = _pieces(form)
    if moved is None:
        return False
    element, pieces = moved
    kept = written = 0
    for place, piece in enumerate(pieces):
        if piece is None:
            continue
        source, here = form.source(piece[0]), low(element) << element * place
        stays = form.same(source, form.target) and piece[1] == place
        if stays and not (form.zeroes and (place == 0 or form.bare not in _SCALAR_MOVES)):
            kept |= here
            continue
        written |= here
        form.read(source, low(element) << element * piece[1])
    vector = form.is_vector(form.target)
    form.write(written if vector else low(form.widths[form.target]), kept)
    return True


def _pieces(form: _VectorForm) -> tuple[int, list[Piece]] | None:
    name, imm = form.bare, form.immediate
    width = form.widths[form.target]
    if rule := _MOVES.get(name):
        if not form.is_vector(form.target):  # a store of one half
            return 64, [("b", 1 if name.startswith("movh") else 0)]
        element, order = rule
        return element, list(order)[: width // element]
    if name in _SHUFFLES:
        element, lane_of = _SHUFFLES[name]
        if imm is None and lane_of in _BY_IMMEDIATE:
            return None
        count = 128 // element
        return element, [
            piece and (piece[0], piece[1] + lane * count)
            for lane in range(width // 128)
            for piece in lane_of(imm or 0, count, lane)
        ]
    return _inserted(form, name, imm, width)


def _inserted(
    form: _VectorForm, name: str, imm: int | None, width: int
) -> tuple[int, list[Piece]] | None:
    if match := re.match(r"p?broadcast(?:[fi](\d+)x(\d)|[fi](128)|s?([bwdqs]))$", name):
        element = int(match[3] or 0) or (
            int(match[1]) * int(match[2]) if match[1] else _ELEMENT[match[4]]
        )
        if name == "broadcastsd":
            element = 64
        return element, [("b", 0)] * (width // element)
    if imm is None:
        return None
    if name in ("permq", "permpd"):
        return 64, [("b", 4 * (i // 4) + (imm >> 2 * (i % 4) & 3)) for i in range(width // 64)]
    if name in ("perm2f128", "perm2i128"):
        halves: list[Piece] = [("a", 0), ("a", 1), ("b", 0), ("b", 1)]
        return 128, [None if imm >> 4 * i & 8 else halves[imm >> 4 * i & 3] for i in range(2)]
    if match := re.match(r"pextr([bwdq])$|extractps$", name):
        element = _ELEMENT[match[1] or "d"]
        return element, [("b", imm & 128 // element - 1)]
    if match := re.match(r"extract[fi](128|32x4|64x2|32x8|64x4)$", name):
        element = 256 if match[1] in ("32x8", "64x4") else 128
        return element, [("b", imm & form.widths[form.last] // element - 1)]
    if match := re.match(r"pinsr([bwdq])$|insert[fi](128|32x4|64x2|32x8|64x4)$", name):
        element = _ELEMENT[match[1]] if match[1] else 256 if match[2] in ("32x8", "64x4") else 128
        pieces: list[Piece] = [("a", place) for place in range(width // element)]
        pieces[imm & len(pieces) - 1] = ("b", 0)
        return element, pieces
    if name == "insertps":
        pieces = [("a", place) for place in range(4)]
        pieces[imm >> 4 & 3] = ("b", imm >> 6 if form.is_vector(form.last) else 0)
        return 32, [None if imm >> place & 1 else piece for place, piece in enumerate(pieces)]
    return None


_Lane = Callable[[int, int, int], list[Piece]]  # immediate, elements per 128-bit lane, lane number


def _interleave(start: Callable[[int], int]) -> _Lane:
    def lane(_imm: int, count: int, _lane: int) -> list[Piece]:
        return [(o, start(count) + i) for i in range(count // 2) for o in ("a", "b")]

    return lane


def _chosen(operands: str, bits: int, step: int = 0) -> _Lane:
    """Return a rule that selects each element by its own bits of the immediate.

    In each further lane, these bits are `step` positions higher.
    """

    def lane(imm: int, count: int, number: int) -> list[Piece]:
        return [
            (operand, imm >> bits * i + step * number & count - 1)
            for i, operand in enumerate(operands)
        ]

    return lane


def _half(start: int) -> _Lane:
    def lane(imm: int, count: int, _lane: int) -> list[Piece]:
        return [
            ("b", start + (imm >> 2 * (i - start) & 3) if 0 <= i - start < 4 else i)
            for i in range(count)
        ]

    return lane


def _blend(imm: int, count: int, number: int) -> list[Piece]:
    shift = 0 if count == 8 else count * number
    return [("b" if imm >> shift + i & 1 else "a", i) for i in range(count)]


def _align(imm: int, _count: int, _lane: int) -> list[Piece]:
    joined: list[Piece] = [(o, i) for o in ("b", "a") for i in range(16)]
    return (joined[imm:] + [None] * 48)[:16]


def _shift_left(imm: int, _count: int, _lane: int) -> list[Piece]:
    return ([None] * min(imm, 16) + [("a", i) for i in range(16)])[:16]


def _shift_right(imm: int, _count: int, _lane: int) -> list[Piece]:
    return ([("a", i) for i in range(16)][imm:] + [None] * 16)[:16]


def _fixed(*order: int) -> _Lane:
    return lambda _imm, _count, _lane: [("b", i) for i in order]


_A1, _B1 = ("a", 1), ("b", 1)
_MOVES: dict[str, tuple[int, tuple[Piece, ...]]] = {
    "movsd": (64, (("b", 0), _A1)),
    "movss": (32, (("b", 0), _A1, ("a", 2), ("a", 3))),
    "movhlps": (64, (_B1, _A1)),
    "movlhps": (64, (("a", 0), ("b", 0))),
    **dict.fromkeys(("movlps", "movlpd"), (64, (("b", 0), _A1))),
    **dict.fromkeys(("movhps", "movhpd"), (64, (("a", 0), ("b", 0)))),
}
_SHUFFLES: dict[str, tuple[int, _Lane]] = {
    **{
        f"{name}{half}{rest}": (element, _interleave(start))
        for half, start in (("l", lambda _count: 0), ("h", lambda count: count // 2))
        for name, rest, element in (
            ("unpck", "ps", 32), ("unpck", "pd", 64), ("punpck", "bw", 8), ("punpck", "wd", 16),
            ("punpck", "dq", 32), ("punpck", "qdq", 64),
        )
    },
    "shufps": (32, _chosen("aabb", 2)),
    "shufpd": (64, _chosen("ab", 1, 2)),
    "pshufd": (32, _chosen("bbbb", 2)),
    "permilps": (32, _chosen("bbbb", 2)),
    "permilpd": (64, _chosen("bb", 1, 2)),
    "pshuflw": (16, _half(0)),
    "pshufhw": (16, _half(4)),
    "movddup": (64, _fixed(0, 0)),
    "movshdup": (32, _fixed(1, 1, 3, 3)),
    "movsldup": (32, _fixed(0, 0, 2, 2)),
    "blendps": (32, _blend), "blendpd": (64, _blend), "pblendw": (16, _blend),
    "pblendd": (32, _blend), "palignr": (8, _align), "pslldq": (8, _shift_left),
    "psrldq": (8, _shift_right),
}  # fmt: skip
_BY_IMMEDIATE = [lane for name, (_, lane) in _SHUFFLES.items() if not re.match("p?unpck|mov", name)]


# -- whole registers


def _packed(form: _VectorForm) -> None:
    """Mark the bits of any other instruction.

    It uses whole registers, except for conversions, controls and counts.
    """
    name, width = form.mnemonic, form.widths[form.target]
    alone = form.same(form.first, form.last) and len(form.sources) == 1 + form.vex
    sources = [] if alone and _ZEROING.match(name) else list(form.sources)
    if _TESTS.match(name) or _ACCUMULATES.match(name) or (form.reads_target and sources != []):
        sources.append(form.target)
    if form.reads_target and not form.sources:
        sources.append(form.target)  # a shift by an immediate
    for position in sources:
        form.read(position, low(form.widths[position]))
    if match := _TESTS.match(name):
        for position in sources:
            form.touched[position].reads &= _signs({"pd": 64, "ps": 32}.get(match[1], 1))
        return
    last = form.touched[form.last]
    if match := _WIDENS.match(name):
        last.reads &= low(width // _RATIO.get(match[1], 2))
    elif match := _SIGNS.match(name):
        last.reads &= _signs({"pd": 64, "ps": 32, "b": 8}[match[1]])
    elif rule := _CONTROLS.get(form.bare):
        form.touched[form.source(rule[0])].reads &= _repeated(rule[1], rule[2](width))
    elif match := _TWO_TABLES.match(name):
        element = _ELEMENT.get(match[2]) or {"ps": 32, "pd": 64}[match[2]]
        control = form.target if match[1] == "i" else form.first
        form.touched[control].reads &= _repeated(element, 2 * width // element - 1)
    elif _SHIFT.match(name) and form.is_vector(form.last) and form.immediate is None:
        last.reads &= low(64)
    form.write(low(form.widths[form.last] // 2 if _NARROWS.match(name) else width))


def _repeated(element: int, mask: int) -> int:
    """Return `mask` repeated in every element of `element` bits."""
    return sum(mask << place for place in range(0, 512, element))


def _signs(element: int) -> int:
    return _repeated(element, 1 << element - 1)


# Operands that select elements: the width of their elements, and the bits that are used.
_CONTROLS: dict[str, tuple[str, int, Callable[[int], int]]] = {
    "pshufb": ("b", 8, lambda _width: 0x8F),
    "permilps": ("b", 32, lambda _width: 3),
    "permilpd": ("b", 64, lambda _width: 2),
    **{name: ("a", 32, lambda width: width // 32 - 1) for name in ("permd", "permps")},
    **{name: ("a", 64, lambda width: width // 64 - 1) for name in ("permq", "permpd")},
}
_TWO_TABLES = re.compile(r"vperm([ti])2(ps|pd|[bwdq])$")


def _mask(form: _VectorForm, lane: int) -> None:
    """Apply an AVX-512 mask, one bit per element; without zeroing, masked elements are kept."""
    assert form.writemask is not None
    target = form.touched[form.target]
    compares = not form.is_vector(form.target)  # into a mask, whose masked bits are cleared
    width = form.widths[form.first if compares else form.target]
    form.read(form.writemask, low(1 if lane else width // _element(form.bare)))
    if not (form.zeroes or compares):
        target.clears &= ~(low(lane) if lane else target.writes)


def _element(name: str) -> int:
    if match := re.search(r"(8|16|32|64)(?:x\d)?$", name):
        return int(match[1])
    match = re.search(r"p([sd])$", name)
    return {"s": 32, "d": 64}[match[1]] if match else _ELEMENT.get(name[-1], 32)
