"""One kernel as a target: golden runs, profile, and runs with one fault each."""

from __future__ import annotations

import math
import signal
import time
from dataclasses import dataclass, field, replace

import numpy as np

from mavfi_cli.campaign.kernels.catalogue import Kernel
from mavfi_cli.campaign.kernels.difference import Difference, unpack
from mavfi_cli.campaign.kernels.place import Place, Told
from mavfi_cli.campaign.kernels.template import RAISED
from mavfi_cli.core.errors import FaultError, TargetError
from mavfi_cli.fi.isolated.compare import digest
from mavfi_cli.fi.isolated.outcome import Outcome
from mavfi_cli.fi.native.alarm import Alarm
from mavfi_cli.fi.native.fault import InstructionFault, Stage
from mavfi_cli.fi.native.image import scope_of
from mavfi_cli.fi.native.inject import (
    NOTHING,
    Followed,
    Injection,
    apply,
    follow,
    instruction_at,
    reach,
)
from mavfi_cli.fi.native.tracee import Ended, Tracee
from mavfi_cli.fi.sampling import Rule, Strategy

_HIT_LIMIT_S = 1e-3  # allowed for one counted execution, about a hundred times what it takes


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """When a run counts as hung, and how far a destination fault is followed."""

    factor: float = 10.0  # times the golden CPU time and duration
    cpu_grace_s: float = 0.2
    wall_grace_s: float = 5.0  # a loaded machine delays; only a blocked kernel waits this long
    follow_window: int = 64


@dataclass(frozen=True, slots=True, kw_only=True)
class Golden:
    """The fault-free run."""

    output: bytes
    cpu_s: float  # of the call
    wall_s: float

    @property
    def sha256(self) -> str:
        """Of the output."""
        return digest(self.output)


@dataclass(frozen=True, slots=True, kw_only=True)
class RunResult:
    """One faulty run."""

    outcome: Outcome
    signal: int | None
    error: str  # what the kernel raised
    difference: Difference | None  # None where there is no output to compare
    within_tolerance: bool
    output_sha256: str
    fault: InstructionFault | None  # None where a time trigger found nothing to hit
    injection: Injection | None
    followed: Followed
    reason: str  # why not injected
    run_s: float


def golden_run(place: Place, runs: int = 3) -> Golden:
    """Run without a fault several times; the kernel must repeat itself.

    Raises:
        TargetError: it crashes, or its outputs differ.
    """
    told = [_fault_free(place) for _ in range(runs)]
    if len({each.data for each in told}) > 1:
        raise TargetError(place.kernel, "fault-free runs differ; outcomes cannot be told")
    return Golden(
        output=told[0].data,
        cpu_s=max(each.cpu_s for each in told),
        wall_s=max(each.wall_s for each in told),
    )


def _fault_free(place: Place) -> Told:
    tracee = place.start()
    ended = _run_out(tracee)
    told = place.told()
    if told is None or ended.exit_code != 0:
        how = f"signal {ended.signal}" if ended.signal else f"exit code {ended.exit_code}"
        text = told.data.decode(errors="replace") if told else how
        raise TargetError(place.kernel, f"fails without a fault: {text}")
    return told


