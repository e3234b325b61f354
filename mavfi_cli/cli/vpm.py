"""`mavfi vpm`: what redundant computers cost a vehicle in speed, time and energy."""

from __future__ import annotations

import json
import os
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mavfi_cli.cli.grouped import GroupedCommand, GroupedOption, given_options, refuse_given
from mavfi_cli.cli.parameters import (
    ABOVE_ZERO,
    BOARD,
    JOBS,
    MISSIONS,
    MODEL_VEHICLE,
    OUT,
    PLATFORM,
    STACK,
    WORLD,
)
from mavfi_cli.core.terminal import echo, echo_lines

if TYPE_CHECKING:
    from mavfi_cli.analysis.beside_model import FlightsReport
    from mavfi_cli.vpm.model import ModelVehicle
    from mavfi_cli.vpm.report import Choices, ModelReport

_FLYING = ("worlds", "stack", "missions", "first_seed", "models", "train", "jobs", "quiet")


_model = partial(click.option, cls=GroupedOption, group="Model")
_flights = partial(click.option, cls=GroupedOption, group="Flights, with --fly")
_output = partial(click.option, cls=GroupedOption, group="Output")


@click.command(cls=GroupedCommand)
@_model("--vehicle", "vehicles", multiple=True, type=MODEL_VEHICLE, metavar="NAME|FILE",
        help="airsim, spark, cal20 or a TOML file; may be repeated  "
             "[airsim, spark: the paper's Fig. 15].")  # fmt: skip
@_model("--platform", type=PLATFORM, metavar="NAME|FILE",
        help="Platform whose latencies give the response time and whose board the vehicle "
             "carries  [the vehicle's own].")  # fmt: skip
@_model("--chain", type=click.Choice(["serial", "pipelined"]), default="serial",
        show_default=True,
        help="Response time of --platform: the sum of its kernels' latencies, or the largest of "
             "them.")  # fmt: skip
@_model("--board", type=BOARD, metavar="NAME|FILE",
        help="Mass and power of a computer: a57, ncs, raspi3b, tx2, xavier or a TOML "
             "file  [the platform's, or the vehicle's own].")  # fmt: skip
@_model("--response", type=ABOVE_ZERO, metavar="S", help="Response time of the computer, s.")
@_model("--range", "range_", type=ABOVE_ZERO, metavar="M", help="Sensing range, m.")
@_model("--distance", type=ABOVE_ZERO, default=50.0, show_default=True, metavar="M",
        help="Length of a mission, m.")  # fmt: skip
@_model("--overhead", "overheads", multiple=True, metavar="DETECTOR=PERCENT|PATH",
        help="Compute overhead of gad or aad: a percentage, or a run folder, campaign or "
             "evaluation that measured it  [--fly: measured in its flights; else the paper's "
             "Table V].")  # fmt: skip
@_flights("--fly", "fly", is_flag=True,
          help="Fly every row in JSBSim with its mass at its safe velocity, and compare model and "
               "flight.")  # fmt: skip
@_flights("--world", "worlds", multiple=True, type=WORLD, metavar="NAME|FILE",
          help="World; may be repeated  [sparse, dense].")  # fmt: skip
@_flights("--stack", type=STACK, default="mavbench", show_default=True, metavar="NAME|FILE",
          help="Stack; `mavfi stacks` lists them.")  # fmt: skip
@_flights("--missions", type=click.IntRange(1, 100_000), default=10, show_default=True,
          help="Missions per scheme and world.")  # fmt: skip
@_flights("--first-seed", type=click.IntRange(0, 2**31 - 200_000), default=1, show_default=True,
          help="Seed of the first mission; each further mission adds 1.")  # fmt: skip
@_flights("--models", type=click.Path(path_type=Path, file_okay=False, exists=True),
          help="Folder of detector models NAME.json  [the shipped].")  # fmt: skip
@_flights("--train", type=click.IntRange(0, MISSIONS.max), default=0,
          metavar="FLIGHTS",
          help="First fit the detectors for each vehicle to this many error-free flights of each "
               "training world at its safe velocity  [0: none].")  # fmt: skip
@_flights("--jobs", type=JOBS,
          help="Number of parallel missions  [one per core].")  # fmt: skip
@_flights("--quiet", is_flag=True, help="No progress on stderr.")
@_output("--out", type=OUT,
         help="Folder for vpm.json, vpm.csv and pictures; with --fly also for the flights, "
              "which are not flown again  [none; --fly: vpm].")  # fmt: skip
