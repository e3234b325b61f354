"""A process that has loaded everything once, and forks a fresh worker for every order.

    python -m mavfi_cli.core.fork_server FD MODULE

    client ──► server: loads MODULE, never works
                  ├─ guard: parent, watch and reaper of one worker
                  │     └─ worker: MODULE.perform(task, folder)
                  └─ guard ...

A worker is a fork of a process with a single thread that has done nothing but load. It dies with
its guard; when it ends, or its time runs out, the guard ends all that it has started and only then
reports. When the client closes the channel of an order, or dies, the guard ends the worker.
Whatever is killed, nothing goes on in secret and nobody waits for ever.

`multiprocessing` has a fork server too. There each child keeps the server's pipe open, so one that
hangs outlives a killed client; each child imports the client's main module again; nothing reaps
what a child leaves; and a daemonic process, as dask's workers are, may not use it.

FD is a socket to the client. Each packet on it is an order in JSON, {"task", "folder", "limit_s"},
with the descriptor of a channel on which the guard says {"pid"} at the begin and at the end
{"exit" | "signal" | "timeout", "report", "wall_s"}.
"""

from __future__ import annotations

import contextlib
import ctypes
import faulthandler
import functools
import gc
import importlib
import json
import math
import os
import resource
import select
import signal
import socket
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn, Protocol, cast

from mavfi_cli.core.errors import MavfiError
from mavfi_cli.core.files import open_own
from mavfi_cli.core.processes import PYTHON, fork

_PR_SET_PDEATHSIG, _PR_SET_NAME, _PR_SET_CHILD_SUBREAPER = 1, 15, 36
# What ps calls them.
SERVER, GUARD, WORKER = "mavfi-server", "mavfi-guard", "mavfi-worker"
ONE_THREAD = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "JE_ARROW_MALLOC_CONF": "background_thread:false",
}
"""Environment of a process that forks itself. Its libraries then start no threads."""

_prctl = ctypes.CDLL(None, use_errno=True).prctl
PACKET = 1 << 17  # bytes, of an order or a report
ERRORS, SCRATCH = "stderr.txt", "tmp"
_READY = b"ready"
_STOP_S = 10.0  # from the closing of the server until it is killed
_TRACEBACK = 8000  # characters of a traceback that are reported, the last ones
_LONGEST_WAIT_S = 3600.0


class _Module(Protocol):
    def prepare(self) -> None:
        """Load everything, once; starts no thread."""

    def perform(self, task: Mapping[str, Any], folder: Path) -> Path:
        """Do a task; the folder that it left, in `folder`."""


# The client's side --------------------------------------------------------------------------------


class ForkServer:
    """Starts workers that call a module's `perform`, and the server again if it was killed."""

    def __init__(self, module: str) -> None:
        self._module = module
        self._process: subprocess.Popen[bytes] | None = None
        self._control: socket.socket | None = None

    def start(self, task: Mapping[str, Any], folder: Path, limit_s: float) -> socket.socket:
        """Have a fresh worker do a task; the channel on which its guard reports.

        Args:
            folder: for what the worker leaves, its standard error and temporary files included.

        Raises:
            MavfiError: the server cannot be started.
        """
        order = json.dumps({"task": task, "folder": str(folder), "limit_s": limit_s}).encode()
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs, contextlib.ExitStack() as undo:
            undo.enter_context(ours)
            for _ in range(2):
                try:
                    socket.send_fds(self._running(), [order], [theirs.fileno()])
                except OSError:  # it was killed since
                    self.close()
                    continue
                undo.pop_all()
                return ours
        raise MavfiError("the process that forks the workers ends at once")

    def _running(self) -> socket.socket:
        if self._control is not None:
            return self._control
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            line = [*PYTHON, "-m", "mavfi_cli.core.fork_server", str(theirs.fileno())]
            self._process = subprocess.Popen(
                [*line, self._module],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                env={**os.environ, **ONE_THREAD},
                start_new_session=True,  # Ctrl-C is for the client
            )
        said = b""
        with contextlib.suppress(OSError):
            said = ours.recv(len(_READY))
        if said != _READY:
            ours.close()
            self._process.wait()
            raise MavfiError("the process that forks the workers could not start")
        self._control = ours
        return ours

    def close(self) -> None:
        """End the server; guards and workers end with their channels."""
        if self._control is None or self._process is None:
            return
        self._control.close()
        try:
            self._process.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._control = self._process = None


# The server ---------------------------------------------------------------------------------------


def _serve() -> NoReturn:
    """Load the module, then fork a guard for every order until the client closes its end."""
    _call_this_process(SERVER)
    control = socket.socket(fileno=int(sys.argv[1]))
    module = cast(_Module, importlib.import_module(sys.argv[2]))
    module.prepare()
    gc.collect()
    if (count := len(os.listdir("/proc/self/task"))) > 1:
        sys.exit(f"error: {count} threads where one is needed: a fork would lack the others")
    gc.freeze()  # the collector would touch, and so copy, every page that forks share
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for the guards
    control.send(_READY)
    while True:
        packet, channels, _, _ = socket.recv_fds(control, PACKET, 1)
        if not packet:
            os._exit(0)  # an orderly end would have native libraries complain of what is loaded
        fork(functools.partial(_guard, control, packet, channels[0], module))
        os.close(channels[0])


