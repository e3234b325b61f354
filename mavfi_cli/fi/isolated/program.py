"""One user's program as a target: how it starts, its golden run, and how its runs are judged."""

from __future__ import annotations

import resource
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from mavfi_cli.core.errors import TargetError
from mavfi_cli.fi.isolated.attack import Attacker, Limits, run_out
from mavfi_cli.fi.isolated.compare import Comparison, digest, magnitude
from mavfi_cli.fi.isolated.outcome import Outcome
from mavfi_cli.fi.isolated.profile import TargetProfile, Watch, profile_function, profile_run
from mavfi_cli.fi.native import linux
from mavfi_cli.fi.native.breakpoints import Mechanism
from mavfi_cli.fi.native.image import Image, Scope, scope_of
from mavfi_cli.fi.native.spawn import Command, run_to_entry, spawn
from mavfi_cli.fi.native.tracee import Ended, Tracee


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
    def scope_objects(self) -> tuple[str, ...]:
        """The objects in scope."""
        return self.objects or (self.name,)


@dataclass(frozen=True, slots=True, kw_only=True)
class Golden:
    """The fault-free run."""

    output: bytes
    exit_code: int
    cpu_s: float
    wall_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ProgramVerdict:
    """What the end and the output of a run amount to."""

    outcome: Outcome
    exit_code: int | None
    magnitude: float | None  # of a silent corruption of numbers
    output_sha256: str

    @property
    def within_tolerance(self) -> bool:
        """Benign by tolerance only."""
        return self.outcome is Outcome.BENIGN and bool(self.magnitude)

    def to_json(self) -> dict[str, Any]:
        """What a record says of a program beside what every record says."""
        return {"exit_code": self.exit_code, "magnitude": self.magnitude}


class Workplace:
    """A scratch folder with the output files of one worker."""

    kind = "program"

    def __init__(self, target: ProgramTarget) -> None:
        self.target = target
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

    def output(self) -> bytes:
        """What the last run left."""
        return self.target.comparison.output(self._directory, self._stdout)

    def attacker(self, golden: Golden) -> Attacker[ProgramVerdict]:
        """For runs with a fault here, against this golden run."""
        return Attacker(
            place=self,
            golden=golden,
            judge=lambda ended: self._judge(golden, ended),
            limits=self.target.limits,
        )

    def _judge(self, golden: Golden, ended: Ended | None) -> ProgramVerdict:
        output = self.output()
        outcome, size = _classify(self.target.comparison, golden, ended, output)
        return ProgramVerdict(
            outcome=outcome,
            exit_code=None if ended is None else ended.exit_code,
            magnitude=size,
            output_sha256=digest(output),
        )

    def close(self) -> None:
        """Delete the scratch folder."""
        self._scratch.cleanup()


def _classify(
    comparison: Comparison, golden: Golden, ended: Ended | None, output: bytes
) -> tuple[Outcome, float | None]:
    """The outcome, and the size of the difference; `ended` is None for a run that was cut off."""
    if ended is None:
        return Outcome.HANG, None
    if ended.signal is not None or (ended.exit_code and ended.exit_code != golden.exit_code):
        return Outcome.CRASH, None
    if output == golden.output and ended.exit_code == golden.exit_code:
        return Outcome.BENIGN, 0.0
    size = magnitude(golden.output, output)
    if size is not None and size <= comparison.tolerance and ended.exit_code == golden.exit_code:
        return Outcome.BENIGN, size
    return Outcome.SDC, size


def golden_run(place: Workplace) -> Golden:
    """Run without a fault, twice; the program must repeat itself.

    Raises:
        TargetError: it is killed by a signal, or its two outputs differ.
    """
    first, second = _fault_free(place), _fault_free(place)
    if first.output != second.output or first.exit_code != second.exit_code:
        raise TargetError(place.name, "two fault-free runs differ; outcomes cannot be told")
    slower = max(first.cpu_s, second.cpu_s), max(first.wall_s, second.wall_s)
    return replace(first, cpu_s=slower[0], wall_s=slower[1])


def _fault_free(place: Workplace) -> Golden:
    """One fault-free run, timed from the entry point."""
    before_s = _children_cpu_s()
    tracee = place.start()
    before_s += linux.cpu_time_s(tracee.pid)
    start = time.perf_counter()
    ended = run_out(tracee)
    if ended.exit_code is None:
        raise TargetError(place.name, f"is killed by signal {ended.signal} without a fault")
    return Golden(
        output=place.output(),
        exit_code=ended.exit_code,
        cpu_s=_children_cpu_s() - before_s,
        wall_s=time.perf_counter() - start,
    )


def _children_cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def profile_program(
    place: Workplace,
    rng: np.random.Generator,
    *,
    windows: int = 16,
    watch: Watch | None = None,
) -> TargetProfile:
    """Step the fault-free run, or sampled invocations of the target's function.

    Args:
        place: where it runs.
        rng: draws the invocations.
        windows: how many invocations are stepped at most.
        watch: is told how far it is.

    Raises:
        WindowTooLong: too many instructions.
        UnknownName: no such object or function.
        TargetError: the function is never called.
    """
    function, limit = place.target.function, place.target.limits.profile_steps
    if function is None:
        return profile_run(place, rng, limit=limit, watch=watch)
    return profile_function(
        place, rng, function=function, windows=windows, limit=limit, watch=watch
    )


def absolute_arguments(argv: Sequence[str], directory: Path) -> tuple[str, ...]:
    """Arguments that name existing files, made absolute: the program runs in a scratch folder."""
    return tuple(
        str((directory / argument).resolve())
        if not argument.startswith("/") and (directory / argument).is_file()
        else argument
        for argument in argv
    )
