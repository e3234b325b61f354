"""`mavfi detect`: list the detectors and evaluate them on missions outside the training data."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mavfi_cli.cli.grouped import GroupedCommand, GroupedOption, GroupOfCommands, names_in
from mavfi_cli.cli.parameters import (
    DETECTORS,
    FIELDS,
    FIRST_SEED,
    JOBS,
    MISSIONS,
    OUT,
    PLATFORM,
    SEED,
    STACK,
    STAGES,
    WORLD,
)
from mavfi_cli.core.terminal import echo, echo_lines

if TYPE_CHECKING:
    from mavfi_cli.detect.base import DetectorListing
    from mavfi_cli.studies.evaluate import EvaluationPlan

_FOLDER = click.Path(path_type=Path, file_okay=False)


@click.group(cls=GroupOfCommands)
def detect() -> None:
    """List the detectors and evaluate them."""


@detect.command("list")
@click.option("--models", type=_FOLDER, help="Folder of model files NAME.json  [the shipped].")
@click.option("--json", "as_json", is_flag=True, help="Print as JSON, with the full provenance.")
def list_(models: Path | None, as_json: bool) -> None:
    """List the detectors with the model file, stack, threshold and origin of each."""
    from mavfi_cli.detect.base import listing

    rows = listing(models)
    if as_json:
        echo(json.dumps([_entry(row) for row in rows], indent=2))
        return
    for row in rows:
        threshold = "-" if row.threshold is None else f"{row.threshold:.6g}"
        stack = f"{row.stack}: " if row.stack else ""
        echo(f"{row.name:<9} threshold {threshold:<9} {stack}{row.model or 'no model file'}")
        echo(f"{'':<9} {row.description}")


def _entry(row: DetectorListing) -> dict[str, Any]:
    """The entry of a detector in `--json`, where its description is `told`."""
    entry = asdict(row)
    entry["told"] = entry.pop("description")
    return entry


_missions = partial(click.option, cls=GroupedOption, group="Missions")
_fault = partial(click.option, cls=GroupedOption, group="Faults")
_detector = partial(click.option, cls=GroupedOption, group="Detectors")
_output = partial(click.option, cls=GroupedOption, group="Output")


@detect.command(cls=GroupedCommand)
@_missions("--world", "worlds", multiple=True, type=WORLD, metavar="NAME|FILE",
           help="World; may be repeated  [sparse, dense, factory, farm].")  # fmt: skip
@_missions("--flights", default=25, show_default=True, type=click.IntRange(0, MISSIONS.max),
           help="Faulty missions per world. Each is flown once per kind of fault.")  # fmt: skip
@_missions("--golden-flights", default=100, show_default=True, type=MISSIONS,
           help="Error-free missions per world, at least --flights.")  # fmt: skip
@_missions("--first-seed", default=500_000, show_default=True, type=FIRST_SEED,
           help="Seed of the first mission; each further mission adds 1. Seeds that trained a "
                "model are rejected.")  # fmt: skip
@_missions(
    "--platform", type=PLATFORM, metavar="NAME|FILE", help="Platform of the companion  [x86]."
)
@_missions("--stack", type=STACK, metavar="NAME|FILE",
           help="Stack; its shipped models are used. `mavfi stacks` lists them  "
                "[mavbench].")  # fmt: skip
@_missions("--jobs", type=JOBS,
           help="Number of parallel missions  [one per core].")  # fmt: skip
@_fault("--level", type=click.Choice(["source", "instruction"]), default="source",
        show_default=True,
        help="`source` corrupts states between kernels, `instruction` operands of a node's "
             "instructions.")  # fmt: skip
@_fault("--field", "fields", type=FIELDS, default="sign,exponent,mantissa,integer",
        show_default=True,
        help="Fields of the bits at source level; integer means states that have no other "
             "field.")  # fmt: skip
@_fault("--seed", default=1, show_default=True, type=SEED,
        help="Seed of the faults.")  # fmt: skip
@_detector("--detector", "detectors", type=DETECTORS, metavar="NAME,NAME",
           help="Detectors to evaluate  [none,range,l2,gad,aad].")  # fmt: skip
@_detector("--models", type=_FOLDER, help="Folder of model files NAME.json  [the shipped].")
@_detector("--protect", type=STAGES, default="perception,planning,control", show_default=True,
           help="Stages that the detectors watch.")  # fmt: skip
@_output("--out", type=OUT, default=Path("evaluation"), show_default=True,
         help="Folder of flights, tables and pictures. Recorded missions are not flown "
              "again.")  # fmt: skip
@_output("--json", "as_json", is_flag=True, help="Print the evaluation as JSON.")
@_output("--csv", "as_csv", is_flag=True, help="Print the evaluation as CSV, one pair per row.")
@_output("--quiet", is_flag=True, help="No progress on stderr.")
def evaluate(
    out: Path, as_json: bool, as_csv: bool, quiet: bool, jobs: int | None, **options: Any
) -> None:
    """Evaluate detectors on held-out missions: golden, faulty, and faulty with detector.

    The same command resumes an interrupted evaluation. More flights, worlds or detectors are added
    to those in the folder. Writes evaluation.json, evaluation.csv, roc.svg and recovery.svg.
    """
    from mavfi_cli.campaigns.run import Options
    from mavfi_cli.cli.progress import missions_view
    from mavfi_cli.core.files import plain, write_json, write_text
    from mavfi_cli.report.detectors import (
        PICTURES,
        detector_csv,
        detector_lines,
    )
    from mavfi_cli.report.drawing import write_figure
    from mavfi_cli.studies.evaluate import evaluate as run

    if as_json and as_csv:
        raise click.UsageError("--json cannot be combined with --csv")
    plan = _plan(**options)
    with missions_view(quiet=quiet) as view:
        evaluation, pairs = run(plan, out, Options(jobs=jobs or 0), view)
    contents = plain(asdict(evaluation))
    write_json(out / "evaluation.json", contents)
    write_text(out / "evaluation.csv", detector_csv(*pairs))
    for name, draw in PICTURES.items():
        write_figure(draw(evaluation), out / name)
    if as_json:
        echo(json.dumps(contents, indent=2, sort_keys=True))
    elif as_csv:
        echo(detector_csv(*pairs), nl=False)
    else:
        files = "evaluation.json, evaluation.csv, roc.svg, recovery.svg"
        echo_lines([*detector_lines(evaluation), "", f"Files  {out}: {files}"])


def _plan(
    *,
    worlds: tuple[str, ...] | None,
    detectors: str | None,
    golden_flights: int,
    flights: int,
    protect: str,
    fields: str,
    platform: str | None,
    stack: str | None,
    **same: Any,
) -> EvaluationPlan:
    from mavfi_cli.spec.mission import MissionConfig
    from mavfi_cli.studies.evaluate import DETECTORS, WORLDS, EvaluationPlan

    base = MissionConfig()
    return EvaluationPlan(
        worlds=worlds or WORLDS,
        detectors=DETECTORS if detectors is None else names_in(detectors),
        golden_flights=max(golden_flights, flights),
        flights=flights,
        protect=names_in(protect),
        fields=names_in(fields),
        base=replace(base, platform=platform or base.platform, stack=stack or base.stack),
        **same,
    )
