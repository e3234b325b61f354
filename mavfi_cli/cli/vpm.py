"""`mavfi vpm`: model what redundant computers cost a vehicle in speed, time and energy."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mavfi_cli.cli import results, types
from mavfi_cli.cli.grouped import (
    Given,
    GroupedCommand,
    given_fields,
    given_options,
    refuse_given,
    section,
)

if TYPE_CHECKING:
    from mavfi_cli.analysis.beside_model import FlightsReport
    from mavfi_cli.vpm.model import ModelVehicle
    from mavfi_cli.vpm.report import Choices, ModelReport

_FLYING = ("worlds", "stack", "missions", "first_seed", "models", "train", "jobs", "quiet")


_model = section("Model")
_flights = section("Flights, with --fly")
_output = section("Output")


@click.command(cls=GroupedCommand)
@_model("--vehicle", "vehicles", multiple=True, type=types.MODEL_VEHICLE, metavar="NAME|FILE",
        help="airsim, spark, cal20 or a TOML file; may be repeated  [airsim, spark: the paper's "
             "Fig. 15].")  # fmt: skip
@_model("--platform", type=types.PLATFORM, metavar="NAME|FILE",
        help="Platform whose latencies give the response time and whose board the vehicle carries  "
             "[the vehicle's own].")  # fmt: skip
@_model("--chain", type=click.Choice(["serial", "pipelined"]), default="serial",
        help="Response time of --platform: the sum of its kernels' latencies, or the largest of "
             "them.")  # fmt: skip
@_model("--board", type=types.BOARD, metavar="NAME|FILE",
        help="Mass and power of a computer: a57, ncs, raspi3b, tx2, xavier or a TOML file  [the "
             "platform's, or the vehicle's own].")  # fmt: skip
@_model("--response", "response_s", type=types.ABOVE_ZERO, metavar="S",
        help="Response time of the computer, s.")  # fmt: skip
@_model("--range", "range_m", type=types.ABOVE_ZERO, metavar="M", help="Sensing range, m.")
@_model("--distance", "distance_m", type=types.ABOVE_ZERO, default=50.0, metavar="M",
        help="Length of a mission, m.")  # fmt: skip
@_model("--overhead", "overheads", multiple=True, metavar="DETECTOR=PERCENT|PATH",
        help="Compute overhead of gad or aad: a percentage, or a run folder, campaign or "
             "evaluation that measured it  [--fly: measured in its flights; else the paper's Table "
             "V].")  # fmt: skip
@_flights("--fly", "fly", is_flag=True,
          help="Fly every row in JSBSim with its mass at its safe velocity, and compare model and "
               "flight.")  # fmt: skip
@_flights("--world", "worlds", multiple=True, type=types.WORLD, metavar="NAME|FILE",
          help="World; may be repeated  [sparse, dense].")  # fmt: skip
@_flights("--stack", type=types.STACK, default="mavbench", metavar="NAME|FILE",
          help="Stack; `mavfi stacks` lists them.")  # fmt: skip
@_flights("--missions", type=click.IntRange(1, 100_000), default=10,
          help="Missions per scheme and world.")  # fmt: skip
@_flights("--first-seed", type=click.IntRange(0, 2**31 - 200_000), default=1,
          help="Seed of the first mission; each further mission adds 1.")  # fmt: skip
@_flights("--models", type=click.Path(path_type=Path, file_okay=False, exists=True),
          help="Folder of detector models NAME.json  [the shipped models].")  # fmt: skip
@_flights("--train", type=click.IntRange(0, types.MISSIONS.max), show_default=False, default=0,
          metavar="FLIGHTS",
          help="First fit the detectors for each vehicle to this many error-free flights in each "
               "training world at its safe velocity  [0: none].")  # fmt: skip
@_flights("--jobs", type=types.JOBS, help="Number of parallel missions  [one per core].")
@_flights("--quiet", is_flag=True, help="No progress on stderr.")
@_output("--out", type=types.OUT,
         help="Folder for vpm.json, vpm.csv and pictures; with --fly also for the flights, which "
              "are not flown again  [none; --fly: vpm].")  # fmt: skip
@_output("--full", is_flag=True,
         help="Print masses, sensitivities and the source of each number, too.")  # fmt: skip
@_output("--json", "as_json", is_flag=True, help="Print the report as JSON.")
@_output("--csv", "as_csv", is_flag=True, help="Print the report as CSV, one scheme per row.")
def vpm(
    vehicles: tuple[str, ...],
    out: Path | None,
    fly: bool,
    full: bool,
    as_json: bool,
    as_csv: bool,
    **options: Any,
) -> None:
    """Compare no protection, DMR, TMR, and detection and recovery.

    The report contains the safe velocity, flight time and energy of each.

    In the F-1 visual performance model a vehicle flies as fast as it can without losing the ability
    to stop within its sensing range. A copy of the computer adds mass and power. Detection and
    recovery adds compute time.
    """
    from mavfi_cli.campaigns.specification import require_named
    from mavfi_cli.report import model as views
    from mavfi_cli.spec.platform import load_platform
    from mavfi_cli.vpm.model import Board, ModelVehicle, schemes_with
    from mavfi_cli.vpm.report import Choices, report

    if not fly:
        refuse_given(_FLYING, "needs --fly")
        given = given_options()
        if "platform" not in given:
            refuse_given(["chain"], "needs --platform, whose latencies it combines")
        if "response_s" in given:
            why = "cannot be combined with --response, which sets the response time"
            refuse_given(["chain"], why)
    if options["models"] is not None and options["train"]:
        raise click.UsageError("--models cannot be combined with --train")
    chosen = [ModelVehicle.load(name) for name in vehicles or ("airsim", "spark")]
    require_named("vehicle", [vehicle.name for vehicle in chosen])
    loaded: Given = {}
    for name, load in (("platform", load_platform), ("board", Board.load)):
        loaded |= {} if options[name] is None else {name: load(options[name])}
    choices = Choices(**given_fields(Choices, **loaded))
    platform = None if choices.platform is None else choices.platform.name
    overheads = _overheads(options["overheads"], platform)
    model, flights = report(chosen, choices, schemes_with(overheads)), None
    if fly:
        out = out or Path("vpm")
        model, flights = _flown(chosen, overheads, choices, out, quiet=options["quiet"])
    contents, table = views.model_json(model, flights), views.model_csv(model)
    flown = "" if flights is None else views.model_csv(flights)
    lines = views.model_lines(model, flights, full=full)
    if out is not None:
        pictures = {name: draw(model) for name, draw in views.MODEL_PICTURES.items()}
        names = results.save(out, {"vpm.json": contents}, {"vpm.csv": table}, pictures)
        if flights is not None:
            drawn = {"flights.svg": views.draw_flights(flights)}
            names += results.save(out, {}, {"flights.csv": flown}, drawn)
        lines += ["", f"Files  {out}: {', '.join(names)}"]
    results.show(contents, flown or table, lines, as_json=as_json, as_csv=as_csv)


def _overheads(texts: tuple[str, ...], platform: str | None = None) -> dict[str, tuple[float, str]]:
    """Return the overhead of each detector in per cent, and the source of this number.

    Args:
        texts: values of the option `--overhead`. Later values replace earlier ones.
        platform: name of the modelled platform; flights on others are ignored. None uses all.

    Raises:
        click.UsageError: a text is neither DETECTOR=PERCENT nor a path.
        RecordError: a path has no flights with a detector on the platform.
    """
    overheads: dict[str, tuple[float, str]] = {}
    for text in texts:
        name, _, number = text.partition("=")
        if os.path.exists(text):  # also false if the text is too long for a path
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
                f"--overhead {text}: no such file or folder, and not DETECTOR=PERCENT, "
                "such as aad=0.0062"
            ) from None
    return overheads


def _flown(
    vehicles: list[ModelVehicle],
    overheads: dict[str, tuple[float, str]],
    choices: Choices,
    out: Path,
    *,
    quiet: bool,
) -> tuple[ModelReport, FlightsReport]:
    from mavfi_cli.campaigns.run import Options
    from mavfi_cli.cli.progress import missions_view
    from mavfi_cli.studies.redundancy import RedundancyPlan, fly_and_report

    own = {"vehicles": vehicles, "choices": choices, "folder": out}
    plan = RedundancyPlan(**given_fields(RedundancyPlan, **own))
    with missions_view(quiet=quiet) as view:
        return fly_and_report(plan, overheads, Options(**given_fields(Options)), view)
