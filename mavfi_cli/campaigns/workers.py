"""Flies missions on this machine or on dask.distributed, and judges how they ended.

Dask workers import this module. Every thread of a dask worker keeps one local worker, so a dask
worker with n threads runs n flights at a time.
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import selectors
import shutil
import signal
import socket
import threading
import time
import uuid
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from mavfi_cli.campaigns.cluster_keys import security
from mavfi_cli.campaigns.missions import Changes, ResultState
from mavfi_cli.campaigns.specification import Keep
from mavfi_cli.core.errors import Interrupted, MavfiError, RecordError
from mavfi_cli.core.files import Json, ScratchFolder, inflate, own_folder, write_atomically
from mavfi_cli.core.fork_server import ERRORS, HALT, PACKET, SCRATCH, ForkServer
from mavfi_cli.core.installed import installed_versions, version_differences
from mavfi_cli.core.types import Outcome
from mavfi_cli.mission.measures import FlightRecord
from mavfi_cli.mission.run_folder import FAULT, RESULT, RunFolder
from mavfi_cli.spec.fault import PROCESS
from mavfi_cli.spec.mission import MissionConfig

if TYPE_CHECKING:
    from distributed import Client, Future


class CampaignStopped(MavfiError):
    """A problem that affects more than one mission, such as a full disk, stopped the campaign."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AttemptResult:
    """How an attempt at a mission counts, judged from the way in which it ended.

    Attributes:
        state: the state to store for the mission; None if something outside the mission ended the
            attempt, so that it does not count.
        result: the mission's record; empty if there is none.
        reason: the reason for the outcome, or why there is no outcome.
        run: the attempt's run folder; None if there is none.
        doubtful: true if something outside the mission may have affected the record.
    """

    state: ResultState | None
    result: Json
    reason: str
    run: Path | None = None
    doubtful: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class AttemptEnd:
    """How the process of one attempt at a mission ended.

    Attributes:
        exit: exit code of the mission's process; None if it did not exit by itself.
        signal: signal that killed the process; None after a time-out, or if its guard was killed
            too.
        timeout: true if the mission exceeded its limit of wall time.
        report: the last message of the mission's process, with its run folder, an error and its
            text, or a traceback.
        lost: the reason to give if the exit code, the signal and the time-out are all unknown.
        unforked: why the mission could not be forked from its shared flight; otherwise empty.
        wall_s: wall time of the whole attempt, including the guard's work, in seconds.
    """

    number: int
    exit: int | None = None
    signal: int | None = None
    timeout: bool = False
    report: Mapping[str, str] | None = None
    lost: str = "its guard was killed"
    unforked: str = ""
    wall_s: float = 0.0

    def judge(self, out: Path, config: MissionConfig, limit_s: float) -> AttemptResult:
        """Decide how the attempt counts, from the way in which it ended.

        Args:
            out: the attempt's own folder.
            config: configuration of the mission.
            limit_s: wall time limit of the mission, in seconds.

        Raises:
            CampaignStopped: the machine cannot fly any mission, for example because the disk is
                full.
        """
        report = self.report or {}
        if self.exit == 0 and "folder" in report:
            return _recorded(out / report["folder"], config)
        if shutil.disk_usage(out if out.is_dir() else out.parent).free < FULL_BYTES:
            raise CampaignStopped(f"{out.parent}: the disk is full; free space and run again")
        if "error" in report:
            return _refused(report["error"], report["text"])
        if self.timeout:
            reason = f"no end within {limit_s:g} s of wall time"
            return _cut_off(Outcome.HANG, reason, out, config)
        if self.signal is None and self.exit is None:
            return AttemptResult(state=None, result={}, reason=self.lost)
        if self.signal is not None:
            name = signal.Signals(self.signal).name
            if self.signal in _FROM_OUTSIDE:
                return AttemptResult(state=None, result={}, reason=f"killed by {name}")
            return _cut_off(Outcome.CRASH, f"the companion was killed by {name}", out, config)
        if "traceback" in report:  # our own defect; the ledger shows where
            reason = report["traceback"].rstrip()
            return AttemptResult(state=ResultState.ERROR, result={}, reason=reason)
        return _cut_off(Outcome.CRASH, f"the companion ended with code {self.exit}", out, config)


