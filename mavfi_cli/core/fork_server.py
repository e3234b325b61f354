"""A server process that loads everything once and forks a fresh worker for every request.

    python -m mavfi_cli.core.fork_server FD MODULE

    client ──► server: loads MODULE, performs no task
                  ├─ guard: parent, watch and reaper of one worker
                  │     └─ worker: MODULE.perform(task, folder)
                  └─ guard ...

A worker is forked from a single-threaded process that has only loaded modules. It dies with its
guard. When the worker ends or its time runs out, the guard kills every process that the worker
started, and only then reports. When the client dies or closes a request's channel, the guard kills
the worker.
Killing any process leaves no orphan and no blocked peer.

The fork server of `multiprocessing` is not suitable: its children keep the server's pipe open, so a
child that hangs outlives a killed client; every child imports the client's main module again;
nothing reaps the processes that a child leaves behind; and daemonic processes, such as dask's
workers, may not use it.

FD is a socket to the client. Every packet on it is a JSON request, {"task", "folder", "limit_s",
"forks", "cwd"}, with the descriptor of a channel. The worker runs in the client's working directory
"cwd". The guard sends {"pid"} on this channel at the start, and {"exit" | "signal" | "timeout",
"report", "wall_s"} at the end. A worker whose request sets "forks" may fork itself in the middle of
its task (`Forks`). The worker waits for its fork as a guard does, and sends the same message with
the fork's {"key"}, or {"key", "unforked"} with the reason why it could not fork.
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
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn, Protocol, cast

from mavfi_cli.core.errors import MavfiError
from mavfi_cli.core.files import Json, open_own, writing
from mavfi_cli.core.processes import PYTHON, fork

_PR_SET_PDEATHSIG, _PR_SET_NAME, _PR_SET_CHILD_SUBREAPER = 1, 15, 36
# Process names in ps.
SERVER, GUARD, WORKER = "mavfi-server", "mavfi-guard", "mavfi-worker"
ONE_THREAD = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "JE_ARROW_MALLOC_CONF": "background_thread:false",
}
"""Environment of a process that forks itself, so that its libraries start no threads."""

_USERS = "MAVFI_USERS_ENVIRONMENT"  # the user's own values of these variables, as JSON

_prctl = ctypes.CDLL(None, use_errno=True).prctl
PACKET = 1 << 17  # largest request or report, bytes
ERRORS, SCRATCH = "stderr.txt", "tmp"
HALT = "halt"  # file in a worker's folder that stops it from forking itself again
_READY = b"ready"
_STOP_S = 10.0  # time for the server to end after `close`, before it is killed
_TRACEBACK = 8000  # trailing characters of a traceback that are reported
_LONGEST_WAIT_S = 3600.0


class _Module(Protocol):
    def prepare(self) -> None:
        """Load everything that tasks need, without starting a thread.

        The server calls it once, before it forks.
        """

    def perform(self, task: Mapping[str, Any], folder: Path) -> Path:
        """Perform a task in a worker. Return the folder with the results, created in `folder`.

        If the request allows the worker to fork itself, there is a further argument, `forks`, which
        is a `Forks`. In a fork of the worker, the folder is created in the fork's own folder.
        """


# The client's side --------------------------------------------------------------------------------


class ForkServer:
    """Client of a fork server, which starts worker processes that call `perform` of a module.

    The server is started with the first worker, and restarted if it was killed.

    Args:
        module: Name of the module.
    """

    def __init__(self, module: str) -> None:
        self._module = module
        self._process: subprocess.Popen[bytes] | None = None
        self._control: socket.socket | None = None

    def start(
        self, task: Mapping[str, Any], folder: Path, limit_s: float, *, forks: bool = False
    ) -> socket.socket:
        """Start a worker for a task. Return the socket on which its guard reports how it ended.

        The module's docstring describes the messages. Closing the socket ends the worker.

        Args:
            folder: receives the worker's results, standard error and temporary files.
            limit_s: limit of the worker's wall time, in seconds, after which it is killed.
            forks: whether the worker may fork itself. It then reports the ends of its forks too.

        Raises:
            MavfiError: the server cannot be started, or the folder cannot be created.
        """
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
        parts = {"task": task, "folder": str(folder), "limit_s": limit_s, "forks": forks}
        order = json.dumps({**parts, "cwd": os.getcwd()}).encode()
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs, contextlib.ExitStack() as undo:
            undo.enter_context(ours)
            for _ in range(2):
                try:
                    socket.send_fds(self._running(), [order], [theirs.fileno()])
                except OSError:  # the server was killed
                    self.close()
                    continue
                undo.pop_all()
                return ours
        raise MavfiError(
            "cannot start a worker: the process that forks the workers ended twice before it "
            "received the task"
        )

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
                env=_forking_environment(),
                start_new_session=True,  # Ctrl-C is for the client
            )
        answer = b""
        with contextlib.suppress(OSError):
            answer = ours.recv(len(_READY))
        if answer != _READY:
            ours.close()
            self._process.wait()
            raise MavfiError("the process that forks the workers could not start")
        self._control = ours
        return ours

    def close(self) -> None:
        """End the server process. Safe to call more than once.

        Guards and workers go on until the sockets that `start` returned are closed.
        """
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
    """Run the server: load the module, then fork a guard for each request of the client.

    The server ends when the client closes its end of the socket.
    """
    _call_this_process(SERVER)
    control = socket.socket(fileno=int(sys.argv[1]))
    gc.disable()  # imports leave few cycles, and collections took an eighth of the time
    module = cast(_Module, importlib.import_module(sys.argv[2]))
    module.prepare()
    gc.enable()
    gc.collect()
    if (count := len(os.listdir("/proc/self/task"))) > 1:
        sys.exit(f"error: must have one thread to fork, got {count}")
    gc.freeze()  # a collection would write to, and so copy, every page that forks share
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # guards need no wait()
    control.send(_READY)
    while True:
        packet, channels, _, _ = socket.recv_fds(control, PACKET, 1)
        if not packet:
            os._exit(0)  # on an orderly exit native libraries print warnings
        fork(functools.partial(_guard, control, packet, channels[0], module))
        os.close(channels[0])


# The guard ----------------------------------------------------------------------------------------


def _guard(control: socket.socket, packet: bytes, descriptor: int, module: _Module) -> int:
    """Run a guard process: fork a worker, wait for it, and report how it ended.

    Args:
        control: the server's socket to the client, which the guard closes.
        packet: the client's request as JSON.
        descriptor: descriptor of the channel on which to report.
    """
    control.close()
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    order, channel = json.loads(packet), socket.socket(fileno=descriptor)
    _call_this_process(GUARD)
    _request(_PR_SET_CHILD_SUBREAPER, 1)  # orphaned descendants become its children
    begun_s, guard = time.monotonic(), os.getpid()
    reading, writing = os.pipe()

    def work() -> NoReturn:
        """Run the worker: close the ends of the channels that only the guard needs, and work."""
        os.close(reading)
        forks = None
        if order["forks"]:
            forks = Forks(Path(order["folder"]), channel, writing)
        else:
            channel.close()
        _work(order, module, guard, writing, forks)

    worker = fork(work)
    os.close(writing)
    with contextlib.suppress(OSError):  # the client is gone, so the guard ends too
        channel.send(json.dumps({"pid": worker}).encode())
        end = _end_of(worker, reading, channel, begun_s + float(order["limit_s"]))
        end["wall_s"] = round(time.monotonic() - begun_s, 6)
        channel.send(json.dumps(end).encode())
    _end_children()
    return 0


def _end_of(
    worker: int,
    reading: int,
    channel: socket.socket,
    deadline_s: float,
    others: Sequence[int] = (),
) -> Json:
    """Wait until a worker has ended, and kill its descendants. Return how it ended, and its report.

    The result has the keys of the guard's last message, without `wall_s`.

    Args:
        reading: read end of the pipe that carries the worker's report.
        deadline_s: time on the monotonic clock at which the worker is killed.
        others: children of this process that do not belong to the worker, and are not killed.

    Raises:
        ConnectionError: the client closed the channel.
    """
    late = _await(worker, channel, deadline_s)
    _, status = os.waitpid(worker, 0)
    _end_children(others)
    end: Json = {"report": _report_of_worker(reading)}
    if late:
        end["timeout"] = True
    elif os.WIFSIGNALED(status):
        end["signal"] = os.WTERMSIG(status)
    else:
        end["exit"] = os.WEXITSTATUS(status)
    return end


def _await(worker: int, channel: socket.socket, deadline_s: float) -> bool:
    """Wait until the worker has ended. Return True if it was killed at its deadline.

    Raises:
        ConnectionError: the client closed the channel.
    """
    process = os.pidfd_open(worker)
    poller = select.poll()
    poller.register(process, select.POLLIN)
    poller.register(channel, select.POLLIN)
    late = False
    try:
        while True:
            left_s = math.inf if late else max(0.0, deadline_s - time.monotonic())
            ready = {ended for ended, _ in poller.poll(1e3 * min(left_s, _LONGEST_WAIT_S))}
            if channel.fileno() in ready:  # a client sends nothing, so it has closed the channel
                raise ConnectionError("the client closed the channel")
            if process in ready:
                return late
            if left_s <= 0.0:
                late = True
                os.kill(worker, signal.SIGKILL)
    finally:
        os.close(process)


def _report_of_worker(reading: int) -> Any:
    """Return the worker's report, or None if it ended before the report was complete."""
    with open(reading, "rb") as pipe:
        text = pipe.read()
    try:
        return json.loads(text)
    except ValueError:
        return None


