"""The interface of targets, and the judgement of a run.

An `AttackTarget` is plain values that can be sent to a worker process. `open` returns the place
where it runs repeatedly from the same memory. Any class with these methods can be a target.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Protocol

import numpy as np

from mavfi_cli.attack.comparison import Difference
from mavfi_cli.attack.place import AttackPlace, Golden, Watch
from mavfi_cli.attack.profile import TargetProfile
from mavfi_cli.fi.tracer.tracee import Ended


class RunOutcome(Enum):
    """The outcome of one run of an isolated program or kernel."""

    BENIGN = "benign"
    CRASH = "crash"
    HANG = "hang"
    SDC = "sdc"
    NOT_INJECTED = "not_injected"

    @property
    def title(self) -> str:
        """The name in tables."""
        return "SDC" if self is RunOutcome.SDC else self.value.replace("_", " ")


@dataclass(frozen=True, slots=True, kw_only=True)
class RunLimits:
    """The limits beyond which a run counts as hung, and how far to step."""

    factor: float = 10.0  # multiple of the golden CPU time and duration
    cpu_grace_s: float = 1.0
    golden_s: float = 120.0  # of a run without a fault
    wall_grace_s: float = 5.0  # for delays on a loaded machine; only a blocked target waits as long
    follow_window: int = 64  # instructions after a destination fault
    profile_steps: int = 2_000_000  # of one window


@dataclass(frozen=True, slots=True, kw_only=True)
class RunVerdict:
    """The judgement of a run from its end and its output.

    Attributes:
        outcome: the outcome, on the assumption that every flip was applied.
        output_sha256: hash of the output; empty if there is none.
        details: further entries of the record, such as `magnitude`.
    """

    outcome: RunOutcome
    output_sha256: str
    details: Mapping[str, Any] = field(default_factory=dict)


class JudgedPlace(AttackPlace, Protocol):
    """A place whose runs end by themselves and leave an output."""

    @property
    def limits(self) -> RunLimits:
        """The limits beyond which a run counts as hung."""

    def context(self) -> dict[str, Any]:
        """Entries of every record about the target."""

    def profile(self, rng: np.random.Generator, *, windows: int, watch: Watch) -> TargetProfile:
        """Step the golden run, or a sample of it."""

    def fault_free(self) -> Golden:
        """Run once without a fault.

        Raises:
            TargetError: the run fails.
        """

    def unlike(self, golden: Golden, again: Golden) -> str:
        """How two fault-free runs differ, in words; empty if they are equal."""

    def judge(self, golden: Golden, ended: Ended | None) -> RunVerdict:
        """Judge the last run; `ended` is None if it exceeded its limit."""


def places_of(place: JudgedPlace) -> Sequence[JudgedPlace]:
    """The places of a target's inputs, if it names them in `inputs`; most have one, their own."""
    inputs: Sequence[JudgedPlace] = getattr(place, "inputs", (place,))
    return inputs


class AttackTarget(Protocol):
    """A target as plain values."""

    @property
    def name(self) -> str:
        """The target's name in progress and errors."""

    @property
    def stream(self) -> tuple[str, ...]:
        """Stream of its random numbers; empty if a campaign has no other target."""

    def known(self) -> dict[str, Any]:
        """Everything that its results depend on; the same for all targets of a campaign."""

    def open(self) -> JudgedPlace:
        """Make a place for runs in this process."""


def judged(
    golden: Golden,
    ended: Ended | None,
    output: bytes | None,
    compare: Callable[[bytes, bytes], Difference | None],
    *,
    tolerance: float | None,
) -> tuple[RunOutcome, Difference | None]:
    """Judge a run: its outcome, and the size of its difference if it is known.

    Args:
        ended: how the run ended; None if it exceeded its limit.
        output: its output; None if that is not complete.
        compare: function from golden and other output to their difference, or to None.
        tolerance: largest relative difference that is benign; None if every byte counts.
    """
    if ended is None:
        return RunOutcome.HANG, None
    same_end = ended.exit_code == golden.exit_code
    if output is None or ended.signal is not None or (ended.exit_code and not same_end):
        return RunOutcome.CRASH, None
    if output == golden.output and same_end:
        return RunOutcome.BENIGN, Difference(relative=0.0, absolute=0.0)
    difference = compare(golden.output, output)
    near = difference is not None and tolerance is not None and difference.relative <= tolerance
    return RunOutcome.BENIGN if near and same_end else RunOutcome.SDC, difference


def signal_name(number: int) -> str:
    """The name of a signal."""
    known = {member.value for member in signal.Signals}
    return signal.Signals(number).name if number in known else f"signal {number}"
