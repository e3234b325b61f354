"""A process that has loaded everything a vehicle needs, and forks itself for each flight.

    python -m sitl.server.template FD PARENT

FD is a socket to the parent, process PARENT, which is a slot of a campaign; the missions of the
slot write to it too. A packet is an order:

    "fly" and JSON {"arguments", "tmp"}, with three descriptors: the companion's socket, a file for
        what the vehicle says on its standard error, and a status channel
    "settle": end every vehicle; answered by SETTLED when none is left

On the status channel comes HERE with a descriptor of the vehicle's process, and when that has
ended, its code as `subprocess` gives it, as text. A flying vehicle that finds JSON {"truth"} there
when SIGUSR1 comes, with three descriptors as above, forks itself: the one flight goes on as if
nothing had happened, the other with the new descriptors, and with its truth in the folder named.

A vehicle is as fresh as `python -m sitl`: this
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
from collections.abc import Mapping
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
    fork_beside,
    threads,
)
from sitl.server.main import Place, main
from sitl.server.simulation import Simulation
from sitl.vehicle.profile_files import load_profile
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


class _Branching:
    """A vehicle's answer to SIGUSR1: it flies on twice from where it is.

    The companion asks between a tick's messages and its answer, when the vehicle only waits and
    nothing is on the link.

    Args:
        link: descriptor of the companion's socket.
        place: where the truth goes.
        status: channel on which the request waits.
        register: channel to the template, which hears of the fork on it.
        template: process id of the template.
    """

    def __init__(
        self, link: int, place: Place, status: socket.socket, register: socket.socket, template: int
    ) -> None:
        self._link, self._place = link, place
        self._status, self._register, self._template = status, register, template

    def on_signal(self, _number: int, _frame: object) -> None:
        """Fork, and let the fork have what the request brought."""
        packet, descriptors, _, _ = socket.recv_fds(self._status, PACKET, 3)
        if len(descriptors) == 3:
            if fork_beside(self._template) == 0:
                signal.signal(signal.SIGUSR1, signal.SIG_IGN)  # it branches once
                self._place.truth = Path(json.loads(packet)["truth"])
                self._become(*descriptors)
                return
            for descriptor in descriptors:
                os.close(descriptor)

    def _become(self, link: int, errors: int, status: int) -> None:
        os.set_blocking(link, False)
        os.dup2(link, self._link)
        os.dup2(errors, 2)
        socket.send_fds(self._register, [str(os.getpid()).encode()], [status])
        for descriptor in (link, errors, status):
            os.close(descriptor)
        self._status.close()
        self._register.close()


class Template:
    """Forks vehicles, and reaps them.

    Args:
        control: where orders come from.
    """

    def __init__(self, control: socket.socket) -> None:
        self._control = control
        self._flying: dict[int, _Flying] = {}  # by descriptor of the process
        self._branched, self._register = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._poller = select.poll()
        self._poller.register(control, select.POLLIN)
        self._poller.register(self._branched, select.POLLIN)

    def serve(self) -> None:
        """Serve until the other end closes, then close every channel."""
        with self._control, self._branched, self._register:
            self._obey_all()
            self._let_go()

    def _obey_all(self) -> None:
        while True:
            for descriptor, _ in self._poller.poll():
                if descriptor in self._flying:
                    self._reap(descriptor)
                elif descriptor == self._branched.fileno():
                    self._take_branch()
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
        self._keep(pid, status)

    def _take_branch(self) -> None:
        """A vehicle has forked itself."""
        said, descriptors, _, _ = socket.recv_fds(self._branched, PACKET, 1)
        status = socket.socket(fileno=descriptors[0])
        try:
            self._keep(int(said), status)
        except ProcessLookupError:  # it was ended with all others
            status.close()

    def _keep(self, pid: int, status: socket.socket) -> None:
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
            self._branched.close()
            for process, other in self._flying.items():
                os.close(process)
                other.status.close()
            os.dup2(errors, 2)
            os.close(errors)
            os.environ["TMPDIR"] = tempfile.tempdir = order["tmp"]
            place = Place()
            branching = _Branching(link, place, status, self._register, template)
            signal.signal(signal.SIGUSR1, branching.on_signal)
            code = main([*order["arguments"], "--fd", str(link)], place)
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
        self._let_go()

    def _let_go(self) -> None:
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


def run(descriptor: int, parent: int) -> int:
    """Get warm, then serve; the exit code."""
    call_this_process(VEHICLES)
    die_with(parent)
    become_reaper()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # the parent says when it is over
    warm_up()
    if (count := threads()) > 1:
        print(f"error: {count} threads where one is needed", file=sys.stderr)  # noqa: T201
        return 1
    gc.collect()
    gc.freeze()  # the collector would touch, and so copy, every page that forks share
    Template(socket.socket(fileno=descriptor)).serve()
    end_children()
    return 0


if __name__ == "__main__":
    os._exit(run(int(sys.argv[1]), int(sys.argv[2])))
