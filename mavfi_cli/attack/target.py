"""The interface of targets, and the verdict on a run.

An `AttackTarget` consists of plain values that can be sent to a worker process. `open` returns the
place where the target runs repeatedly from the same memory. Any class with these methods can be a
target.
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
from mavfi_cli.core.files import Json
from mavfi_cli.core.processes import Ended


class RunOutcome(Enum):
    """The outcome of one run of an isolated program or kernel."""

    BENIGN = "benign"
    CRASH = "crash"
    HANG = "hang"
    SDC = "sdc"
    NOT_INJECTED = "not_injected"

    @property
    def title(self) -> str:
        """The name of the outcome in tables."""
        return "SDC" if self is RunOutcome.SDC else self.value.replace("_", " ")


@dataclass(frozen=True, slots=True, kw_only=True)
class RunLimits:
    """The limits beyond which a run counts as hung, and the limits of single-stepping."""

    factor: float = 10.0  # multiple of the golden CPU time and duration
    cpu_grace_s: float = 1.0
    golden_s: float = 120.0  # wall time of a fault-free run
    wall_grace_s: float = 5.0  # for delays on a loaded machine; only a blocked target uses it up
    follow_window: int = 64  # instructions after a destination fault
    profile_steps: int = 2_000_000  # limit of one window


@dataclass(frozen=True, slots=True, kw_only=True)
class RunVerdict:
    """The verdict on a run, which depends on how the run ended and on its output.

    Attributes:
        outcome: the outcome, if the flip was applied.
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

    def context(self) -> Json:
        """Return the entries about the target that every record contains."""

    def profile(self, rng: np.random.Generator, *, windows: int, watch: Watch) -> TargetProfile:
        """Step the golden run, or a sample of it, and return the instructions that it executes."""

    def fault_free(self) -> Golden:
        """Run the target once without a fault, and return its output and times.

        Raises:
            TargetError: the run fails.
        """

    def describe_difference(self, golden: Golden, again: Golden) -> str:
        """Describe how two fault-free runs differ. Return an empty string if they are equal."""

    def judge(self, golden: Golden, ended: Ended | None) -> RunVerdict:
        """Judge the last run. `ended` is None if the run exceeded its limit."""


def places_of(place: JudgedPlace) -> Sequence[JudgedPlace]:
    """Return one place for each input of a target: `place.inputs` if it exists, or else `place`."""
    inputs: Sequence[JudgedPlace] = getattr(place, "inputs", (place,))
    return inputs


class AttackTarget(Protocol):
    """A program or kernel to attack, as plain values that can be sent to a worker process."""

    @property
    def name(self) -> str:
        """The target's name in progress reports and error messages."""

    @property
    def stream(self) -> tuple[str, ...]:
        """Name of the target's random stream; empty if a campaign has no other target."""

    def settings(self) -> Json:
        """Return the settings that determine the results. All targets of a campaign share them."""

    def open(self) -> JudgedPlace:
        """Open a place in which this process can run the target."""


def judged(
    golden: Golden,
    ended: Ended | None,
    output: bytes | None,
    compare: Callable[[bytes, bytes], Difference | None],
    *,
    tolerance: float | None,
) -> tuple[RunOutcome, Difference | None]:
    """Return the outcome of a run, and how its output differs from that of the golden run.

    Args:
        ended: how the run ended; None if it exceeded its limit.
        output: the output of the run; None if it is incomplete.
        compare: returns the difference between the golden output and another one, or None if they
            cannot be compared.
        tolerance: largest relative difference that is benign; None if every byte counts.

    Returns:
        The difference is None if the run hung or crashed, or if `compare` returns None.
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
    """Return the name of a signal."""
    known = {member.value for member in signal.Signals}
    return signal.Signals(number).name if number in known else f"signal {number}"