@_output("--json", "as_json", is_flag=True, help="Print the report as JSON.")
@_output("--csv", "as_csv", is_flag=True, help="Print the report as CSV, one scheme per row.")
def vpm(
    vehicles: tuple[str, ...],
    out: Path | None,
    fly: bool,
    as_json: bool,
    as_csv: bool,
    **options: Any,
) -> None:
    """Compare no protection, DMR, TMR, and detection and recovery.

    The report contains the safe velocity, flight time and energy of each.

    In the F-1 visual performance model a vehicle flies as fast as it can stop within its sensing
    range. A copy of the computer adds mass and power. Detection and recovery adds compute time.
    """
    from mavfi_cli.campaigns.specification import require_named
    from mavfi_cli.report.model import model_csv, model_json, model_lines
    from mavfi_cli.vpm.model import ModelVehicle, schemes_with
    from mavfi_cli.vpm.report import report

    if as_json and as_csv:
        raise click.UsageError("--json cannot be combined with --csv")
    if not fly:
        refuse_given(_FLYING, "needs --fly")
        given = given_options()
        if "platform" not in given:
            refuse_given(["chain"], "needs --platform, whose latencies it combines")
        if "response" in given:
            refuse_given(
                ["chain"], "cannot be combined with --response, which sets the response time"
            )
    if options["models"] is not None and options["train"]:
        raise click.UsageError("--models cannot be combined with --train")
    chosen = [ModelVehicle.load(name) for name in vehicles or ("airsim", "spark")]
    require_named("vehicle", [vehicle.name for vehicle in chosen])
    choices = _choices(options)
    platform = None if choices.platform is None else choices.platform.name
    overheads = _overheads(options["overheads"], platform)
    model, flights = report(chosen, choices, schemes_with(overheads)), None
    if fly:
        out = out or Path("vpm")
        model, flights = _flown(chosen, overheads, choices, out, options)
    files = [] if out is None else _save(model, flights, out)
    if as_json:
        echo(json.dumps(model_json(model, flights), indent=2, sort_keys=True))
    elif as_csv:
        echo(model_csv(flights or model), nl=False)
    else:
        written = ["", f"Files  {out}: {', '.join(files)}"] if files else []
        echo_lines([*model_lines(model, flights), *written])


def _overheads(texts: tuple[str, ...], platform: str | None = None) -> dict[str, tuple[float, str]]:
    """Overhead in per cent and its source for each detector; the last option of one wins.

    Args:
        platform: name of the modelled platform; flights on others are ignored. None uses all.

    Raises:
        click.UsageError: the text is neither DETECTOR=PERCENT nor a path.
        RecordError: the path has no flights with a detector on the platform.
    """
    overheads: dict[str, tuple[float, str]] = {}
    for text in texts:
        name, _, number = text.partition("=")
        if os.path.exists(text):  # false also of a text that is too long for a path
            from mavfi_cli.analysis.overhead import recorded_overheads
            from mavfi_cli.vpm.model import DETECTORS

            measured = recorded_overheads(Path(text), DETECTORS, platform)
            overheads |= {
                name: (100.0 * own.share, own.describe(text)) for name, own in measured.items()
            }
            continue
        try:
            overheads[name.strip()] = float(number), "--overhead"
        except ValueError:
            raise click.UsageError(
                f"--overhead {text}: no such file or folder; for a percentage write aad=0.0062"
            ) from None
    return overheads


def _flown(
    vehicles: list[ModelVehicle],
    overheads: dict[str, tuple[float, str]],
    choices: Choices,
    out: Path,
    options: dict[str, Any],
) -> tuple[ModelReport, FlightsReport]:
    from mavfi_cli.campaigns.run import Options
    from mavfi_cli.cli.progress import missions_view
    from mavfi_cli.studies.redundancy import WORLDS, RedundancyPlan, fly_and_report

    same = ("missions", "first_seed", "models", "train", "stack")
    plan = RedundancyPlan(
        vehicles=vehicles, choices=choices, worlds=options["worlds"] or WORLDS, folder=out,
        **{name: options[name] for name in same},
    )  # fmt: skip
    with missions_view(quiet=options["quiet"]) as view:
        return fly_and_report(plan, overheads, Options(jobs=options["jobs"] or 0), view)


def _choices(options: dict[str, Any]) -> Choices:
    from mavfi_cli.spec.platform import load_platform
    from mavfi_cli.vpm.model import Board
    from mavfi_cli.vpm.report import Choices

    platform, board = options["platform"], options["board"]
    return Choices(
        platform=None if platform is None else load_platform(platform),
        chain=options["chain"],
        board=None if board is None else Board.load(board),
        response_s=options["response"],
        range_m=options["range_"],
        distance_m=options["distance"],
    )


def _save(model: ModelReport, flights: FlightsReport | None, out: Path) -> list[str]:
    from mavfi_cli.core.files import write_json, write_text, writing
    from mavfi_cli.report.drawing import write_figure
    from mavfi_cli.report.model import MODEL_PICTURES, draw_flights, model_csv, model_json

    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
    write_json(out / "vpm.json", model_json(model, flights))
    write_text(out / "vpm.csv", model_csv(model))
    for name, draw in MODEL_PICTURES.items():
        write_figure(draw(model), out / name)
    if flights is None:
        return ["vpm.json", "vpm.csv", *MODEL_PICTURES]
    write_text(out / "flights.csv", model_csv(flights))
    write_figure(draw_flights(flights), out / "flights.svg")
    return ["vpm.json", "vpm.csv", *MODEL_PICTURES, "flights.csv", "flights.svg"]
