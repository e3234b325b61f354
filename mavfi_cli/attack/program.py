"""A user's program as a target: starts, profiles and judges its runs.

Long programs are profiled by exact execution counts.
"""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from mavfi_cli.attack.attacker import run_out
from mavfi_cli.attack.callgrind import Executions, count_executions, find_valgrind
from mavfi_cli.attack.comparison import LARGEST_BYTES, STDOUT, OutputComparison
from mavfi_cli.attack.place import Golden, Watch, digest
from mavfi_cli.attack.profile import (
    TargetProfile,
    function_of,
    native_time_s,
    profile_calls,
    profile_counted,
    profile_run,
)
from mavfi_cli.attack.target import RunLimits, RunVerdict, judged, signal_name
from mavfi_cli.attack.work_folder import WorkFolder
from mavfi_cli.core.errors import TargetError
from mavfi_cli.core.files import Json, ScratchFolder, gains_rights
from mavfi_cli.core.processes import Ended
from mavfi_cli.fi.tracer import linux
from mavfi_cli.fi.tracer.image import Image, Scope
from mavfi_cli.fi.tracer.linux import ProcessTimer
from mavfi_cli.fi.tracer.sampling import WindowTooLong
from mavfi_cli.fi.tracer.spawn import ObservedRun, Program, run_to_entry, spawn, watch
from mavfi_cli.fi.tracer.tracee import Mechanism, Tracee


def _require_attackable(path: Path) -> None:
    """Raise an error if a program cannot be attacked.

    Raises:
        TargetError: the program is a script, gains rights, or is built for another processor.
    """
    with path.open("rb") as file:
        head = file.read(256)
    if head.startswith(b"#!"):
        shell = head[2:].split(b"\n")[0].decode(errors="replace").strip()
        program, _, option = shell.removeprefix("/usr/bin/env ").partition(" ")
        line = " ".join(part for part in (option, str(path)) if part)
        raise TargetError(
            path.name,
            f"is a script; attack its interpreter: --program {program} --args {line!r}",
        )
    if head[:5] != b"\x7fELF\x02" or head[18:20] != b"\x3e\0":
        raise TargetError(path.name, "is not a program for x86-64")
    if gains_rights(path):
        raise TargetError(
            path.name,
            "is set-uid or set-gid or has file capabilities: it would lose these rights under the "
            "tracer, and must not hold them while its state is corrupted; attack a copy without "
            "them",
        )


_SHORT = 100_000  # longest run that is stepped rather than counted, instructions
_STEP_LIMIT_S = 1e-3  # for one stepped instruction, about forty times what it takes
_WATCHING = 20.0  # largest slowdown of a run whose system calls are observed


@dataclass(frozen=True, slots=True, kw_only=True)
class ProgramTarget:
    """A program to attack, with its code in scope and the outputs to compare."""

    command: Program
    comparison: OutputComparison
    objects: tuple[str, ...] = ()  # file names in scope; by default the program itself
    function: str | None = None  # hit only calls of this function
    folder: Path | None = None  # each run works in a copy of it; None: in an empty folder
    # Further files and folders to copy, by their path relative to the program's folder.
    files: Mapping[str, Path] = field(default_factory=dict)
    limits: RunLimits = field(default_factory=RunLimits)
    mechanism: Mechanism | None = None

    @property
    def name(self) -> str:
        """The program's file name."""
        return Path(self.command.argv[0]).name

    @property
    def stream(self) -> tuple[str, ...]:
        """Name of the random stream: empty, because a campaign has only one program."""
        return ()

    @property
    def scope_objects(self) -> tuple[str, ...]:
        """File names of the objects in scope; by default, only the program itself."""
        return self.objects or (self.name,)

    def context(self) -> Json:
        """Return the entries about the program that every record contains."""
        entries: Json = {
            "program": list(self.command.argv),
            "scope": list(self.scope_objects),
            "function": self.function,
        }
        if self.command.stdin != Path(os.devnull):
            entries["stdin"] = str(self.command.stdin)
        return entries

    def settings(self) -> Json:
        """Return all settings that determine the results of the program's runs."""
        entries = self.context() | {
            "comparison": self.comparison.to_json(),
            "environment": dict(self.command.environment),
            "memory_bytes": self.command.memory_bytes,
            "folder": None if self.folder is None else str(self.folder),
        }
        if self.files:
            entries["files"] = {place: str(source) for place, source in self.files.items()}
        return entries

    def open(self) -> _Workplace:
        """Create a scratch folder, and return the `AttackPlace` whose runs use that folder."""
        return _Workplace(self)


