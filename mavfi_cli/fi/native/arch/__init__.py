"""What differs between processors, behind one boundary.

Everything outside this package works with register *names* and Python integers. A module for
another processor supplies `Registers` and `TRAITS` with the same members; see docs/injection.md
for what is known about aarch64.
"""

from __future__ import annotations

import platform

from mavfi_cli.core.errors import TracingForbidden

MACHINE = platform.machine()

if MACHINE != "x86_64":  # pragma: no cover - other processors
    raise TracingForbidden(
        "instruction-level injection",
        f"this machine is {MACHINE}",
        "use an x86-64 Linux machine, or source-level faults",
    )

from mavfi_cli.fi.native.arch.x86_64 import TRAITS, Registers  # noqa: E402

__all__ = ["MACHINE", "TRAITS", "Registers"]
