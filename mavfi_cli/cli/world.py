"""`mavfi world`: hands its arguments to `python -m sitl.world`."""

from __future__ import annotations

import click

from mavfi_cli.cli.delegate import run_module


@click.command(
    context_settings={"ignore_unknown_options": True, "help_option_names": []},
    add_help_option=False,
)
@click.argument("arguments", nargs=-1, type=click.UNPROCESSED)
def world(arguments: tuple[str, ...]) -> None:
    """See `mavfi world --help`."""
    run_module("sitl.world", arguments)
