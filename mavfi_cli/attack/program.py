"""A user's program as a target: its start, its golden run, and the judgement of its runs.

Standard output and files are compared with those of the golden run.
"""

from __future__ import annotations

import math
import os
import re
import resource
import shutil
import tempfile
import time
import weakref
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from mavfi_cli.attack.attacker import run_out
from mavfi_cli.attack.profile import function_of, profile_calls, profile_run
from mavfi_cli.attack.target import (
    Difference,
    Golden,
    RunLimits,
    RunVerdict,
    TargetProfile,
    Watch,
    digest,
    judged,
)
from mavfi_cli.core.errors import ConfigError, TargetError
from mavfi_cli.fi.tracer import linux
from mavfi_cli.fi.tracer.image import Image, Scope, scope_of
from mavfi_cli.fi.tracer.spawn import Program, run_to_entry, spawn
from mavfi_cli.fi.tracer.tracee import Ended, Mechanism, Tracee

STDOUT = "stdout"
_SEPARATORS = re.compile(rb"[\s,;:=()\[\]]+")


@dataclass(frozen=True, slots=True, kw_only=True)
class OutputComparison:
    """The compared outputs, and how they are compared.

    Attributes:
        files: compared files, relative to the folder in which the program runs.
        stdout: whether standard output is compared too.
        tolerance: largest relative difference of a number that still counts as equal.
        ignored: patterns (bytes); a line that contains one is left out.
    """

    files: tuple[str, ...] = ()
    stdout: bool = True
    tolerance: float = 0.0
    ignored: tuple[bytes, ...] = ()

    @classmethod
    def of(
        cls, outputs: Iterable[str], *, tolerance: float = 0.0, ignored: Iterable[str] = ()
    ) -> OutputComparison:
        """Make a comparison from options of the command line.

        Args:
            outputs: each `stdout`, or `file:PATH` relative to the program's folder; an empty list
                means standard output.

        Raises:
            ConfigError: an output is neither of the two, a path leads out of the program's
                folder, or a pattern is not a regular expression.
        """
        chosen = tuple(dict.fromkeys(outputs)) or (STDOUT,)
        return cls(
            files=tuple(_inside(text) for text in chosen if text != STDOUT),
            stdout=STDOUT in chosen,
            tolerance=tolerance,
            ignored=tuple(_pattern(text) for text in ignored),
        )

    def to_json(self) -> dict[str, Any]:
        """The entries that results depend on."""
        names: list[str | None] = [None] if self.stdout else []
        names += self.files
        told: dict[str, Any] = {"file": names[0] if len(names) == 1 else names}
        if self.ignored:
            told["ignored"] = [pattern.decode() for pattern in self.ignored]
        return told | {"tolerance": self.tolerance}

    def parts(self, folder: Path, stdout: Path) -> dict[str, bytes | None]:
        """Read a run's outputs, by name; None for a file that it did not write."""
        found: dict[str, bytes | None] = {}
        if self.stdout:
            found[STDOUT] = self._kept(stdout.read_bytes())
        for name in self.files:
            data = _read_inside(folder, name)
            found[name] = None if data is None else self._kept(data)
        return found

    def _kept(self, data: bytes) -> bytes:
        if not self.ignored:
            return data
        lines = re.findall(rb"[^\n]*\n|[^\n]+", data)
        return b"".join(
            line for line in lines if not any(re.search(each, line) for each in self.ignored)
        )

    def same(self, golden: bytes, output: bytes) -> bool:
        """True if two outputs are equal, or differ only in numbers within the tolerance."""
        if golden == output:
            return True
        size = magnitude(golden, output) if self.tolerance > 0.0 else None
        return size is not None and size <= self.tolerance


def _joined(parts: dict[str, bytes | None]) -> bytes:
    """Join all outputs: a single one as it is, several each after its name."""
    pieces = [b"\0missing" if data is None else data for data in parts.values()]
    if len(pieces) == 1:
        return pieces[0]
    names = (f"== {name}\n".encode() for name in parts)
    return b"".join(name + piece for name, piece in zip(names, pieces, strict=True))