@dataclass(frozen=True, slots=True, kw_only=True)
class Attacker:
    """Runs faults in one place against one golden run."""

    kernel: Kernel
    place: Place
    golden: Golden
    tolerance: float = 0.0
    limits: Limits = field(default_factory=Limits)

    def run(self, fault: InstructionFault) -> RunResult:
        """One run with a fault at an exact execution of an instruction.

        Raises:
            FaultError: the instruction at the place is not the one that was drawn.
        """
        start = time.perf_counter()
        tracee = self.place.start()
        try:
            hits = sum(stage.count for stage in fault.trigger)
            wall_s = self._wall_limit_s + hits * _HIT_LIMIT_S
            with Alarm(tracee.pid, signal.SIGKILL, cpu_s=None, wall_s=wall_s):
                reason = reach(tracee, self.place.layout.image, fault)
            if reason:
                return self._result(start, tracee.ended, fault, None, NOTHING, reason)
            return self._corrupt(start, tracee, fault)
        finally:
            tracee.kill()

    def run_timed(self, plan: Strategy, rng: np.random.Generator) -> RunResult:
        """One run with a fault at a drawn moment of the CPU time or duration of the call."""
        start = time.perf_counter()
        tracee = self.place.start()
        try:
            fault, reason = self._fault_at_moment(tracee, plan, rng)
            if fault is not None:
                return self._corrupt(start, tracee, fault)
            with self._deadline(tracee):
                ended = _run_out(tracee)
            return self._result(start, ended, None, None, NOTHING, reason)
        finally:
            tracee.kill()

    @property
    def _wall_limit_s(self) -> float:
        return self.limits.factor * self.golden.wall_s + self.limits.wall_grace_s

    def _deadline(self, tracee: Tracee) -> Alarm:
        cpu_s = self.limits.factor * self.golden.cpu_s + self.limits.cpu_grace_s
        return Alarm(tracee.pid, signal.SIGKILL, cpu_s=cpu_s, wall_s=self._wall_limit_s)

    def _fault_at_moment(
        self, tracee: Tracee, plan: Strategy, rng: np.random.Generator
    ) -> tuple[InstructionFault | None, str]:
        cpu = plan.rule is Rule.CPU_TIME
        moment_s = float(rng.uniform(0.0, self.golden.cpu_s if cpu else self.golden.wall_s))
        reason = ""
        for _ in range(plan.attempts):
            alarm = Alarm(
                tracee.pid,
                signal.SIGTRAP,
                cpu_s=moment_s if cpu else None,
                wall_s=None if cpu else moment_s,
            )
            if isinstance(tracee.resume_until_alarm(alarm), Ended):
                return None, "the kernel ended before the moment"
            moment_s = plan.retry_s
            fault, reason = self._fault_here(tracee, plan, rng)
            if fault is not None:
                return fault, ""
        return None, reason

    def _fault_here(
        self, tracee: Tracee, plan: Strategy, rng: np.random.Generator
    ) -> tuple[InstructionFault | None, str]:
        here, image = tracee.registers.ip, self.place.layout.image
        if tracee.registers.system_call is not None and not plan.in_system_calls:
            return None, f"inside system call {tracee.registers.system_call}"
        in_scope = here in scope_of(image, self.place.layout.scope.objects)
        if not in_scope and not plan.whole_process:
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

    def _corrupt(self, start: float, tracee: Tracee, fault: InstructionFault) -> RunResult:
        """Stopped in front of the attacked instruction: flip, follow, run to the end."""
        instruction = instruction_at(tracee, tracee.registers.ip)
        if instruction is None or instruction.raw != fault.instruction_bytes:
            found = "nothing" if instruction is None else instruction.text
            raise FaultError(f"{fault.target} holds {found!r}, expected {fault.instruction!r}")
        injection, followed = None, NOTHING
        with self._deadline(tracee) as alarm:
            if fault.corruption is not None:
                injection = apply(tracee, instruction, fault.corruption)
                window = self.limits.follow_window if tracee.ended is None else 0
                followed = follow(tracee, instruction, fault.corruption, injection, window=window)
            ended = _run_out(tracee)
        reason = injection.reason if injection is not None else ""
        hung = alarm.fired and ended.signal == signal.SIGKILL
        return self._result(start, None if hung else ended, fault, injection, followed, reason)

    def _result(
        self,
        start: float,
        ended: Ended | None,
        fault: InstructionFault | None,
        injection: Injection | None,
        followed: Followed,
        reason: str,
    ) -> RunResult:
        told = self.place.told()
        data = told.data if told is not None and ended is not None else b""
        outcome, difference, error = self._classify(ended, told)
        within = outcome is Outcome.BENIGN and difference is not None and difference.relative > 0.0
        planned = fault is None or fault.corruption is not None
        if planned and not (injection is not None and injection.applied):
            outcome = Outcome.NOT_INJECTED
        return RunResult(
            outcome=outcome,
            signal=None if ended is None else ended.signal,
            error=error,
            difference=difference,
            within_tolerance=within,
            output_sha256=digest(data) if data else "",
            fault=fault,
            injection=injection,
            followed=followed,
            reason=reason,
            run_s=time.perf_counter() - start,
        )

    def _classify(
        self, ended: Ended | None, told: Told | None
    ) -> tuple[Outcome, Difference | None, str]:
        """`ended` is None for a run that was cut off."""
        if ended is None:
            return Outcome.HANG, None, ""
        if ended.exit_code == RAISED and told is not None:
            return Outcome.CRASH, None, told.data.decode(errors="replace")
        if ended.exit_code != 0 or told is None:
            return Outcome.CRASH, None, ""
        if told.data == self.golden.output:
            return Outcome.BENIGN, Difference(relative=0.0, absolute=0.0, unit="", text=""), ""
        try:
            difference = self.kernel.compare(unpack(self.golden.output), unpack(told.data))
        except (ValueError, KeyError) as damage:
            text = f"unreadable: {damage}"
            difference = Difference(relative=math.inf, absolute=math.inf, unit="", text=text)
        if difference.relative <= self.tolerance and self.tolerance > 0.0:
            return Outcome.BENIGN, difference, ""
        return Outcome.SDC, difference, ""


def _run_out(tracee: Tracee) -> Ended:
    while tracee.ended is None:
        tracee.resume()
    return tracee.ended


def without_flip(fault: InstructionFault) -> InstructionFault:
    """The same fault as a null injection: everything but the flip."""
    return replace(fault, corruption=None)
