"""`mavfi show` and `mavfi replay`: summarise a recorded run, or fly it again and compare."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from mavfi_cli.cli.grouped import GroupedCommand, option
from mavfi_cli.cli.types import NUMBER, OUT, RunPath
from mavfi_cli.core.option_types import OutFile
from mavfi_cli.core.terminal import echo, echo_lines, note
from mavfi_cli.report.drawing import PICTURES

_ACTIVATION_SECTIONS = ("events", "fault")  # these sections contain the fault's activation


@click.command(cls=GroupedCommand)
@click.argument("run", type=RunPath())
@option("--json", "as_json", is_flag=True, help="Print result.json unchanged.")
@option("--pair", is_flag=True,
        help="Fly the golden run of the pair, keep it, and report what the fault "
             "changed.")  # fmt: skip
@option("--events", is_flag=True, help="Add a list of all events of the flight.")
@option("--picture", metavar="FILE", type=OutFile(PICTURES),
        help="Draw the flight from above into this .svg, .pdf or .png file.")  # fmt: skip
def show(run: Path, as_json: bool, pair: bool, events: bool, picture: Path | None) -> None:
    """Summarise RUN, a run folder."""
    from mavfi_cli.core.files import reading
    from mavfi_cli.mission.run import paired_golden
    from mavfi_cli.mission.run_folder import load_run
    from mavfi_cli.report.summary import difference_lines, event_lines, folder_lines, summary_lines

    if as_json and (pair or events):
        raise click.UsageError("--json cannot be combined with --pair or --events")
    recorded = load_run(run)
    if pair and not recorded.record.fault:
        raise click.UsageError("--pair needs a run with a fault")
    if picture is not None:
        from mavfi_cli.report.drawing import write_figure
        from mavfi_cli.report.top_view import draw_top_view

        with reading(recorded.folder.path):
            drawn = draw_top_view(recorded)
        write_figure(drawn, picture)
    if as_json:
        echo(json.dumps(recorded.result, indent=2, sort_keys=True))
        return
    golden = None
    if recorded.record.fault:
        golden = paired_golden(recorded, note) if pair else recorded.golden
    with reading(recorded.folder.path):
        lines = summary_lines(recorded.record)
        if golden is not None:
            lines += difference_lines(recorded, golden)
        elif recorded.record.fault and recorded.record.config.get("companion") is None:
            lines.append("Effect      unknown; `mavfi show --pair` flies the golden run to find it")
        if events:
            lines += ["", "Events", *event_lines(recorded.record)]
    echo_lines([*lines, *folder_lines(recorded, picture)])


@click.command(cls=GroupedCommand)
@click.argument("run", type=RunPath())
@option("--mission", "number", type=NUMBER, metavar="NUMBER",
        help="Repeat this mission of RUN, the folder or exported .parquet file of a "
             "campaign.")  # fmt: skip
@option("--without-fault", is_flag=True, help="Fly the golden run of the pair instead.")
@option("--out", type=OUT, default=Path("runs"), help="Parent of the new run folder.")
@option("--firmware", metavar="PATH",
        help="SITL binary to trust. The binary that RUN names runs only if it is this one or that "
             "of PX4_SITL or ARDUCOPTER_SITL.")  # fmt: skip
@option("--gdb", is_flag=True,
        help="Instruction level: stop the node at the injected instruction and wait for a "
             "debugger. The activation is then neither tracked nor compared.")  # fmt: skip
@option("--json", "as_json", is_flag=True, help="Print the comparison as JSON.")
def replay(
    run: Path, number: int | None, out: Path, firmware: str | None, as_json: bool, **how: bool
) -> None:
    """Repeat RUN, a run folder, and compare the records byte for byte.

    Exits with code 1 if the repetition differs. With --without-fault the difference shows the
    effect of the fault. An interrupted replay leaves no files. With --mission, the measures of the
    repetition are compared with those that the campaign recorded.
    """
    from mavfi_cli.analysis.flights import number_span
    from mavfi_cli.campaigns.begin import opened
    from mavfi_cli.campaigns.ledger import LEDGER, is_export

    if number is None and (is_export(run) or (run / LEDGER).is_file()):
        with opened(run) as ledger:
            span = number_span(ledger)
        raise click.UsageError(f"{run} is a campaign: add --mission NUMBER ({span})")
    options: Any = {"with_fault": not how["without_fault"], "firmware": firmware}
    if number is None:
        comparison, lines = _repeat_run(run, out, gdb=how["gdb"], **options)
    elif how["gdb"]:
        raise click.UsageError("--gdb needs a run folder and cannot be combined with --mission")
    else:
        comparison, lines = _repeat_mission(run, number, out, **options)
    echo_lines(json.dumps(comparison, indent=2).split("\n") if as_json else lines)
    if not comparison["identical"] and not how["without_fault"]:
        raise click.exceptions.Exit(1)


_Comparison = tuple[dict[str, Any], list[str]]  # as JSON, and as lines


def _repeat_run(
    path: Path, out: Path, *, with_fault: bool, firmware: str | None, gdb: bool
) -> _Comparison:
    from mavfi_cli.core.files import file_digest
    from mavfi_cli.mission.run import fly_again
    from mavfi_cli.mission.run_folder import load_run
    from mavfi_cli.report.summary import difference_lines, outcome_line

    run = load_run(path)
    if gdb and not (with_fault and run.record.config.get("instruction")):
        raise click.UsageError(
            "--gdb needs a run with an instruction-level fault, "
            "and cannot be combined with --without-fault"
        )
    _warn_of_builds(run.record.versions)
    flown: Any = {"with_fault": with_fault, "firmware": firmware}
    config = run.mission(**flown)
    what = "again" if with_fault else "without its fault"
    note(f"flying {config.world}, seed {config.seed}, {what}")
    again = fly_again(run, out, **flown, for_debugger=_announce_stop if gdb else None)
    ignored = _ACTIVATION_SECTIONS if gdb else ()
    differing = [name for name in run.differing_sections(again) if name not in ignored]
    if file_digest(run.folder.trace) != file_digest(again.folder.trace):
        differing.append("trace")
    parting = run.first_difference(again, truth=True)
    comparison = {
        "run": str(run.folder.path),
        "again": str(again.folder.path),
        "identical": not differing,
        "outcomes": [run.record.outcome, again.record.outcome],
        "differing_sections": differing,
        "first_difference": parting and {"stamp_s": parting.stamp_s, "column": parting.column},
    }
    if not with_fault:
        lines = [
            f"with the fault     {outcome_line(run.record)}",
            f"without            {outcome_line(again.record)}",
            *difference_lines(run, again),
            "",
        ]
    else:
        lines = [f"DIFFERENT in {', '.join(differing)}" if differing else "identical"]
        if run.first_difference(again) is not None:
            lines += difference_lines(run, again)
    return comparison, [*lines, f"Run folder  {again.folder.path}"]


def _repeat_mission(
    campaign: Path, number: int, out: Path, *, with_fault: bool, firmware: str | None
) -> _Comparison:
    from mavfi_cli.analysis.flights import differing, mission_of, provenance
    from mavfi_cli.campaigns.begin import opened
    from mavfi_cli.core.errors import RecordError
    from mavfi_cli.core.files import reading
    from mavfi_cli.mission.run import fly_to_end
    from mavfi_cli.mission.run_folder import COMPANION_VARIES
    from mavfi_cli.report.summary import outcome_line

    with opened(campaign) as ledger:
        config, row = mission_of(ledger, number)
        with reading(campaign):
            _warn_of_builds(provenance(ledger).get("versions", {}))
    if config.companion is not None:
        raise RecordError(f"mission {number}: {COMPANION_VARIES}")
    config.require_programs(firmware)
    config = config if with_fault else config.golden
    note(f"flying mission {number}: {config.world}, seed {config.seed}")
    again = fly_to_end(config, out)
    changed = differing(row, again.record)
    comparison = {
        "campaign": str(campaign),
        "mission": number,
        "again": str(again.folder.path),
        "identical": not changed,
        "outcomes": [row["outcome"], again.record.outcome],
        "differing_measures": changed,
    }
    same = "identical in every measure"
    verdict = f"DIFFERENT in {', '.join(changed)}" if changed else same
    return comparison, [outcome_line(again.record), verdict, f"Run folder  {again.folder.path}"]


def _warn_of_builds(versions: Mapping[str, str]) -> None:
    """Print a warning for each program or library whose version differs from the recorded one.

    Args:
        versions: the recorded versions, keyed by name; empty if they are unknown, which gives no
            warning.
    """
    from mavfi_cli.core.installed import installed_versions, version_differences

    for text in version_differences(versions, installed_versions()) if versions else ():
        note(f"warning: another build: {text}")


def _announce_stop(pid: int) -> None:
    note(
        f"the node is stopped at the injected instruction, with the fault in place: gdb -p {pid}  "
        f"(or continue it: kill -CONT {pid})"
    )
