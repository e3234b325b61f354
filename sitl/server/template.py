"""A process that has loaded everything a vehicle needs, and forks itself for each flight.

    python -m sitl.server.template FD PARENT

FD is a socket to the parent, process PARENT, which is a slot of a campaign; the missions of the
slot write to it too. A packet is an order:

    "fly" and JSON {"arguments", "tmp"}, with three descriptors: the companion's socket, a file for
        what the vehicle says on its standard error, and a status channel
    "settle": end every vehicle; answered by SETTLED when none is left

On the status channel comes HERE with a descriptor of the vehicle's process, and when that has
ended, its code as `subprocess` gives it, as text. A vehicle is as fresh as `python -m sitl`: this
process has flown nothing but the ticks that load the compiled code, in a simulation of their own.
"""

from __future__ import annotations

import contextlib
import gc
import json
import os
import select
import signal
import socket
import sys
import tempfile
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from mavfi_cli.core.processes import (
    VEHICLE,
    VEHICLES,
    become_reaper,
    call_this_process,
    die_with,
    end_children,
)
from sitl.server.main import main
from sitl.server.simulation import Simulation
from sitl.vehicle.profile import load_profile
from sitl.world import load_world

PACKET = 1 << 16
FLY, SETTLE, SETTLED, HERE = b"fly", b"settle", b"settled", b"here"
_WORLD, _VEHICLE = "dense", "solo"  # the code is the same for all of them
_TICKS = 2


@dataclass(frozen=True, slots=True)
class _Flying:
    """One vehicle: who is to hear how its process ended."""

    pid: int
    status: socket.socket


class Template:
    """Forks vehicles, and reaps them.

    Args:
        control: where orders come from.
        fly: the whole work of a vehicle, `python -m sitl` with arguments; the exit code.
    """

    def __init__(self, control: socket.socket, fly: Callable[[list[str]], int]) -> None:
        self._control = control
        self._fly = fly
        self._flying: dict[int, _Flying] = {}  # by descriptor of the process
        self._poller = select.poll()
        self._poller.register(control, select.POLLIN)

    def serve(self) -> None:
        """Until the other end closes."""
        while True:
            for descriptor, _ in self._poller.poll():
                if descriptor in self._flying:
                    self._reap(descriptor)
                elif not self._obey():
                    return

    def _obey(self) -> bool:
        """Carry out one order; False where there will be none."""
        packet, descriptors, _, _ = socket.recv_fds(self._control, PACKET, 3)
        if packet.startswith(FLY):
            self._start(json.loads(packet.removeprefix(FLY)), descriptors)
        elif packet == SETTLE:
            self._settle()
            self._control.send(SETTLED)
        return bool(packet)

    def _start(self, order: Mapping[str, Any], descriptors: list[int]) -> None:
        link, errors, channel = descriptors
        status = socket.socket(fileno=channel)
        template = os.getpid()
        pid = os.fork()
        if pid == 0:
            self._become_vehicle(order, template, link, errors, status)
        os.close(link)
        os.close(errors)
        process = os.pidfd_open(pid)
        self._flying[process] = _Flying(pid, status)
        self._poller.register(process, select.POLLIN)
        with contextlib.suppress(OSError):  # the mission is gone
            socket.send_fds(status, [HERE], [process])

    def _become_vehicle(
        self, order: Mapping[str, Any], template: int, link: int, errors: int, status: socket.socket
    ) -> NoReturn:
        """The vehicle's whole life, in a session of its own."""
        code = 1
        try:
            call_this_process(VEHICLE)
            os.setsid()
            die_with(template)
            self._control.close()
            status.close()
            for process, other in self._flying.items():
                os.close(process)
                other.status.close()
            os.dup2(errors, 2)
            os.close(errors)
            os.environ["TMPDIR"] = tempfile.tempdir = order["tmp"]
            code = self._fly([*order["arguments"], "--fd", str(link)])
        except SystemExit as error:  # arguments that make no sense
            code = error.code if isinstance(error.code, int) else 1
        except BaseException:  # the process boundary: last words are what others see of it
            traceback.print_exc()
        finally:
            sys.stderr.flush()
            os._exit(code)

    def _reap(self, descriptor: int) -> None:
        self._poller.unregister(descriptor)
        os.close(descriptor)
        ended = self._flying.pop(descriptor)
        _, status = os.waitpid(ended.pid, 0)
        with ended.status, contextlib.suppress(OSError):
            ended.status.send(str(os.waitstatus_to_exitcode(status)).encode())

    def _settle(self) -> None:
        end_children()
        for descriptor, ended in self._flying.items():
            self._poller.unregister(descriptor)
            os.close(descriptor)
            ended.status.close()
        self._flying.clear()


def warm_up() -> None:
    """Load and compile all that a flight needs."""
    world = load_world(_WORLD, seed=1)
    simulation = Simulation(world, load_profile(_VEHICLE))
    for _ in range(_TICKS):
        simulation.advance()


def _threads() -> int:
    return len(list(Path("/proc/self/task").iterdir()))


def run(descriptor: int, parent: int) -> int:
    """Get warm, then serve; the exit code."""
    call_this_process(VEHICLES)
    die_with(parent)
    become_reaper()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # the parent says when it is over
    warm_up()
    if (threads := _threads()) > 1:  # a fork has only one of them, and the others' locks
        print(f"error: {threads} threads where one is needed", file=sys.stderr)  # noqa: T201
        return 1
    gc.collect()
    gc.freeze()  # the collector would touch, and so copy, every page that forks share
    Template(socket.socket(fileno=descriptor), main).serve()
    end_children()
    return 0


if __name__ == "__main__":
    os._exit(run(int(sys.argv[1]), int(sys.argv[2])))
