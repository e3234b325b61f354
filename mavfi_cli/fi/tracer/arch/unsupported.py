"""Stand-ins for an unsupported processor; each raises when it is used.

Everything can still be imported, and missions without instruction-level faults need none of it.
"""

from __future__ import annotations

import platform
from typing import Any, NoReturn

from mavfi_cli.core.errors import TracingForbidden


def refuse(*_arguments: Any, **_named: Any) -> NoReturn:
    """Raise an error that names what is missing.

    Raises:
        TracingForbidden: always.
    """
    raise TracingForbidden(
        "instruction-level injection",
        f"this machine is {platform.machine()}",
        "use an x86-64 Linux machine, or source-level faults",
    )


class _Refusing:
    """An object whose attributes raise when they are read."""

    def __getattr__(self, name: str) -> NoReturn:
        refuse()


TRAITS = _Refusing()
Registers = DebugBreakpoint = refuse
decode = address_of = erase_trap = record_steps = return_address = refuse
all_registers = register_kind = widest_vector = width_of = refuse
