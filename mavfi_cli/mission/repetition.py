"""Flies a recorded mission again."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mavfi_cli.core.errors import Interrupted
from mavfi_cli.core.files import file_digest
from mavfi_cli.fi.tracer.record import read
from mavfi_cli.mission.progress import Recorder, Watcher
from mavfi_cli.mission.record.run_folder import Run, load_run
from mavfi_cli.mission.replay import config_of, interrupted
from mavfi_cli.mission.run import fly_mission
from mavfi_cli.spec.mission import MissionConfig


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
    if interrupted(flown):
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
