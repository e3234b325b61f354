"""`mavfi doctor`: test what works on this machine, and suggest remedies."""

from __future__ import annotations

import json
import textwrap
from dataclasses import asdict

import click

from mavfi_cli.report.columns import WIDTH

_INDENT = 29  # column of a check's finding
_MARKS = {"ok": ("green", "ok"), "limited": ("yellow", "limited"), "failed": ("red", "FAILED")}


@click.command()
@click.option("--json", "as_json", is_flag=True, help="Print the checks as JSON.")
def doctor(as_json: bool) -> None:
    """Test this machine: wheels, cores, physics, loopback, ptrace, breakpoints.

    Exits with code 1 if mavfi cannot fly here. Limitations do not count.
    """
    from mavfi_cli.mission.machine import FAILED, check_machine

    checks = []
    for check in check_machine():
        checks.append(check)
        if not as_json:
            colour, mark = _MARKS[check.verdict]
            first, *rest = textwrap.wrap(check.found, WIDTH - _INDENT) or [""]
            click.echo(f"{click.style(f'{mark:<8}', fg=colour)}{check.name:<20} {first}")
            for line in rest:
                click.echo(f"{'':<{_INDENT}}{line}")
            if check.remedy:
                click.echo(f"{'':<{_INDENT}}-> {check.remedy}")
    if as_json:
        click.echo(json.dumps([asdict(check) for check in checks], indent=2))
    if any(check.verdict == FAILED for check in checks):
        raise click.exceptions.Exit(1)