# The worker ---------------------------------------------------------------------------------------


def _work(
    order: Mapping[str, Any], module: _Module, guard: int, writing: int, forks: Forks | None
) -> NoReturn:
    """Run the worker: perform the task, report the result or the error, and exit.

    A fork of the worker ends here, too.
    """
    code, report = 1, {}
    try:
        _call_this_process(WORKER)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_DFL)
        os.chdir(order["cwd"])
        folder = Path(order["folder"])
        _begin(folder, guard)
        task = order["task"]
        allowed = {"forks": forks} if forks else {}
        report = {"folder": module.perform(task, folder, **allowed).name}
        code = 0
    except MavfiError as error:
        report = {"error": type(error).__name__, "text": str(error)}
    except BaseException:  # the process boundary; the client gets the traceback
        report = {"traceback": traceback.format_exc()[-_TRACEBACK:]}
    finally:
        with contextlib.suppress(OSError):
            os.write(writing, json.dumps(report).encode())
        os._exit(code)


class Forks:
    """Lets a worker fork itself in the middle of its task, so that several tasks share a beginning.

    The worker waits while its fork runs, so only one process runs at a time, but both use memory.

    Args:
        folder: folder of the worker.
        channel: channel to the client.
        report: write end of the pipe that carries the worker's report.
    """

    def __init__(self, folder: Path, channel: socket.socket, report: int) -> None:
        self._halt, self._channel, self._report = folder / HALT, channel, report
        self._since_s = time.monotonic()

    def fork(self, key: int, folder: Path, limit_s: float) -> bool:
        """Fork the worker. Return True in the fork, and False in the worker after the fork's end.

        The fork ends by returning from `perform`. The method returns False without a fork if the
        file HALT exists in the worker's folder, or if the system has no memory or process left. In
        the latter case the client gets a message with the reason.

        Args:
            key: identifies the fork in the message to the client about its end. The message also
                gives the wall time since the end of the previous fork.
            folder: receives the fork's results, standard error and temporary files.
            limit_s: limit of the fork's wall time, in seconds, after which it is killed.
        """
        if self._halt.exists():
            return False
        worker = os.getpid()
        _request(_PR_SET_CHILD_SUBREAPER, 1)
        deadline_s = time.monotonic() + limit_s
        reading, writing = os.pipe()
        others = _children()
        try:
            child = fork(None)
        except OSError as error:
            for descriptor in (reading, writing):
                os.close(descriptor)
            self._send({"key": key, "unforked": f"cannot fork: {error.strerror}"})
            return False
        if not child:
            os.dup2(writing, self._report)
            for descriptor in (reading, writing, self._channel.detach()):
                os.close(descriptor)
            _begin(folder, worker)
            return True
        os.close(writing)
        end = _end_of(child, reading, self._channel, deadline_s, others)
        now_s = time.monotonic()
        end |= {"key": key, "wall_s": round(now_s - self._since_s, 6)}
        self._since_s = now_s
        self._send(end)
        return False

    def _send(self, message: Json) -> None:
        self._channel.send(json.dumps(message).encode())


