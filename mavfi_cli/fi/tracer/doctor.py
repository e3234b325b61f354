"""Checks of this machine for instruction-level injection; each tries the real operation."""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

from mavfi_cli.core.errors import MavfiError
from mavfi_cli.fi.tracer.arch import widest_vector
from mavfi_cli.fi.tracer.spawn import Program, run_to_entry, spawn
from mavfi_cli.fi.tracer.tracee import Mechanism, Tracee, perf_allowed

_PERF_REMEDY = (
    "perf_event_open needs Linux 5.13, kernel.perf_event_paranoid at most 2, and in a container a "
    "seccomp profile that allows it"
)
_COUNTING = "counted breakpoints"


@dataclass(frozen=True, slots=True, kw_only=True)
class _Capability:
    name: str
    found: str = ""
    problem: str | None = None  # None: it works
    remedy: str = ""  # how to make it work, or work better


def check_tracing(mechanism: Mechanism | None = None) -> _Capability:
    """Start a program, stop it at its entry point, flip a register there and back, let it go."""
    with tempfile.TemporaryDirectory(prefix="mavfi-doctor-") as folder:
        output = Path(folder) / "output"
        try:
            command = Program.of(["true"], environment=dict(os.environ))
            tracee = spawn(command, stdout=output, stderr=output, mechanism=mechanism)
            try:
                if not run_to_entry(tracee):
                    return _Capability(name="ptrace", problem="a hardware breakpoint never hit")
                return _flip_and_back(tracee)
            finally:
                tracee.kill()
        except (MavfiError, OSError) as error:
            return _Capability(name="ptrace", problem=str(error))


def _flip_and_back(tracee: Tracee) -> _Capability:
    for register in ("rbx", f"{widest_vector()}15"):
        before = tracee.registers.read(register)
        tracee.registers.write(register, before ^ 1)
        if tracee.registers.read(register) != before ^ 1:
            return _Capability(name="ptrace", problem=f"a flip of {register} did not stick")
        tracee.registers.write(register, before)
    return _Capability(
        name="ptrace", found="a program was stopped, a register flipped and read back"
    )


def check_counting() -> _Capability:
    """Find the mechanism that counts executions here; the worse one is tried."""
    refused = perf_allowed()
    if refused is None:
        return _Capability(name=_COUNTING, found="by the kernel (perf_event_open)")
    tried = check_tracing(Mechanism.DEBUG)
    if tried.problem is not None:
        return _Capability(
            name=_COUNTING,
            problem=f"perf_event_open: {refused}; debug registers: {tried.problem}",
            remedy=tried.remedy,
        )
    return _Capability(
        name=_COUNTING,
        found=f"by debug registers, about three times slower a hit: perf_event_open is refused "
        f"({refused})",
        remedy=_PERF_REMEDY,
    )
