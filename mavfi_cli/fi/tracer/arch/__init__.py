"""The parts of the injector that differ between processors.

Code outside this package works with register *names*, Python integers and the types of
`arch.instruction`, and imports from here only; import-linter enforces that. A package for another
processor supplies the names below with the same meaning. docs/injection.md says what is known about
aarch64.
"""

from __future__ import annotations

import platform
from typing import TYPE_CHECKING

from mavfi_cli.fi.tracer.arch.instruction import Instruction, MemoryUse, RegisterUse
from mavfi_cli.fi.tracer.arch.traits import Traits

SUPPORTED = platform.system() == "Linux" and platform.machine() == "x86_64"

if SUPPORTED or TYPE_CHECKING:
    from mavfi_cli.fi.tracer.arch.x86_64 import (
        TRAITS,
        DebugBreakpoint,
        Registers,
        address_of,
        all_registers,
        decode,
        erase_trap,
        record_steps,
        register_kind,
        return_address,
        widest_vector,
        width_of,
    )
else:
    from mavfi_cli.fi.tracer.arch.unsupported import *  # noqa: F403

__all__ = [
    "SUPPORTED", "TRAITS", "DebugBreakpoint", "Instruction", "MemoryUse", "RegisterUse",
    "Registers", "Traits", "address_of", "all_registers", "decode", "erase_trap", "record_steps",
    "register_kind", "return_address", "widest_vector", "width_of",
]  # fmt: skip
