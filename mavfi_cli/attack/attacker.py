"""Runs a target with one fault: stops at its instruction, flips bits, and judges the run."""

from __future__ import annotations

import signal
import time
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace

import numpy as np

from mavfi_cli.attack.place import Golden
from mavfi_cli.attack.target import JudgedPlace, RunOutcome, RunVerdict
from mavfi_cli.core.errors import TargetError
from mavfi_cli.core.processes import Ended
from mavfi_cli.fi.tracer import record
from mavfi_cli.fi.tracer.fault import InstructionFault, Rule, Strategy
from mavfi_cli.fi.tracer.inject import NOTHING, Followed, Injection, reach, strike
from mavfi_cli.fi.tracer.linux import ProcessTimer
from mavfi_cli.fi.tracer.record_fields import FaultRecord
from mavfi_cli.fi.tracer.sampling import draw_fault_here
from mavfi_cli.fi.tracer.tracee import Tracee

GOLDEN_RUNS = 3
_HIT_LIMIT_S = 1e-3  # allowed for one counted execution, about a hundred times what it takes
Task = tuple[int, InstructionFault | None]  # number and fault; None: drawn when it strikes


@dataclass(frozen=True, slots=True, kw_only=True)
class RunResult:
    """The result of one run with a fault, or of a null run."""

    outcome: RunOutcome
    signal: int | None
    verdict: RunVerdict
    fault: InstructionFault | None  # None if a time trigger hit no instruction in scope
    injection: Injection | None
    followed: Followed
    reason: str  # why the fault was not injected
    run_s: float  # wall time of the whole run

    def completed(self, planned: FaultRecord) -> FaultRecord:
        """Return the record of the run: the planned record, completed with this result."""
        fault = self.fault
        if fault is not None and not planned["trigger"]:  # a time trigger, which is not repeatable
            planned = {
                **planned,
                "object": fault.target.object,
                "offset": fault.target.offset,
                "instruction": fault.instruction,
                "instruction_bytes": fault.instruction_bytes.hex(),
                "corruption": None if fault.corruption is None else fault.corruption.to_json(),
            }
        return record.completed(
            planned,
            self.injection,
            self.followed,
            outcome=self.outcome.value,
            signal=self.signal,
            **self.verdict.details,
            output_sha256=self.verdict.output_sha256,
            not_injected_reason=self.reason,
            run_s=self.run_s,
        )


def golden_run(place: JudgedPlace) -> Golden:
    """Make `GOLDEN_RUNS` fault-free runs, and require equal results.

    Returns:
        The first run, with the CPU time and the duration of the slowest runs.

    Raises:
        TargetError: a run fails, or the results differ.
    """
    runs = [place.fault_free() for _ in range(GOLDEN_RUNS)]
    for again in runs[1:]:
        if unlike := place.describe_difference(runs[0], again):
            problem = f"fault-free runs differ, so no outcome can be judged: {unlike}"
            raise TargetError(place.name, problem)
    slowest = max(run.cpu_s for run in runs), max(run.wall_s for run in runs)
    return replace(runs[0], cpu_s=slowest[0], wall_s=slowest[1])


