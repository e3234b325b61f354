"""Flies a recorded mission again, with its fault or as the golden run of the pair."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mavfi_cli.core.errors import Interrupted
from mavfi_cli.core.files import file_digest, writing
from mavfi_cli.fi.tracer.record import read
from mavfi_cli.mission.progress import Recorder, Watcher
from mavfi_cli.mission.record.run_folder import Run, load_run
from mavfi_cli.mission.replay import config_of
from mavfi_cli.mission.run import fly_mission
from mavfi_cli.spec.mission import MissionConfig

GOLDEN = "golden"  # folder of the golden run in the folder of its pair


def fly_again(
    run: Run,
    out: Path,
    *,
    with_fault: bool = True,
    recorder: Recorder | None = None,
    for_debugger: Callable[[int], None] | None = None,
) -> Run:
    """Repeat a run, or fly its golden run if `with_fault` is False.

    Args:
        out: Parent of the new run folder.
        recorder, for_debugger: As for `fly_mission`.

    Raises:
        RecordError: The run is not repeatable.
        Interrupted, MavfiError: As for `fly_to_end`.
    """
    config = config_of(run, with_fault=with_fault)
    repeat = read(run.folder.fault) if config.instruction is not None else None
    return fly_to_end(config, out, recorder=recorder, repeat=repeat, for_debugger=for_debugger)


def fly_to_end(config: MissionConfig, out: Path, **options: Any) -> Run:
    """Fly a mission that is of no use unless it is flown to its end.

    Args:
        options: As for `fly_mission`.

    Raises:
        Interrupted: The user ended it. Nothing of it is kept.
        MavfiError: As for `fly_mission`.
    """
    flown = load_run(fly_mission(config, out, Watcher(), **options).path)
    if flown.record.interrupted:
        shutil.rmtree(flown.folder.path)
        raise Interrupted("interrupted: the mission was not flown to its end")
    return flown


def watch_again(run: Run) -> tuple[Recorder, bool]:
    """Repeat a run to see what its nodes received. Nothing of the repetition is kept.

    Returns:
        Inputs of all nodes, and whether the repetition has the same trace, as it has unless the
        software or the machine differs.

    Raises:
        RecordError, Interrupted, MavfiError: As for `fly_again`.
    """
    recorder = Recorder()
    with tempfile.TemporaryDirectory(prefix="mavfi-again-") as scratch:
        again = fly_again(run, Path(scratch), recorder=recorder)
        same = file_digest(again.folder.trace) == file_digest(run.folder.trace)
    return recorder, same


def kept_golden(run: Run) -> Run | None:
    """The golden pair that is kept in the run's folder; None if none was flown to its end."""
    folder = run.folder.path / GOLDEN
    golden = load_run(folder) if folder.is_dir() else None
    return None if golden is None or golden.record.interrupted else golden


def paired_golden(run: Run, note: Callable[[str], None] = lambda _: None) -> Run:
    """Return the golden run of a run. It is flown once and kept in the run's folder.

    Args:
        run: Run with a fault.
        note: Callback with a message before the golden run is flown.

    Raises:
        RecordError: The run is not repeatable, or its folder cannot be written.
        Interrupted: The user ended the golden run. Nothing of it is kept.
    """
    config = config_of(run, with_fault=False)
    if (golden := kept_golden(run)) is not None:
        return golden
    kept = run.folder.path / GOLDEN
    note(f"flying the golden pair: {config.world}, seed {config.seed}")
    with (
        writing(kept),
        tempfile.TemporaryDirectory(dir=run.folder.path, prefix=".golden-") as parent,
    ):
        flown = fly_to_end(config, Path(parent))
        if kept.is_dir():
            shutil.rmtree(kept)
        shutil.move(flown.folder.path, kept)
    return load_run(kept)
