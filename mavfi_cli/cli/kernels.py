"""`mavfi kernels`: one fault a run in an isolated kernel, and what it did to the output."""

from __future__ import annotations

import csv
import io
import json
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mavfi_cli.core.errors import ConfigError

if TYPE_CHECKING:
    from mavfi_cli.fi.isolated.campaign import Campaign, Plan


@click.command()
@click.option("--kernel", multiple=True, metavar="NAME",
              help="point_cloud, octomap, collision_check, rrt, rrtconnect, rrtstar or control. "
                   "May be repeated  [all].")  # fmt: skip
@click.option("--world", default="dense", show_default=True, metavar="NAME|FILE",
              help="World of the golden flight that feeds the kernels.")  # fmt: skip
@click.option("--world-seed", default=3, show_default=True, help="Its seed.")
@click.option("--program", help="Attack this native program instead of our kernels.")
@click.option("--args", help="Its arguments, quoted as in a shell.")
@click.option("--compare", help="What of it is compared: stdout or file:PATH  [stdout].")
@click.option("--tolerance", default=0.0, type=click.FloatRange(min=0.0),
              help="Relative difference that is no SDC.")  # fmt: skip
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
    from mavfi_cli.cli.own_kernels import replay_folder, run_own_kernels

    if options["replay"] is not None:
        others = [name for name in options if name not in ("replay", "kernel", "runs")]
        _refuse(others, "goes without --replay: a record says how it was drawn")
        limit = options["runs"] if _given("runs") else 0
        if not replay_folder(options["replay"], options["kernel"], limit):
            raise click.exceptions.Exit(1)
    elif options["program"] is not None:
        _refuse(("kernel", "world", "world_seed"), "goes without --program")
        _attack_program(options)
    else:
        _refuse(("args", "compare", "scope", "function"), "needs --program")
        run_own_kernels(options, _model(options))


def _given(name: str) -> bool:
    source = click.get_current_context().get_parameter_source(name)
    return source is click.core.ParameterSource.COMMANDLINE


def _refuse(names: Sequence[str], why: str) -> None:
    """An option that would do nothing is a mistake: exit code 2."""
    for option in click.get_current_context().command.params:
        if option.name in names and _given(option.name):
            raise click.UsageError(f"{option.opts[0]} {why}")


def _attack_program(options: dict[str, Any]) -> None:
    from mavfi_cli.cli.runs_view import runs_view
    from mavfi_cli.fi.isolated.campaign import run_campaign

    as_json, out = options["as_json"], options["out"]
    plan = _plan(options)
    name = Path(options["program"]).name
    with runs_view([name], plan.runs) as view:
        view.show(name, 0)
        campaign = run_campaign(
            plan,
            jobs=options["jobs"],
            folder=out,
            progress=lambda done: view.show(name, done),
            stage=view.stage,
        )
    if out is not None:
        _save(campaign, out)
    if as_json:
        click.echo(json.dumps(campaign.summary(), indent=2))
        return
    click.echo(_table(campaign))
    if out is not None:
        click.echo(f"\nFiles  {out}: kernels.json, kernels.csv, runs.jsonl")


def _plan(options: dict[str, Any]) -> Plan:
    from mavfi_cli.fi.isolated.campaign import Plan
    from mavfi_cli.fi.isolated.compare import Comparison
    from mavfi_cli.fi.isolated.program import ProgramTarget, absolute_arguments
    from mavfi_cli.fi.native.spawn import Command

    comparison = Comparison.of(options["compare"] or "stdout", options["tolerance"])
    try:
        arguments: tuple[str, ...] = tuple(shlex.split(options["args"] or ""))
    except ValueError as error:
        raise ConfigError(str(error), key="args") from None
    if comparison.file is not None:
        arguments = absolute_arguments(arguments, Path.cwd())
    return Plan(
        target=ProgramTarget(
            command=Command.of([options["program"], *arguments]),
            comparison=comparison,
            objects=tuple(options["scope"]),
            function=options["function"],
        ),
        runs=options["runs"],
        seed=options["seed"],
        rule=options["sampling"],
        compat=options["compat"],
        model=_model(options),
        windows=options["windows"],
        null=options["null"],
    )


def _model(options: dict[str, Any]) -> Any:
    from mavfi_cli.core.errors import UnknownName
    from mavfi_cli.fi.bits import Field
    from mavfi_cli.fi.native.fault import FaultModel, Role, Site

    def named(kind: Any, name: str, what: str) -> Any:
        """A member of an enum by its value; an unknown one names the nearest."""
        try:
            return kind(name)
        except ValueError:
            raise UnknownName(what, name, [known.value for known in kind]) from None

    default = FaultModel()
    sites = frozenset(named(Site, name, "site") for name in options["site"])
    roles = frozenset(named(Role, name, "role") for name in options["role"])
    return FaultModel(
        sites=sites or default.sites,
        roles=roles or default.roles,
        field=named(Field, options["field"], "field"),
        count=options["bits"],
    )


def _table(campaign: Campaign) -> str:
    from mavfi_cli.fi.isolated.outcome import Outcome

    summary = campaign.summary()
    lines = [f"{'outcome':<14}{'runs':>7}{'share':>9}   95 % interval"]
    for name, row in summary["outcomes"].items():
        share = "-" if row["share"] is None else f"{100 * row['share']:.1f} %"
        low, high = (100 * edge for edge in row["wilson95"])
        lines.append(
            f"{Outcome(name).title:<14}{row['count']:>7}{share:>9}   {low:.1f} to {high:.1f} %"
        )
    lines.append(f"sampling: {summary['sampling']}; scope: {', '.join(summary['scope'])}")
    if summary["executed_in_scope"] is not None:
        lines.append(
            f"{summary['executed_in_scope']} executed instructions in scope, windows stepped: "
            f"{summary['windows']}"
        )
    for title in ("crashes", "not_injected", "activation"):
        if summary[title]:
            parts = ", ".join(f"{name} {count}" for name, count in summary[title].items())
            lines.append(f"{title.replace('_', ' ')}: {parts}")
    return "\n".join(lines)


def _save(campaign: Campaign, folder: Path) -> None:
    from mavfi_cli.core.files import write_json, write_text
    from mavfi_cli.fi.isolated.campaign import csv_rows, to_json

    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(csv_rows(campaign))
    write_text(folder / "kernels.csv", text.getvalue())
    write_json(folder / "kernels.json", to_json(campaign))
