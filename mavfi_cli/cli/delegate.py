"""Commands that live on the vehicle's side: run them as a process, as everything else does."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
from collections.abc import Sequence

import click


def run_module(module: str, arguments: Sequence[str]) -> None:
    """Run `python -m module arguments` with our own streams and leave with its exit code."""
    with subprocess.Popen([sys.executable, "-m", module, *arguments]) as process:
        while process.poll() is None:
            with contextlib.suppress(KeyboardInterrupt):  # the child got the same Ctrl-C
                process.wait()
    code = process.returncode
    raise click.exceptions.Exit(128 - code if code < 0 and -code in set(signal.Signals) else code)
