"""The summary that `mavfi kernels` writes, `kernels.json`."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mavfi_cli.core.errors import RecordError, lack_of
from mavfi_cli.stats.shares import Share

KERNELS = "kernels.json"


def kernel_summary(path: Path) -> Mapping[str, Any]:
    """Read a summary of `mavfi kernels`; RecordError if the file is missing or is no summary."""
    try:
        summary: Mapping[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        summary["plan"]["rule"], summary["plan"]["compat"], summary["plan"]["model"]
        for kernel in summary["kernels"]:
            sdc = kernel["outcomes"]["sdc"]
            kernel["kernel"], sdc["count"], sdc["of"]
    except OSError as error:
        raise RecordError(f"{path}: {error.strerror or error}") from None
    except (ValueError, KeyError, TypeError) as error:
        raise RecordError(f"{path}: not a summary of `mavfi kernels` ({lack_of(error)})") from None
    return summary


def outcome_share(kernel: Mapping[str, Any], outcome: str) -> Share:
    """The share of an outcome in a kernel of a summary, with the interval of the summary.

    It is wider than that of independent runs, because runs on one input are correlated.
    """
    entry = kernel["outcomes"][outcome]
    low, high = entry["wilson95"]
    share = math.nan if entry["share"] is None else entry["share"]
    return Share(count=entry["count"], total=entry["of"], share=share, low=low, high=high)