def _inside(text: str) -> str:
    kind, _, name = text.partition(":")
    if kind != "file" or not name:
        raise ConfigError(f"cannot compare {text!r}; known: stdout, file:PATH", key="compare")
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
            f"{text!r} is no regular expression: {error}", key="ignore_lines"
        ) from None
    return text.encode()


def _read_inside(folder: Path, name: str) -> bytes | None:
    """Read a regular file below the folder; None if a link leads out of it."""
    path = (folder / name).resolve()
    if not path.is_relative_to(folder.resolve()) or not path.is_file():
        return None
    return path.read_bytes()


def _compared(golden: bytes, output: bytes) -> Difference | None:
    """The difference between the numbers of two texts; None if anything else differs."""
    size = magnitude(golden, output)
    return None if size is None else Difference(relative=size, absolute=size)


def magnitude(golden: bytes, output: bytes) -> float | None:
    """Largest relative difference between the numbers of two texts.

    It is relative to the golden number's size, absolute if that is 0, and infinite if one of the
    two is not finite and they differ. None if the texts differ in more than their numbers.
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


def absolute_arguments(
    argv: Iterable[str], directory: Path, written: Iterable[str]
) -> Iterator[str]:
    """Make arguments that name existing files absolute: the program runs in a scratch folder.

    Args:
        directory: the folder that they are relative to.
        written: files that the program writes; their names stay, so the user's are not overwritten.
    """
    own = {str(PurePosixPath(name)) for name in written}
    for argument in argv:
        path = directory / argument
        if str(PurePosixPath(argument)) in own or argument.startswith("/") or not path.is_file():
            yield argument
        else:
            yield str(path.resolve())


@dataclass(frozen=True, slots=True, kw_only=True)
class ProgramTarget:
    """A program, its code in scope, and its compared outputs."""

    command: Program
    comparison: OutputComparison
    objects: tuple[str, ...] = ()  # file names in scope; by default the program itself
    function: str | None = None  # hit only calls of this function
    limits: RunLimits = field(default_factory=RunLimits)
    mechanism: Mechanism | None = None

    @property
    def name(self) -> str:
        """The program's file name."""
        return Path(self.command.argv[0]).name

    @property
    def stream(self) -> tuple[str, ...]:
        """No stream, because a campaign has one program."""
        return ()

    @property
    def scope_objects(self) -> tuple[str, ...]:
        """The objects in scope."""
        return self.objects or (self.name,)

    def context(self) -> dict[str, Any]:
        """Entries of every record about the program."""
        told: dict[str, Any] = {
            "program": list(self.command.argv),
            "scope": list(self.scope_objects),
            "function": self.function,
        }
        if self.command.stdin != Path(os.devnull):
            told["stdin"] = str(self.command.stdin)
        return told

    def known(self) -> dict[str, Any]:
        """Everything that its results depend on."""
        return self.context() | {"comparison": self.comparison.to_json()}

    def open(self) -> Workplace:
        """Make a scratch folder for its runs."""
        return Workplace(self)


