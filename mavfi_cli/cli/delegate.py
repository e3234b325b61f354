"""Commands that live on the vehicle's side: this process becomes theirs."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import NoReturn


def run_module(module: str, arguments: Sequence[str]) -> NoReturn:
    """Become `python -m module arguments`: its streams, its signals, its exit code."""
    sys.stdout.flush()
    sys.stderr.flush()
    os.execv(sys.executable, [sys.executable, "-m", module, *arguments])
