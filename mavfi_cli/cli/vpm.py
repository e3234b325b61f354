"""`mavfi vpm`: what redundant computers cost a vehicle in speed, time and energy."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource


class _Positive(click.FloatRange):
    """A number from a millionth to a million; click's own range lets "nan" through."""

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """As click does, and refuse NaN."""
        number = float(super().convert(value, param, ctx))
        return self.fail(f"{value} is not a number.", param, ctx) if number != number else number


_FLYING = ("worlds", "stack", "missions", "first_seed", "models", "train", "jobs", "quiet")
_ABOVE_ZERO = _Positive(min=1.0e-6, max=1.0e6)


@click.command()
@click.option("--vehicle", "vehicles", multiple=True, metavar="NAME|FILE",
              help="airsim, spark, cal20 or a TOML file; may be repeated  "
                   "[airsim, spark: the paper's Fig. 15].")  # fmt: skip
@click.option("--platform", metavar="NAME|FILE",
              help="Its latencies are the response time; its board flies  "
                   "[the vehicle's own].")  # fmt: skip
@click.option("--chain", type=click.Choice(["serial", "pipelined"]), default="serial",
              show_default=True,
              help="With --platform: its response time is the sum of its kernels' latencies, or "
                   "the slowest.")  # fmt: skip
@click.option("--board", metavar="NAME|FILE",
              help="Mass and power of a computer: a57, ncs, raspi3b, tx2, xavier or a TOML "
                   "file  [the platform's, or the vehicle's own].")  # fmt: skip
@click.option("--response", type=_ABOVE_ZERO, metavar="S", help="Response time of the computer, s.")
@click.option("--range", "range_", type=_ABOVE_ZERO, metavar="M", help="Sensing range, m.")
@click.option("--distance", type=_ABOVE_ZERO, default=50.0, show_default=True, metavar="M",
              help="Length of a mission, m.")  # fmt: skip
@click.option("--overhead", "overheads", multiple=True, metavar="DETECTOR=PERCENT|PATH",
              help="Compute overhead of gad or aad: per cent, or measured in the flights of a run "
                   "folder, a campaign or an evaluation  [--fly: in its own flights; else the "
                   "paper's Table V].")  # fmt: skip
@click.option("--fly", "fly", is_flag=True,
              help="Fly every row in JSBSim with its mass at its safe velocity, and put model and "
                   "flight side by side.")  # fmt: skip
@click.option("--world", "worlds", multiple=True, metavar="NAME|FILE",
              help="With --fly: where; may be repeated  [sparse, dense].")  # fmt: skip
@click.option("--stack", default="mavbench", show_default=True, metavar="NAME|FILE",
              help="With --fly: how the companion is wired.")  # fmt: skip
@click.option("--missions", type=click.IntRange(1, 100_000), default=10, show_default=True,
              help="With --fly: of each scheme in each world.")  # fmt: skip
@click.option("--first-seed", type=click.IntRange(0, 2**31 - 200_000), default=1,
              show_default=True, help="With --fly: seeds count up from here.")  # fmt: skip
@click.option("--models", type=click.Path(path_type=Path, file_okay=False, exists=True),
              help="With --fly: folder of detectors' models NAME.json  [the shipped].")  # fmt: skip
@click.option("--train", type=click.IntRange(min=0), default=0, metavar="FLIGHTS",
              help="With --fly: fit the detectors for each vehicle to so many error-free flights "
                   "of each training world at its safe velocity first  [0: none].")  # fmt: skip
@click.option("--jobs", type=click.IntRange(min=1),
              help="With --fly: missions at the same time  [one a core].")  # fmt: skip
@click.option("--quiet", is_flag=True, help="With --fly: no progress on stderr.")
@click.option("--out", type=click.Path(path_type=Path, file_okay=False),
              help="Folder for vpm.json, vpm.csv and pictures; with --fly also for the flights, "
                   "which are not flown again  [none; --fly: vpm].")  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print the report as JSON.")
@click.option("--csv", "as_csv", is_flag=True, help="Print a row a scheme as CSV.")
def vpm(
    vehicles: tuple[str, ...],
    out: Path | None,
    fly: bool,
    as_json: bool,
    as_csv: bool,
    **options: Any,
) -> None:
    """Safe velocity, flight time and energy with none, DMR, TMR, and detection and recovery.

    The F-1 visual performance model: a vehicle flies so fast that it stops within what it sees.
    A copy of the computer adds mass and power; detection and recovery adds compute time.
    """
    from mavfi_cli.core.config import require_distinct
    from mavfi_cli.core.files import plain
    from mavfi_cli.report.tables.model import model_csv, model_lines
    from mavfi_cli.report.tables.redundancy import redundancy_csv, redundancy_lines
    from mavfi_cli.vpm.report import report
    from mavfi_cli.vpm.schemes import schemes_with
    from mavfi_cli.vpm.vehicle import load_vehicle

    if as_json and as_csv:
        raise click.UsageError("--json or --csv, not both")
    if not fly:
        _refuse_unused()
    if options["models"] is not None and options["train"]:
        raise click.UsageError("--models or --train, not both")
    chosen = [load_vehicle(name) for name in vehicles or ("airsim", "spark")]
    require_distinct([vehicle.name for vehicle in chosen], "vehicle")
    choices = _choices(options)
    platform = choices.platform
    known = overheads(options["overheads"], None if platform is None else platform.name)
    told = report(chosen, choices, schemes_with(known))
    if fly:
        out = out or Path("vpm")
        told = _flown(chosen, known, choices, out, options)
    files = [] if out is None else _save(told, out)
    if as_json:
        click.echo(json.dumps(plain(told), indent=2, sort_keys=True))
    elif as_csv:
        click.echo(redundancy_csv(told["flights"]) if fly else model_csv(told), nl=False)
    else:
        lines = [*model_lines(told), *(redundancy_lines(told["flights"]) if fly else [])]
        if files:
            lines += ["", f"Files  {out}: {', '.join(files)}"]
        click.echo("\n".join(lines))


