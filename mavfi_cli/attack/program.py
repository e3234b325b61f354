"""A user's program as a target: how it starts, its golden run, and how its runs are judged."""

from __future__ import annotations

import math
import re
import resource
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from mavfi_cli.attack.attacker import run_out
from mavfi_cli.attack.profile import TargetProfile, Watch, function_of, profile_calls, profile_run
from mavfi_cli.attack.target import Difference, Golden, Limits, Verdict, digest, judged
from mavfi_cli.core.errors import ConfigError, TargetError
from mavfi_cli.fi.tracer import linux
from mavfi_cli.fi.tracer.breakpoints import Mechanism
from mavfi_cli.fi.tracer.image import Image, Scope, scope_of
from mavfi_cli.fi.tracer.spawn import Command, run_to_entry, spawn
from mavfi_cli.fi.tracer.tracee import Ended, Tracee

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


@dataclass(frozen=True, slots=True, kw_only=True)
class ProgramTarget:
    """A program, what of it may be hit, and what is compared."""

    command: Command
    comparison: Comparison
    objects: tuple[str, ...] = ()  # file names in scope; default the program itself
    function: str | None = None  # only within invocations of this function
    limits: Limits = field(default_factory=Limits)
    mechanism: Mechanism | None = None

    @property
    def name(self) -> str:
        """The program's file name."""
        return Path(self.command.argv[0]).name

    @property
    def stream(self) -> tuple[str, ...]:
        """A campaign has one program."""
        return ()

    @property
    def scope_objects(self) -> tuple[str, ...]:
        """The objects in scope."""
        return self.objects or (self.name,)

    def context(self) -> dict[str, Any]:
        """What every record says of it."""
        return {
            "program": list(self.command.argv),
            "scope": list(self.scope_objects),
            "function": self.function,
        }

    def known(self) -> dict[str, Any]:
        """What its results depend on."""
        return self.context() | {"comparison": asdict(self.comparison)}

    def open(self) -> Workplace:
        """Make a scratch folder for its runs."""
        return Workplace(self)


class Workplace:
    """A scratch folder with the output files of one worker."""

    kind = "program"

    def __init__(self, target: ProgramTarget) -> None:
        self.target, self.limits = target, target.limits
        self._scratch = tempfile.TemporaryDirectory(prefix="mavfi-kernels-")
        root = Path(self._scratch.name)
        self._stdout, self._stderr = root / "stdout", root / "stderr"
        self._directory = target.command.directory
        self._own_file: Path | None = None
        if target.comparison.file is not None:
            self._directory = root / "run"
            self._directory.mkdir()
            self._own_file = self._directory / target.comparison.file
        self._command = replace(target.command, directory=self._directory)

    @property
    def name(self) -> str:
        """The program's file name."""
        return self.target.name

    def start(self) -> Tracee:
        """Start the program, stopped at its entry point.

        Raises:
            TargetError: it ends before its entry point.
        """
        if self._own_file is not None:
            self._own_file.unlink(missing_ok=True)
        tracee = spawn(
            self._command,
            stdout=self._stdout,
            stderr=self._stderr,
            mechanism=self.target.mechanism,
        )
        if not run_to_entry(tracee):
            said = self._stderr.read_text(errors="replace").strip().splitlines()
            problem = f"ends before its entry point{': ' + said[0] if said else ''}"
            raise TargetError(self._command.argv[0], problem)
        return tracee

    def image(self, tracee: Tracee) -> Image:
        """What a run has in its memory."""
        return Image(tracee.pid)

    def scope(self, image: Image) -> Scope:
        """The code that may be hit."""
        return scope_of(image, self.target.scope_objects)

    def context(self) -> dict[str, Any]:
        """What every record says of the program."""
        return self.target.context()

    def output(self) -> bytes:
        """What the last run left."""
        return self.target.comparison.output(self._directory, self._stdout)

    def profile(
        self, rng: np.random.Generator, *, windows: int = 16, watch: Watch | None = None
    ) -> TargetProfile:
        """Step the fault-free run, or sampled invocations of the target's function.

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
        """One run without a fault, timed from the entry point.

        Raises:
            TargetError: it is killed by a signal.
        """
        before_s = _children_cpu_s()
        tracee = self.start()
        before_s += linux.cpu_time_s(tracee.pid)
        start = time.perf_counter()
        ended = run_out(tracee)
        if ended.exit_code is None:
            raise TargetError(self.name, f"is killed by signal {ended.signal} without a fault")
        return Golden(
            output=self.output(),
            exit_code=ended.exit_code,
            cpu_s=_children_cpu_s() - before_s,
            wall_s=time.perf_counter() - start,
        )

    def judge(self, golden: Golden, ended: Ended | None) -> Verdict:
        """Judge the last run; `ended` is None where it was cut off."""
        output = self.output()
        tolerance = self.target.comparison.tolerance
        outcome, difference = judged(golden, ended, output, compared, tolerance=tolerance)
        return Verdict(
            outcome=outcome,
            output_sha256=digest(output),
            details={
                "exit_code": None if ended is None else ended.exit_code,
                "magnitude": None if difference is None else difference.relative,
            },
        )

    def close(self) -> None:
        """Delete the scratch folder."""
        self._scratch.cleanup()


def compared(golden: bytes, output: bytes) -> Difference | None:
    """The difference between the numbers of two texts; None where other things differ."""
    size = magnitude(golden, output)
    return None if size is None else Difference(relative=size, absolute=size)


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


def _children_cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def absolute_arguments(argv: Sequence[str], directory: Path) -> tuple[str, ...]:
    """Arguments that name existing files, made absolute: the program runs in a scratch folder."""
    return tuple(
        str((directory / argument).resolve())
        if not argument.startswith("/") and (directory / argument).is_file()
        else argument
        for argument in argv
    )
