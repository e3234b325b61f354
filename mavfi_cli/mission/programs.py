"""Starts the programs of a user's companion, and ends them however the mission ends.

A worker of the fork server runs one program: it starts the program, stores its output, restarts it
according to its rule, and then keeps running, because the program's children may outlive it. Its
guard kills the worker and all descendants of the program when the mission ends, is killed, or
closes the program.

The worker reports by appending lines of JSON to a file: {"started": PID}, {"ended": CODE}, where a
negative code is a signal, and {"ready": true}. The mission reads them.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import select
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, NoReturn

from mavfi_cli.core.errors import MavfiError
from mavfi_cli.core.files import ScratchFolder, open_own, own_folder
from mavfi_cli.core.fork_server import HALT, PACKET, ForkServer, die_with, users_environment
from mavfi_cli.core.processes import Ended

_EVENTS = "events.jsonl"
_STREAMS = ("stdout", "stderr")
_MOST_BYTES = 16 << 20  # kept per stream; the rest is read and dropped
_CHUNK, _LOOK_S = 1 << 16, 0.05
_MOST_LINE = 4096  # bytes of a line that are searched for readiness
_TAIL, _MOST_WORDS = 8192, 200  # bytes of stderr that are read for the last line; its length
_LONGEST_S = 1e6
_GRACE_S = 2.0  # time to end after SIGTERM
_PERIOD_S = 0.02  # cycle of running and stopping a slowed program


# The mission's side -------------------------------------------------------------------------------


class Programs:
    """The running programs of one companion. `close` ends them and all of their descendants.

    Args:
        folder: Folder for the outputs of the programs, with one subfolder per program.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._scratch = ScratchFolder("companion")
        self._server = ForkServer(__name__)
        self._running: dict[str, RunningProgram] = {}

    def start(self, name: str, task: Mapping[str, Any]) -> RunningProgram:
        """Start a program.

        Args:
            name: Name of the program, and of the subfolder for its outputs.
            task: As for `perform`, but without "out", which is set here.

        Raises:
            MavfiError: The program cannot be started.
        """
        place = own_folder(self._folder / name).resolve()
        own = self._scratch.path / name
        channel = self._server.start({**task, "out": str(place)}, own, _LONGEST_S)
        program = self._running[name] = RunningProgram(name, place, channel, own / HALT)
        return program

    def close(self) -> None:
        """Ask the programs to end, then kill those that remain. Safe to call more than once."""
        for program in self._running.values():
            program.terminate()
        deadline_s = time.monotonic() + _GRACE_S
        for program in self._running.values():
            while program.poll() and program.pid is not None and time.monotonic() < deadline_s:
                time.sleep(_LOOK_S)
            program.close()
        self._running.clear()
        self._server.close()
        self._scratch.close()


