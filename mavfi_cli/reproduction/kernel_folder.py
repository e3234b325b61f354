"""The folder of the runs of isolated kernels, beside those of the stacks."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mavfi_cli.core.errors import RecordError

FOLDER, SUMMARY = "kernels", "kernels.json"


def kernel_summary(out: Path) -> Mapping[str, Any]:
    """The summary of the runs of a reproduction.

    Raises:
        RecordError: there is none, or it is damaged.
    """
    path = out / FOLDER / SUMMARY
    try:
        found: Mapping[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except OSError:
        raise RecordError(f"{path.parent}: no runs of kernels (mavfi reproduce fig6)") from None
    except ValueError as error:
        raise RecordError(f"{path}: damaged ({error})") from None
    return found
