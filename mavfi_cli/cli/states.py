"""`mavfi states`: the table of monitored, injectable states."""

from __future__ import annotations

import json

import click


@click.command()
@click.option("--json", "as_json", is_flag=True, help="Print the table as JSON.")
def states(as_json: bool) -> None:
    """List the monitored states, which are the injection sites of source-level faults."""
    from mavfi_cli.core.types import STATES

    rows = [
        {
            "name": state.name,
            "stage": state.stage.value,
            "group": state.group,
            "type": state.dtype.value,
            "unit": state.unit,
        }
        for state in STATES
    ]
    if as_json:
        click.echo(json.dumps(rows, indent=2))
        return
    widths = {key: max(len(key), *(len(row[key]) for row in rows)) for key in rows[0]}
    for row in ({key: key for key in widths}, *rows):
        click.echo("  ".join(row[key].ljust(width) for key, width in widths.items()).rstrip())
