"""A user's program as a target: its start, golden run and profile, and the judgement of its runs.

A program that is not short is profiled by exact execution counts.
"""

from __future__ import annotations

import os
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
from mavfi_cli.attack.comparison import OutputComparison, compared, joined
from mavfi_cli.attack.counts import callgrind, read_counts, run_counted
from mavfi_cli.attack.profile import (
    function_of,
    profile_calls,
    profile_counted,
    profile_run,
    require_counts,
)
from mavfi_cli.attack.target import (
    Golden,
    RunLimits,
    RunVerdict,
    TargetProfile,
    Watch,
    digest,
    judged,
)
from mavfi_cli.core.errors import TargetError
from mavfi_cli.fi.tracer import linux
from mavfi_cli.fi.tracer.image import Image, Scope, scope_of
from mavfi_cli.fi.tracer.sampling import WindowTooLong
from mavfi_cli.fi.tracer.spawn import Program, run_to_entry, spawn
from mavfi_cli.fi.tracer.tracee import Ended, Mechanism, Tracee


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


_SHORT = 100_000  # instructions that are stepped rather than counted


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
        self._golden: Golden | None = None
        scratch = Path(tempfile.mkdtemp(prefix="mavfi-kernels-"))
        self._remove = weakref.finalize(self, shutil.rmtree, scratch, ignore_errors=True)
        self._stdout, self._stderr = scratch / "stdout", scratch / "stderr"
        self._counts = scratch / "counts"
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
        """Step or count the golden run, or step sampled calls of the target's function.

        Raises:
            WindowTooLong: too many instructions to step, and nothing that counts them.
            UnknownName: no such object or function.
            TargetError: the function is never called, or the counts are not those of a run.
        """
        function, limit = self.target.function, self.limits.profile_steps
        if function is not None:
            entry = function_of(self, function)
            return profile_calls(self, rng, [entry], windows=windows, limit=limit, watch=watch)
        if callgrind() is None:
            return profile_run(self, rng, limit=limit, watch=watch)
        try:
            return profile_run(self, rng, limit=min(limit, _SHORT), watch=watch)
        except WindowTooLong:
            return self._counted(rng)

    def _counted(self, rng: np.random.Generator) -> TargetProfile:
        """Count the executions of a whole run by callgrind, and check some of them."""
        begun, golden = time.perf_counter(), self._golden or self.fault_free()
        self._renew_folder()
        code = run_counted(
            self._command, stdout=self._stdout, stderr=self._stderr, counts=self._counts,
            wall_s=golden.wall_s,
        )  # fmt: skip
        counted = replace(golden, output=joined(self._parts()), exit_code=code)
        if unlike := self.unlike(golden, counted):
            problem = "does not run under callgrind as it does without, so it cannot be counted"
            raise TargetError(self.name, f"{problem}: {unlike}")
        profile = profile_counted(self, lambda paths: read_counts(self._counts, paths), begun)
        self._counts.unlink()
        require_counts(self, profile, rng)
        return profile

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
        self._golden = Golden(
            output=joined(parts),
            exit_code=ended.exit_code,
            cpu_s=_children_cpu_s() - before_s,
            wall_s=time.perf_counter() - start,
        )
        return self._golden

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
        output = joined(parts)
        outcome, difference = judged(golden, ended, output, compared, tolerance=tolerance)
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
