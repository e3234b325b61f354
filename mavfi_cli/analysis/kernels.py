"""Reads `kernels.json`, the summary that `mavfi kernels` writes."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from mavfi_cli.core.errors import RecordError, lack_of
from mavfi_cli.core.files import read_bounded
from mavfi_cli.stats.shares import Share

KERNELS = "kernels.json"
_LARGEST = 1 << 24  # bytes of a summary
OUTCOMES = ("benign", "sdc", "crash", "hang")


@dataclass(frozen=True, slots=True, kw_only=True)
class IsolatedKernel:
    """The outcomes of fault injection into one isolated kernel. Each run has one fault.

    Attributes:
        name, title: the kernel's name, and its name in tables.
        runs: number of runs.
        outcomes: the share of runs with each of the OUTCOMES. Its interval is wider than that of
            independent runs, because runs on the same input are correlated.
    """

    name: str
    title: str
    runs: int
    outcomes: Mapping[str, Share]


@dataclass(frozen=True, slots=True, kw_only=True)
class KernelSummary:
    """The contents of `kernels.json`: the outcomes of fault injection into isolated kernels.

    Attributes:
        faults: how the faults were drawn: `rule`, `compat` and `model`.
        seed: seed from which the faults were drawn.
        flight: the flight from which the kernels' inputs were taken.
    """

    path: Path
    kernels: tuple[IsolatedKernel, ...]
    faults: Mapping[str, object]
    seed: int
    flight: str

    @property
    def runs(self) -> int:
        """Total number of runs, over all kernels."""
        return sum(kernel.runs for kernel in self.kernels)

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read the summary in the file at `path`.

        Raises:
            RecordError: the file is missing, or is not a summary written by `mavfi kernels`.
        """
        try:
            data = json.loads(read_bounded(path, _LARGEST))
            plan = data["plan"]
            return cls(
                path=path,
                faults={name: plan[name] for name in ("rule", "compat", "model")},
                kernels=tuple(
                    IsolatedKernel(
                        name=str(part["kernel"]),
                        title=str(part["title"]),
                        runs=int(part["runs"]),
                        outcomes={name: _share(part["outcomes"][name]) for name in OUTCOMES},
                    )
                    for part in data["kernels"]
                ),
                seed=int(plan["seed"]),
                flight=str(plan["flight"]),
            )
        except (ValueError, LookupError, TypeError, AttributeError) as error:
            lack = lack_of(error)
            raise RecordError(
                f"{path}: not a summary written by `mavfi kernels` ({lack})"
            ) from None


def _share(entry: Any) -> Share:
    low, high = entry["wilson95"]
    share = math.nan if entry["share"] is None else float(entry["share"])
    return Share(count=entry["count"], total=entry["of"], share=share, low=low, high=high)