def overheads(texts: tuple[str, ...], platform: str | None = None) -> dict[str, tuple[float, str]]:
    """Per cent and source of each detector, as given or measured in flights; the last word counts.

    Args:
        platform: that is modelled; flights on others do not count. None: all count.

    Raises:
        click.UsageError: neither DETECTOR=PERCENT nor a path.
        RecordError: a path without flights with a detector on the platform.
    """
    found: dict[str, tuple[float, str]] = {}
    for text in texts:
        name, _, number = text.partition("=")
        if Path(text).exists():
            found |= _measured(text, platform)
            continue
        try:
            found[name.strip()] = float(number), "--overhead"
        except ValueError:
            raise click.UsageError(
                f"--overhead {text}: no such file or folder; for per cent write aad=0.0062"
            ) from None
    return found


def _measured(path: str, platform: str | None) -> dict[str, tuple[float, str]]:
    from mavfi_cli.analysis.overhead import recorded_overheads
    from mavfi_cli.vpm.schemes import DETECTORS

    known = recorded_overheads(Path(path), DETECTORS, platform)
    return {name: (100.0 * each.share, each.told(path)) for name, each in known.items()}


def _refuse_unused() -> None:
    """An option that would do nothing without --fly is a mistake: exit code 2."""
    context = click.get_current_context()
    for option in context.command.params:
        if option.name in _FLYING and _given(str(option.name)):
            raise click.UsageError(f"{option.opts[0]} needs --fly")
    if _given("chain") and not _given("platform"):
        raise click.UsageError("--chain needs --platform: it is how its latencies add up")
    if _given("chain") and _given("response"):
        raise click.UsageError("--chain or --response, not both: either is the response time")


def _given(name: str) -> bool:
    source = click.get_current_context().get_parameter_source(name)
    return source is ParameterSource.COMMANDLINE


def _flown(
    vehicles: list[Any],
    known: dict[str, tuple[float, str]],
    choices: Any,
    out: Path,
    options: dict[str, Any],
) -> dict[str, Any]:
    from mavfi_cli.campaign.run import Options
    from mavfi_cli.cli.missions_view import missions_view
    from mavfi_cli.studies.redundancy import fly_and_report
    from mavfi_cli.studies.redundancy_plan import WORLDS, RedundancyPlan

    plan = RedundancyPlan(
        vehicles=vehicles,
        choices=choices,
        worlds=options["worlds"] or WORLDS,
        missions=options["missions"],
        first_seed=options["first_seed"],
        folder=out,
        models=options["models"],
        train=options["train"],
        stack=options["stack"],
    )
    with missions_view(quiet=options["quiet"]) as view:
        return fly_and_report(plan, known, Options(jobs=options["jobs"] or 0), view)


def _choices(options: dict[str, Any]) -> Any:
    from mavfi_cli.mission.platform import load_platform
    from mavfi_cli.vpm.board import load_board
    from mavfi_cli.vpm.report import Choices

    platform, board = options["platform"], options["board"]
    return Choices(
        platform=None if platform is None else load_platform(platform),
        chain=options["chain"],
        board=None if board is None else load_board(board),
        response_s=options["response"],
        range_m=options["range_"],
        distance_m=options["distance"],
    )


def _save(told: dict[str, Any], out: Path) -> list[str]:
    """Write everything; the names of the files."""
    from mavfi_cli.core.errors import RecordError
    from mavfi_cli.core.files import write_json, write_text
    from mavfi_cli.report.flight_plot import write_flight_plot
    from mavfi_cli.report.redundancy_plot import write_redundancy_plot
    from mavfi_cli.report.roofline_plot import write_roofline_plot
    from mavfi_cli.report.tables.model import model_csv
    from mavfi_cli.report.tables.redundancy import redundancy_csv

    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordError(f"{out}: {error.strerror or error}") from None
    write_json(out / "vpm.json", told)
    write_text(out / "vpm.csv", model_csv(told))
    write_roofline_plot(told, out / "roofline.svg")
    write_redundancy_plot(told, out / "redundancy.svg")
    names = ["vpm.json", "vpm.csv", "roofline.svg", "redundancy.svg"]
    if "flights" in told:
        write_text(out / "flights.csv", redundancy_csv(told["flights"]))
        write_flight_plot(told, out / "flights.svg")
        names += ["flights.csv", "flights.svg"]
    return names
