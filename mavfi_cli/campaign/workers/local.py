"""Workers on this machine, forks of one process that has loaded everything."""

from __future__ import annotations

import contextlib
import json
import selectors
import socket
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mavfi_cli.campaign.workers.base import Assignment, AttemptEnd, Workers
from mavfi_cli.core.fork_server import PACKET, ForkServer

TASK = "mavfi_cli.campaign.workers.task"
_STOP_S = 10.0  # time after which a worker with a closed channel counts as ended


class LocalWorkers(Workers):
    """Keeps up to `jobs` missions flying.

    Args:
        jobs: missions at the same time.
        module: the module that does the work.

    Attributes:
        running: process id by mission number; 0 until the worker's guard has sent it.
    """

    def __init__(self, jobs: int, module: str = TASK) -> None:
        self._jobs = jobs
        self._server = ForkServer(module)
        self._selector = selectors.DefaultSelector()
        self._number: dict[socket.socket, int] = {}  # mission number by channel
        self.running: dict[int, int] = {}

    @property
    def free(self) -> int:
        """Number of missions that may be started now."""
        return self._jobs - len(self._number)

    def start(self, mission: Assignment, limit_s: float) -> None:
        """Start a mission.

        Raises:
            ForkServerFailed: the processes cannot be started.
        """
        channel = self._server.start(mission.changes, Path(mission.out), limit_s)
        self._selector.register(channel, selectors.EVENT_READ)
        self._number[channel] = mission.number
        self.running[mission.number] = 0

    def wait(self, timeout_s: float) -> list[AttemptEnd]:
        """Wait for a guard's message or the time-out; return the missions that ended."""
        ended = []
        for key, _ in self._selector.select(timeout_s):
            channel = key.fileobj
            assert isinstance(channel, socket.socket)
            number = self._number[channel]
            said = _heard(channel)
            if said is not None and "pid" in said:
                self.running[number] = said["pid"]
                continue
            ended.append(AttemptEnd(number=number, **(said or {})))
            self._release(channel)
        return ended

    def _release(self, channel: socket.socket) -> None:
        self._selector.unregister(channel)
        del self.running[self._number.pop(channel)]
        channel.close()

    def close(self) -> None:
        """Kill all running missions and wait until they have ended."""
        for channel in self._number:
            channel.shutdown(socket.SHUT_WR)  # the guard ends its worker, and then itself
        for channel in list(self._number):
            channel.settimeout(_STOP_S)
            while _heard(channel) is not None:
                pass
            self._release(channel)
        self._server.close()
        self._selector.close()


def _heard(channel: socket.socket) -> Mapping[str, Any] | None:
    """Read a guard's next message; None if it is gone or sends nothing in time."""
    with contextlib.suppress(OSError):
        if packet := channel.recv(PACKET):
            said: dict[str, Any] = json.loads(packet)
            return said
    return None
