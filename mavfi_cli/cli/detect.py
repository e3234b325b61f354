"""`mavfi detect`: the detectors, and what they are worth on flights that training never saw."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

_FOLDER = click.Path(path_type=Path, file_okay=False)


@click.group()
def detect() -> None:
    """The detectors that can protect a flight, and what they are worth."""


@detect.command("list")
@click.option("--models", type=_FOLDER, help="Folder of model files NAME.json  [the shipped].")
@click.option("--json", "as_json", is_flag=True, help="Print with the whole provenance.")
def list_(models: Path | None, as_json: bool) -> None:
    """Detectors, their model files, stacks and thresholds, and where they come from."""
    from mavfi_cli.detect.listing import listing

    rows = listing(models)
    if as_json:
        click.echo(json.dumps(rows, indent=2))
        return
    for row in rows:
        threshold = "-" if row["threshold"] is None else f"{row['threshold']:.6g}"
        stack = f"{row['stack']}: " if row["stack"] else ""
        click.echo(
            f"{row['name']:<9} threshold {threshold:<9} {stack}{row['model'] or 'no model file'}"
        )
        click.echo(f"{'':<9} {row['told']}")


@detect.command()
@click.option("--world", "worlds", multiple=True, metavar="NAME|FILE",
              help="Where to fly; may be repeated  [sparse, dense, factory, farm].")  # fmt: skip
@click.option("--detector", "detectors", metavar="NAME,NAME",
              help="Which detectors  [none,range,l2,gad,aad].")  # fmt: skip
@click.option("--models", type=_FOLDER, help="Folder of model files NAME.json  [the shipped].")
@click.option("--protect", default="perception,planning,control", show_default=True,
              help="Stages whose states are watched.")  # fmt: skip
@click.option("--flights", default=25, show_default=True, type=click.IntRange(min=0),
              help="Missions of each world with faults: of each, one for every kind.")  # fmt: skip
@click.option("--harmless-flights", default=5, show_default=True, type=click.IntRange(min=0),
              help="Of these missions the first so many are flown with the detectors for every "
                   "fault, the others only for faults that do harm without.")  # fmt: skip
@click.option("--golden-flights", default=100, show_default=True, type=click.IntRange(min=1),
              help="Error-free missions of each world, --flights at least.")  # fmt: skip
@click.option("--first-seed", default=500_000, show_default=True, type=click.IntRange(min=0),
              help="Of the missions; seeds count up from here. Those that trained a model are "
                   "refused.")  # fmt: skip
@click.option("--seed", default=1, show_default=True, help="Of the faults.")
@click.option("--level", type=click.Choice(["source", "instruction"]), default="source",
              show_default=True,
              help="Faults in states between kernels, or in instructions of a node.")  # fmt: skip
@click.option("--field", "fields", default="sign,exponent,mantissa,integer", show_default=True,
              help="Bit fields that are struck at the source level; integer: states that have none "
                   "of the others.")  # fmt: skip
@click.option("--platform", metavar="NAME|FILE", help="The companion computer  [x86].")
@click.option("--stack", metavar="NAME|FILE",
              help="How the companion is wired; its shipped models are taken  "
                   "[mavbench].")  # fmt: skip
@click.option("--jobs", type=click.IntRange(min=1),
              help="Missions at the same time  [one a core].")  # fmt: skip
@click.option("--out", type=_FOLDER, default=Path("evaluation"), show_default=True,
              help="Folder of flights, tables and pictures; what it has is not flown "
                   "again.")  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print the evaluation as JSON.")
@click.option("--csv", "as_csv", is_flag=True, help="Print a row a pair as CSV.")
@click.option("--quiet", is_flag=True, help="No progress on stderr.")
def evaluate(out: Path, as_json: bool, as_csv: bool, quiet: bool, **options: Any) -> None:
    """Fly held-out missions golden, with faults, and with faults and detectors; count.

    Interrupted, it goes on where it stopped when it is called again with the same folder; called
    with more flights, worlds or detectors, it adds them. Writes evaluation.json, evaluation.csv,
    roc.svg and recovery.svg.
    """
    from mavfi_cli.campaign.run import Options
    from mavfi_cli.cli.missions_view import missions_view
    from mavfi_cli.core.files import plain, write_json, write_text
    from mavfi_cli.report.detection_plot import write_recovery_plot, write_roc_plot
    from mavfi_cli.report.tables.detectors import detector_csv, detector_lines
    from mavfi_cli.studies.evaluate import evaluate as run

    if as_json and as_csv:
        raise click.UsageError("--json or --csv, not both")
    plan = _plan(options)
    with missions_view(quiet=quiet) as view:
        evaluation, pairs = run(plan, out, Options(jobs=options["jobs"] or 0), view)
    write_json(out / "evaluation.json", evaluation)
    write_text(out / "evaluation.csv", detector_csv(*pairs))
    write_roc_plot(evaluation, out / "roc.svg")
    write_recovery_plot(evaluation, out / "recovery.svg")
    if as_json:
        click.echo(json.dumps(plain(evaluation), indent=2, sort_keys=True))
    elif as_csv:
        click.echo(detector_csv(*pairs), nl=False)
    else:
        files = "evaluation.json, evaluation.csv, roc.svg, recovery.svg"
        click.echo("\n".join([*detector_lines(evaluation), "", f"Files  {out}: {files}"]))


def _plan(options: dict[str, Any]) -> Any:
    from mavfi_cli.mission.config import MissionConfig
    from mavfi_cli.studies.evaluation_plan import DETECTORS, WORLDS, EvaluationPlan

    base = {key: options[key] for key in ("platform", "stack") if options[key] is not None}
    named = options["detectors"]
    return EvaluationPlan(
        worlds=options["worlds"] or WORLDS,
        detectors=DETECTORS if named is None else _names(named),
        flights=options["flights"],
        harmless_flights=options["harmless_flights"],
        golden_flights=max(options["golden_flights"], options["flights"]),
        first_seed=options["first_seed"],
        protect=_names(options["protect"]),
        models=options["models"],
        level=options["level"],
        fields=_names(options["fields"]),
        seed=options["seed"],
        base=MissionConfig(**base),
    )


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())
