"""A separate node: a fresh fork of a program that has loaded every kernel once.

    mission ──► program: has loaded, reaps the guards         `server`
                  ├─ server: forks, and nothing else
                  ├─ guard: parent of one node, and reports its end
                  │     └─ node: works until its mission closes the connection
                  └─ guard ...

Loading takes half a second of CPU, a fork a few milliseconds. A mission needs up to three nodes,
and the missions of a campaign share the program, which their fork server has started. The server
keeps nothing from one fork to the next, so every node begins with the same memory.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import gc
import io
import os
import pickle
import select
import signal
import socket
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NoReturn

from mavfi_cli.attack.served import ServedProcess, served_process, start_early
from mavfi_cli.companion.node_process import NodeProcess
from mavfi_cli.core.errors import TargetError
from mavfi_cli.core.processes import fork, receive, send

if TYPE_CHECKING:
    from mavfi_cli.attack.kernels.scope import KernelScope

_PROGRAM = "mavfi_cli.mission.instruction.server"
_REQUEST = b"n"
_NUMBER = 4  # bytes of a process id or of a wait status
_SET_CHILD_SUBREAPER, _SET_PTRACER, _ANYBODY = 36, 0x59616D61, -1  # prctl(2)
_prctl = ctypes.CDLL(None).prctl

# -- the mission's side

_loaded: list[ServedProcess] = []  # the program, once it has loaded


def start_program() -> None:
    """Start the program of the nodes, because it loads long; it ends with all its users."""
    if not _loaded:
        start_early(_PROGRAM)


def load_program() -> ServedProcess:
    """Wait until the program has loaded. A fork of this process can use it too.

    Raises:
        TargetError: it could not start; says why.
    """
    if not _loaded:
        program = served_process(_PROGRAM)
        program.begin(None, "node")
        _loaded.append(program)
    return _loaded[0]


class ForkedNode:
    """The process of one node.

    Attributes:
        pid: its process id.
        connection: our end of the socket to it.
        scope: entry and scope of its kernel.

    Args:
        setup: the message to the node.
        name: its name in errors.

    Raises:
        TargetError: it does not start; says why.
    """

    def __init__(self, setup: Any, name: str) -> None:
        if self._start(setup, name):  # it has another memory than one that finds bytecode
            self.kill()
            _drop_program()
            self._start(setup, name)

    def _start(self, setup: Any, name: str) -> bool:
        """Fork a node and set it up; return whether it had to compile a module."""
        self.connection, self._guard = _forked(setup)
        try:
            self.pid = int.from_bytes(self._guard.recv(_NUMBER), "little")
            self.scope: KernelScope
            self.scope, compiled = receive(self.connection)
        except (OSError, EOFError):
            self.kill()
            problem = f"does not start: {load_program().last_words()}"
            raise TargetError(name, problem) from None
        return bool(compiled)

    def process(self, *, patient: bool = False) -> NodeProcess:
        """The node for an executor, which then owns it.

        Args:
            patient: never treat the node as hung, because a debugger may hold it.
        """
        return NodeProcess(self.connection, self.pid, ending=self._ending, patient=patient)

    def _ending(self) -> str | None:
        """Wait until the node has ended; return how, in words, or None if nobody knows."""
        if self._guard.fileno() >= 0:
            with self._guard:
                self._status = self._guard.recv(_NUMBER)
        if not self._status:
            return None
        status = int.from_bytes(self._status, "little")
        if os.WIFSIGNALED(status):
            return f"killed by {signal.Signals(os.WTERMSIG(status)).name}"
        return f"ended with code {os.WEXITSTATUS(status)}"

    def kill(self) -> None:
        """Kill the node if it has not ended, and wait for its end."""
        if self._guard.fileno() >= 0:
            self._guard.shutdown(socket.SHUT_WR)
        self._ending()
        self.connection.close()


def _forked(setup: Any) -> tuple[socket.socket, socket.socket]:
    """Our ends of the connections to a fresh node and to its guard."""
    ours, theirs = socket.socketpair()
    guard, guarded = socket.socketpair()
    send(ours, _canonical(setup))  # now, because a message in pieces leaves other memory behind
    with theirs, guarded:
        descriptors = [theirs.fileno(), guarded.fileno()]
        try:
            socket.send_fds(load_program().connection, [_REQUEST], descriptors)
        except OSError:
            _drop_program()  # it was killed since
            socket.send_fds(load_program().connection, [_REQUEST], descriptors)
    return ours, guard


def _canonical(value: Any) -> bytes:
    """A pickle that is the same for equal values, whether or not their parts are one object."""
    buffer = io.BytesIO()
    pickler = pickle.Pickler(buffer, protocol=pickle.HIGHEST_PROTOCOL)
    pickler.fast = True  # without references to what came before
    pickler.dump(value)
    return buffer.getvalue()


def _drop_program() -> None:
    """Leave the program to its other users; it ends if there are none."""
    _loaded.pop().connection.close()


# -- the program's side

Work = Callable[[socket.socket], None]


def fork_nodes(control: socket.socket, work: Work) -> NoReturn:
    """Fork a node for every request, until all users have closed their end.

    Args:
        control: the program's end of the socket to its users.
        work: the work of a node, given its connection.
    """
    gc.collect()
    gc.freeze()
    gc.disable()
    _prctl(_SET_CHILD_SUBREAPER, 1)
    server = fork(functools.partial(_serve, control, work), exact=True)
    while os.wait()[0] != server:  # but a guard
        pass
    os._exit(0)


def _serve(control: socket.socket, work: Work) -> int:
    """Fork what answers the next request, and do nothing else: it would change the memory."""
    answer = functools.partial(_answer, control, work)
    status = 0
    while status == 0:
        fork(answer, exact=True)
        status = os.wait()[1]
    return 0


def _answer(control: socket.socket, work: Work) -> int:
    """Wait for one request and have a guard answer it; return 1 if there are no more users."""
    request, descriptors, _, _ = socket.recv_fds(control, len(_REQUEST), 2)
    if not request:
        return 1
    fork(functools.partial(_guard, control, descriptors, work), exact=True)
    return 0


def _guard(control: socket.socket, descriptors: Sequence[int], work: Work) -> int:
    """The whole life of a guard: fork the node, and kill it if its mission is gone."""
    control.close()
    connection, channel = (socket.socket(fileno=each) for each in descriptors)
    node = fork(functools.partial(_node, connection, channel, work), exact=True)
    connection.close()
    process = os.pidfd_open(node)
    with contextlib.suppress(OSError):
        channel.send(node.to_bytes(_NUMBER, "little"))
        if process not in select.select([process, channel.fileno()], [], [])[0]:
            os.kill(node, signal.SIGKILL)
        channel.send(os.waitpid(node, 0)[1].to_bytes(_NUMBER, "little"))
    return 0


def _node(connection: socket.socket, channel: socket.socket, work: Work) -> int:
    """The whole life of a node."""
    channel.close()
    _prctl(_SET_PTRACER, _ANYBODY)  # its mission is no ancestor
    gc.enable()
    try:
        work(connection)
    except Exception as error:  # the process boundary: the mission reads the last line
        os.write(2, f"{type(error).__name__}: {error}\n".encode())
        raise
    return 0
