"""Which run folders of a campaign are kept."""

from __future__ import annotations

import shutil
from enum import Enum
from pathlib import Path

from mavfi_cli.core.errors import RecordError
from mavfi_cli.mission.record.run_folder import RESULT

SAMPLE = 20  # about one success in so many is kept by `sampled`
_WORD = 1 << 32


class Keep(Enum):
    """The policy. A failure is every end but success."""

    NONE = "none"
    FAILURES = "failures"
    SAMPLED = "sampled"  # all failures, and one success in SAMPLE
    ALL = "all"

    def wants(self, number: int, outcome: str | None) -> bool:
        """Whether the run folder of this mission is kept."""
        if self is Keep.ALL or self is Keep.NONE:
            return self is Keep.ALL
        return outcome != "success" or (self is Keep.SAMPLED and _sampled(number))


def _sampled(number: int) -> bool:
    """Whether this success is one of the sample: of every setting, however many take turns."""
    mixed = number
    for factor in (0x9E3779B1, 0x85EBCA6B):  # odd, so that no two numbers become one
        mixed = mixed * factor % _WORD
        mixed ^= mixed >> 15
    return mixed < _WORD // SAMPLE


def put_away(run: Path, runs: Path, number: int) -> Path:
    """Move a run folder to its place among those that are kept; the place.

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