TASK = "mavfi_cli.campaigns.task"
_STOP_S = 10.0  # time after which a worker with a closed channel counts as ended


Attempt = tuple[int, Changes, Path]  # mission number, changes, the attempt's own folder


class LocalWorkers:
    """Runs up to `jobs` flights at a time, in processes on this machine."""

    def __init__(self, jobs: int, module: str = TASK) -> None:
        self._jobs = jobs
        self._server = ForkServer(module)
        self._selector = selectors.DefaultSelector()
        self._flying: dict[socket.socket, list[int]] = {}  # missions still running, by channel
        self._shared: dict[socket.socket, Path] = {}  # folders of shared flights

    @property
    def free(self) -> int:
        """Number of flights that can start now."""
        return self._jobs - len(self._flying)

    @property
    def flights(self) -> int:
        """Number of flights that have not ended, including those whose missions have all ended."""
        return len(self._flying)

    def start(self, attempts: Sequence[Attempt], limit_s: float, alone: str = "") -> None:
        """Start a flight for one mission, or one flight that several missions share.

        Args:
            attempts: the missions, each with its changed fields and the attempt's own folder.
            limit_s: wall time limit of each mission, in seconds.
            alone: why the mission does not share a flight, for its record; may be empty.

        Raises:
            MavfiError: the processes cannot be started.
        """
        missions = [(number, changes, str(out)) for number, changes, out in attempts]
        task = {"missions": missions, "limit_s": limit_s, "alone": alone}
        folder = attempts[0][2]
        if len(attempts) == 1:
            channel = self._server.start(task, folder, limit_s)
        else:
            folder = folder.with_name(f"{folder.name}-shared")
            all_s = limit_s * (len(attempts) + 1)
            channel = self._server.start(task, folder, all_s, forks=True)
            self._shared[channel] = folder
        self._selector.register(channel, selectors.EVENT_READ)
        self._flying[channel] = [number for number, _, _ in attempts]

    def halt(self) -> None:
        """Stop shared flights from forking further missions."""
        for folder in self._shared.values():
            with contextlib.suppress(OSError):
                (folder / HALT).touch()

    def wait(self, timeout_s: float) -> list[AttemptEnd]:
        """Wait until a guard reports or `timeout_s` has passed. Return the attempts that ended."""
        ended = []
        for selected, _ in self._selector.select(timeout_s):
            channel = selected.fileobj
            assert isinstance(channel, socket.socket)
            message = dict(_next_message(channel) or {})
            flying = self._flying[channel]
            if (number := message.pop("key", None)) is not None:
                flying.remove(number)
                ended.append(AttemptEnd(number=number, **message))
            elif "pid" not in message:  # not the message about the worker's start
                if channel in self._shared:
                    reason = _end_of_flight(message)
                    ended += [AttemptEnd(number=number, unforked=reason) for number in flying]
                else:
                    ended.append(AttemptEnd(number=flying[0], **message))
                self._release(channel)
        return ended

    def _release(self, channel: socket.socket) -> None:
        self._selector.unregister(channel)
        del self._flying[channel]
        if (folder := self._shared.pop(channel, None)) is not None:
            shutil.rmtree(folder, ignore_errors=True)
        channel.close()

    def close(self) -> None:
        """Kill all running missions and wait until they have ended."""
        for channel in self._flying:
            channel.shutdown(socket.SHUT_WR)  # the guard ends its worker, and then itself
        for channel in list(self._flying):
            channel.settimeout(_STOP_S)
            while _next_message(channel) is not None:
                pass
            self._release(channel)
        self._server.close()
        self._selector.close()


def _end_of_flight(message: Mapping[str, Any]) -> str:
    """Describe why a shared flight ended before it had forked all its missions."""
    report = message.get("report") or {}
    if "signal" in message:
        return f"their flight was killed by {signal.Signals(message['signal']).name}"
    if "timeout" in message:
        return "their flight did not end in time"
    text = report.get("text") or report.get("traceback", "").rstrip().rpartition("\n")[2]
    if text.startswith(SystemExit.__name__):  # the usual end of a shared flight
        return text.partition(": ")[2] or "their flight ended early"
    return f"their flight failed: {text}" if text else "their flight ended early"


