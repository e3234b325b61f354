"""Prints one example of every form of instruction that our kernels execute, to test masks.

    python benchmarks/kernel_opcodes.py > tests/fi/tracer/kernel_opcodes.txt

The tests check the bits that these instructions read and write. A form is a mnemonic with the kinds
and widths of its operands, which of them are the same register, and the immediate of a shuffle.
"""

from __future__ import annotations

import re
import sys
import tempfile
from contextlib import closing
from pathlib import Path
from typing import Any

import capstone
import numpy as np
from capstone import x86

from mavfi_cli.attack.campaign import one_processor
from mavfi_cli.attack.kernels import catalogue
from mavfi_cli.attack.target import places_of
from mavfi_cli.mission.kernel_inputs import kernel_targets
from mavfi_cli.spec.mission import MissionConfig

_HEAD = (
    "# Each form of instruction that our kernels execute, by one example: "
    "python benchmarks/kernel_opcodes.py"
)


def form_of(found: Any) -> tuple[str, ...]:
    """Return the form of an instruction: everything on which its masks may depend."""
    names: list[str] = []
    kinds = [found.mnemonic, "evex" if found.bytes[0] == 0x62 else ""]
    for op in found.operands:
        if op.type == x86.X86_OP_REG:
            name = found.reg_name(op.reg)
            names += [name] * (name not in names)
            kind = name[0] if name[1:3] == "mm" or name[0] == "k" else name[1:] == "h"
            kinds.append(f"{kind}{op.size} {names.index(name)}")
        elif op.type == x86.X86_OP_MEM:
            relative = found.reg_name(op.mem.base) == "rip"
            kinds.append(f"m{op.size} {relative} {bool(op.mem.index)}")
        else:
            chooses = re.search("shuf|pextr|pinsr|perm|blend|insert|extract", found.mnemonic)
            kinds.append(f"i{op.imm if chooses else ''}")
    return tuple(kinds)


def main() -> None:
    """Single-step all kernels, and print an example of every form that they execute."""
    engine = capstone.Cs(capstone.CS_ARCH_X86, capstone.CS_MODE_64)
    engine.detail = True
    forms: dict[tuple[str, ...], str] = {}
    with tempfile.TemporaryDirectory() as scratch:
        flight = MissionConfig(stack="hardened")
        for target in kernel_targets(catalogue.select(()), flight, Path(scratch)):
            with one_processor(), closing(target.open()) as place:
                rng = np.random.default_rng(1)
                profiles = [each.profile(rng, windows=16) for each in places_of(place)]
            strata = [stratum for profile in profiles for stratum in profile.strata]
            traces = [each.trace for stratum in strata for each in stratum.segments]
            for address in np.unique(np.concatenate(traces)).tolist():
                found = next(engine.disasm(profiles[0].code_at(address), 0x1000, 1))
                line = f"{found.bytes.hex()} {found.mnemonic} {found.op_str}".strip()
                forms.setdefault(form_of(found), line)
            print(f"{target.name}: {len(forms)} forms", file=sys.stderr, flush=True)
    print(_HEAD, *(forms[form] for form in sorted(forms)), sep="\n")


if __name__ == "__main__":
    main()
