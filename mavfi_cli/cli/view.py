"""`mavfi view`: look at a recorded run in rerun or Foxglove."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

from mavfi_cli.cli.grouped import GroupedCommand, option
from mavfi_cli.cli.types import RunPath
from mavfi_cli.core.errors import RecordError
from mavfi_cli.core.files import reading
from mavfi_cli.core.option_types import OutFile
from mavfi_cli.core.terminal import echo, note

if TYPE_CHECKING:
    from mavfi_cli.mission.progress import Recorder
    from mavfi_cli.mission.run_folder import Run


@click.command(cls=GroupedCommand)
@click.argument("run", type=RunPath())
@option("--save", metavar="FILE", type=OutFile((".rrd", ".mcap")),
        help="Write a file instead of opening a window: .rrd for rerun, .mcap for "
             "Foxglove.")  # fmt: skip
@option("--layout", metavar="FILE.json", type=OutFile((".json",)),
        help="With --save FILE.mcap: also write a layout that Foxglove imports.")  # fmt: skip
@option("--json", "as_json", is_flag=True,
        help="With --save: print the file and its flights as JSON.")  # fmt: skip
def view(run: Path, save: Path | None, layout: Path | None, as_json: bool) -> None:
    """Show RUN, a run folder, in rerun: world, camera, map, plans, path and all states over time.

    The mission is flown again, because depth frames, clouds and maps are not in the record. A
    flight with a fault is shown together with its golden flight, which is flown once and kept.
    """
    from mavfi_cli.mission.run_folder import load_run
    from mavfi_cli.report import view as viewers
    from mavfi_cli.report.view.entries import ViewedFlight

    if as_json and save is None:
        raise click.UsageError("--json needs --save FILE")
    if layout is not None and (save is None or save.suffix.lower() != ".mcap"):
        raise click.UsageError("--layout needs --save FILE.mcap")
    recorded = load_run(run)
    viewers.require_viewer(save)
    golden = _golden(recorded) if recorded.record.fault else None
    named = {"golden": golden, "faulty": recorded} if golden else {"flight": recorded}
    flights = [
        ViewedFlight(name=name, run=flown, recorder=_again(flown)) for name, flown in named.items()
    ]
    with reading(recorded.folder.path):
        viewers.save(flights, save)
    if as_json:
        summary = [
            {"name": flight.name, "run": str(flight.run.folder.path),
             "outcome": flight.run.record.outcome, "frames": flight.recorder is not None}
            for flight in flights
        ]  # fmt: skip
        echo(json.dumps({"file": str(save), "flights": summary}, indent=2))
    elif save is not None:
        echo(str(save))
    if layout is not None:
        from mavfi_cli.report.view.mcap_file import write_layout

        write_layout(flights, layout)
        if not as_json:
            echo(str(layout))


def _golden(run: Run) -> Run | None:
    """Return the golden flight of a run with a fault, or None if it cannot be flown.

    The golden flight is flown if it is not there yet.
    """
    from mavfi_cli.mission.run import paired_golden

    try:
        return paired_golden(run, note)
    except RecordError as error:
        note(f"the golden flight is not shown: {error}")
        return None


def _again(run: Run) -> Recorder | None:
    """Fly a run again and return its depth frames, clouds and maps, or None if it cannot repeat."""
    from mavfi_cli.mission.run import watch_again

    try:
        config = run.mission()
        note(f"flying again: {config.world}, seed {config.seed}")
        recorder, same = watch_again(run)
    except RecordError as error:
        remedy = "" if run.record.config.get("companion") else "; `mavfi fly --record` keeps them"
        note(f"no depth frames, clouds and maps: {error}{remedy}")
        return None
    if not same:
        note(f"warning: {run.folder.path}: the repetition differs: depth frames, clouds and maps "
              "are those of the repetition")  # fmt: skip
    return recorder
