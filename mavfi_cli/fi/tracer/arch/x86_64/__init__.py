"""x86-64: registers, instructions, and the traces that single steps leave."""

from __future__ import annotations

from mavfi_cli.fi.tracer.arch.x86_64.decode import address_of, decode, widest_vector
from mavfi_cli.fi.tracer.arch.x86_64.registers import (
    TRAITS,
    Registers,
    all_registers,
    register_kind,
    width_of,
)
from mavfi_cli.fi.tracer.arch.x86_64.stepping import (
    DebugBreakpoint,
    erase_trap,
    record_steps,
    return_address,
)

__all__ = [
    "TRAITS", "DebugBreakpoint", "Registers", "address_of", "all_registers", "decode",
    "erase_trap", "record_steps", "register_kind", "return_address", "widest_vector", "width_of",
]  # fmt: skip