class RunningProgram:
    """A started program. Its attributes hold the state that its worker last reported.

    Attributes:
        pid: Id of the program's process, which leads a process group; None while it does not run.
        codes: Exit codes of the program's earlier processes; -N if signal N killed a process.
        starts: Number of times that the program has been started.
        ready: True once a line of its stdout has matched "ready_line".
        throttle: What slows the program down, if its `share` is below 1.
    """

    throttle: Throttle | None = None

    def __init__(self, name: str, folder: Path, channel: socket.socket, halt: Path) -> None:
        self.name, self._halt, self._stderr = name, halt, folder / "stderr"
        self.pid: int | None = None
        self.codes: list[int] = []
        self.starts = 0
        self.ready = False
        self._channel, self._rest = channel, b""
        self._events = open(open_own(folder / _EVENTS, os.O_RDONLY), "rb")  # noqa: SIM115

    def poll(self) -> bool:
        """Read the worker's new reports. Return False if the worker itself has ended."""
        *lines, self._rest = (self._rest + self._events.read()).split(b"\n")
        for line in lines:
            event = json.loads(line)
            if "started" in event:
                self.pid, self.starts = int(event["started"]), self.starts + 1
            elif "ended" in event:
                self.pid = None
                self.codes.append(int(event["ended"]))
            self.ready = self.ready or "ready" in event
        poller = select.poll()
        poller.register(self._channel, 0)
        return not poller.poll(0)

    def failure(self) -> str:
        """Return why the worker ended. Call it only after `poll` has returned False."""
        while packet := self._channel.recv(PACKET):
            if report := (json.loads(packet).get("report") or {}):
                return str(report.get("text") or report.get("traceback"))
        return "its process was killed"

    def last_words(self) -> str:
        """Return the last line, of at most 200 characters, that the program wrote to stderr.

        The string is empty if it wrote none.
        """
        with open(open_own(self._stderr, os.O_RDONLY), "rb") as file:
            file.seek(max(0, os.fstat(file.fileno()).st_size - _TAIL))
            lines = Ended.last_lines(file.read(_TAIL), 1)
        return lines[0][:_MOST_WORDS] if lines else ""

    def signal(self, number: int, *, group: bool = False) -> bool:
        """Send signal `number` to the program's process, or to its process group.

        Return False if the program is not running.
        """
        self.poll()
        if self.pid is None:
            return False
        try:
            (os.killpg if group else os.kill)(self.pid, number)
        except ProcessLookupError:
            return False
        return True

    def process(self, executable: str | None) -> int | None:
        """Return the id of the first process of the program that runs a given executable.

        Return None if no such process exists.

        Args:
            executable: File name of the executable, or of the script that an interpreter runs. If
                None, the id of the program's own process is returned, which leads the session.
        """
        self.poll()
        if self.pid is None or executable is None:
            return self.pid
        for pid in sorted(int(name) for name in os.listdir("/proc") if name.isdigit()):
            with contextlib.suppress(OSError):  # it has ended, or is another user's
                if os.getsid(pid) != self.pid:
                    continue
                line = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
                name, *words = map(os.fsdecode, line)
                script = next((word for word in words if not word.startswith("-")), "")
                files = [name, script]
                with contextlib.suppress(PermissionError):  # it forbids to trace it
                    files.append(os.readlink(f"/proc/{pid}/exe"))
                if executable in [Path(file).name for file in files]:
                    return pid
        return None

    def terminate(self) -> None:
        """Resume the program if it is stopped, and ask it to end (SIGTERM). It does not restart."""
        self._halt.touch()
        for number in (signal.SIGCONT, signal.SIGTERM):
            self.signal(number, group=True)

    def close(self) -> None:
        """Kill the program and all of its descendants."""
        self._channel.close()
        self._events.close()


class Throttle(threading.Thread):
    """Slows a program down: lets it run for a share of every 20 ms, and stops it for the rest.

    The signals go to the program's process group.

    Attributes:
        share: Share of the time for which the program runs, from 0 (stopped) to 1.
    """

    def __init__(self, program: RunningProgram, share: float) -> None:
        super().__init__(daemon=True)
        self._program, self.share = program, share
        self._over = threading.Event()
        self.start()

    def run(self) -> None:
        """Alternately resume and stop the program until `end`."""
        while not self._over.is_set():
            share = self.share
            if share > 0.0:
                self._signal(signal.SIGCONT)
                self._over.wait(share * _PERIOD_S)
            if share < 1.0:
                self._signal(signal.SIGSTOP)
                self._over.wait((1.0 - share) * _PERIOD_S)
        self._signal(signal.SIGCONT)

    def _signal(self, number: int) -> None:
        pid = self._program.pid
        if pid is not None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(pid, number)

    def end(self) -> None:
        """Stop throttling, so that the program runs freely."""
        self._over.set()
        self.join()


# The worker's side --------------------------------------------------------------------------------


def prepare() -> None:
    """Load nothing: the fork server calls this first, but a worker needs no further modules."""


def perform(task: Mapping[str, Any], folder: Path) -> NoReturn:
    """Run a program, and restart it according to its rule, until the guard kills this process.

    Args:
        task: "argv", "folder", "environment", "restart", "restart_s" and "ready_line", as in
            `ProgramConfig`; "out", the folder for stdout, stderr and the reports.
        folder: Folder of this worker. Once it has a file HALT, the program is not restarted.
    """
    out = Path(task["out"])
    events = open_own(out / _EVENTS, os.O_WRONLY | os.O_APPEND)

    def report(**event: Any) -> None:
        os.write(events, json.dumps(event).encode() + b"\n")

    with contextlib.ExitStack() as undo:
        kept = {name: _Kept(undo, out / name) for name in _STREAMS}
        while True:
            code = _run(task, kept, report)
            report(ended=code)
            if not (task["restart"] == "always" or (task["restart"] == "on-failure" and code)):
                break
            _pump(kept, report, None, time.monotonic() + float(task["restart_s"]))
            if (folder / HALT).exists():
                break
        _pump(kept, report, None, time.monotonic() + _LONGEST_S)
    raise MavfiError("the flight exceeded the time limit for its programs")