def _forking_environment() -> dict[str, str]:
    """Return the environment of a server process, which remembers what it changes."""
    users = {name: os.environ.get(name) for name in ONE_THREAD}
    return {_USERS: json.dumps(users), **os.environ, **ONE_THREAD}


def users_environment() -> dict[str, str]:
    """Return the environment in which the user has started mavfi, for programs of the user.

    TMPDIR remains this process's own folder, which mavfi removes.
    """
    environment = {**os.environ}
    for name, value in json.loads(environment.pop(_USERS, "{}")).items():
        environment.pop(name, None)
        if value is not None:
            environment[name] = value
    return environment


def _begin(folder: Path, parent: int) -> None:
    """Give a new worker or fork its own session and streams, and have it die with its parent."""
    os.setsid()
    die_with(parent)
    _isolate_streams(folder)


def _isolate_streams(folder: Path) -> None:
    """Redirect standard error and temporary files of this process to `folder`.

    Standard input and output go to /dev/null. `folder` is not recreated if it is gone, because a
    client that is exiting may have removed it.
    """
    scratch = folder / SCRATCH
    scratch.mkdir(exist_ok=True)
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
    """Have Linux kill this process when the parent process ends. Exit if it has already ended.

    Args:
        parent: process id of the parent.
    """
    _request(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)


