"""A mission's side of its slot: which mission a process is, and where it tells how it ended."""

from __future__ import annotations

import contextlib
import faulthandler
import json
import math
import os
import resource
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mavfi_cli.core.processes import fork_beside, threads
from mavfi_cli.link.waiting import readable

ERRORS, SCRATCH = "stderr.txt", "tmp"


class Desk:
    """Who a process is, among the missions of one order.

    Args:
        missions: as the order has them: {"number", "changes", "out"}.
        writing: a pipe for each, to the slot.
        slot: process id of the slot.
        place: of the files of a process that is no mission yet.

    Attributes:
        me: index of the mission that this process is; None: none yet.
    """

    def __init__(
        self, missions: Sequence[Mapping[str, Any]], writing: Sequence[int], slot: int, place: Path
    ) -> None:
        self.missions = missions
        self.place = place
        self.me: int | None = None
        self._writing = writing
        self._slot = slot
        self._fork: int | None = None  # a descriptor of the newest

    def out(self, mission: int) -> Path:
        """The folder that is to hold what a mission leaves."""
        return Path(self.missions[mission]["out"])

    def scratch(self, mission: int) -> Path:
        """A new folder for what a mission need not keep."""
        folder = self.out(mission) / SCRATCH
        folder.mkdir(parents=True, exist_ok=True)
        return Path(tempfile.mkdtemp(dir=folder))

    def begin(self) -> None:
        """Be a process that is no mission yet."""
        _own_surroundings(self.place)

    def become(self, mission: int) -> None:
        """Be a mission from now on, and say so."""
        self.me = mission
        _own_surroundings(self.out(mission))
        self.tell({"pid": os.getpid()})

    def fork(self, mission: int) -> bool:
        """Fork: True in the new process, which is the mission; False here.

        With several threads there is no fork, nor where it is killed at once: the mission is left
        out.
        """
        if threads() > 1:
            return False
        pid = fork_beside(self._slot)
        if pid is None:
            return False
        if pid == 0:
            os.setsid()
            self.become(mission)
            return True
        with contextlib.suppress(ProcessLookupError):  # the slot has reaped it already
            self._fork = os.pidfd_open(pid)
        return False

    def await_fork(self) -> None:
        """Pause until the newest fork has ended."""
        if self._fork is not None:
            readable(self._fork, math.inf)
            os.close(self._fork)
            self._fork = None

    def tell(self, report: Mapping[str, Any]) -> None:
        """Tell the slot, a line; nothing where this is no mission."""
        if self.me is not None:
            with contextlib.suppress(OSError):
                os.write(self._writing[self.me], json.dumps(report).encode() + b"\n")


def _own_surroundings(out: Path) -> None:
    """Streams, temporary files and signals of a mission of its own."""
    scratch = out / SCRATCH
    scratch.mkdir(parents=True, exist_ok=True)
    os.environ["TMPDIR"] = tempfile.tempdir = str(scratch)
    nothing = os.open(os.devnull, os.O_RDWR)
    errors = os.open(out / ERRORS, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
    for stream, target in ((0, nothing), (1, nothing), (2, errors)):
        os.dup2(target, stream)
    for descriptor in (nothing, errors):
        os.close(descriptor)
    faulthandler.enable(sys.stderr)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
