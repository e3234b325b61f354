"""Runs the command line, so that `python -m mavfi_cli` does the same as `mavfi`."""

from mavfi_cli.cli import main

main()