class Workplace:
    """A scratch folder with the output files of one worker.

    Nothing outside it is ever removed. If files are compared, the program runs in a folder in it
    that is made anew for every run.
    """

    kind = "program"

    def __init__(self, target: ProgramTarget) -> None:
        self.target, self.limits = target, target.limits
        scratch = Path(tempfile.mkdtemp(prefix="mavfi-kernels-"))
        self._remove = weakref.finalize(self, shutil.rmtree, scratch, ignore_errors=True)
        self._stdout, self._stderr = scratch / "stdout", scratch / "stderr"
        self._folder = scratch / "run" if target.comparison.files else None
        self._command = target.command
        if self._folder is not None:
            self._folder.mkdir()
            self._command = replace(target.command, directory=self._folder)

    @property
    def name(self) -> str:
        """The program's file name."""
        return self.target.name

    def start(self) -> Tracee:
        """Start the program, stopped at its entry point.

        Raises:
            TargetError: the program ends before its entry point.
        """
        self._renew_folder()
        tracee = spawn(
            self._command, stdout=self._stdout, stderr=self._stderr, mechanism=self.target.mechanism
        )
        if not run_to_entry(tracee):
            said = self._stderr.read_text(errors="replace").strip().splitlines()
            problem = f"ends before its entry point{': ' + said[0] if said else ''}"
            raise TargetError(self._command.argv[0], problem)
        return tracee

    def _renew_folder(self) -> None:
        if self._folder is None:
            return
        try:
            shutil.rmtree(self._folder)  # follows no link
            self._folder.mkdir()
        except OSError as error:
            problem = f"leaves files in its scratch folder that cannot be removed: {error}"
            raise TargetError(self.name, problem) from None

    def image(self, tracee: Tracee) -> Image:
        """The memory image of a run."""
        return Image(tracee.pid)

    def scope(self, image: Image) -> Scope:
        """The code that may be hit."""
        return scope_of(image, self.target.scope_objects)

    def context(self) -> dict[str, Any]:
        """Entries of every record about the program."""
        return self.target.context()

    def _parts(self) -> dict[str, bytes | None]:
        """The outputs of the last run, by name."""
        folder = self._folder or self._command.directory
        return self.target.comparison.parts(folder, self._stdout)

    def profile(
        self, rng: np.random.Generator, *, windows: int = 16, watch: Watch | None = None
    ) -> TargetProfile:
        """Step the golden run, or sampled calls of the target's function.

        Raises:
            WindowTooLong: too many instructions.
            UnknownName: no such object or function.
            TargetError: the function is never called.
        """
        function, limit = self.target.function, self.limits.profile_steps
        if function is None:
            return profile_run(self, rng, limit=limit, watch=watch)
        entry = function_of(self, function)
        return profile_calls(self, rng, [entry], windows=windows, limit=limit, watch=watch)

    def fault_free(self) -> Golden:
        """Run once without a fault, timed from the entry point.

        Raises:
            TargetError: a signal kills it, or it does not write a compared file.
        """
        before_s = _children_cpu_s()
        tracee = self.start()
        before_s += linux.cpu_time_s(tracee.pid)
        start = time.perf_counter()
        ended = run_out(tracee)
        if ended.exit_code is None:
            raise TargetError(self.name, f"is killed by signal {ended.signal} without a fault")
        parts = self._parts()
        if missing := [name for name, data in parts.items() if data is None]:
            raise TargetError(
                self.name,
                f"writes no file {missing[0]} in the folder in which it runs, so there is nothing "
                "to compare",
            )
        return Golden(
            output=_joined(parts),
            exit_code=ended.exit_code,
            cpu_s=_children_cpu_s() - before_s,
            wall_s=time.perf_counter() - start,
        )

    def unlike(self, golden: Golden, again: Golden) -> str:
        """How two fault-free runs differ; empty if they are equal."""
        if again.exit_code != golden.exit_code:
            return f"their exit codes are {golden.exit_code} and {again.exit_code}"
        if self.target.comparison.same(golden.output, again.output):
            return ""
        lines = zip(golden.output.splitlines(), again.output.splitlines(), strict=False)
        first = next((a for a, b in lines if a != b), b"")
        text = first[:60].decode(errors="replace").strip()
        where = f"at the line {text!r}" if text else "in length"
        return f"their outputs differ {where}; --ignore-lines leaves out lines that change"

    def judge(self, golden: Golden, ended: Ended | None) -> RunVerdict:
        """Judge the last run; `ended` is None if it exceeded its limit."""
        parts, tolerance = self._parts(), self.target.comparison.tolerance
        output = _joined(parts)
        outcome, difference = judged(golden, ended, output, _compared, tolerance=tolerance)
        return RunVerdict(
            outcome=outcome,
            output_sha256=digest(output if any(parts.values()) else b""),
            details={
                "exit_code": None if ended is None else ended.exit_code,
                "magnitude": None if difference is None else difference.relative,
            },
        )

    def close(self) -> None:
        """Delete the scratch folder."""
        self._remove()


def _children_cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
