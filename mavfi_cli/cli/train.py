"""`mavfi train`: fly error-free missions, store their data set, and fit the detectors."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from mavfi_cli.cli import types
from mavfi_cli.cli.grouped import GroupedCommand, given_fields, given_options, option, refuse_given
from mavfi_cli.core.terminal import echo

_FLYING = {"worlds", "flights", "first_seed", "autopilot", "firmware", "jobs", "speed"}
_LOG = click.Path(path_type=Path, exists=True, dir_okay=False)


@click.command(cls=GroupedCommand)
@option("--out", type=types.OUT, default=Path("training"),
        help="Folder for flights, data set and models.")  # fmt: skip
@option("--stack", type=types.STACK, default="mavbench", metavar="NAME|FILE",
        help="Stack to fly and to fit models for; `mavfi stacks` lists them.")  # fmt: skip
@option("--world", "worlds", multiple=True, type=types.WORLD, metavar="NAME|FILE",
        help="World; may be repeated  [the paper's four: two densities, two sizes].")  # fmt: skip
@option("--flights", type=types.MISSIONS, default=25, help="Flights per world.")
@option("--first-seed", default=10_000, type=types.FIRST_SEED,
        help="Seed of the first flight; each further flight adds 1.")  # fmt: skip
@option("--autopilot", type=types.AUTOPILOT, default="ours", metavar="ours|px4|ardupilot",
        help="Autopilot that flies the missions.")  # fmt: skip
@option("--firmware", metavar="PATH",
        help="SITL binary of px4 or ardupilot  [$PX4_SITL or $ARDUCOPTER_SITL].")  # fmt: skip
@option("--flown", type=click.Path(path_type=Path, exists=True, file_okay=False),
        help="Do not fly; fit to the error-free flights among the run folders in this folder. Any "
             "autopilot may have flown them.")  # fmt: skip
@option("--companion", metavar="FILE|CMD",
        help="Fly your own companion, and fit models for its gate. With --from, name the "
             "companion that flew.")  # fmt: skip
@option("--speed", default=1.0,
        help="Pace of the vehicle with --companion, in times real time.")  # fmt: skip
@option("--from", "log", type=_LOG,
        help="Do not fly; fit to this .tlog of a fault-free flight of your own companion and to "
             "those that follow it.")  # fmt: skip
@click.argument("more", nargs=-1, type=_LOG)
@option("--kind", "kinds", multiple=True, type=types.DETECTOR,
        help="Detector to fit: gad, aad, range, l2. May be repeated  [all].")  # fmt: skip
@option("--n-sigma", type=types.ABOVE_ZERO, help="Threshold of the Gaussian model  [its default].")
@option("--seed", default=1, type=types.SEED,
        help="Seed of the split and of the autoencoder's initial weights.")  # fmt: skip
@option("--jobs", type=types.JOBS, help="Number of parallel missions  [one per core].")
@option("--json", "as_json", is_flag=True, help="Print the provenance of the models as JSON.")
@option("--quiet", is_flag=True, help="No progress on stderr.")
def train(out: Path, as_json: bool, quiet: bool, **options: Any) -> None:
    """Fly error-free missions and fit the detectors to them.

    The same command resumes an interrupted training. Fitting the autoencoder needs torch:
    pip install 'mavfi[train]'.
    """
    from mavfi_cli.campaigns.run import Options
    from mavfi_cli.cli.progress import missions_view
    from mavfi_cli.report.detectors import draw_loss_curve
    from mavfi_cli.report.drawing import write_figure
    from mavfi_cli.spec.mission import OWN_AUTOPILOT, MissionConfig
    from mavfi_cli.studies.train import TrainingPlan
    from mavfi_cli.studies.train import train as run

    flown, stack = options["flown"], options["stack"]
    if options["autopilot"] == OWN_AUTOPILOT:
        refuse_given({"firmware"}, "needs --autopilot px4 or ardupilot")
    logs = tuple(filter(None, (options["log"], *options["more"])))
    if flown is not None:
        refuse_given(_FLYING, "has no effect with --flown")
    if logs:
        refuse_given(_FLYING | {"flown"}, "has no effect with --from")
        if options["log"] is None:
            raise click.UsageError(f"{logs[0]}: the first log file must follow --from")
    if options["companion"] and flown is None and not logs and "worlds" not in given_options():
        raise click.UsageError("--companion needs --world")
    if not options["companion"]:
        refuse_given({"speed"}, "needs --companion")
    if logs or options["companion"]:
        stack = "a companion"
    base = MissionConfig(**given_fields(MissionConfig, seed=MissionConfig().seed))
    plan = TrainingPlan(**given_fields(TrainingPlan, base=base, logs=logs))
    with missions_view(quiet=quiet) as view:
        dataset, models, left = run(plan, out, Options(**given_fields(Options)), view)
    if "aad" in models:
        model, _ = models["aad"]
        write_figure(draw_loss_curve(model.provenance["loss_curve"]["rows"]), out / "loss.svg")
    if as_json:
        provenance = {kind: dict(model.provenance) for kind, (model, _) in models.items()}
        echo(json.dumps(provenance, indent=2))
        return
    failed = f"{left} flights failed and are left out"
    left_out = failed if flown is None else f"left out: {left}"
    samples = sum(len(flight.deltas) for flight in dataset.flights)
    echo(
        f"Data set    {len(dataset)} flights of {stack}, {samples} samples"
        + (f"; {left_out}" if left else "")
    )
    for kind, (model, path) in models.items():
        echo(f"{kind:<11} threshold {model.provenance['threshold']:.6g}  {path}")
    files = ["dataset.parquet", *(["loss.svg"] if "aad" in models else [])]
    echo(f"\nFiles  {out}: {', '.join(files)}")
