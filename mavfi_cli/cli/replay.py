"""`mavfi replay`: fly a recorded mission again and compare the records."""

from __future__ import annotations

import json
from pathlib import Path

import click

_TELL_ACTIVATION = ("events", "fault")  # sections that also name the reader of the flip


@click.command()
@click.argument("run", type=click.Path(path_type=Path))
@click.option("--mission", "number", type=click.IntRange(min=0), metavar="NUMBER",
              help="RUN is a campaign's folder or exported .parquet: repeat its mission of this "
                   "number.")  # fmt: skip
@click.option("--without-fault", is_flag=True, help="Fly the golden run of the pair instead.")
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), default=Path("runs"),
              show_default=True, help="Parent of the new run folder.")  # fmt: skip
@click.option("--gdb", is_flag=True,
              help="Instruction level: stop the node at the injected instruction and wait for a "
                   "debugger. The activation is then neither followed nor compared.")  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print the comparison as JSON.")
def replay(
    run: Path, number: int | None, without_fault: bool, out: Path, gdb: bool, as_json: bool
) -> None:
    """Repeat RUN, a run folder, and compare the records byte for byte.

    Exits with code 1 if the repetition differs. With --without-fault the difference shows the
    effect of the fault. An interrupted replay leaves no files. With --mission, the measures of the
    repetition are compared with those that the campaign recorded.
    """
    if number is not None:
        if gdb:
            raise click.UsageError("--gdb needs a run folder, which --mission does not")
        _replay_mission(run, number, out, without_fault=without_fault, as_json=as_json)
        return
    from mavfi_cli.core.files import file_digest
    from mavfi_cli.core.installed import installed_versions, version_differences
    from mavfi_cli.mission.record.run_folder import load_run
    from mavfi_cli.mission.repetition import fly_again
    from mavfi_cli.mission.replay import config_of, differing_results, first_difference
    from mavfi_cli.report.summary import difference_lines, outcome_line

    recorded = load_run(run)
    if gdb and (without_fault or not recorded.record.config.get("instruction")):
        raise click.UsageError("--gdb needs an instruction-level fault to stop at")
    for text in version_differences(recorded.record.versions, installed_versions()):
        click.echo(f"warning: another build: {text}", err=True)
    config = config_of(recorded, with_fault=not without_fault)
    what = "without its fault" if without_fault else "again"
    click.echo(f"flying {config.world}, seed {config.seed}, {what}", err=True)
    again = fly_again(
        recorded, out, with_fault=not without_fault, for_debugger=_say_where if gdb else None
    )
    differing = [
        section
        for section in differing_results(recorded.result, again.result)
        if not (gdb and section in _TELL_ACTIVATION)
    ]
    identical = (
        file_digest(recorded.folder.trace) == file_digest(again.folder.trace) and not differing
    )
    parting = first_difference(recorded, again, truth=True)
    if as_json:
        comparison = {
            "run": str(recorded.folder.path),
            "again": str(again.folder.path),
            "identical": identical,
            "outcomes": [recorded.record.outcome, again.record.outcome],
            "differing_sections": differing,
            "first_difference": None
            if parting is None
            else {"stamp_s": parting.stamp_s, "column": parting.column},
        }
        click.echo(json.dumps(comparison, indent=2))
    elif without_fault:
        click.echo(f"with the fault     {outcome_line(recorded.result)}")
        click.echo(f"without            {outcome_line(again.result)}")
        click.echo("\n".join(difference_lines(recorded, again)))
        click.echo(f"\nRun folder  {again.folder.path}")
    else:
        click.echo("identical" if identical else "DIFFERENT")
        if not identical:
            click.echo("\n".join(difference_lines(recorded, again)))
        click.echo(f"Run folder  {again.folder.path}")
    if not identical and not without_fault:
        raise click.exceptions.Exit(1)


def _replay_mission(
    campaign: Path, number: int, out: Path, *, without_fault: bool, as_json: bool
) -> None:
    from mavfi_cli.mission.repetition import fly_to_end
    from mavfi_cli.report.summary import outcome_line
    from mavfi_cli.studies.again import mission_of

    mission = mission_of(campaign, number)
    config = mission.config.golden if without_fault else mission.config
    click.echo(f"flying mission {number}: {config.world}, seed {config.seed}", err=True)
    again = fly_to_end(config, out)
    differing = mission.differing(again.result)
    if as_json:
        comparison = {
            "campaign": str(campaign),
            "mission": number,
            "again": str(again.folder.path),
            "identical": not differing,
            "outcomes": [mission.row["outcome"], again.record.outcome],
            "differing_measures": differing,
        }
        click.echo(json.dumps(comparison, indent=2))
    else:
        click.echo(outcome_line(again.result))
        told = (
            "identical in every measure"
            if not differing
            else "DIFFERENT in " + ", ".join(differing)
        )
        click.echo(told)
        click.echo(f"Run folder  {again.folder.path}")
    if differing and not without_fault:
        raise click.exceptions.Exit(1)


def _say_where(pid: int) -> None:
    click.echo(
        f"the node waits at the injected instruction, the fault in place: gdb -p {pid}  "
        f"(or let it go on: kill -CONT {pid})",
        err=True,
    )