def _next_message(channel: socket.socket) -> Mapping[str, Any] | None:
    """Return a guard's next message, or None if the guard has died or does not send one in time."""
    with contextlib.suppress(OSError):
        if packet := channel.recv(PACKET):
            message: dict[str, Any] = json.loads(packet)
            return message
    return None


# What the end of an attempt means --------------------------------------------------------------

FULL_BYTES = 16 << 20  # with less free space a disk counts as full
# Signals from outside the mission; a fault can only make a process die from others.
_FROM_OUTSIDE = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT)
_OUTSIDE_WORDS = tuple(f"killed by {number.name}" for number in _FROM_OUTSIDE)
# Errors that the machine may have caused, so that another attempt may succeed.
_BY_CHANCE = ("VehicleProcessError", "LinkLost", "NoAutopilot", "TargetError")
# Errors that every other mission would have too.
_OF_THE_MACHINE = ("RecordError", "TracingForbidden", "BuildMismatch")


def _recorded(run: Path, config: MissionConfig) -> AttemptResult:
    try:
        result = json.loads((run / "result.json").read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise RecordError(f"{run}: {error}") from None
    flight = FlightRecord.of(result)
    outcome, reason = flight.outcome, flight.reason
    if outcome == Outcome.INTERRUPTED.value:
        return AttemptResult(state=None, result={}, reason="interrupted")
    crashes = [crash.how for node in flight.nodes.values() for crash in node.crashes]
    if config.link is None:  # no fault in the companion can kill the simulated vehicle
        if outcome == Outcome.LINK_LOST.value and reason.endswith(_OUTSIDE_WORDS):
            return AttemptResult(state=None, result={}, reason=reason)
        if flight.referee is None:
            reason = "the vehicle died before it had saved the truth"
            return AttemptResult(state=None, result={}, reason=reason)
    fault = flight.state_fault
    # A process fault kills its node, and the programs of a user's companion may end each other.
    by_fault = config.companion is not None or (fault is not None and fault.stage == PROCESS)
    doubtful = not by_fault and any(how.endswith(_OUTSIDE_WORDS) for how in crashes)
    return AttemptResult(
        state=ResultState.FLOWN, result=result, reason=reason, run=run, doubtful=doubtful
    )


def _refused(kind: str, text: str) -> AttemptResult:
    if kind in _OF_THE_MACHINE:
        raise CampaignStopped(text)
    if kind == Interrupted.__name__:
        return AttemptResult(state=None, result={}, reason="interrupted")
    if kind in _BY_CHANCE and text.endswith(_OUTSIDE_WORDS):
        return AttemptResult(state=None, result={}, reason=text)
    doubtful = kind in _BY_CHANCE
    return AttemptResult(state=ResultState.ERROR, result={}, reason=text, doubtful=doubtful)


def _cut_off(outcome: Outcome, reason: str, out: Path, config: MissionConfig) -> AttemptResult:
    """Return how a mission counts whose process ended before it wrote its record."""
    runs = [path for path in out.glob("[!.]*/") if path.name != SCRATCH]
    run = runs[0] if len(runs) == 1 else None
    fault = None
    if run is not None and (written := RunFolder(run).fault).is_file():
        fault = json.loads(written.read_text(encoding="utf-8"))
    if run is not None and (errors := out / ERRORS).is_file() and errors.stat().st_size:
        errors.replace(run / ERRORS)
    planned = config.fault or config.instruction
    result = {
        "schema": 1,
        "outcome": outcome.value,
        "reason": reason,
        "config": config.to_dict(),
        "seeds": {"root": config.seed, "fault": planned.seed if planned else None},
        "quality_of_flight": {},
        "fault": fault,
    }
    return AttemptResult(state=ResultState.FLOWN, result=result, reason=reason, run=run)


# On dask.distributed --------------------------------------------------------------------------

CONNECT_S, WORKERS_S = 15.0, 60.0
_BACKLOG = 2  # missions queued for each thread, so that it never waits for us
_LARGEST_FILE = 1 << 30  # largest file of a run folder, bytes
_LOOK_S = 2.0  # interval between queries for the number of threads


class Cluster:
    """Flies missions on the workers of one dask scheduler.

    Args:
        address: address of the scheduler, such as tls://host:8786.
        keep: policy that selects the run folders to keep. Workers send the other run folders
            without traces.
        keys: folder with the keys of the cluster; required for tls://.

    Raises:
        CampaignStopped: dask is not installed, the scheduler does not answer, no worker connects,
            or the version of a component that affects results differs on a worker.
        ConfigError: the keys are invalid.
    """

    def __init__(
        self, address: str, keep: Keep, task: str = TASK, keys: Path | None = None
    ) -> None:
        self._keep, self._task = keep, task
        self._versions = installed_versions()
        self._token = uuid.uuid4().hex[:8]  # distinguishes this run's results from others
        self._submitted = 0
        self._futures: dict[int, tuple[Future, dict[int, Path]]] = {}  # by flight
        self._done: queue.SimpleQueue[int] = queue.SimpleQueue()
        self._threads, self._looked_s = 0, 0.0
        self._client = _connect(address, keys)
        with contextlib.ExitStack() as undo:
            undo.callback(self._client.close)
            _require_workers(self._client, address, self._versions)
            undo.pop_all()

    @property
    def free(self) -> int:
        """Number of flights that can be sent now. Negative if the cluster has lost threads."""
        if time.monotonic() - self._looked_s > _LOOK_S:
            self._threads = sum(self._client.nthreads().values())
            self._looked_s = time.monotonic()
        return _BACKLOG * self._threads - len(self._futures)

    @property
    def flights(self) -> int:
        """Number of flights that have not ended."""
        return len(self._futures)

    def start(self, attempts: Sequence[Attempt], limit_s: float, alone: str = "") -> None:
        """Send a flight to the cluster. The arguments are those of `LocalWorkers.start`."""
        self._submitted += 1
        missions = [(number, changes) for number, changes, _ in attempts]
        future = self._client.submit(
            _fly, missions, limit_s, alone, self._keep.value, self._task, self._versions,
            key=f"mission-{self._token}-{self._submitted}", pure=False, retries=0,
        )  # fmt: skip
        outs = {number: out for number, _, out in attempts}
        self._futures[self._submitted] = future, outs
        future.add_done_callback(partial(_put, self._done, self._submitted))

    def halt(self) -> None:
        """Do nothing, because flights on the cluster always fly all their missions."""

    def wait(self, timeout_s: float) -> list[AttemptEnd]:
        """Wait until a flight ends or `timeout_s` has passed. Return the attempts that ended."""
        flights = []
        with contextlib.suppress(queue.Empty):
            flights.append(self._done.get(timeout=timeout_s))
            while True:
                flights.append(self._done.get_nowait())
        return [ended for flight in flights for ended in self._taken(flight)]

    def _taken(self, flight: int) -> list[AttemptEnd]:
        future, outs = self._futures.pop(flight)
        if future.status != "finished":
            lost = f"lost by the cluster: {future.exception()}"
            return [AttemptEnd(number=number, lost=lost) for number in outs]
        answer = future.result()
        if isinstance(answer, str):
            raise CampaignStopped(f"a worker's versions differ from those here: {answer}")
        return [_unpacked(ended, files, outs[ended.number]) for ended, files in answer]

    def close(self) -> None:
        """Cancel the missions that have not begun, and disconnect from the cluster.

        The results of missions in flight are discarded.
        """
        with contextlib.suppress(OSError, TimeoutError):  # the cluster may be gone
            self._client.cancel([future for future, _ in self._futures.values()])
        self._futures.clear()
        self._client.close()


def _put(done: queue.SimpleQueue[int], flight: int, _future: Future) -> None:
    done.put(flight)


def _unpacked(ended: AttemptEnd, files: Mapping[str, bytes], out: Path) -> AttemptEnd:
    """Write the files that a worker sent into the attempt's folder, as a local mission would.

    Return how the attempt ended; it is lost if the path of a file lies outside that folder.
    """
    for name, data in files.items():
        path = out / name
        if ".." in Path(name).parts or not path.is_relative_to(out):
            return AttemptEnd(number=ended.number, lost=f"a worker sent the file {name!r}")
        write = partial(_write, inflate(data, _LARGEST_FILE))
        write_atomically(own_folder(path.parent) / path.name, write)
    return ended


def _write(data: bytes, file: BinaryIO) -> None:
    file.write(data)


def _connect(address: str, keys: Path | None) -> Client:
    try:
        from distributed import Client
    except ImportError:
        raise CampaignStopped(
            "--cluster needs dask.distributed: pip install 'mavfi[cluster]'"
        ) from None
    secure = {} if keys is None else {"security": security(keys)}
    try:
        return Client(address, timeout=CONNECT_S, set_as_default=False, **secure)
    except (OSError, ValueError, TimeoutError) as error:
        first = str(error).partition("\n")[0]
        secured = "" if keys is None else f" with the keys in {keys}"
        text = f"cannot connect to a scheduler at {address}{secured}: {first}"
        raise CampaignStopped(text) from None


def _require_workers(client: Client, address: str, ours: Mapping[str, str]) -> None:
    try:
        client.wait_for_workers(1, timeout=WORKERS_S)
    except TimeoutError:
        raise CampaignStopped(f"{address}: no worker connected within {WORKERS_S:g} s") from None
    answers = client.run(_worker_versions, on_error="return")
    for worker, versions in sorted(answers.items()):
        if not isinstance(versions, dict):
            raise CampaignStopped(f"worker {worker} cannot fly missions: {versions!r}")
        differing = version_differences(ours, versions)
        if differing:
            raise CampaignStopped(
                f"the versions of worker {worker} differ from those here: {'; '.join(differing)}"
            )


_SMALL = (RESULT, FAULT)  # files that the runner reads from a run folder that is not kept
_thread = threading.local()


@cache
def _worker_versions() -> dict[str, str]:
    return installed_versions()


def _fly(
    missions: Sequence[tuple[int, Changes]],
    limit_s: float,
    alone: str,
    keep: str,
    task: str,
    versions: Mapping[str, str],
) -> str | list[tuple[AttemptEnd, dict[str, bytes]]]:
    """Fly one mission, or several that share a flight, on a worker of the cluster.

    Run folders that the campaign does not keep are sent without their traces.

    Args:
        versions: versions on the machine that runs the campaign.

    Returns:
        For each mission, how it ended, and its compressed files keyed by their paths relative to
        its folder. If this worker's versions differ, nothing is flown, and the result is a text
        that lists the differences.
    """
    differing = version_differences(versions, _worker_versions())
    if differing:
        return "; ".join(differing)
    place = _scratch().path / str(threading.get_ident())
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir()
    attempts = [(number, changes, place / str(number)) for number, changes in missions]
    for _, _, out in attempts:
        out.mkdir()
        (out / ".profiles").symlink_to(_scratch().path / "profiles")
    try:
        workers = _workers(task)
        workers.start(attempts, limit_s, alone)
        ended: list[AttemptEnd] = []
        while len(ended) < len(attempts):
            ended += workers.wait(60.0)
        return [(end, _packed(place / str(end.number), end.number, Keep(keep))) for end in ended]
    finally:
        shutil.rmtree(place, ignore_errors=True)


def _workers(task: str) -> LocalWorkers:
    kept: dict[str, LocalWorkers] = _thread.__dict__.setdefault("workers", {})
    if task not in kept:
        kept[task] = LocalWorkers(1, task)
    return kept[task]


@cache
def _scratch() -> ScratchFolder:
    """Return this worker's scratch folder, with a subfolder for instruction-level profiles."""
    folder = ScratchFolder("worker")
    (folder.path / "profiles").mkdir()
    return folder


def _packed(place: Path, number: int, keep: Keep) -> dict[str, bytes]:
    outcome = None
    for result in place.glob(f"[!.]*/{RESULT}"):
        outcome = json.loads(result.read_text(encoding="utf-8")).get("outcome")
    whole = keep.wants(number, outcome)
    return {
        str(path.relative_to(place)): zlib.compress(path.read_bytes(), 1)
        for path in _files(place)
        if whole or path.name in _SMALL or path.parent == place
    }


def _files(place: Path) -> Iterator[Path]:
    """Yield the regular files of an attempt, except those in its scratch or hidden folders."""
    for folder, folders, files in os.walk(place):
        folders[:] = sorted(n for n in folders if n != SCRATCH and not n.startswith("."))
        paths = (Path(folder, name) for name in sorted(files))
        yield from (path for path in paths if path.is_file() and not path.is_symlink())
