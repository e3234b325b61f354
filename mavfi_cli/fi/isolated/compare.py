"""Compare an output with the golden one: equal, different, and by how much."""

from __future__ import annotations

import hashlib
import math
import re
from dataclasses import dataclass
from pathlib import Path

from mavfi_cli.core.errors import ConfigError

_SEPARATORS = re.compile(rb"[\s,;:=()\[\]]+")


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """What is compared: standard output, or a file that the program writes."""

    file: str | None = None  # None: standard output
    tolerance: float = 0.0  # largest relative difference of a number that still counts as equal

    @classmethod
    def of(cls, text: str, tolerance: float = 0.0) -> Comparison:
        """From the command line: `stdout`, or `file:PATH` relative to where the program runs.

        Raises:
            ConfigError: neither.
        """
        if text == "stdout":
            return cls(tolerance=tolerance)
        kind, _, path = text.partition(":")
        if kind == "file" and path:
            return cls(file=path, tolerance=tolerance)
        raise ConfigError(f"cannot compare {text!r}; known: stdout, file:PATH", key="compare")

    def output(self, directory: Path, stdout: Path) -> bytes:
        """The output of a run; a file that was not written is empty."""
        path = stdout if self.file is None else directory / self.file
        return path.read_bytes() if path.is_file() else b""


def digest(output: bytes) -> str:
    """SHA-256 of an output."""
    return hashlib.sha256(output).hexdigest()


def magnitude(golden: bytes, output: bytes) -> float | None:
    """Largest relative difference between the numbers of two texts.

    Relative to the golden number's size, absolute where that is 0; infinite where one of the two
    is not finite and they differ. None where the texts differ in more than their numbers.
    """
    ours, theirs = _SEPARATORS.split(golden), _SEPARATORS.split(output)
    if len(ours) != len(theirs):
        return None
    largest = 0.0
    for a, b in zip(ours, theirs, strict=True):
        if a == b:
            continue
        try:
            expected, got = float(a), float(b)
        except ValueError:
            return None
        if not (math.isfinite(expected) and math.isfinite(got)):
            return math.inf
        largest = max(largest, abs(got - expected) / (abs(expected) or 1.0))
    return largest
