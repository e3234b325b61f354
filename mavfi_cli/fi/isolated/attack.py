"""One fault in one isolated run: reach the place, flip, follow, run to the end, judge.

The same for a kernel of ours and for a user's program; what differs is where they run (`Place`)
and how their end and their output are judged.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from mavfi_cli.fi.isolated.outcome import Outcome
from mavfi_cli.fi.native.alarm import Alarm
from mavfi_cli.fi.native.fault import InstructionFault, Stage
from mavfi_cli.fi.native.image import Image, Scope
from mavfi_cli.fi.native.inject import (
    NOTHING,
    Followed,
    Injection,
    instruction_at,
    reach,
    strike,
)
from mavfi_cli.fi.native.tracee import Ended, Tracee
from mavfi_cli.fi.sampling import Rule, Strategy

_HIT_LIMIT_S = 1e-3  # allowed for one counted execution, about a hundred times what it takes


class Place(Protocol):
    """Where a target runs, again and again from the same start."""

    @property
    def name(self) -> str:
        """Of the target."""

    @property
    def kind(self) -> str:
        """What the target is, for messages: kernel or program."""

    def start(self) -> Tracee:
        """A fresh run, stopped before all that can be attacked."""

    def image(self, tracee: Tracee) -> Image:
        """What a run has in its memory."""

    def scope(self, image: Image) -> Scope:
        """The code that may be hit."""

    def close(self) -> None:
        """Leave nothing behind."""


class Timed(Protocol):
    """A fault-free run, as far as time limits depend on it."""

    @property
    def cpu_s(self) -> float:
        """CPU time."""

    @property
    def wall_s(self) -> float:
        """Duration."""


class Verdict(Protocol):
    """What a run's end and output amount to."""

    @property
    def outcome(self) -> Outcome:
        """As if every flip had been applied."""

    @property
    def within_tolerance(self) -> bool:
        """Benign by tolerance only."""

    @property
    def output_sha256(self) -> str:
        """Of the output; empty where there is none."""

    def to_json(self) -> Mapping[str, Any]:
        """What else belongs in a record."""


V = TypeVar("V", bound=Verdict)


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """When a run counts as hung, and how far to step."""

    factor: float = 10.0  # times the golden CPU time and duration
    cpu_grace_s: float = 1.0
    wall_grace_s: float = 5.0  # a loaded machine delays; only a blocked target waits this long
    follow_window: int = 64  # instructions after a destination fault
    profile_steps: int = 2_000_000  # of one window


@dataclass(frozen=True, slots=True, kw_only=True)
class RunResult(Generic[V]):
    """One faulty run."""

    outcome: Outcome
    signal: int | None
    verdict: V
    fault: InstructionFault | None  # None where a time trigger found nothing to hit
    injection: Injection | None
    followed: Followed
    reason: str  # why not injected
    run_s: float  # wall time of the whole run


@dataclass(frozen=True, slots=True, kw_only=True)
class Attacker(Generic[V]):
    """Runs faults in one place against one golden run."""

    place: Place
    golden: Timed
    judge: Callable[[Ended | None], V]  # of a run that is over; None: it was cut off
    limits: Limits = field(default_factory=Limits)

    def run(self, fault: InstructionFault) -> RunResult[V]:
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
                reason = reach(tracee, self.place.image(tracee), fault)
            if reason:
                return self._result(start, tracee.ended, fault, None, NOTHING, reason)
            return self._corrupt(start, tracee, fault)
        finally:
            tracee.kill()

    def run_timed(self, plan: Strategy, rng: np.random.Generator) -> RunResult[V]:
        """One run with a fault at a drawn moment of the CPU time or duration of the golden run."""
        start = time.perf_counter()
        cpu = plan.rule is Rule.CPU_TIME
        moment_s = float(rng.uniform(0.0, self.golden.cpu_s if cpu else self.golden.wall_s))
        tracee = self.place.start()
        try:
            fault, reason = self._fault_at_moment(tracee, plan, rng, moment_s)
            if fault is not None:
                return self._corrupt(start, tracee, fault)
            with self._deadline(tracee) if tracee.ended is None else nullcontext():
                ended = run_out(tracee)
            return self._result(start, ended, None, None, NOTHING, reason)
        finally:
            tracee.kill()

    @property
    def _wall_limit_s(self) -> float:
        return self.limits.factor * self.golden.wall_s + self.limits.wall_grace_s

    def _deadline(self, tracee: Tracee) -> AbstractContextManager[Alarm]:
        cpu_s = self.limits.factor * self.golden.cpu_s + self.limits.cpu_grace_s
        return Alarm(tracee.pid, signal.SIGKILL, cpu_s=cpu_s, wall_s=self._wall_limit_s)

    def _fault_at_moment(
        self, tracee: Tracee, plan: Strategy, rng: np.random.Generator, moment_s: float
    ) -> tuple[InstructionFault | None, str]:
        image, cpu = self.place.image(tracee), plan.rule is Rule.CPU_TIME
        scope, reason = self.place.scope(image), ""
        for _ in range(plan.attempts):
            alarm = Alarm(
                tracee.pid,
                signal.SIGTRAP,
                cpu_s=moment_s if cpu else None,
                wall_s=None if cpu else moment_s,
            )
            if isinstance(tracee.resume_until_alarm(alarm), Ended):
                return None, f"the {self.place.kind} ended before the moment"
            moment_s = plan.retry_s
            fault, reason = _fault_here(tracee, image, scope, plan, rng)
            if fault is not None:
                return fault, ""
        return None, reason

    def _corrupt(self, start: float, tracee: Tracee, fault: InstructionFault) -> RunResult[V]:
        """Stopped in front of the attacked instruction: flip, follow, run to the end."""
        with self._deadline(tracee) as alarm:
            injection, followed = strike(tracee, fault, window=self.limits.follow_window)
            ended = run_out(tracee)
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
    ) -> RunResult[V]:
        verdict = self.judge(ended)
        planned = fault is None or fault.corruption is not None
        missed = planned and not (injection is not None and injection.applied)
        return RunResult(
            outcome=Outcome.NOT_INJECTED if missed else verdict.outcome,
            signal=None if ended is None else ended.signal,
            verdict=verdict,
            fault=fault,
            injection=injection,
            followed=followed,
            reason=reason,
            run_s=time.perf_counter() - start,
        )


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


def run_out(tracee: Tracee) -> Ended:
    """Let a run go on to its end."""
    while tracee.ended is None:
        tracee.resume()
    return tracee.ended


def without_flip(fault: InstructionFault) -> InstructionFault:
    """The same fault as a null injection: everything but the flip."""
    return replace(fault, corruption=None)
