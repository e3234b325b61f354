"""What an attack asks of its target, and how the end of a run is judged.

An `AttackTarget` is plain values that can be handed to a worker process. `open` gives the place
where it runs, again and again from the same memory. A class with these methods is a target of your
own.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from mavfi_cli.attack.outcome import Outcome
from mavfi_cli.fi.tracer.image import Image, Scope
from mavfi_cli.fi.tracer.tracee import Ended, Tracee

if TYPE_CHECKING:
    from mavfi_cli.attack.profile import TargetProfile, Watch


@dataclass(frozen=True, slots=True, kw_only=True)
class RunLimits:
    """When a run counts as hung, and how far to step."""

    factor: float = 10.0  # times the golden CPU time and duration
    cpu_grace_s: float = 1.0
    wall_grace_s: float = 5.0  # a loaded machine delays; only a blocked target waits this long
    follow_window: int = 64  # instructions after a destination fault
    profile_steps: int = 2_000_000  # of one window


@dataclass(frozen=True, slots=True, kw_only=True)
class Golden:
    """The fault-free run."""

    output: bytes
    cpu_s: float
    wall_s: float
    exit_code: int = 0

    @property
    def sha256(self) -> str:
        """Of the output."""
        return digest(self.output)


@dataclass(frozen=True, slots=True, kw_only=True)
class RunVerdict:
    """What the end and the output of a run amount to.

    Attributes:
        outcome: as if every flip had been applied.
        output_sha256: empty where there is no output.
        details: what else belongs in the record, `magnitude` among it.
    """

    outcome: Outcome
    output_sha256: str
    details: Mapping[str, Any] = field(default_factory=dict)


class AttackPlace(Protocol):
    """Where a target runs, again and again from the same start."""

    @property
    def name(self) -> str:
        """Name of the target."""

    @property
    def kind(self) -> str:
        """What the target is, for messages: kernel, node or program."""

    def start(self) -> Tracee:
        """Start a run, stopped before anything that can be hit."""

    def image(self, tracee: Tracee) -> Image:
        """What a run has in its memory."""

    def scope(self, image: Image) -> Scope:
        """The code that may be hit."""

    def close(self) -> None:
        """Leave nothing behind."""


class JudgedPlace(AttackPlace, Protocol):
    """A place whose runs end by themselves and leave an output."""

    @property
    def target(self) -> AttackTarget:
        """The target, with what was found out about it, so that a worker opens it faster."""

    @property
    def limits(self) -> RunLimits:
        """When a run counts as hung."""

    def context(self) -> dict[str, Any]:
        """What every record says of the target."""

    def profile(self, rng: np.random.Generator, *, windows: int, watch: Watch) -> TargetProfile:
        """Step the fault-free run, or a sample of it."""

    def fault_free(self) -> Golden:
        """Run once without a fault.

        Raises:
            TargetError: it fails.
        """

    def unlike(self, golden: Golden, again: Golden) -> str:
        """How two fault-free runs differ, in words; empty where they do not."""

    def judge(self, golden: Golden, ended: Ended | None) -> RunVerdict:
        """Judge the last run; `ended` is None where it was cut off."""


class AttackTarget(Protocol):
    """A target as plain values."""

    @property
    def name(self) -> str:
        """As progress and errors call it."""

    @property
    def stream(self) -> tuple[str, ...]:
        """Stream of its random numbers; empty where a campaign has no other target."""

    def known(self) -> dict[str, Any]:
        """What its results depend on; the same for all targets of a campaign."""

    def open(self) -> JudgedPlace:
        """Get ready, in this process."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Difference:
    """How far an output is from the golden one.

    Attributes:
        relative: what a tolerance is compared with; inf where the outputs cannot be compared
            number by number (another shape, another kind of answer, not a number).
        absolute: the same in `unit`, or inf.
        unit: of `absolute`.
        text: what differs, in words.
    """

    relative: float
    absolute: float
    unit: str = ""
    text: str = ""

    def to_json(self) -> dict[str, Any]:
        """For a record: a size that is no number is null."""
        finite = math.isfinite(self.relative)
        return {
            "relative": self.relative if finite else None,
            "absolute": self.absolute if finite else None,
            "unit": self.unit,
            "text": self.text,
        }


def judged(
    golden: Golden,
    ended: Ended | None,
    output: bytes | None,
    compare: Callable[[bytes, bytes], Difference | None],
    *,
    tolerance: float | None,
) -> tuple[Outcome, Difference | None]:
    """The outcome of a run, and the size of its difference where there is one to tell.

    Args:
        golden: the fault-free run.
        ended: how the run ended; None where it was cut off.
        output: what it left; None where that is not whole.
        compare: golden and other output to their difference; None where none can be told.
        tolerance: largest relative difference that is benign; None where every byte counts.
    """
    if ended is None:
        return Outcome.HANG, None
    same_end = ended.exit_code == golden.exit_code
    if output is None or ended.signal is not None or (ended.exit_code and not same_end):
        return Outcome.CRASH, None
    if output == golden.output and same_end:
        return Outcome.BENIGN, Difference(relative=0.0, absolute=0.0)
    difference = compare(golden.output, output)
    near = difference is not None and tolerance is not None and difference.relative <= tolerance
    return Outcome.BENIGN if near and same_end else Outcome.SDC, difference


def digest(output: bytes) -> str:
    """SHA-256 of an output."""
    return hashlib.sha256(output).hexdigest()