class _Workplace:
    """The scratch folder of one worker, with a fresh folder for every run of the program.

    Nothing outside the scratch folder is ever removed.

    Raises:
        TargetError: this kind of program cannot be attacked, or its files cannot be copied.
        RecordError: the scratch folder cannot be created.
    """

    kind = "program"

    def __init__(self, target: ProgramTarget) -> None:
        _require_attackable(Path(target.command.argv[0]))
        self.target, self.name, self.limits = target, target.name, target.limits
        self._golden: Golden | None = None
        self._observed: ObservedRun | None = None
        self._scratch = ScratchFolder("kernels")
        self.close, scratch = self._scratch.close, self._scratch.path
        self._stdout, self._stderr = scratch / "stdout", scratch / "stderr"
        self._counts = scratch / "counts"
        self._folder = WorkFolder(scratch, target.folder, target.files, self.name)
        self._command = replace(target.command, directory=self._folder.path)

    def context(self) -> Json:
        exact = self.target.comparison.tolerance == 0.0
        return self.target.context() | (
            {"golden_sha256": self._known_golden().sha256} if exact else {}
        )

    def start(self) -> Tracee:
        """Start the program, stopped at its entry point.

        Raises:
            TargetError: the program ends before its entry point.
        """
        self._folder.renew()
        tracee = spawn(
            self._command, stdout=self._stdout, stderr=self._stderr, mechanism=self.target.mechanism
        )
        if not run_to_entry(tracee):
            lines = self._stderr.read_text(errors="replace").strip().splitlines()
            problem = f"ends before its entry point{': ' + lines[0] if lines else ''}"
            raise TargetError(self._command.argv[0], problem)
        return tracee

    def image(self, tracee: Tracee) -> Image:
        return Image(tracee.pid)

    def scope(self, image: Image) -> Scope:
        return image.scope(self.target.scope_objects)

    def _parts(self) -> dict[str, bytes | None]:
        """Return the last run's outputs to compare, keyed by name.

        The value is None for a file that the run did not write.
        """
        parts = self.target.comparison.parts(self._folder.path, self._stdout)
        for name in self.target.comparison.files:
            if parts[name] is not None and not self._folder.wrote(name):
                parts[name] = None
        return parts

    def profile(
        self, rng: np.random.Generator, *, windows: int = 16, watch: Watch | None = None
    ) -> TargetProfile:
        """Profile the golden run: step it, count it, or step some calls of the target's function.

        Raises:
            WindowTooLong: the run is too long to be stepped, and valgrind is not installed.
            UnknownName: the program has no such object or function.
            TargetError: the function is never called, or the counts do not match a native run.
        """
        if (observed := self._observe()).started:
            raise TargetError(
                self.name,
                f"{observed.started}, which the tracer does not follow, so instructions there can "
                "be neither counted nor struck; attack a program with one thread (--env "
                "OMP_NUM_THREADS=1 may limit it to one)",
            )
        function, limit = self.target.function, self.limits.profile_steps
        if function is not None:
            return profile_calls(
                self, rng, [function_of(self, function)], windows=windows, limit=limit,
                watch=watch, guard=self._guard,
            )  # fmt: skip
        if find_valgrind() is None:
            return profile_run(self, rng, limit=limit, watch=watch, guard=self._guard)
        try:
            short = min(limit, _SHORT)
            return profile_run(self, rng, limit=short, watch=watch, guard=self._guard)
        except WindowTooLong:
            return self._counted(rng, watch)

    @contextlib.contextmanager
    def _guard(self, tracee: Tracee) -> Iterator[None]:
        """Set a deadline for a stepped run. If the run ends, require the golden run's result."""
        wall_s = self._watching_s + self.limits.profile_steps * _STEP_LIMIT_S
        with ProcessTimer(tracee.pid, signal.SIGKILL, cpu_s=None, wall_s=wall_s) as alarm:
            yield
        if alarm.fired:
            raise TargetError(self.name, f"does not end within {wall_s:.0f} s when stepped")
        if tracee.ended is not None:
            self._require_golden("stepped", tracee.ended)

    def _counted(self, rng: np.random.Generator, watch: Watch | None) -> TargetProfile:
        """Count the executions of a whole run with callgrind, and check some of the counts."""
        begun = time.perf_counter()
        self._folder.renew()
        code, executions = count_executions(
            self._command, stdout=self._stdout, stderr=self._stderr, counts=self._counts,
            golden=self._known_golden(), native_s=self._native_s, report=watch or (lambda _: None),
        )  # fmt: skip
        self._require_golden("run under callgrind", Ended(exit_code=code, signal=None))
        return profile_counted(self, rng, executions, begun)

    def _native_s(self, executions: Executions) -> float | None:
        """Return the CPU time, in seconds, of a native run up to the given counts.

        The run has a folder of its own, because callgrind runs meanwhile. Returns None if the time
        is unknown.
        """
        with contextlib.closing(self.target.open()) as other:
            return native_time_s(other, executions)

    def _require_golden(self, how: str, ended: Ended) -> None:
        """Raise TargetError if a profiled run's end or output differs from the golden run's."""
        golden = self._known_golden()
        if ended.signal is not None:
            unlike = f"it is killed by {signal_name(ended.signal)}"
        else:
            again = replace(golden, output=_joined(self._parts()), exit_code=ended.exit_code or 0)
            unlike = self.describe_difference(golden, again)
        if unlike:
            problem = f"behaves differently when {how}, so it cannot be profiled: {unlike}"
            raise TargetError(self.name, problem)

    def _known_golden(self) -> Golden:
        return self._golden or self.fault_free()

    @property
    def _watching_s(self) -> float:
        golden_s = self.limits.golden_s if self._golden is None else self._golden.wall_s
        return _WATCHING * golden_s + self.limits.wall_grace_s

    def _observe(self) -> ObservedRun:
        """Watch the program's system calls in one fault-free run, which is made on first use."""
        if self._observed is None:
            tracee = self.start()
            try:
                self._observed = watch(tracee, wall_s=min(self._watching_s, self.limits.golden_s))
            finally:
                tracee.kill()
        return self._observed

    def fault_free(self) -> Golden:
        """Run the program once without a fault. Its times count from the entry point.

        Raises:
            TargetError: the run times out, is killed, lacks memory or a terminal, prints too much,
                or does not write a compared file.
        """
        before_s = _children_cpu_s()
        tracee = self.start()
        before_s += linux.cpu_time_s(tracee.pid)
        start, limit_s = time.perf_counter(), self.limits.golden_s
        with ProcessTimer(tracee.pid, signal.SIGKILL, cpu_s=None, wall_s=limit_s) as alarm:
            ended = run_out(tracee)
        tracee.kill()  # and its children
        if alarm.fired:
            raise TargetError(self.name, f"does not end within {limit_s:g} s without a fault")
        wall_s, cpu_s = time.perf_counter() - start, _children_cpu_s() - before_s
        parts = self._parts()
        self._require_sound(ended, parts)
        golden = Golden(
            output=_joined(parts), exit_code=ended.exit_code or 0, cpu_s=cpu_s, wall_s=wall_s
        )
        self._golden = self._golden or golden
        return replace(golden, notices=tuple(self._notices(golden.exit_code)))

    def _require_sound(self, ended: Ended, parts: Mapping[str, bytes | None]) -> None:
        """Raise TargetError if a fault-free run failed or has no output that can be compared."""
        problem = self._failure(ended)
        for name, data in parts.items():
            if data is None:
                before = ", which was there before," if self._folder.had(name) else ""
                problem = problem or (
                    f"writes no file {name}{before} in the folder in which it runs, so there is "
                    "nothing to compare"
                )
            elif len(data) > LARGEST_BYTES:
                what = "prints" if name == STDOUT else f"writes to {name}"
                problem = problem or (
                    f"{what} more than {LARGEST_BYTES >> 20} MB, the limit of a comparison: reduce "
                    "its output, or compare another one"
                )
        if problem:
            raise TargetError(self.name, problem)

    def _failure(self, ended: Ended) -> str:
        """Explain why a fault-free run failed. Return an empty string if it did not fail."""
        if ended.signal == signal.SIGXFSZ:
            return "was stopped after it had written 1 GB"
        if ended.exit_code == 0:
            return ""
        how = f"ends with exit code {ended.exit_code} without a fault"
        if ended.signal is not None:
            how = f"is killed by {signal_name(ended.signal)} without a fault"
        how, silent = how + self._last_error(), self._stdout.stat().st_size == 0
        observed, limit_bytes = self._observe(), self._command.memory_bytes
        if observed.lacked_memory and limit_bytes is not None:
            return f"{how}: it needs more than {limit_bytes / (1 << 30):g} GB; --memory allows more"
        if observed.terminal and silent:
            return f"{how}: it may need input (--stdin), or a terminal, which campaigns lack"
        return how if ended.signal is not None else ""

    def _last_error(self) -> str:
        lines = self._stderr.read_text(errors="replace").strip().splitlines()
        return f" ({lines[-1][:200]})" if lines else ""

    def _notices(self, exit_code: int) -> Iterator[str]:
        if exit_code:
            yield (
                f"{self.name} ends with exit code {exit_code} without a fault"
                f"{self._last_error()}; a run that ends in the same way is benign"
            )
        written = [Path(path) for path in self._observe().written]
        outside = [path for path in written if not path.is_relative_to(self._folder.tree)]
        if outside:
            yield (
                f"{self.name} writes outside its folder: {_first_of(outside)}; all runs "
                "share these files, and faults may damage them"
            )
        compared = [self._folder.path / name for name in self.target.comparison.files]
        ignored = [
            Path(os.path.relpath(path, self._folder.path))
            for path in written
            if path.is_relative_to(self._folder.path) and path not in compared and path.is_file()
        ]
        if ignored:
            yield (
                f"{self.name} writes {_first_of(ignored)}, which is not compared: a fault that "
                f"changes nothing else is benign; --compare file:{ignored[0]} compares it"
            )

    def describe_difference(self, golden: Golden, again: Golden) -> str:
        """Describe how two fault-free runs differ. Return an empty string if they are equal."""
        if again.exit_code != golden.exit_code:
            return f"their exit codes are {golden.exit_code} and {again.exit_code}"
        if self.target.comparison.same(golden.output, again.output):
            return ""
        lines = zip(golden.output.splitlines(), again.output.splitlines(), strict=False)
        first = next((a for a, b in lines if a != b), b"")
        text = first[:60].decode(errors="replace").strip()
        where = f"at the line {text!r}" if text else "in length"
        return f"their outputs differ {where}; --ignore-lines skips lines that vary"

    def judge(self, golden: Golden, ended: Ended | None) -> RunVerdict:
        parts, comparison = self._parts(), self.target.comparison
        output = _joined(parts)
        outcome, difference = judged(
            golden, ended, output, comparison.difference, tolerance=comparison.tolerance
        )
        return RunVerdict(
            outcome=outcome,
            output_sha256=digest(output if any(parts.values()) else b""),
            details={
                "exit_code": None if ended is None else ended.exit_code,
                "magnitude": None if difference is None else difference.relative,
            },
        )


def _joined(parts: dict[str, bytes | None]) -> bytes:
    """Join all outputs. If there are several, each is preceded by a line with its name."""
    pieces = [b"\0missing" if data is None else data for data in parts.values()]
    if len(pieces) == 1:
        return pieces[0]
    names = (f"== {name}\n".encode() for name in parts)
    return b"".join(name + piece for name, piece in zip(names, pieces, strict=True))


def _first_of(paths: Sequence[Path]) -> str:
    return f"{paths[0]} and {len(paths) - 1} more" if len(paths) > 1 else str(paths[0])


def _children_cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
