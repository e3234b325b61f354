"""Compares our decoder with iced-x86: the bits that instructions access, and the decoding time.

    pip install iced-x86==1.21.0
    python benchmarks/other_decoder.py [--differences]

The instructions are those whose masks the tests check by execution (tests/fi/tracer/*.txt). Iced
knows the registers that an instruction uses, so a register counts with all the bits of its name.
"""

from __future__ import annotations

import re
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import iced_x86 as iced

from mavfi_cli.fi.tracer.decode import FLAG_BITS, _named, decode, engine
from mavfi_cli.fi.tracer.vectors import low

FOLDER = Path(__file__).parents[1] / "tests" / "fi" / "tracer"
Bits = dict[str, int]  # of a full register or a flag
NAMES = {number: name.lower() for name, number in vars(iced.Register).items() if name.isupper()}
READS = ("READ", "COND_READ", "READ_WRITE", "READ_COND_WRITE")
WRITES = ("WRITE", "COND_WRITE", "READ_WRITE", "READ_COND_WRITE")
ACCESS = {number: name for name, number in vars(iced.OpAccess).items() if name.isupper()}
FLAGS = {name: getattr(iced.RflagsBits, name.upper()) for name in FLAG_BITS}
uses = iced.InstructionInfoFactory()


def known_to_iced(code: bytes) -> tuple[Bits, Bits]:
    """Return the bits that an instruction reads and those that it writes, according to iced."""
    found = iced.Decoder(64, code).decode()
    reads, writes = Bits(), Bits()
    for use in uses.info(found).used_registers():
        name = re.sub(r"^(r\d+)l$", r"\1b", re.sub(r"^st(\d)$", r"st(\1)", NAMES[use.register]))
        if named := _named(name):
            mask, access = low(named.width) << named.shift, ACCESS[use.access]
            for bits, kinds in ((reads, READS), (writes, WRITES)):
                if access in kinds:
                    bits[named.full] = bits.get(named.full, 0) | mask
    for name, bit in FLAGS.items():
        if found.rflags_read & bit:
            reads[name] = 1
        if found.rflags_modified & bit:
            writes[name] = int(not found.rflags_undefined & bit)
    return reads, writes


def known_to_us(code: bytes) -> tuple[Bits, Bits]:
    """Return the bits that an instruction reads and those that it writes, by our decoder.

    As in iced, a write of 32 bits to a general register includes the upper half.
    """
    found = decode(code, 0)
    assert found is not None
    reads, writes = Bits(), Bits()
    for bits, operands in ((reads, found.reads), (writes, found.writes)):
        for use in operands:
            if use.register == "rflags":
                bits[use.operand] = int(bool(use.mask))
            else:
                general = re.match(r"r", use.register)
                bits[use.register] = use.mask | (use.clears if general else 0)
    return reads, writes


def microseconds(work: Callable[[bytes], object], codes: list[bytes]) -> float:
    """Return the time for one instruction, in microseconds: the least of five passes."""
    passes = []
    for _ in range(5):
        begun = time.process_time()
        for code in codes:
            work(code)
        passes.append((time.process_time() - begun) / len(codes) * 1e6)
    return min(passes)


def main() -> None:
    """Print how many instructions agree, and the times of both decoders."""
    lines = [
        line for path in sorted(FOLDER.glob("*.txt")) for line in path.read_text().splitlines()
    ]
    codes = [bytes.fromhex(line.split()[0]).ljust(16, b"\x90") for line in lines if line[0] != "#"]
    counts: Counter[tuple[str, str]] = Counter()
    for code in codes:
        theirs, ours = known_to_iced(code), known_to_us(code)
        found = decode(code, 0)
        assert found is not None
        kind = "vector" if re.search(r"[xyz]mm|\bk\d", found.text) else "other"
        same = all(a.keys() == b.keys() for a, b in zip(theirs, ours, strict=True))
        counts[kind, "all"] += 1
        counts[kind, "same registers"] += same
        counts[kind, "same bits"] += theirs == ours
        if "--differences" in sys.argv and not same:
            differing = [sorted(a.keys() ^ b.keys()) for a, b in zip(theirs, ours, strict=True)]
            print(found.text, "| read", *differing[0], "| written", *differing[1])
    for (kind, what), count in sorted(counts.items()):
        print(f"{kind}, {what}: {count}")
    for name, work in (
        ("ours, masks", lambda code: decode.__wrapped__(code, 0)),
        ("capstone alone", lambda code: next(engine.disasm(code, 0, 1))),
        ("iced, masks", known_to_iced),
        ("iced alone", lambda code: uses.info(iced.Decoder(64, code).decode())),
    ):
        print(f"{name}: {microseconds(work, codes):.1f} us an instruction")


if __name__ == "__main__":
    main()
