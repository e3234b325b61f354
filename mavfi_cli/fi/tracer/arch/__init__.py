"""The parts of the injector that differ between processors.

Code outside this package works with register *names*, Python integers and the types of
`arch.interface`, and imports from here only; import-linter enforces that. A package for another
processor supplies the names below with the same meaning. docs/explanation/injection.md says what
is known about aarch64. On an unsupported processor everything can be imported, because missions
without instruction-level faults need none of it; each name raises `TracingForbidden` when it is
used.
"""

from __future__ import annotations

import platform
from typing import TYPE_CHECKING, Any, NoReturn

from mavfi_cli.core.errors import TracingForbidden
from mavfi_cli.fi.tracer.arch.interface import (
    Asked,
    Detour,
    Flow,
    Instruction,
    MemoryUse,
    RegisterUse,
    Traits,
)

SUPPORTED = platform.system() == "Linux" and platform.machine() == "x86_64"

if SUPPORTED or TYPE_CHECKING:
    from mavfi_cli.fi.tracer.arch.x86_64.calls import (
        asked,
        call_name,
        lacks_memory,
        prepare_system_call,
    )
    from mavfi_cli.fi.tracer.arch.x86_64.decode import address_of, decode
    from mavfi_cli.fi.tracer.arch.x86_64.detour import detour_code, flow
    from mavfi_cli.fi.tracer.arch.x86_64.registers import (
        JUMP_FLAGS,
        TRAITS,
        Registers,
        all_registers,
        inverting_bits,
        register_kind,
        widest_vector,
        width_of,
    )
    from mavfi_cli.fi.tracer.arch.x86_64.stepping import (
        DebugBreakpoint,
        erase_trap,
        record_steps,
        return_address,
    )
else:

    class _Refusing:
        """Raises when it is called or one of its attributes is read."""

        def __call__(self, *_arguments: Any, **_named: Any) -> NoReturn:
            raise TracingForbidden(
                "instruction-level injection",
                f"this machine is {platform.machine()}",
                "use an x86-64 Linux machine, or source-level faults",
            )

        def __getattr__(self, name: str) -> NoReturn:
            self()

    TRAITS = Registers = DebugBreakpoint = _Refusing()
    decode = address_of = erase_trap = record_steps = return_address = TRAITS
    all_registers = register_kind = widest_vector = width_of = TRAITS
    asked = call_name = lacks_memory = TRAITS
    JUMP_FLAGS = inverting_bits = detour_code = flow = prepare_system_call = TRAITS

__all__ = [
    "JUMP_FLAGS", "SUPPORTED", "TRAITS", "Asked", "DebugBreakpoint", "Detour", "Flow",
    "Instruction", "MemoryUse", "RegisterUse", "Registers", "Traits", "address_of",
    "all_registers", "asked", "call_name", "decode", "detour_code", "erase_trap", "flow",
    "inverting_bits", "lacks_memory", "prepare_system_call", "record_steps", "register_kind",
    "return_address", "widest_vector", "width_of",
]  # fmt: skip
