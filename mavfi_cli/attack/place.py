"""The interface of a place where a target runs repeatedly, and the target's golden run."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from mavfi_cli.fi.tracer.image import Image, Scope
from mavfi_cli.fi.tracer.tracee import Tracee

# Called with the number of instructions stepped since the last call, or with a status text.
Watch = Callable[[int | str], None]


class AttackPlace(Protocol):
    """A place where a target runs repeatedly from the same start."""

    @property
    def name(self) -> str:
        """Name of the target."""

    @property
    def kind(self) -> str:
        """Kind of the target for messages: kernel, node or program."""

    def start(self) -> Tracee:
        """Start a run, and stop it before it executes any code in scope."""

    def image(self, tracee: Tracee) -> Image:
        """Return the memory image of a run's process."""

    def scope(self, image: Image) -> Scope:
        """Return the code that faults may hit."""

    def close(self) -> None:
        """End all processes and remove all temporary files."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Golden:
    """The output, CPU time, duration and exit code of a golden run."""

    output: bytes
    cpu_s: float
    wall_s: float
    exit_code: int = 0
    notices: tuple[str, ...] = ()  # warnings for the user

    @property
    def sha256(self) -> str:
        """SHA-256 of the output, in hexadecimal."""
        return digest(self.output)


def digest(output: bytes) -> str:
    """Return the SHA-256 of an output, in hexadecimal."""
    return hashlib.sha256(output).hexdigest()
