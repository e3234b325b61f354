"""One kernel as a target: its golden run, and how its faulty runs are judged."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from mavfi_cli.campaign.kernels.catalogue import Kernel
from mavfi_cli.campaign.kernels.difference import Difference, unpack
from mavfi_cli.campaign.kernels.place import Place, Told
from mavfi_cli.campaign.kernels.template import RAISED
from mavfi_cli.core.errors import TargetError
from mavfi_cli.fi.isolated.attack import Attacker, Limits, run_out
from mavfi_cli.fi.isolated.compare import digest
from mavfi_cli.fi.isolated.outcome import Outcome
from mavfi_cli.fi.native.tracee import Ended


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
class KernelVerdict:
    """What the end and the output of a run amount to."""

    outcome: Outcome
    error: str  # what the kernel raised
    difference: Difference | None  # None where there is no output to compare
    output_sha256: str

    @property
    def within_tolerance(self) -> bool:
        """Benign by tolerance only."""
        size = 0.0 if self.difference is None else self.difference.relative
        return self.outcome is Outcome.BENIGN and size > 0.0

    def to_json(self) -> dict[str, Any]:
        """What a record says of a kernel beside what every record says."""
        return {
            "error": self.error,
            "magnitude": None if self.difference is None else self.difference.to_json(),
            "within_tolerance": self.within_tolerance,
        }


def golden_run(place: Place, runs: int = 3) -> Golden:
    """Run without a fault several times; the kernel must repeat itself.

    Raises:
        TargetError: it crashes, or its outputs differ.
    """
    told = [_fault_free(place) for _ in range(runs)]
    if len({each.data for each in told}) > 1:
        raise TargetError(place.name, "fault-free runs differ; outcomes cannot be told")
    return Golden(
        output=told[0].data,
        cpu_s=max(each.cpu_s for each in told),
        wall_s=max(each.wall_s for each in told),
    )


def _fault_free(place: Place) -> Told:
    ended = run_out(place.start())
    told = place.told()
    if told is None or ended.exit_code != 0:
        how = f"signal {ended.signal}" if ended.signal else f"exit code {ended.exit_code}"
        text = told.data.decode(errors="replace") if told else how
        raise TargetError(place.name, f"fails without a fault: {text}")
    return told


def attacker_of(
    kernel: Kernel,
    place: Place,
    golden: Golden,
    *,
    tolerance: float = 0.0,
    limits: Limits | None = None,
) -> Attacker[KernelVerdict]:
    """For runs of a kernel with a fault, against this golden run.

    Args:
        kernel: which one.
        place: where it runs.
        golden: its fault-free run there.
        tolerance: relative difference of an output that is no silent corruption.
        limits: when a run counts as hung; the usual ones by default.
    """
    judge = _Judge(kernel=kernel, place=place, golden=golden, tolerance=tolerance)
    return Attacker(place=place, golden=golden, judge=judge.judge, limits=limits or Limits())


@dataclass(frozen=True, slots=True, kw_only=True)
class _Judge:
    kernel: Kernel
    place: Place
    golden: Golden
    tolerance: float

    def judge(self, ended: Ended | None) -> KernelVerdict:
        """`ended` is None for a run that was cut off."""
        told = self.place.told()
        data = told.data if told is not None and ended is not None else b""
        outcome, difference, error = self._classify(ended, told)
        return KernelVerdict(
            outcome=outcome,
            error=error,
            difference=difference,
            output_sha256=digest(data) if data else "",
        )

    def _classify(
        self, ended: Ended | None, told: Told | None
    ) -> tuple[Outcome, Difference | None, str]:
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
