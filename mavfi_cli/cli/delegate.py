"""`mavfi sitl` and `mavfi world`: commands of the vehicle's side, which replace this process."""

from __future__ import annotations

import os
import sys

import click

from mavfi_cli.core.processes import PYTHON


def _delegate(name: str, module: str) -> click.Command:
    @click.command(
        name,
        context_settings={"ignore_unknown_options": True, "help_option_names": []},
        add_help_option=False,
    )
    @click.argument("arguments", nargs=-1, type=click.UNPROCESSED)
    def command(arguments: tuple[str, ...]) -> None:
        """Become `python -m module arguments`, with its streams, signals and exit code."""
        sys.stdout.flush()
        sys.stderr.flush()
        os.execv(sys.executable, [*PYTHON, "-m", module, *arguments])

    return command


sitl = _delegate("sitl", "sitl")
world = _delegate("world", "sitl.world")
