"""`mavfi kernels` without a program: our own kernels."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from mavfi_cli.campaign.kernels.runs import KernelRuns, Plan
    from mavfi_cli.fi.native.fault import FaultModel


def run_own_kernels(options: dict[str, Any], model: FaultModel) -> None:
    """Attack the chosen kernels, write what belongs in the folder, print the table."""
    from mavfi_cli.campaign.kernels.catalogue import select
    from mavfi_cli.campaign.kernels.runs import run_kernels
    from mavfi_cli.campaign.kernels.summary import summarise, table
    from mavfi_cli.cli.runs_view import runs_view
    from mavfi_cli.fi.sampling import strategy

    strategy(options["sampling"], model, compat=options["compat"])  # says now what is wrong
    kernels = select(options["kernel"])
    with _folder(options["out"]) as folder:
        plan = _plan(options, tuple(kernel.name for kernel in kernels), model, folder)
        with runs_view(plan.kernels, plan.runs) as view:
            campaign = run_kernels(
                plan, jobs=options["jobs"], folder=folder, progress=view.show, stage=view.stage
            )
        summary = summarise(plan, campaign)
        if options["out"] is not None:
            _save(folder, summary, campaign)
    if options["as_json"]:
        click.echo(json.dumps(summary, indent=2))
        return
    click.echo(table(summary))
    if options["out"] is not None:
        click.echo(f"\nFiles  {folder}: kernels.json, kernels.csv, kernels.svg, runs.jsonl")


@contextlib.contextmanager
def _folder(out: Path | None) -> Iterator[Path]:
    if out is not None:
        yield out
        return
    with tempfile.TemporaryDirectory(prefix="mavfi-kernels-") as scratch:
        yield Path(scratch)


def _plan(
    options: dict[str, Any], kernels: tuple[str, ...], model: FaultModel, folder: Path
) -> Plan:
    from mavfi_cli.campaign.kernels.recorder import inputs_of_flight
    from mavfi_cli.campaign.kernels.runs import Plan
    from mavfi_cli.mission.config import MissionConfig

    # Check, planner and tracker are attacked with the parameters of `hardened`.
    config = MissionConfig(world=options["world"], seed=options["world_seed"], stack="hardened")
    click.echo(f"inputs: world {config.world}, seed {config.seed}", err=True)
    path, flight, sha256 = inputs_of_flight(config, folder)
    return Plan(
        kernels=kernels,
        runs=options["runs"],
        seed=options["seed"],
        inputs=path,
        inputs_sha256=sha256,
        flight=flight,
        rule=options["sampling"],
        compat=options["compat"],
        model=model,
        windows=options["windows"],
        tolerance=options["tolerance"],
        null=options["null"],
    )


def _save(folder: Path, summary: dict[str, Any], campaign: list[KernelRuns]) -> None:
    from mavfi_cli.campaign.kernels.summary import csv_rows
    from mavfi_cli.core.files import write_json, write_text
    from mavfi_cli.report.kernel_plot import write_kernel_plot

    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(csv_rows(campaign))
    write_text(folder / "kernels.csv", text.getvalue())
    write_json(folder / "kernels.json", summary)
    write_kernel_plot(summary, folder / "kernels.svg")


def replay_folder(folder: Path, kernels: tuple[str, ...], runs: int) -> bool:
    """Repeat recorded runs and say which came out differently; True where none did."""
    from mavfi_cli.campaign.kernels.replay import replay_runs

    equal = total = 0
    for result in replay_runs(folder, kernels, runs):
        total += 1
        equal += not result.differs
        if result.differs:
            click.echo(f"{result.kernel} {result.run}: differs in {', '.join(result.differs)}")
    click.echo(f"{equal} of {total} replays identical")
    return equal == total
