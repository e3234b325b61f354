"""One user's program as a target: golden run, profile, and runs with one fault each."""

from __future__ import annotations

import resource
import signal
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from mavfi_cli.core.errors import FaultError, TargetError
from mavfi_cli.fi.isolated.compare import Comparison, digest, magnitude
from mavfi_cli.fi.isolated.outcome import Outcome
from mavfi_cli.fi.native import linux
from mavfi_cli.fi.native.alarm import Alarm
from mavfi_cli.fi.native.breakpoints import Mechanism
from mavfi_cli.fi.native.fault import InstructionFault, Stage
from mavfi_cli.fi.native.image import Image, Location, Scope, scope_of
from mavfi_cli.fi.native.inject import (
    NOTHING,
    Followed,
    Injection,
    apply,
    follow,
    instruction_at,
    reach,
)
from mavfi_cli.fi.native.profile import Profile, Segment, record_window
from mavfi_cli.fi.native.spawn import Command, run_to_entry, spawn
from mavfi_cli.fi.native.tracee import Ended, Tracee
from mavfi_cli.fi.sampling import Rule, Strategy

_HIT_LIMIT_S = 1e-3  # allowed for one counted execution, about a hundred times what it takes


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """When a run counts as hung, and how far to step."""

    factor: float = 10.0  # times the golden CPU time and wall time
    cpu_grace_s: float = 0.2
    wall_grace_s: float = 5.0  # a loaded machine delays; only a blocked program waits this long
    follow_window: int = 64  # instructions after a destination fault
    profile_steps: int = 2_000_000

    def wall_limit_s(self, golden: Golden) -> float:
        """Wall time after which a run counts as hung."""
        return self.factor * golden.wall_s + self.wall_grace_s


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
class RunResult:
    """One faulty run."""

    outcome: Outcome
    signal: int | None
    exit_code: int | None
    magnitude: float | None  # of a silent corruption of numbers
    within_tolerance: bool
    output_sha256: str
    fault: InstructionFault | None  # None where a time trigger found nothing to hit
    injection: Injection | None
    followed: Followed
    reason: str  # why not injected
    run_s: float  # wall time of the whole run


class Workplace:
    """A scratch folder with the output files of one worker."""

    def __init__(self, target: ProgramTarget) -> None:
        self._scratch = tempfile.TemporaryDirectory(prefix="mavfi-kernels-")
        root = Path(self._scratch.name)
        self.stdout, self.stderr = root / "stdout", root / "stderr"
        self.directory = target.command.directory
        self._own_file: Path | None = None
        if target.comparison.file is not None:
            self.directory = root / "run"
            self.directory.mkdir()
            self._own_file = self.directory / target.comparison.file
        self._command = replace(target.command, directory=self.directory)
        self._mechanism = target.mechanism

    def start(self) -> Tracee:
        """Start the program, stopped at its entry point.

        Raises:
            TargetError: it ends before its entry point.
        """
        if self._own_file is not None:
            self._own_file.unlink(missing_ok=True)
        tracee = spawn(
            self._command, stdout=self.stdout, stderr=self.stderr, mechanism=self._mechanism
        )
        if not run_to_entry(tracee):
            said = self.stderr.read_text(errors="replace").strip().splitlines()
            problem = f"ends before its entry point{': ' + said[0] if said else ''}"
            raise TargetError(self._command.argv[0], problem)
        return tracee

    def close(self) -> None:
        """Delete the scratch folder."""
        self._scratch.cleanup()


def golden_run(target: ProgramTarget, place: Workplace) -> Golden:
    """Run without a fault, twice; the program must repeat itself.

    Raises:
        TargetError: it is killed by a signal, or its two outputs differ.
    """
    first, second = _fault_free(target, place), _fault_free(target, place)
    if first.output != second.output or first.exit_code != second.exit_code:
        raise TargetError(target.name, "two fault-free runs differ; outcomes cannot be told")
    slower = max(first.cpu_s, second.cpu_s), max(first.wall_s, second.wall_s)
    return replace(first, cpu_s=slower[0], wall_s=slower[1])


def _fault_free(target: ProgramTarget, place: Workplace) -> Golden:
    """One fault-free run, timed from the entry point."""
    before_s = _children_cpu_s()
    tracee = place.start()
    before_s += linux.cpu_time_s(tracee.pid)
    start = time.perf_counter()
    ended = _run_out(tracee)
    if ended.exit_code is None:
        raise TargetError(target.name, f"is killed by signal {ended.signal} without a fault")
    return Golden(
        output=target.comparison.output(place.directory, place.stdout),
        exit_code=ended.exit_code,
        cpu_s=_children_cpu_s() - before_s,
        wall_s=time.perf_counter() - start,
    )


