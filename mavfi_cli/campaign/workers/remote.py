"""The worker's side of a campaign on a cluster: one mission in a fresh process, results packed.

Workers of dask.distributed import this module, which does not use dask itself. Each thread of a
dask worker keeps a worker of ours, so a dask worker with n threads flies n missions at a time.
"""

from __future__ import annotations

import json
import shutil
import tempfile
import threading
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from mavfi_cli.campaign.keep import Keep
from mavfi_cli.campaign.workers.base import Assignment, AttemptEnd
from mavfi_cli.campaign.workers.local import LocalWorkers
from mavfi_cli.core.fork_server import SCRATCH
from mavfi_cli.mission.record.run_folder import FAULT, RESULT
from mavfi_cli.mission.replay import version_differences
from mavfi_cli.mission.run import installed_versions

_SMALL = (RESULT, FAULT)  # files that the runner reads of a run folder that is not kept
_thread = threading.local()


@dataclass(frozen=True, slots=True, kw_only=True)
class Order:
    """One mission for a worker."""

    number: int
    changes: Mapping[str, Any]
    limit_s: float
    keep: str
    task: str
    versions: Mapping[str, str]  # versions of the runner


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """A worker's answer to an order.

    Attributes:
        refused: how this worker's versions differ from the runner's; it then does not fly.
        ended: how the mission ended; None if it was refused.
        files: its files, compressed, by path in its folder.
    """

    refused: str = ""
    ended: Mapping[str, Any] | None = None
    files: Mapping[str, bytes] = field(default_factory=dict)


@cache
def worker_versions() -> dict[str, str]:
    """Versions on this worker that results depend on."""
    return installed_versions()


def fly(order: Order) -> Answer:
    """Fly a mission; run folders that the campaign does not keep are sent without their traces."""
    differing = version_differences(order.versions, worker_versions())
    if differing:
        return Answer(refused="; ".join(differing))
    place = _scratch() / f"{order.number}-{threading.get_ident()}"
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir()
    (place / ".profiles").symlink_to(_scratch() / "profiles")
    try:
        workers = _workers(order.task)
        mission = Assignment(number=order.number, changes=order.changes, out=str(place))
        workers.start(mission, order.limit_s)
        ended: list[AttemptEnd] = []
        while not ended:
            ended = workers.wait(60.0)
        return Answer(ended=asdict(ended[0]), files=_packed(place, order))
    finally:
        shutil.rmtree(place, ignore_errors=True)


def _workers(task: str) -> LocalWorkers:
    """The workers of this thread, one mission at a time."""
    kept: dict[str, LocalWorkers] = _thread.__dict__.setdefault("workers", {})
    if task not in kept:
        kept[task] = LocalWorkers(1, task)
    return kept[task]


@cache
def _scratch() -> Path:
    """A folder of this worker; profiles of instruction-level faults stay in it."""
    folder = Path(tempfile.mkdtemp(prefix="mavfi-worker-"))
    (folder / "profiles").mkdir()
    return folder


def _packed(place: Path, order: Order) -> dict[str, bytes]:
    outcome = None
    for result in place.glob(f"[!.]*/{RESULT}"):
        outcome = json.loads(result.read_text(encoding="utf-8")).get("outcome")
    whole = Keep(order.keep).wants(order.number, outcome)
    return {
        str(path.relative_to(place)): zlib.compress(path.read_bytes(), 1)
        for path in sorted(place.glob("[!.]*/*")) + sorted(place.glob("[!.]*"))
        if path.is_file()
        and path.parent.name != SCRATCH
        and (whole or path.name in _SMALL or path.parent == place)
    }


def unpack(files: Mapping[str, bytes], out: Path) -> None:
    """Write a worker's files where the mission would have written them."""
    for name, data in files.items():
        path = out / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(zlib.decompress(data))
