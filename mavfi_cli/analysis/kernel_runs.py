"""The summary of attacked kernels that `mavfi kernels --out` writes."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mavfi_cli.core.errors import RecordError
from mavfi_cli.stats.shares import Share

KERNELS = "kernels.json"


def kernel_summary(path: Path) -> Mapping[str, Any]:
    """Read a summary.

    Raises:
        RecordError: the file cannot be read, or is no such summary.
    """
    try:
        found: Mapping[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        found["plan"]["rule"], found["plan"]["compat"], found["plan"]["model"]
        for each in found["kernels"]:
            each["kernel"], silent_of_all(each)
    except OSError as error:
        raise RecordError(f"{path}: {error.strerror or error}") from None
    except (ValueError, KeyError, TypeError) as error:
        raise RecordError(f"{path}: not a summary of `mavfi kernels` ({error!r})") from None
    return found


def outcome_share(kernel: Mapping[str, Any], outcome: str) -> Share:
    """The share of an outcome in a kernel of a summary, with the interval of the summary.

    That interval is wider than one of independent runs, because runs of one input are alike.
    """
    told = kernel["outcomes"][outcome]
    low, high = told["wilson95"]
    share = math.nan if told["share"] is None else told["share"]
    return Share(count=told["count"], total=told["of"], share=share, low=low, high=high)


def silent_of_all(kernel: Mapping[str, Any]) -> tuple[int, int]:
    """Silent corruptions of a kernel, and faults that were injected into it."""
    sdc = kernel["outcomes"]["sdc"]
    return sdc["count"], sdc["of"]