class _Kept:
    """The file of one output stream, of which it keeps the first _MOST_BYTES bytes."""

    def __init__(self, undo: contextlib.ExitStack, path: Path) -> None:
        self._file: BinaryIO = undo.enter_context(
            open(open_own(path, os.O_WRONLY | os.O_TRUNC), "wb")  # noqa: SIM115
        )
        self._left = _MOST_BYTES
        self.pipes: list[int] = []

    def write(self, data: bytes) -> None:
        kept, self._left = data[: self._left], max(0, self._left - len(data))
        if kept:
            self._file.write(kept)
            self._file.flush()
            if not self._left:
                self._file.write(b"\n[mavfi keeps no more of this output]\n")
                self._file.flush()


class _Ready:
    """Searches a program's stdout for the line that signals its readiness."""

    def __init__(self, pattern: str | None) -> None:
        self._pattern = None if pattern is None else re.compile(pattern.encode())
        self._line = b""

    def appears_in(self, data: bytes) -> bool:
        if self._pattern is None:
            return False
        *lines, rest = (self._line + data).split(b"\n")
        self._line = rest[-_MOST_LINE:]
        if any(self._pattern.search(line) for line in (*lines, rest)):
            self._pattern = None
            return True
        return False


def _run(task: Mapping[str, Any], kept: Mapping[str, _Kept], report: Any) -> int:
    """Start the program, store its output until it ends, and return its exit code."""
    usual = {"PYTHONUNBUFFERED": "1", **users_environment()}
    try:
        process = subprocess.Popen(
            task["argv"], cwd=task["folder"], env={**usual, **task["environment"]},
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            start_new_session=True, preexec_fn=partial(die_with, os.getpid()),
        )  # fmt: skip
    except OSError as error:
        raise MavfiError(f"cannot run {task['argv'][0]}: {error.strerror}") from None
    report(started=process.pid)
    for name in _STREAMS:
        pipe = getattr(process, name)
        os.set_blocking(pipe.fileno(), False)
        kept[name].pipes.append(os.dup(pipe.fileno()))
        pipe.close()
    _pump(kept, report, _Ready(task["ready_line"]), time.monotonic() + _LONGEST_S, process)
    return process.wait()


def _pump(
    kept: Mapping[str, _Kept],
    report: Any,
    ready: _Ready | None,
    until_s: float,
    process: subprocess.Popen[bytes] | None = None,
) -> None:
    """Store the program's outputs and report its readiness.

    Return once `process` has ended, or at the monotonic time `until_s`.
    """
    ended = None if process is None else os.pidfd_open(process.pid)
    try:
        while (left_s := until_s - time.monotonic()) > 0.0:
            poller = select.poll()
            for descriptor in _open_pipes(kept):
                poller.register(descriptor, select.POLLIN)
            if ended is not None:
                poller.register(ended, select.POLLIN)
            events = [number for number, _ in poller.poll(1e3 * min(left_s, 3600.0))]
            for name, output in kept.items():
                for pipe in [pipe for pipe in output.pipes if pipe in events]:
                    data = _read(pipe, output)
                    output.write(data)
                    if ready is not None and name == "stdout" and ready.appears_in(data):
                        report(ready=True)
            if ended in events:
                return
    finally:
        if ended is not None:
            os.close(ended)


def _open_pipes(kept: Mapping[str, _Kept]) -> Iterator[int]:
    for output in kept.values():
        yield from output.pipes


def _read(pipe: int, output: _Kept) -> bytes:
    """Return the bytes that wait in a pipe, which may be none. At end of file, close the pipe."""
    with contextlib.suppress(BlockingIOError):
        if data := os.read(pipe, _CHUNK):
            return data
        output.pipes.remove(pipe)
        os.close(pipe)
    return b""
