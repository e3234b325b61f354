"""`mavfi show`: summarise a recorded run."""

from __future__ import annotations

import json
from pathlib import Path

import click


@click.command()
@click.argument("run", type=click.Path(path_type=Path))
@click.option("--json", "as_json", is_flag=True, help="Print result.json unchanged.")
@click.option("--pair", is_flag=True,
              help="Fly the golden run of the pair, keep it, and report what the fault "
                   "changed.")  # fmt: skip
@click.option("--events", is_flag=True, help="Add a list of all events of the flight.")
@click.option("--picture", metavar="FILE", type=click.Path(path_type=Path, dir_okay=False),
              help="Draw the flight from above into this .svg, .pdf or .png file.")  # fmt: skip
def show(run: Path, as_json: bool, pair: bool, events: bool, picture: Path | None) -> None:
    """Summarise RUN, a run folder."""
    from mavfi_cli.mission.record.run_folder import load_run
    from mavfi_cli.mission.repetition import kept_golden, paired_golden
    from mavfi_cli.report.summary import difference_lines, event_lines, folder_lines, summary_lines

    if as_json and (pair or events):
        raise click.UsageError("--json prints the record alone: leave out --pair and --events")
    record = load_run(run)
    if picture is not None:
        from mavfi_cli.report.drawing import write_figure
        from mavfi_cli.report.top_view import draw_top_view

        write_figure(draw_top_view(record), picture)
    if as_json:
        click.echo(json.dumps(record.result, indent=2, sort_keys=True))
        return
    lines = summary_lines(record.result)
    if record.record.fault:
        golden = paired_golden(record, _note) if pair else kept_golden(record)
        if golden is None:
            lines.append("Effect      unknown; `mavfi show --pair` flies the golden pair to tell")
        else:
            lines += difference_lines(record, golden)
    if events:
        lines += ["", "Events", *event_lines(record.result)]
    click.echo("\n".join([*lines, *folder_lines(record, picture)]))


def _note(text: str) -> None:
    click.echo(text, err=True)
