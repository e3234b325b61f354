"""The policy of keeping a campaign's run folders."""

from __future__ import annotations

import shutil
from enum import Enum
from pathlib import Path

from mavfi_cli.core.errors import RecordError
from mavfi_cli.mission.record.run_folder import RESULT

SAMPLE = 20  # `sampled` keeps about one success in 20
_WORD = 1 << 32


class Keep(Enum):
    """Which run folders are kept. Every outcome but success is a failure."""

    NONE = "none"
    FAILURES = "failures"
    SAMPLED = "sampled"  # all failures, and one success in SAMPLE
    ALL = "all"

    def wants(self, number: int, outcome: str | None) -> bool:
        """True if the run folder of this mission is kept."""
        if self is Keep.ALL or self is Keep.NONE:
            return self is Keep.ALL
        return outcome != "success" or (self is Keep.SAMPLED and _sampled(number))


def _sampled(number: int) -> bool:
    """True if this success is in the sample, which covers every setting however they alternate."""
    mixed = number
    for factor in (0x9E3779B1, 0x85EBCA6B):  # odd, so that no two numbers collide
        mixed = mixed * factor % _WORD
        mixed ^= mixed >> 15
    return mixed < _WORD // SAMPLE


def put_away(run: Path, runs: Path, number: int) -> Path:
    """Move a run folder to the kept ones; return its new path.

    Raises:
        RecordError: it cannot be moved.
    """
    stem = run.name.rpartition("-")[0] if (run / RESULT).is_file() else "cut-off"
    place = runs / f"{number:06d}-{stem}"
    try:
        runs.mkdir(exist_ok=True)
        for old in runs.glob(f"{number:06d}-*"):  # of an attempt whose row was never written
            shutil.rmtree(old)
        run.replace(place)
    except OSError as error:
        raise RecordError(f"{place}: {error.strerror or error}") from None
    return place