def _children_cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


@dataclass(frozen=True, slots=True, kw_only=True)
class Profiled:
    """A profile with what is needed to draw from it after the process is gone."""

    profile: Profile
    image: Image
    code: tuple[tuple[int, bytes], ...]  # start address and bytes of the code in scope

    def code_at(self, address: int) -> bytes:
        """16 bytes of code."""
        for start, data in self.code:
            if start <= address < start + len(data):
                return data[address - start : address - start + 16]
        return b""


def profile_program(
    target: ProgramTarget,
    place: Workplace,
    rng: np.random.Generator,
    *,
    windows: int = 16,
) -> Profiled:
    """Step the fault-free run, or sampled invocations of the target's function.

    Args:
        target: the program.
        place: where it runs.
        rng: draws the invocations.
        windows: how many invocations are stepped at most.

    Raises:
        WindowTooLong: too many instructions.
        UnknownName: no such object or function.
        TargetError: the function is never called.
    """
    start = time.perf_counter()
    if target.function is None:
        segments, in_run = [_window(target, place, ())], 1
    else:
        entry, in_run = _invocations(target, place)
        drawn = rng.choice(in_run, size=min(windows, in_run), replace=False)
        segments = [
            _window(target, place, (Stage(entry, int(number) + 1),)) for number in sorted(drawn)
        ]
    tracee = place.start()
    try:
        image = Image(tracee.pid)
        scope = scope_of(image, target.scope_objects)
        code = tuple(
            (span.start, tracee.read_memory(span.start, len(span) + 16)) for span in scope.spans
        )
    finally:
        tracee.kill()
    profile = Profile(
        segments=tuple(segments), windows_in_run=in_run, cost_s=time.perf_counter() - start
    )
    return Profiled(profile=profile, image=image, code=code)


def _invocations(target: ProgramTarget, place: Workplace) -> tuple[Location, int]:
    tracee = place.start()
    try:
        image = Image(tracee.pid)
        assert target.function is not None
        entry = image.function(target.function, target.scope_objects)
        count = tracee.count_to_end(image.address(entry))
    finally:
        tracee.kill()
    if not count:
        raise TargetError(target.name, f"never calls {target.function}")
    return entry, count


def _window(target: ProgramTarget, place: Workplace, start: tuple[Stage, ...]) -> Segment:
    tracee = place.start()
    try:
        image = Image(tracee.pid)
        scope = scope_of(image, target.scope_objects)
        for stage in start:
            if not tracee.run_to(image.address(stage.location), stage.count):
                raise TargetError(target.name, "does not repeat its function calls")
        trace = record_window(
            tracee,
            scope,
            limit=target.limits.profile_steps,
            program=target.name,
            until_return=bool(start),
        )
    finally:
        tracee.kill()
    return Segment(start=start, trace=trace)


def run_fault(
    target: ProgramTarget, place: Workplace, golden: Golden, fault: InstructionFault
) -> RunResult:
    """One run with a fault at an exact execution of an instruction.

    Raises:
        FaultError: the instruction at the place is not the one that was drawn.
    """
    start = time.perf_counter()
    tracee = place.start()
    try:
        hits = sum(stage.count for stage in fault.trigger)
        wall_s = target.limits.wall_limit_s(golden) + hits * _HIT_LIMIT_S
        with Alarm(tracee.pid, signal.SIGKILL, cpu_s=None, wall_s=wall_s):
            reason = reach(tracee, Image(tracee.pid), fault)
        if reason:
            ended = tracee.ended
            return _result(target, place, golden, start, ended, fault, None, NOTHING, reason)
        return _corrupt(target, place, golden, start, tracee, fault)
    finally:
        tracee.kill()


def run_timed(
    target: ProgramTarget,
    place: Workplace,
    golden: Golden,
    plan: Strategy,
    rng: np.random.Generator,
) -> RunResult:
    """One run with a fault at a drawn moment of CPU time or wall time."""
    start = time.perf_counter()
    cpu = plan.rule is Rule.CPU_TIME
    moment_s = float(rng.uniform(0.0, golden.cpu_s if cpu else golden.wall_s))
    tracee = place.start()
    try:
        fault, reason = _fault_at_moment(target, tracee, plan, rng, moment_s, cpu)
        if fault is None:
            ended = tracee.ended
            if ended is None:
                with _deadline(tracee, golden, target.limits):
                    ended = _run_out(tracee)
            return _result(target, place, golden, start, ended, None, None, NOTHING, reason)
        return _corrupt(target, place, golden, start, tracee, fault)
    finally:
        tracee.kill()


