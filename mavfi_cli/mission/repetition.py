"""Flies a recorded mission again."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

from mavfi_cli.core.errors import Interrupted
from mavfi_cli.core.files import file_digest
from mavfi_cli.fi.tracer.record import read
from mavfi_cli.mission.progress import Recorder, Watcher
from mavfi_cli.mission.record.run_folder import Run, load_run
from mavfi_cli.mission.replay import config_of, interrupted
from mavfi_cli.mission.run import fly_mission


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
        MavfiError: As for `fly_mission`.
    """
    config = config_of(run, with_fault=with_fault)
    repeat = read(run.folder.fault) if config.instruction is not None else None
    flown = fly_mission(
        config, out, Watcher(), recorder=recorder, repeat=repeat, for_debugger=for_debugger
    )
    return load_run(flown.path)


def watch_again(run: Run) -> tuple[Recorder, bool]:
    """Repeat a run to see what its nodes received. Nothing of the repetition is kept.

    Returns:
        Inputs of all nodes, and whether the repetition has the same trace, as it has unless the
        software or the machine differs.

    Raises:
        RecordError: The run is not repeatable.
        Interrupted: The user ended the repetition.
        MavfiError: As for `fly_mission`.
    """
    recorder = Recorder()
    with tempfile.TemporaryDirectory(prefix="mavfi-again-") as scratch:
        again = fly_again(run, Path(scratch), recorder=recorder)
        if interrupted(again):
            raise Interrupted("interrupted: the repetition was not flown to its end")
        same = file_digest(again.folder.trace) == file_digest(run.folder.trace)
    return recorder, same
