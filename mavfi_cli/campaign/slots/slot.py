"""A slot: a process that keeps one flight at a time, in a fresh fork of itself.

It is the reaper of everything that the mission starts, so whatever becomes of the mission, nothing
of it is left when the slot reports. What stays from mission to mission is the template that their
simulated vehicles are forks of; one that does not answer is ended and made anew. Orders and
reports are JSON, one a packet.

    runner -> slot   {"missions": [{"number", "changes", "out"} ...], "limit_s", "fork"}
    slot -> runner   {"number", "pid"} when it begins
                     {"number", "exit" | "signal" | "timeout" | "lost", "report", "wall_s"} when it
                     is over
    the runner's end closes: the mission is killed, and the slot ends
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import socket
import traceback
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn, Protocol

from mavfi_cli.campaign.slots.desk import Desk
from mavfi_cli.campaign.slots.keeper import Keeper
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

    def perform_together(self, desk: Desk, vehicles: VehicleTemplate | None) -> Path:
        """Do several that begin alike; the folder of the one that this process has become."""


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
            _keep(json.loads(packet), channel, task, equipment)
        except OSError:
            os._exit(0)  # the runner is gone


def _keep(
    order: Mapping[str, Any], channel: socket.socket, task: Task, equipment: Equipment
) -> None:
    """Have the missions of an order flown."""
    vehicles = equipment.vehicles() if order["fork"] else None
    slot = os.getpid()
    first = Path(order["missions"][0]["out"])
    place = first.with_name(f"trunk-{first.name}")

    def perform(writing: list[int]) -> NoReturn:
        """What the order's process does."""
        _perform(Desk(order["missions"], writing, slot, place), task, slot, vehicles)

    Keeper(order, channel, perform, equipment.settle).keep()
    shutil.rmtree(place, ignore_errors=True)


def _perform(desk: Desk, task: Task, slot: int, vehicles: VehicleTemplate | None) -> NoReturn:
    """The whole life of an order's process, in a process group of its own."""
    code = 1
    try:
        call_this_process(MISSION)
        os.setsid()
        die_with(slot)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_DFL)
        if len(desk.missions) == 1:
            desk.become(0)
            folder = task.perform(desk.missions[0]["changes"], desk.out(0), vehicles)
        else:
            folder = task.perform_together(desk, vehicles)
        desk.tell({"folder": folder.name})
        code = 0
    except MavfiError as error:
        desk.tell({"error": type(error).__name__, "text": str(error)})
    except BaseException:  # the process boundary: the traceback goes to the runner
        desk.tell({"traceback": traceback.format_exc()[-8000:]})
    finally:
        os._exit(code)
