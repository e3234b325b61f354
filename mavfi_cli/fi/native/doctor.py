"""What this machine can do for instruction-level injection, found out by doing it."""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

from mavfi_cli.core.errors import MavfiError
from mavfi_cli.fi.native.arch import widest_vector
from mavfi_cli.fi.native.breakpoints import perf_allowed
from mavfi_cli.fi.native.spawn import Command, run_to_entry, spawn
from mavfi_cli.fi.native.tracee import Tracee

_PERF_REMEDY = (
    "needs Linux 5.13, kernel.perf_event_paranoid at most 2, and in a container a seccomp "
    "profile that allows perf_event_open; debug registers are used instead, about three times "
    "slower a hit"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Capability:
    """One thing that was tried."""

    name: str
    problem: str | None  # None: it works
    remedy: str = ""


def check_tracing() -> Capability:
    """Start a program, stop it at its entry point, flip a register there and back, let it go."""
    with tempfile.TemporaryDirectory(prefix="mavfi-doctor-") as folder:
        output = Path(folder) / "output"
        try:
            command = Command.of(["true"], environment=dict(os.environ))
            tracee = spawn(command, stdout=output, stderr=output)
            try:
                if not run_to_entry(tracee):
                    return Capability(name="ptrace", problem="a hardware breakpoint never hit")
                return _flip_and_back(tracee)
            finally:
                tracee.kill()
        except MavfiError as error:
            return Capability(name="ptrace", problem=str(error))
        except OSError as error:
            return Capability(name="ptrace", problem=str(error))


def _flip_and_back(tracee: Tracee) -> Capability:
    for register in ("rbx", f"{widest_vector()}15"):
        before = tracee.registers.read(register)
        tracee.registers.write(register, before ^ 1)
        if tracee.registers.read(register) != before ^ 1:
            return Capability(name="ptrace", problem=f"a flip of {register} did not stick")
        tracee.registers.write(register, before)
    return Capability(name="ptrace", problem=None)


def check_counting() -> Capability:
    """Whether the kernel counts executions for us."""
    problem = perf_allowed()
    return Capability(
        name="counted breakpoints", problem=problem, remedy="" if problem is None else _PERF_REMEDY
    )
