"""`mavfi detect`: list the detectors and evaluate them on missions outside the training data."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mavfi_cli.cli import results, types
from mavfi_cli.cli.grouped import GroupedCommand, GroupOfCommands, given_fields, option, section
from mavfi_cli.core.terminal import echo

if TYPE_CHECKING:
    from mavfi_cli.detect.base import DetectorListing

_FOLDER = click.Path(path_type=Path, file_okay=False)


@click.group(cls=GroupOfCommands)
def detect() -> None:
    """List the detectors and evaluate them."""


@detect.command("list")
@option("--models", type=_FOLDER, help="Folder of model files NAME.json  [shipped models].")
@option("--json", "as_json", is_flag=True, help="Print as JSON, with the full provenance.")
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
    """Return the entry of a detector for `--json`, with its description under the key `told`."""
    entry = asdict(row)
    entry["told"] = entry.pop("description")
    return entry


_missions = section("Missions")
_fault = section("Faults")
_detector = section("Detectors")
_output = section("Output")


@detect.command(cls=GroupedCommand)
@_missions("--world", "worlds", multiple=True, type=types.WORLD, metavar="NAME|FILE",
           help="World; may be repeated  [sparse, dense, factory, farm].")  # fmt: skip
@_missions("--flights", default=25, type=click.IntRange(0, types.MISSIONS.max),
           help="Faulty missions per world. Each is flown once per kind of fault.")  # fmt: skip
@_missions("--golden-flights", default=100, type=types.MISSIONS,
           help="Error-free missions per world, at least --flights.")  # fmt: skip
@_missions("--first-seed", default=500_000, type=types.FIRST_SEED,
           help="Seed of the first mission; each further mission adds 1. Seeds that trained a "
                "model are rejected.")  # fmt: skip
@_missions("--platform", type=types.PLATFORM, metavar="NAME|FILE",
           help="Platform of the companion  [x86].")  # fmt: skip
@_missions("--stack", type=types.STACK, metavar="NAME|FILE",
           help="Stack; its shipped models are used. `mavfi stacks` lists them  "
                "[mavbench].")  # fmt: skip
@_missions("--jobs", type=types.JOBS, help="Number of parallel missions  [one per core].")
@_fault("--level", type=click.Choice(["source", "instruction"]), default="source",
        help="`source` corrupts states between kernels, `instruction` operands of a node's "
             "instructions.")  # fmt: skip
@_fault("--field", "fields", type=types.FIELDS, default="sign,exponent,mantissa,integer",
        help="Fields of the bits at source level; integer means states that have no other "
             "field.")  # fmt: skip
@_fault("--seed", default=1, type=types.SEED, help="Seed of the faults.")
@_detector("--detector", "detectors", type=types.DETECTORS, metavar="NAME,NAME",
           help="Detectors to evaluate  [none,range,l2,gad,aad].")  # fmt: skip
@_detector("--models", type=_FOLDER, help="Folder of model files NAME.json  [shipped models].")
@_detector("--protect", type=types.STAGES, default="perception,planning,control",
           help="Stages that the detectors watch.")  # fmt: skip
@_output("--out", type=types.OUT, default=Path("evaluation"),
         help="Folder of flights, tables and pictures. Recorded missions are not flown "
              "again.")  # fmt: skip
@_output("--json", "as_json", is_flag=True, help="Print the evaluation as JSON.")
@_output("--csv", "as_csv", is_flag=True, help="Print the evaluation as CSV, one pair per row.")
@_output("--quiet", is_flag=True, help="No progress on stderr.")
def evaluate(out: Path, as_json: bool, as_csv: bool, quiet: bool, **options: Any) -> None:
    """Evaluate detectors on held-out missions: golden, faulty, and faulty with detector.

    The same command resumes an interrupted evaluation. More flights, worlds or detectors are added
    to those in the folder. Writes evaluation.json, evaluation.csv, roc.svg and recovery.svg.
    """
    from mavfi_cli.campaigns.run import Options
    from mavfi_cli.cli.progress import missions_view
    from mavfi_cli.core.files import plain
    from mavfi_cli.report.detectors import PICTURES, detector_csv, detector_lines
    from mavfi_cli.spec.mission import MissionConfig
    from mavfi_cli.studies.evaluate import EvaluationPlan
    from mavfi_cli.studies.evaluate import evaluate as run

    golden = max(options["golden_flights"], options["flights"])
    base = MissionConfig(**given_fields(MissionConfig, seed=MissionConfig().seed))
    plan = EvaluationPlan(**given_fields(EvaluationPlan, golden_flights=golden, base=base))
    with missions_view(quiet=quiet) as view:
        evaluation, pairs = run(plan, out, Options(**given_fields(Options)), view)
    contents, table = plain(asdict(evaluation)), detector_csv(*pairs)
    pictures = {name: draw(evaluation) for name, draw in PICTURES.items()}
    names = results.save(out, {"evaluation.json": contents}, {"evaluation.csv": table}, pictures)
    lines = [*detector_lines(evaluation), "", f"Files  {out}: {', '.join(names)}"]
    results.show(contents, table, lines, as_json=as_json, as_csv=as_csv)
