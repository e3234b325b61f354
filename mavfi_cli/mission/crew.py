"""The programs of a user's companion during a flight: their order, readiness and ends."""

from __future__ import annotations

import contextlib
import math
import signal
import socket
import time
from collections.abc import Callable
from typing import Any

from mavfi_cli.core.errors import MavfiError
from mavfi_cli.core.flight_record import ProgramEnds
from mavfi_cli.core.types import VehicleState
from mavfi_cli.mission.programs import Programs, RunningProgram, Throttle
from mavfi_cli.spec.companion import CompanionConfig, ProgramConfig

_PORT_LOOK_S = 0.1

Note = Callable[[float, str, str, VehicleState | None], None]
"""Function that logs an event, given its stamp (s), kind, text, and the vehicle's state."""


class Crew:
    """The programs of a companion during a flight: their order, readiness and ends.

    Attributes:
        begun_s: Stamp of the start of the first program; infinite before.
        running: Started programs by name.
        connected: True once the program in lockstep has connected; always true without lockstep.
        unready: Why the companion cannot become ready; empty if it is or still may.
    """

    def __init__(self, companion: CompanionConfig, note: Note) -> None:
        self._companion, self._note = companion, note
        self._waiting: list[tuple[str, ProgramConfig]] = list(companion.program.items())
        self.begun_s = math.inf
        self.running: dict[str, RunningProgram] = {}
        self.connected = not companion.in_lockstep
        self._senders: set[tuple[int, int]] = set()  # of heartbeats: system, component
        self._known_senders = 0  # when the newest program started
        self.unready = ""
        self._started_s = self._looked_s = 0.0  # newest start, newest look at a port; wall clock
        self._known: dict[str, tuple[int, int]] = {}  # number of logged starts and ends

    def prepare(self, programs: Programs, values: dict[str, str]) -> None:
        """Fill in the placeholders in the commands of all programs.

        Args:
            values: Value of each placeholder, by its name.
        """
        self._programs = programs
        self._tasks = {name: _task(program, values) for name, program in self._waiting}

    def _start(self) -> None:
        name, _ = self._waiting[0]
        self.running[name] = self._programs.start(name, self._tasks[name])
        self._started_s, self._known_senders = time.monotonic(), len(self._senders)
        if (share := self._companion.program[name].share) < 1.0:
            self.running[name].throttle = Throttle(self.running[name], share)

    def hear(self, system: int, component: int) -> None:
        """Note a heartbeat of a program, by its MAVLink system and component."""
        self._senders.add((system, component))

    def close(self) -> None:
        """Let slowed programs run at full speed, so that they can end."""
        for program in self.running.values():
            if program.throttle is not None:
                program.throttle.end()

    def manage(self, stamp_s: float, state: VehicleState | None) -> None:
        """Log new starts and ends of programs. Start the next program if the newest one is ready.

        Raises:
            MavfiError: A program cannot be started.
        """
        if not self.running:
            self.begun_s = stamp_s
            self._start()
        for name, program in self.running.items():
            if not program.poll():
                raise MavfiError(f"the program {name} cannot run: {program.failure()}")
            starts, ends = self._known.get(name, (0, 0))
            if program.starts > starts:
                again = " again" if program.starts > 1 else ""
                self._note(stamp_s, "program", f"{name} starts{again}", state)
            for code in program.codes[ends:]:
                self._note(stamp_s, "program", f"{name} {_how(code)}", state)
            self._known[name] = program.starts, len(program.codes)
        if self._waiting and not self.unready:
            self._await_ready()

    def _await_ready(self) -> None:
        name, config = self._waiting[0]
        program = self.running[name]
        if self._is_ready(config, program):
            del self._waiting[0]
            if self._waiting:
                self._start()
        elif program.codes and program.pid is None and self._is_over(name):
            early = f"{name} {_how(program.codes[-1])} before it was ready"
            self.unready = _with_words(early, program)
        elif time.monotonic() - self._started_s > config.ready_limit_s:
            self.unready = f"{name} was not ready within {config.ready_limit_s:g} s"

    def _is_ready(self, config: ProgramConfig, program: RunningProgram) -> bool:
        return (
            program.starts > 0
            and self.connected
            and (config.ready_line is None or program.ready)
            and (not config.ready_heartbeat or len(self._senders) > self._known_senders)
            and (config.ready_port is None or self._is_open(config.ready_port))
        )

    def _is_open(self, port: int) -> bool:
        """Return True if a local TCP port accepts connections. Checks at most every 0.1 s."""
        if time.monotonic() < self._looked_s + _PORT_LOOK_S:
            return False
        self._looked_s = time.monotonic()
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
            probe.settimeout(_PORT_LOOK_S)
            return probe.connect_ex(("127.0.0.1", port)) == 0

    def summary(self) -> dict[str, ProgramEnds]:
        """Return each program's number of starts and the exit codes of its processes, by name."""
        return {
            name: ProgramEnds(starts=program.starts, codes=[*program.codes])
            for name, program in self.running.items()
        }

    @property
    def ready(self) -> bool:
        """True once every program has become ready."""
        return not self._waiting

    @property
    def over(self) -> bool:
        """True once every program has ended and none will restart."""
        return self.ready and all(map(self._is_over, self.running))

    def _is_over(self, name: str) -> bool:
        program, rule = self.running[name], self._companion.program[name].restart
        if program.pid is not None or not program.codes:
            return False
        return rule == "never" or (rule == "on-failure" and program.codes[-1] == 0)

    def failure(self) -> str:
        """Describe the failure of a program that will not restart, with its last line on stderr.

        Return an empty string if no program has failed like this.
        """
        for name, program in self.running.items():
            if program.codes and program.codes[-1] and self._is_over(name):
                return _with_words(f"{name} {_how(program.codes[-1])}", program)
        return ""

    def ended(self) -> str:
        """Name a program that is gone, even if it will restart.

        A program that has ended with exit code 0 is gone only if `success.exit` names it or no
        other program runs: it may have been a preparation. Return an empty string if no program is
        gone.
        """
        down = {
            name: program.codes[-1]
            for name, program in self.running.items()
            if program.codes and program.pid is None
        }
        for name, code in down.items():
            if code or name == self._companion.success.exit or len(down) == len(self.running):
                return f"the program {name} is gone"
        return ""

    def succeeded(self, name: str) -> bool:
        """Return True if the program has ended with exit code 0 and will not restart."""
        return name in self.running and self._is_over(name) and self.running[name].codes[-1] == 0


def _with_words(text: str, program: RunningProgram) -> str:
    words = program.last_words()
    return f"{text}: {words}" if words else text


def _how(code: int) -> str:
    """Describe how a process ended, given its exit code, which is -N after signal N."""
    if code >= 0:
        return f"ended with code {code}"
    with contextlib.suppress(ValueError):
        return f"was killed by {signal.Signals(-code).name}"
    return f"was killed by signal {-code}"


def _task(program: ProgramConfig, values: dict[str, str]) -> dict[str, Any]:
    return {
        "argv": program.argv(values),
        "folder": program.folder,
        "environment": program.environment,
        "restart": program.restart,
        "restart_s": program.restart_s,
        "ready_line": program.ready_line,
    }
