"""Commands of the vehicle's side, which replace this process."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import NoReturn


def run_module(module: str, arguments: Sequence[str]) -> NoReturn:
    """Become `python -m module arguments`, with its streams, signals and exit code."""
    sys.stdout.flush()
    sys.stderr.flush()
    os.execv(sys.executable, [sys.executable, "-m", module, *arguments])