def _fault_at_moment(
    target: ProgramTarget,
    tracee: Tracee,
    plan: Strategy,
    rng: np.random.Generator,
    moment_s: float,
    cpu: bool,
) -> tuple[InstructionFault | None, str]:
    image = Image(tracee.pid)
    scope = scope_of(image, target.scope_objects)
    reason = ""
    for _ in range(plan.attempts):
        alarm = Alarm(
            tracee.pid,
            signal.SIGTRAP,
            cpu_s=moment_s if cpu else None,
            wall_s=None if cpu else moment_s,
        )
        if isinstance(tracee.resume_until_alarm(alarm), Ended):
            return None, "the program ended before the moment"
        moment_s = plan.retry_s
        fault, reason = _fault_here(tracee, image, scope, plan, rng)
        if fault is not None:
            return fault, ""
    return None, reason


def _fault_here(
    tracee: Tracee, image: Image, scope: Scope, plan: Strategy, rng: np.random.Generator
) -> tuple[InstructionFault | None, str]:
    here = tracee.registers.ip
    if tracee.registers.system_call is not None and not plan.in_system_calls:
        return None, f"inside system call {tracee.registers.system_call}"
    if here not in scope and not plan.whole_process:
        return None, f"outside the scope, in {image.locate(here).object}"
    instruction = instruction_at(tracee, here)
    corruption = None if instruction is None else plan.draw_at(instruction, rng)
    if instruction is None or corruption is None:
        return None, "no operand that the fault model allows"
    fault = InstructionFault(
        trigger=(Stage(image.locate(here), 1),),
        execution=0,
        instruction=instruction.text,
        instruction_bytes=instruction.raw,
        corruption=corruption,
    )
    return fault, ""


def _corrupt(
    target: ProgramTarget,
    place: Workplace,
    golden: Golden,
    start: float,
    tracee: Tracee,
    fault: InstructionFault,
) -> RunResult:
    """The target is stopped in front of the attacked instruction: flip, follow, run to the end."""
    instruction = instruction_at(tracee, tracee.registers.ip)
    if instruction is None or instruction.raw != fault.instruction_bytes:
        found = "nothing" if instruction is None else instruction.text
        raise FaultError(f"{fault.target} holds {found!r}, expected {fault.instruction!r}")
    injection, followed = None, NOTHING
    with _deadline(tracee, golden, target.limits) as alarm:
        if fault.corruption is not None:
            injection = apply(tracee, instruction, fault.corruption)
            followed = follow(
                tracee,
                instruction,
                fault.corruption,
                injection,
                window=target.limits.follow_window if tracee.ended is None else 0,
            )
        ended = _run_out(tracee)
    reason = injection.reason if injection is not None else ""
    hung = alarm.fired and ended.signal == signal.SIGKILL
    result = None if hung else ended
    return _result(target, place, golden, start, result, fault, injection, followed, reason)


def _run_out(tracee: Tracee) -> Ended:
    while tracee.ended is None:
        tracee.resume()
    return tracee.ended


def _deadline(tracee: Tracee, golden: Golden, limits: Limits) -> Alarm:
    return Alarm(
        tracee.pid,
        signal.SIGKILL,
        cpu_s=limits.factor * golden.cpu_s + limits.cpu_grace_s,
        wall_s=limits.wall_limit_s(golden),
    )


def _result(
    target: ProgramTarget,
    place: Workplace,
    golden: Golden,
    start: float,
    ended: Ended | None,
    fault: InstructionFault | None,
    injection: Injection | None,
    followed: Followed,
    reason: str,
) -> RunResult:
    output = target.comparison.output(place.directory, place.stdout)
    outcome, size = _classify(target.comparison, golden, ended, output)
    within = outcome is Outcome.BENIGN and size is not None and size > 0
    planned = fault is not None and fault.corruption is not None
    applied = injection is not None and injection.applied
    if not applied and (planned or fault is None):
        outcome = Outcome.NOT_INJECTED
    return RunResult(
        outcome=outcome,
        signal=None if ended is None else ended.signal,
        exit_code=None if ended is None else ended.exit_code,
        magnitude=size,
        within_tolerance=within,
        output_sha256=digest(output),
        fault=fault,
        injection=injection,
        followed=followed,
        reason=reason,
        run_s=time.perf_counter() - start,
    )


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


def absolute_arguments(argv: Sequence[str], directory: Path) -> tuple[str, ...]:
    """Arguments that name existing files, made absolute: the program runs in a scratch folder."""
    return tuple(
        str((directory / argument).resolve())
        if not argument.startswith("/") and (directory / argument).is_file()
        else argument
        for argument in argv
    )