# The guard ----------------------------------------------------------------------------------------


def _guard(control: socket.socket, packet: bytes, descriptor: int, module: _Module) -> int:
    """The whole life of a guard; the server's socket is not for it."""
    control.close()
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    order, channel = json.loads(packet), socket.socket(fileno=descriptor)
    _call_this_process(GUARD)
    _request(_PR_SET_CHILD_SUBREAPER, 1)  # its descendants' orphans become its children
    begun_s, guard = time.monotonic(), os.getpid()
    reading, writing = os.pipe()

    def work() -> NoReturn:
        """Do the work in the fork, without the guard's ends of channels."""
        channel.close()
        os.close(reading)
        _work(order, module, guard, writing)

    worker = fork(work)
    os.close(writing)
    with contextlib.suppress(OSError):  # the client is gone: so will be the guard
        channel.send(json.dumps({"pid": worker}).encode())
        late = _await(worker, channel, begun_s + float(order["limit_s"]))
        _, status = os.waitpid(worker, 0)
        _end_children()
        told: dict[str, Any] = {"report": _last_words(reading)}
        if late:
            told["timeout"] = True
        elif os.WIFSIGNALED(status):
            told["signal"] = os.WTERMSIG(status)
        else:
            told["exit"] = os.WEXITSTATUS(status)
        told["wall_s"] = round(time.monotonic() - begun_s, 6)
        channel.send(json.dumps(told).encode())
    _end_children()
    return 0


def _await(worker: int, channel: socket.socket, deadline_s: float) -> bool:
    """Until the worker has ended; True where it was killed because its time ran out.

    Raises:
        ConnectionError: the client has closed the channel.
    """
    process = os.pidfd_open(worker)
    poller = select.poll()
    poller.register(process, select.POLLIN)
    poller.register(channel, select.POLLIN)
    late = False
    while True:
        left_s = math.inf if late else max(0.0, deadline_s - time.monotonic())
        ready = {descriptor for descriptor, _ in poller.poll(1e3 * min(left_s, _LONGEST_WAIT_S))}
        if channel.fileno() in ready:  # nothing is said meanwhile
            raise ConnectionError("the client has closed")
        if process in ready:
            return late
        if left_s <= 0.0:
            late = True
            os.kill(worker, signal.SIGKILL)


def _last_words(reading: int) -> Any:
    """The worker's report; None where it was ended before it had made a whole one."""
    with open(reading, "rb") as pipe:
        said = pipe.read()
    try:
        return json.loads(said)
    except ValueError:
        return None


# The worker ---------------------------------------------------------------------------------------


def _work(order: Mapping[str, Any], module: _Module, guard: int, writing: int) -> NoReturn:
    """The whole life of a worker, in a process group of its own."""
    code, report = 1, {}
    try:
        _call_this_process(WORKER)
        os.setsid()
        die_with(guard)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_DFL)
        folder = Path(order["folder"])
        _own_surroundings(folder)
        report = {"folder": module.perform(order["task"], folder).name}
        code = 0
    except MavfiError as error:
        report = {"error": type(error).__name__, "text": str(error)}
    except BaseException:  # the process boundary: the traceback goes to the client
        report = {"traceback": traceback.format_exc()[-_TRACEBACK:]}
    finally:
        with contextlib.suppress(OSError):
            os.write(writing, json.dumps(report).encode())
        os._exit(code)


def _own_surroundings(folder: Path) -> None:
    """Streams and temporary files of a worker of its own."""
    scratch = folder / SCRATCH
    scratch.mkdir(parents=True, exist_ok=True)
    os.environ["TMPDIR"] = tempfile.tempdir = str(scratch)
    nothing = os.open(os.devnull, os.O_RDWR)
    errors = open_own(folder / ERRORS, os.O_WRONLY | os.O_TRUNC)
    for stream, target in ((0, nothing), (1, nothing), (2, errors)):
        os.dup2(target, stream)
    for descriptor in (nothing, errors):
        os.close(descriptor)
    faulthandler.enable(sys.stderr)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


# Processes ----------------------------------------------------------------------------------------


def die_with(parent: int) -> None:
    """Have the kernel kill this process when its parent ends. Exit now if it has already ended."""
    _request(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)


def _call_this_process(name: str) -> None:
    """Set the name of this process in ps and top, at most 15 bytes."""
    _request(_PR_SET_NAME, ctypes.c_char_p(name.encode()))


def _request(option: int, value: int | ctypes.c_char_p) -> None:
    if _prctl(option, value, 0, 0, 0) != 0:
        code = ctypes.get_errno()
        raise OSError(code, os.strerror(code))


def _end_children() -> None:
    """Kill and reap every descendant of this process, which is their reaper.

    A killed child leaves its own children to us, so the loop ends when there are none.
    """
    while children := _children():
        for pid in children:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        for pid in children:
            with contextlib.suppress(ChildProcessError):
                os.waitpid(pid, 0)


def _children() -> list[int]:
    """Return the children of this process, which has one thread; none if Linux does not tell."""
    with contextlib.suppress(OSError):  # of a kernel without CONFIG_PROC_CHILDREN
        return [*map(int, Path("/proc/thread-self/children").read_text().split())]
    return []


if __name__ == "__main__":
    _serve()