@dataclass(frozen=True, slots=True, kw_only=True)
class Attacker:
    """Runs a target with faults in one place, and judges each run against one golden run."""

    place: JudgedPlace
    golden: Golden

    def run(self, fault: InstructionFault) -> RunResult:
        """Run the target once, with `fault` at the exact execution that its trigger names.

        Raises:
            FaultError: the location holds an instruction other than the drawn one.
        """
        start = time.perf_counter()
        tracee = self.place.start()
        try:
            hits = sum(stage.count for stage in fault.trigger)
            wall_s = self._wall_limit_s + hits * _HIT_LIMIT_S
            image = self.place.image(tracee)
            with ProcessTimer(tracee.pid, signal.SIGKILL, cpu_s=None, wall_s=wall_s) as alarm:
                reason = reach(tracee, image, fault)
            if alarm.fired:
                late = f"the {self.place.kind} did not reach the instruction in time"
                return self._result(start, None, fault, None, NOTHING, late)
            if reason:
                return self._result(start, tracee.ended, fault, None, NOTHING, reason)
            return self._corrupt(start, tracee, fault)
        finally:
            tracee.kill()

    def run_timed(
        self, plan: Strategy, rng: np.random.Generator, *, null: bool = False
    ) -> RunResult:
        """Run the target once, with a fault at a random moment.

        The moment is uniform over the CPU time or the duration of the golden run, as the rule
        requires. The fault is drawn from the instruction that is about to execute at that moment.

        Args:
            null: leave out the flip.
        """
        start = time.perf_counter()
        cpu = plan.rule is Rule.CPU_TIME
        moment_s = float(rng.uniform(0.0, self.golden.cpu_s if cpu else self.golden.wall_s))
        tracee = self.place.start()
        try:
            fault, reason = self._fault_at_moment(tracee, plan, rng, moment_s)
            if fault is not None:
                struck = replace(fault, corruption=None) if null else fault
                return self._corrupt(start, tracee, struck)
            with self._deadline(tracee) if tracee.ended is None else nullcontext():
                ended = run_out(tracee)
            return self._result(start, ended, None, None, NOTHING, reason)
        finally:
            tracee.kill()

    @property
    def _wall_limit_s(self) -> float:
        limits = self.place.limits
        return limits.factor * self.golden.wall_s + limits.wall_grace_s

    def _deadline(self, tracee: Tracee) -> AbstractContextManager[ProcessTimer]:
        limits = self.place.limits
        cpu_s = limits.factor * self.golden.cpu_s + limits.cpu_grace_s
        return ProcessTimer(tracee.pid, signal.SIGKILL, cpu_s=cpu_s, wall_s=self._wall_limit_s)

    def _fault_at_moment(
        self, tracee: Tracee, plan: Strategy, rng: np.random.Generator, moment_s: float
    ) -> tuple[InstructionFault | None, str]:
        image, cpu = self.place.image(tracee), plan.rule is Rule.CPU_TIME
        scope, reason = self.place.scope(image), ""
        for _ in range(plan.attempts):
            alarm = ProcessTimer(
                tracee.pid,
                signal.SIGTRAP,
                cpu_s=moment_s if cpu else None,
                wall_s=None if cpu else moment_s,
            )
            if tracee.resume_until_alarm(alarm) is not None:
                return None, f"the {self.place.kind} ended before the moment"
            moment_s = plan.retry_s
            fault, reason = draw_fault_here(tracee, image, scope, plan, rng)
            if fault is not None:
                return fault, ""
        return None, reason

    def _corrupt(self, start: float, tracee: Tracee, fault: InstructionFault) -> RunResult:
        """Apply the fault at its instruction, follow the corrupted bits, and run to the end."""
        injection, followed = None, NOTHING
        with self._deadline(tracee) as alarm:
            window = self.place.limits.follow_window
            injection, followed = strike(tracee, fault, window=window)
            run_out(tracee)
        ended = tracee.kill()
        reason = injection.reason if injection is not None else ""
        if alarm.fired and injection is None and fault.corruption is not None:
            reason = f"the {self.place.kind} was stopped before the flip was complete"
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
        verdict = self.place.judge(self.golden, ended)
        planned = fault is None or fault.corruption is not None
        missed = planned and not (injection is not None and injection.applied)
        return RunResult(
            outcome=RunOutcome.NOT_INJECTED if missed else verdict.outcome,
            signal=None if ended is None else ended.signal,
            verdict=verdict,
            fault=fault,
            injection=injection,
            followed=followed,
            reason=reason,
            run_s=time.perf_counter() - start,
        )


def run_out(tracee: Tracee) -> Ended:
    """Let the process run to its end, and return how it ended."""
    while tracee.ended is None:
        tracee.resume()
    return tracee.ended
