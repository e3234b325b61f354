"""`mavfi kernels`: one fault a run in an isolated kernel, and what it did to the output."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import os
import shlex
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mavfi_cli.core.errors import ConfigError

if TYPE_CHECKING:
    from mavfi_cli.attack.campaign import TargetRuns
    from mavfi_cli.attack.plan import Plan
    from mavfi_cli.attack.target import AttackTarget


@click.command()
@click.option("--kernel", multiple=True, metavar="NAME",
              help="point_cloud, octomap, collision_check, rrt, rrtconnect, rrtstar or control, or "
                   "a Python file with a kernel of your own. May be repeated  [all].")  # fmt: skip
@click.option("--world", default="dense", show_default=True, metavar="NAME|FILE",
              help="World of the golden flight that feeds the kernels.")  # fmt: skip
@click.option("--world-seed", default=3, show_default=True, help="Its seed.")
@click.option("--program", help="Attack this native program instead of our kernels.")
@click.option("--args", help="Its arguments, quoted as in a shell.")
@click.option("--compare", multiple=True, metavar="OUTPUT",
              help="What of it is compared: stdout, or file:PATH that it writes, relative to the "
                   "scratch folder in which it then runs. May be repeated  [stdout].")  # fmt: skip
@click.option("--ignore-lines", multiple=True, metavar="REGEX",
              help="Program: lines in which this is found are not compared. May be "
                   "repeated.")  # fmt: skip
@click.option("--stdin", "stdin_file", metavar="FILE",
              type=click.Path(exists=True, dir_okay=False, path_type=Path),
              help="Program: its standard input  [none].")  # fmt: skip
@click.option("--tolerance", default=0.0, type=click.FloatRange(min=0.0),
              help="Relative error of a number that is still counted as benign.")  # fmt: skip
@click.option("--runs", default=1000, show_default=True, type=click.IntRange(min=1),
              help="Of each kernel, or of the program: one fault a run.")  # fmt: skip
@click.option("--jobs", default=1, show_default=True, type=click.IntRange(min=1),
              help="Runs at the same time; the results are the same.")  # fmt: skip
@click.option("--seed", default=1, show_default=True, type=click.IntRange(min=0),
              help="Of the faults.")  # fmt: skip
@click.option("--scope", multiple=True, help="Program: shared object in scope.")
@click.option("--function", help="Program: attack only inside calls of this function.")
@click.option(
    "--windows",
    default=16,
    show_default=True,
    help="Windows (of a program: calls of --function) that are stepped, where all is too much.",
)
@click.option(
    "--sampling",
    default="instruction-uniform",
    show_default=True,
    help="instruction-uniform, cpu-time or wall-clock.",
)
@click.option("--site", multiple=True,
              help="general, flags, vector, x87, mask, instruction-pointer, opcode, memory. May be "
                   "repeated  [the first five: registers].")  # fmt: skip
@click.option("--role", multiple=True, help="source or destination  [both].")
@click.option("--field", default="any", show_default=True,
              help="Of which field bits are flipped: sign, exponent, mantissa, any.")  # fmt: skip
@click.option("--bits", default=1, show_default=True, type=click.IntRange(min=1),
              help="How many bits are flipped.")  # fmt: skip
@click.option("--compat", help="Repeat another injector's habits: rosfi-2021.")
@click.option("--null", is_flag=True, help="Do everything but the flip.")
@click.option("--out", type=click.Path(path_type=Path, file_okay=False),
              help="Folder for records, JSON, CSV, plot; what it has is not repeated.")  # fmt: skip
@click.option("--replay", type=click.Path(path_type=Path, file_okay=False),
              help="Repeat the recorded runs of such a folder and compare; with --kernel these "
                   "kernels, with --runs so many of each.")  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print the summary as JSON.")
def kernels(**options: Any) -> None:
    """Flip bits in one kernel at a time, one fault a run, and compare its output.

    Attacks the kernels of the autonomy, or with --program any native program.

    Outcomes: benign, crash, hang, SDC (silent data corruption), not injected.
    """
    if options["replay"] is not None:
        others = [name for name in options if name not in ("replay", "kernel", "runs")]
        _refuse(others, "goes without --replay: a record says how it was drawn")
        limit = options["runs"] if _given("runs") else 0
        if not _replay_folder(options["replay"], options["kernel"], limit):
            raise click.exceptions.Exit(1)
    elif options["program"] is not None:
        _refuse(("kernel", "world", "world_seed"), "goes without --program")
        _attack_program(options)
    else:
        _refuse(
            ("args", "compare", "ignore_lines", "stdin_file", "scope", "function"),
            "needs --program",
        )
        _attack_kernels(options)


def _given(name: str) -> bool:
    source = click.get_current_context().get_parameter_source(name)
    return source is click.core.ParameterSource.COMMANDLINE


def _refuse(names: Sequence[str], why: str) -> None:
    """An option that would do nothing is a mistake: exit code 2."""
    for option in click.get_current_context().command.params:
        if option.name in names and _given(option.name):
            raise click.UsageError(f"{option.opts[0]} {why}")


def _plan(options: dict[str, Any]) -> Plan:
    from mavfi_cli.attack.plan import Plan
    from mavfi_cli.fi.tracer.fault import FaultModel

    plan = Plan(
        runs=options["runs"],
        seed=options["seed"],
        rule=options["sampling"],
        compat=options["compat"],
        model=FaultModel.named(
            sites=options["site"],
            roles=options["role"],
            field=options["field"],
            bits=options["bits"],
        ),
        windows=options["windows"],
        null=options["null"],
    )
    plan.strategy()  # says now what is wrong
    return plan


def _attacked(
    plan: Plan, targets: Sequence[AttackTarget], options: dict[str, Any], folder: Path | None
) -> list[TargetRuns]:
    from mavfi_cli.attack.campaign import run_campaign
    from mavfi_cli.cli.runs_view import runs_view

    with runs_view([target.name for target in targets], plan.runs) as view:
        return run_campaign(
            plan,
            targets,
            jobs=options["jobs"],
            folder=folder,
            progress=view.show,
            stage=view.stage,
        )


def _attack_kernels(options: dict[str, Any]) -> None:
    from mavfi_cli.attack.kernels.catalogue import select
    from mavfi_cli.attack.kernels.target import KernelTarget
    from mavfi_cli.attack.summary import KERNEL_COLUMNS, summarise, table
    from mavfi_cli.mission.config import MissionConfig
    from mavfi_cli.mission.kernel_inputs import inputs_of_flight
    from mavfi_cli.report.kernel_plot import write_kernel_plot

    plan, kernels, out = _plan(options), select(options["kernel"]), options["out"]
    # Check, planner and tracker are attacked with the parameters of `hardened`.
    config = MissionConfig(world=options["world"], seed=options["world_seed"], stack="hardened")
    with _folder(out) as folder:
        click.echo(f"inputs: world {config.world}, seed {config.seed}", err=True)
        fed = inputs_of_flight(config, folder)
        tolerance = options["tolerance"]
        targets = [KernelTarget(kernel=each, tolerance=tolerance, **fed) for each in kernels]
        campaign = _attacked(plan, targets, options, folder)
        summary = summarise(plan, campaign)
        if out is not None:
            _save(out, summary, campaign, KERNEL_COLUMNS)
            write_kernel_plot(summary, out / "kernels.svg")
    _tell(summary, table(summary), "kernels.json, kernels.csv, kernels.svg, runs.jsonl", options)


@contextlib.contextmanager
def _folder(out: Path | None) -> Iterator[Path]:
    if out is not None:
        yield out
        return
    with tempfile.TemporaryDirectory(prefix="mavfi-kernels-") as scratch:
        yield Path(scratch)


def _attack_program(options: dict[str, Any]) -> None:
    from mavfi_cli.attack.summary import PROGRAM_COLUMNS, program_table, summarise_program

    plan, out = _plan(options), options["out"]
    campaign = _attacked(plan, [_program(options)], options, out)
    told = summarise_program(plan, campaign[0])
    if out is not None:
        _save(out, told, campaign, PROGRAM_COLUMNS)
    summary = told["summary"]
    _tell(summary, program_table(summary), "kernels.json, kernels.csv, runs.jsonl", options)


def _program(options: dict[str, Any]) -> AttackTarget:
    from mavfi_cli.attack.comparison import OutputComparison, absolute_arguments
    from mavfi_cli.attack.program import ProgramTarget
    from mavfi_cli.fi.tracer.spawn import Command

    comparison = OutputComparison.of(
        options["compare"], tolerance=options["tolerance"], ignored=options["ignore_lines"]
    )
    try:
        arguments = shlex.split(options["args"] or "")
    except ValueError as error:
        raise ConfigError(str(error), key="args") from None
    if comparison.files:
        arguments = list(absolute_arguments(arguments, Path.cwd(), comparison.files))
    stdin = (options["stdin_file"] or Path(os.devnull)).resolve()
    return ProgramTarget(
        command=Command.of([options["program"], *arguments], stdin=stdin),
        comparison=comparison,
        objects=tuple(options["scope"]),
        function=options["function"],
    )


def _save(
    folder: Path, told: dict[str, Any], campaign: list[TargetRuns], columns: Sequence[str]
) -> None:
    from mavfi_cli.attack.summary import csv_rows
    from mavfi_cli.core.files import write_json, write_text

    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(csv_rows(columns, campaign))
    write_text(folder / "kernels.csv", text.getvalue())
    write_json(folder / "kernels.json", told)


def _tell(summary: dict[str, Any], table: str, files: str, options: dict[str, Any]) -> None:
    if options["as_json"]:
        click.echo(json.dumps(summary, indent=2))
        return
    click.echo(table)
    if options["out"] is not None:
        click.echo(f"\nFiles  {options['out']}: {files}")


def _replay_folder(folder: Path, kernels: tuple[str, ...], runs: int) -> bool:
    """Repeat recorded runs and say which came out differently; True where none did."""
    from mavfi_cli.attack.replay import replay_runs

    equal = total = 0
    for result in replay_runs(folder, kernels, runs):
        total += 1
        equal += not result.differs
        if result.differs:
            click.echo(f"{result.kernel} {result.run}: differs in {', '.join(result.differs)}")
    click.echo(f"{equal} of {total} replays identical")
    return equal == total
