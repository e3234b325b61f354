"""The runner's side of the slots on this machine: start missions, hear how they ended."""

from __future__ import annotations

import contextlib
import json
import os
import selectors
import socket
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict

from mavfi_cli.campaign.slots.seats import Assignment, Ended, Seats
from mavfi_cli.campaign.slots.slot import PACKET
from mavfi_cli.campaign.slots.template import READY
from mavfi_cli.core.errors import MavfiError
from mavfi_cli.core.processes import ONE_THREAD

TASK = "mavfi_cli.campaign.slots.task"
_STOP_S = 10.0  # from the closing of the slots until what is left of them is killed


class SlotsFailed(MavfiError):
    """The processes that fly the missions could not start."""


class Slots(Seats):
    """Keeps up to `jobs` missions flying.

    Args:
        jobs: missions at the same time.
        module: that does the work.
        fork: simulated vehicles are forks of a warm template; otherwise programs.

    Attributes:
        running: process id by mission number; 0 until the slot has told it.
    """

    def __init__(self, jobs: int, module: str = TASK, *, fork: bool = True) -> None:
        self._jobs = jobs
        self._module = module
        self._fork = fork
        self._selector = selectors.DefaultSelector()
        self._idle: list[socket.socket] = []
        self._at: dict[socket.socket, set[int]] = {}  # the missions that a slot keeps
        self._template: subprocess.Popen[bytes] | None = None
        self._control: socket.socket | None = None
        self.running: dict[int, int] = {}

    @property
    def free(self) -> int:
        """How many missions may be started now."""
        return self._jobs - len(self._at)

    def start(self, missions: Sequence[Assignment], limit_s: float) -> None:
        """Start missions in a free slot.

        Raises:
            SlotsFailed: the processes cannot be started.
        """
        order = {
            "missions": [asdict(mission) for mission in missions],
            "limit_s": limit_s,
            "fork": self._fork,
        }
        packet = json.dumps(order).encode()
        while True:
            channel = self._idle.pop() if self._idle else self._new_slot()
            try:
                channel.send(packet)
            except OSError:  # the slot was killed while it was idle
                channel.close()
                continue
            self._selector.register(channel, selectors.EVENT_READ)
            self._at[channel] = {mission.number for mission in missions}
            self.running |= dict.fromkeys(self._at[channel], 0)
            return

    def wait(self, timeout_s: float) -> list[Ended]:
        """The missions that ended, waiting for at least one word of a slot or the time-out."""
        ended = []
        for key, _ in self._selector.select(timeout_s):
            channel = key.fileobj
            assert isinstance(channel, socket.socket)
            try:
                packet = channel.recv(PACKET)
            except OSError:
                packet = b""
            kept = self._at[channel]
            if not packet:
                ended += [Ended(number=number) for number in sorted(kept)]
                self._release(channel)
                channel.close()
                continue
            said = json.loads(packet)
            if "pid" in said:
                self.running[said["number"]] = said["pid"]
                continue
            ended.append(Ended(**said))
            kept.remove(said["number"])
            del self.running[said["number"]]
            if not kept:
                self._release(channel)
                self._idle.append(channel)
        return ended

    def _release(self, channel: socket.socket) -> None:
        self._selector.unregister(channel)
        for number in self._at.pop(channel):
            del self.running[number]

    def _new_slot(self) -> socket.socket:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            for _ in range(2):
                if self._control is None:
                    self._control = self._start_template()
                try:
                    socket.send_fds(self._control, [b"slot"], [theirs.fileno()])
                except OSError:  # it was killed since
                    self._end_template()
                    continue
                return ours
        ours.close()
        raise SlotsFailed("the process that forks the missions ends at once")

    def _start_template(self) -> socket.socket:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        line = [sys.executable, "-m", "mavfi_cli.campaign.slots.template"]
        with theirs:
            self._template = subprocess.Popen(
                [*line, str(theirs.fileno()), self._module],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                env={**os.environ, **ONE_THREAD},
                start_new_session=True,  # Ctrl-C is for the runner, which lets missions finish
            )
        try:
            said = ours.recv(len(READY))
        except OSError:
            said = b""
        if said != READY:
            ours.close()
            self._template.wait()
            raise SlotsFailed("the process that forks the missions could not start")
        return ours

    def _end_template(self) -> None:
        if self._control is not None:
            self._control.close()
            self._control = None
        if self._template is not None:
            try:
                self._template.wait(_STOP_S)
            except subprocess.TimeoutExpired:
                self._template.kill()
                self._template.wait()
            self._template = None

    def close(self) -> None:
        """Kill what is running, and wait until all of it has ended."""
        for channel in list(self._at):
            channel.shutdown(socket.SHUT_WR)  # the slot kills its mission and ends
        for channel in list(self._at):
            channel.settimeout(_STOP_S)
            with contextlib.suppress(OSError):
                while channel.recv(PACKET):
                    pass
            self._release(channel)
            channel.close()
        for channel in self._idle:
            channel.close()
        self._idle.clear()
        self._end_template()
        self._selector.close()
