"""Golden run of a faulty run: the same mission without the fault."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

from mavfi_cli.core.files import writing
from mavfi_cli.mission.record.run_folder import Run, load_run
from mavfi_cli.mission.repetition import fly_to_end
from mavfi_cli.mission.replay import config_of, interrupted

FOLDER = "golden"


def kept_golden(run: Run) -> Run | None:
    """The golden pair that is kept in the run's folder; None if none was flown to its end."""
    folder = run.folder.path / FOLDER
    golden = load_run(folder) if folder.is_dir() else None
    return None if golden is None or interrupted(golden) else golden


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
    kept = run.folder.path / FOLDER
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
