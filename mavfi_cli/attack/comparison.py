"""Compares outputs with those of the golden run.

Kernel templates import this module, so it must not load the tracer: every run copies everything
that its template has loaded.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from mavfi_cli.core.errors import ConfigError
from mavfi_cli.core.files import Json

STDOUT = "stdout"
LARGEST_BYTES = 64 << 20  # of one compared output
_SEPARATORS = re.compile(rb"[\s,;:=()\[\]]+")


@dataclass(frozen=True, slots=True, kw_only=True)
class Difference:
    """The difference between the output of a run and that of the golden run.

    Attributes:
        relative: the value to compare with a tolerance; inf if the outputs cannot be compared
            number by number (different shapes, different kinds of answer, not a number).
        absolute: the difference in `unit`, or inf if the outputs cannot be compared.
        unit: unit of `absolute`.
        text: the difference in words.
        noticeable: whether it exceeds what the consumer of the output tolerates.
        parts: named components of the difference.
    """

    relative: float
    absolute: float
    unit: str = ""
    text: str = ""
    noticeable: bool = True
    parts: Mapping[str, float] = field(default_factory=dict)

    def to_json(self) -> Json:
        """Return the difference as entries of a record. An infinite difference becomes null."""
        finite = math.isfinite(self.relative)
        return {
            "relative": self.relative if finite else None,
            "absolute": self.absolute if finite else None,
            "unit": self.unit,
            "text": self.text,
            "noticeable": self.noticeable,
            "parts": dict(self.parts),
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class OutputComparison:
    """The outputs of a program to compare with the golden run, and the rules of the comparison.

    Attributes:
        files: compared files, relative to the folder in which the program runs.
        stdout: whether standard output is compared too.
        tolerance: largest relative difference of a number that still counts as equal.
        ignored: patterns (bytes); lines that match one are ignored.
    """

    files: tuple[str, ...] = ()
    stdout: bool = True
    tolerance: float = 0.0
    ignored: tuple[bytes, ...] = ()

    @classmethod
    def of(
        cls, outputs: Iterable[str], *, tolerance: float = 0.0, ignored: Iterable[str] = ()
    ) -> OutputComparison:
        """Create a comparison from command-line options.

        Args:
            outputs: the outputs to compare, each `stdout` or `file:PATH` with a path relative to
                the program's folder; empty for standard output alone.
            ignored: regular expressions; a line that matches one is ignored.

        Raises:
            ConfigError: an output has neither form, a path leads out of the program's folder, or a
                pattern is not a regular expression.
        """
        chosen = tuple(dict.fromkeys(outputs)) or (STDOUT,)
        return cls(
            files=tuple(_inside(text) for text in chosen if text != STDOUT),
            stdout=STDOUT in chosen,
            tolerance=tolerance,
            ignored=tuple(_pattern(text) for text in ignored),
        )

    def to_json(self) -> Json:
        """Return the settings of the comparison, as entries of a campaign's plan."""
        names: list[str | None] = [None] if self.stdout else []
        names += self.files
        entries: Json = {"file": names[0] if len(names) == 1 else names}
        if self.ignored:
            entries["ignored"] = [pattern.decode() for pattern in self.ignored]
        return entries | {"tolerance": self.tolerance}

    def parts(self, folder: Path, stdout: Path) -> dict[str, bytes | None]:
        """Read the outputs of a run without their ignored lines, keyed by name.

        The value is None for a file that is missing, or if a link leads out of `folder`.
        """
        outputs: dict[str, bytes | None] = {}
        if self.stdout:
            outputs[STDOUT] = self._kept(_beginning(stdout))
        for name in self.files:
            data = _read_inside(folder, name)
            outputs[name] = None if data is None else self._kept(data)
        return outputs

    def _kept(self, data: bytes) -> bytes:
        if not self.ignored:
            return data
        lines = re.findall(rb"[^\n]*\n|[^\n]+", data)
        return b"".join(
            line for line in lines if not any(re.search(pattern, line) for pattern in self.ignored)
        )

    def difference(self, golden: bytes, output: bytes) -> Difference | None:
        """Return the largest relative difference between the numbers of two outputs.

        Returns None if the outputs differ in more than their numbers.
        """
        size = _magnitude(golden, output)
        return None if size is None else Difference(relative=size, absolute=size)

    def same(self, golden: bytes, output: bytes) -> bool:
        """Return True if two outputs are equal, or differ only in numbers within the tolerance."""
        if golden == output:
            return True
        size = _magnitude(golden, output) if self.tolerance > 0.0 else None
        return size is not None and size <= self.tolerance


def _inside(text: str) -> str:
    kind, _, name = text.partition(":")
    if kind != "file" or not name:
        raise ConfigError(f"must be stdout or file:PATH, got {text!r}", key="compare")
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or not path.parts:
        raise ConfigError(
            f"{name!r} leads out of the scratch folder in which the program runs: name a file "
            "relative to it, without '..'",
            key="compare",
        )
    return str(path)


def _pattern(text: str) -> bytes:
    try:
        re.compile(text.encode())
    except re.error as error:
        raise ConfigError(
            f"{text!r} is not a regular expression: {error}", key="ignore_lines"
        ) from None
    return text.encode()


def _read_inside(folder: Path, name: str) -> bytes | None:
    """Return the contents of a regular file below `folder`.

    Returns None if the file is missing or a link leads out of the folder.
    """
    path = (folder / name).resolve()
    if not path.is_relative_to(folder.resolve()) or not path.is_file():
        return None
    return _beginning(path)


def _beginning(path: Path) -> bytes:
    """Return the contents of a file, cut off one byte after the largest size that is allowed."""
    with path.open("rb") as file:
        return file.read(LARGEST_BYTES + 1)


def _magnitude(golden: bytes, output: bytes) -> float | None:
    """Return the largest relative difference between the numbers of two texts.

    The difference is absolute where the golden number is 0, and infinite where one of two differing
    numbers is not finite. Returns None if the texts differ in more than their numbers.
    """
    ours, theirs = _SEPARATORS.split(golden), _SEPARATORS.split(output)
    if len(ours) != len(theirs):
        return None
    largest = 0.0
    for a, b in zip(ours, theirs, strict=True):
        size = 0.0 if a == b else _size(a, b)
        if size is None or math.isinf(size):
            return size
        largest = max(largest, size)
    return largest


def _size(golden: bytes, other: bytes) -> float | None:
    try:
        expected, got = float(golden), float(other)
    except ValueError:
        return None
    if not (math.isfinite(expected) and math.isfinite(got)):
        return math.inf
    return abs(got - expected) / (abs(expected) or 1.0)
