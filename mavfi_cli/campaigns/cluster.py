"""Workers of a campaign on dask.distributed, and the code that runs on their side.

Dask's workers import this module. Each thread of a dask worker keeps a worker of ours, so a dask
worker with n threads flies n missions at a time.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import queue
import shutil
import tempfile
import threading
import time
import uuid
import zlib
from collections.abc import Mapping
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from mavfi_cli.campaigns.specification import Keep
from mavfi_cli.campaigns.workers import TASK, AttemptEnd, CampaignStopped, LocalWorkers, Workers
from mavfi_cli.core.fork_server import SCRATCH
from mavfi_cli.core.installed import installed_versions, version_differences
from mavfi_cli.mission.run_folder import FAULT, RESULT

if TYPE_CHECKING:
    from distributed import Client, Future

CONNECT_S, WORKERS_S = 15.0, 60.0
_BACKLOG = 2  # missions queued for each thread, so that it never waits for us
_LOOK_S = 2.0  # interval between queries for the number of threads


class Cluster(Workers):
    """The workers of one scheduler.

    Args:
        address: address of the scheduler, such as tcp://host:8786.
        keep: the campaign's policy; other run folders are sent without their traces.
        task: the module that does the work.

    Raises:
        CampaignStopped: dask is not installed, the scheduler does not answer, no worker connects,
            or a worker has another version of something that results depend on.
    """

    def __init__(self, address: str, keep: Keep, task: str = TASK) -> None:
        self._keep, self._task = keep, task
        self._versions = installed_versions()
        self._token = uuid.uuid4().hex[:8]  # tells this run's results from others
        self._submitted = 0
        self._futures: dict[int, tuple[Future, Path]] = {}
        self._done: queue.SimpleQueue[int] = queue.SimpleQueue()
        self._threads, self._looked_s = 0, 0.0
        self._client = _connect(address)
        with contextlib.ExitStack() as undo:
            undo.callback(self._client.close)
            _require_workers(self._client, address, self._versions)
            undo.pop_all()

    @property
    def free(self) -> int:
        """Number of missions that may be sent now."""
        if time.monotonic() - self._looked_s > _LOOK_S:
            self._threads = sum(self._client.nthreads().values())
            self._looked_s = time.monotonic()
        return _BACKLOG * self._threads - len(self._futures)

    def start(self, number: int, changes: Mapping[str, Any], out: Path, limit_s: float) -> None:
        """Send a mission to the cluster."""
        self._submitted += 1
        future = self._client.submit(
            _fly, number, changes, limit_s, self._keep.value, self._task, self._versions,
            key=f"mission-{self._token}-{self._submitted}", pure=False, retries=0,
        )  # fmt: skip
        self._futures[number] = (future, out)
        future.add_done_callback(lambda _future: self._done.put(number))

    def wait(self, timeout_s: float) -> list[AttemptEnd]:
        """Wait for news or the time-out; return the missions that ended."""
        numbers = []
        with contextlib.suppress(queue.Empty):
            numbers.append(self._done.get(timeout=timeout_s))
            while True:
                numbers.append(self._done.get_nowait())
        return [self._taken(number) for number in numbers]

    def _taken(self, number: int) -> AttemptEnd:
        future, out = self._futures.pop(number)
        if future.status != "finished":
            return AttemptEnd(number=number, lost=f"lost by the cluster: {future.exception()}")
        answer = future.result()
        if isinstance(answer, str):
            raise CampaignStopped(f"a worker has other versions: {answer}")
        ended, files = answer
        for name, data in files.items():  # where the mission would have written them
            path = out / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(zlib.decompress(data))
        return AttemptEnd(**ended)

    def close(self) -> None:
        """Cancel missions that have not begun; results of missions in flight are dropped."""
        with contextlib.suppress(OSError, TimeoutError):  # the cluster may be gone
            self._client.cancel([future for future, _ in self._futures.values()])
        self._futures.clear()
        self._client.close()


def _connect(address: str) -> Client:
    try:
        from distributed import Client
    except ImportError:
        raise CampaignStopped(
            "--cluster needs dask.distributed: pip install 'mavfi[cluster]'"
        ) from None
    parts = urlsplit(address)
    try:
        usable = bool(parts.scheme and parts.hostname and parts.port)
    except ValueError:  # the port is not a number
        usable = False
    if not usable:  # dask would retry for half a minute, and then raise a traceback
        raise CampaignStopped(
            f"{address}: expected the scheduler's address, such as tcp://host:8786"
        )
    try:
        return Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        first = str(error).partition("\n")[0]
        raise CampaignStopped(f"no scheduler at {address}: {first}") from None


def _require_workers(client: Client, address: str, ours: Mapping[str, str]) -> None:
    """Require at least one worker, and our versions on all of them."""
    try:
        client.wait_for_workers(1, timeout=WORKERS_S)
    except TimeoutError:
        raise CampaignStopped(f"{address}: no worker within {WORKERS_S:g} s") from None
    told = client.run(_worker_versions, on_error="return")
    for worker, versions in sorted(told.items()):
        if not isinstance(versions, dict):
            raise CampaignStopped(f"worker {worker} cannot fly missions: {versions!r}")
        differing = version_differences(ours, versions)
        if differing:
            raise CampaignStopped(f"worker {worker} has other versions: {'; '.join(differing)}")


_SMALL = (RESULT, FAULT)  # files that the runner reads of a run folder that is not kept
_thread = threading.local()


@cache
def _worker_versions() -> dict[str, str]:
    """Versions on this worker that results depend on."""
    return installed_versions()


def _fly(
    number: int,
    changes: Mapping[str, Any],
    limit_s: float,
    keep: str,
    task: str,
    versions: Mapping[str, str],
) -> str | tuple[dict[str, Any], dict[str, bytes]]:
    """Fly a mission; run folders that the campaign does not keep are sent without their traces.

    Args:
        versions: those of the runner.

    Returns:
        Fields of its `AttemptEnd`, and its files, compressed, by path in its folder. Or how this
        worker's versions differ from the runner's; it then does not fly.
    """
    differing = version_differences(versions, _worker_versions())
    if differing:
        return "; ".join(differing)
    place = _scratch() / f"{number}-{threading.get_ident()}"
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir()
    (place / ".profiles").symlink_to(_scratch() / "profiles")
    try:
        workers = _workers(task)
        workers.start(number, changes, place, limit_s)
        ended: list[AttemptEnd] = []
        while not ended:
            ended = workers.wait(60.0)
        return asdict(ended[0]), _packed(place, number, Keep(keep))
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
    """A folder of this worker, until it ends; profiles of instruction-level faults stay in it."""
    folder = Path(tempfile.mkdtemp(prefix="mavfi-worker-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    (folder / "profiles").mkdir()
    return folder


def _packed(place: Path, number: int, keep: Keep) -> dict[str, bytes]:
    outcome = None
    for result in place.glob(f"[!.]*/{RESULT}"):
        outcome = json.loads(result.read_text(encoding="utf-8")).get("outcome")
    whole = keep.wants(number, outcome)
    return {
        str(path.relative_to(place)): zlib.compress(path.read_bytes(), 1)
        for path in sorted(place.glob("[!.]*/*")) + sorted(place.glob("[!.]*"))
        if path.is_file()
        and path.parent.name != SCRATCH
        and (whole or path.name in _SMALL or path.parent == place)
    }
