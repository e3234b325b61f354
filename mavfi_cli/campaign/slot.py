"""A slot: a process that keeps one mission at a time, in a fresh fork of itself.

It is the reaper of everything that the mission starts, so whatever becomes of the mission, nothing
of it is left when the slot reports. What stays from mission to mission is the template that their
simulated vehicles are forks of; one that does not answer is ended and made anew. Orders and
reports are JSON, one a packet.

    runner -> slot   {"number", "changes", "out", "limit_s", "fork"}
    slot -> runner   {"number", "pid"} when it begins
                     {"number", "exit" | "signal" | "timeout", "report", "wall_s"} when it is over
    the runner's end closes: the mission is killed, and the slot ends
"""

from __future__ import annotations

import contextlib
import faulthandler
import json
import os
import resource
import select
import signal
import socket
import sys
import tempfile
import time
import traceback
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn, Protocol

from mavfi_cli.core.errors import MavfiError, VehicleProcessError
from mavfi_cli.core.processes import (
    MISSION,
    SLOT,
    become_reaper,
    call_this_process,
    die_with,
    end_children,
)
from mavfi_cli.mission.vehicle_template import VehicleTemplate

PACKET = 1 << 17  # bytes, of an order or a report
_REPORT = 1 << 15  # bytes of what a mission says itself
ERRORS, SCRATCH = "stderr.txt", "tmp"
SETTLE_S = 60.0  # the template answers at once, but may have to get warm first


class Task(Protocol):
    """A module that knows what to do for a mission."""

    def prepare(self) -> None:
        """Load everything, once."""

    def equip(self) -> VehicleTemplate | None:
        """What forks the vehicles of the missions of a slot; None where they have none."""

    def perform(
        self, changes: Mapping[str, Any], out: Path, vehicles: VehicleTemplate | None
    ) -> Path:
        """Do it; the folder that it left."""


class Equipment:
    """A slot's template of vehicles, started when a mission first needs it."""

    def __init__(self, task: Task) -> None:
        self._task = task
        self._vehicles: VehicleTemplate | None = None

    def vehicles(self) -> VehicleTemplate | None:
        """The template; None where the task has none, or it cannot be started."""
        if self._vehicles is None:
            with contextlib.suppress(VehicleProcessError):  # the mission starts its own, or says so
                self._vehicles = self._task.equip()
        return self._vehicles

    def settle(self) -> None:
        """After a mission: end and reap everything but the template, which has to answer."""
        if self._vehicles is not None:
            end_children(spare=self._vehicles.pid)
            if self._vehicles.settle(SETTLE_S):
                return
            self._vehicles.close()
            self._vehicles = None
        end_children()


def serve(channel: socket.socket, task: Task) -> NoReturn:
    """The slot's whole life."""
    call_this_process(SLOT)
    become_reaper()
    equipment = Equipment(task)
    while True:
        try:
            packet = channel.recv(PACKET)
            if not packet:
                os._exit(0)
            channel.send(_keep(json.loads(packet), channel, task, equipment))
        except OSError:
            os._exit(0)  # the runner is gone


def _keep(
    order: Mapping[str, Any], channel: socket.socket, task: Task, equipment: Equipment
) -> bytes:
    """Have one mission flown; the packet that says how it ended."""
    begun = time.monotonic()
    vehicles = equipment.vehicles() if order["fork"] else None
    reading, writing = os.pipe()
    slot = os.getpid()
    pid = os.fork()
    if pid == 0:
        channel.close()
        os.close(reading)
        _perform(order, task, slot, writing, vehicles)
    os.close(writing)
    channel.send(json.dumps({"number": order["number"], "pid": pid}).encode())
    timeout = _await(pid, channel, begun + order["limit_s"])
    if timeout:
        os.kill(pid, signal.SIGKILL)
    _, status = os.waitpid(pid, 0)
    equipment.settle()
    ended: dict[str, Any] = {"number": order["number"], "report": _read(reading)}
    if timeout:
        ended["timeout"] = True
    elif os.WIFSIGNALED(status):
        ended["signal"] = os.WTERMSIG(status)
    else:
        ended["exit"] = os.WEXITSTATUS(status)
    ended["wall_s"] = round(time.monotonic() - begun, 6)
    return json.dumps(ended).encode()


def _await(pid: int, channel: socket.socket, deadline: float) -> bool:
    """Wait for the end of the mission; whether its time ran out."""
    descriptor = os.pidfd_open(pid)
    try:
        poller = select.poll()
        poller.register(descriptor, select.POLLIN)
        poller.register(channel, select.POLLIN)
        while True:
            left_s = deadline - time.monotonic()
            if left_s <= 0.0:
                return True
            ready = {fd for fd, _ in poller.poll(min(left_s, 3600.0) * 1e3)}
            if descriptor in ready:
                return False
            if channel.fileno() in ready:  # nothing is said meanwhile: the other end has closed
                end_children()
                os._exit(0)
    finally:
        os.close(descriptor)


def _read(reading: int) -> Any:
    """What the mission said before it ended; None where it said nothing, or not to the end."""
    with open(reading, "rb", buffering=0) as pipe:
        data = pipe.read(_REPORT)
    try:
        return json.loads(data or b"null")
    except ValueError:
        return None


def _perform(
    order: Mapping[str, Any], task: Task, slot: int, writing: int, vehicles: VehicleTemplate | None
) -> NoReturn:
    """The mission's whole life, in a process group of its own."""
    code = 1
    try:
        call_this_process(MISSION)
        os.setsid()
        die_with(slot)
        out = Path(order["out"])
        _own_surroundings(out)
        folder = task.perform(order["changes"], out, vehicles)
        _tell(writing, {"folder": folder.name})
        code = 0
    except MavfiError as error:
        _tell(writing, {"error": type(error).__name__, "text": str(error)})
    except BaseException:  # the process boundary: the traceback goes to the runner
        _tell(writing, {"traceback": traceback.format_exc()[-8000:]})
    finally:
        os._exit(code)


def _own_surroundings(out: Path) -> None:
    """Streams, temporary files and signals of a mission of its own."""
    scratch = out / SCRATCH
    scratch.mkdir(parents=True, exist_ok=True)
    os.environ["TMPDIR"] = tempfile.tempdir = str(scratch)
    nothing = os.open(os.devnull, os.O_RDWR)
    errors = os.open(out / ERRORS, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
    for stream, target in ((0, nothing), (1, nothing), (2, errors)):
        os.dup2(target, stream)
    faulthandler.enable(sys.stderr)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_DFL)


def _tell(writing: int, report: Mapping[str, Any]) -> None:
    with contextlib.suppress(OSError):
        os.write(writing, json.dumps(report).encode())