def _call_this_process(name: str) -> None:
    """Set the name of this process in ps and top (at most 15 bytes)."""
    _request(_PR_SET_NAME, ctypes.c_char_p(name.encode()))


def _request(option: int, value: int | ctypes.c_char_p) -> None:
    if _prctl(option, value, 0, 0, 0) != 0:
        code = ctypes.get_errno()
        raise OSError(code, os.strerror(code))


def _end_children(others: Sequence[int] = ()) -> None:
    """Kill and reap every descendant of this process, except its children in `others`.

    This process inherits the children of a killed child, so the loop repeats until none are left.
    A child that has become another user's, for example by sudo, cannot be killed.
    """
    left = set(others)
    while children := [pid for pid in _children() if pid not in left]:
        for pid in children:
            try:
                os.kill(pid, signal.SIGKILL)
            except ProcessLookupError:
                pass
            except PermissionError:  # it has become another user's
                left.add(pid)
        for pid in children:
            if pid not in left:
                with contextlib.suppress(ChildProcessError):
                    os.waitpid(pid, 0)


def _children() -> list[int]:
    """Return the process ids of the children of this process.

    The list is empty if Linux does not list children. The main thread is read last, because it
    inherits the children of a thread that ends meanwhile.
    """
    children = list[int]()
    threads = Path("/proc/self/task").iterdir()
    for thread in sorted(threads, key=lambda thread: thread.name == str(os.getpid())):
        with contextlib.suppress(OSError):
            children += map(int, (thread / "children").read_text().split())
    return children


if __name__ == "__main__":
    _serve()
