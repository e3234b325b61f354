"""`mavfi gate`: the gate as a process between a companion and an autopilot.

A parent opens both links and forks a worker, which routes frames and judges setpoints. When
the worker fails or dies, or shows no sign of life for 1 s, the parent forks another on the same
links. That one judges nothing: it passes everything (fails open), or everything but setpoints
(fails closed).
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import select
import signal
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mavfi_cli.core.errors import MavfiError, described
from mavfi_cli.core.files import open_own, read_bounded
from mavfi_cli.core.processes import EndWatch, fork, interruptible
from mavfi_cli.core.terminal import exit_code, note
from mavfi_cli.core.types import StackMark
from mavfi_cli.link.codec import Codec, Message, dialect, frame_of, text_messages
from mavfi_cli.link.router import Router, Side
from mavfi_cli.link.transport import signing_from_file
from mavfi_cli.mission.setpoint_gate import SetpointGate
from mavfi_cli.mission.setpoints import SETPOINTS
from mavfi_cli.spec.companion import GateConfig
from mavfi_cli.spec.detector import DetectorConfig

_TURN_S = 0.1
_HANG_S = 1.0  # silence of the worker after which it is killed
_FAILED = 70  # exit code of a worker that an unexpected error ended
_REMIND_S = 5.0  # interval between texts that the gate has failed
_LOOK_S = 0.5  # interval between checks of the companion's process


@dataclass(frozen=True, slots=True, kw_only=True)
class GateProcess:
    """The settings of `mavfi gate`.

    Attributes:
        autopilot, companion: URLs of the two links.
        mark: Companion for which the detector's model must have been made; None allows any.
        process: Process id of the companion, or the path of a file that contains it; None to watch
            no process.
        log: File to which one line of JSON per event is appended; None to write no log.
        key_file: File with the signing passphrase of both links.
        allow_unsigned: Allow an unsigned link to another machine.
    """

    autopilot: str
    companion: str
    detector: DetectorConfig
    settings: GateConfig = field(default_factory=GateConfig)
    mark: StackMark | None = None
    process: str | None = None
    log: Path | None = None
    key_file: Path | None = None
    allow_unsigned: bool = False

    def run(self) -> int:
        """Run the gate until it is interrupted, and return the exit code for this process.

        Raises:
            MavfiError: The companion's process is gone, a link cannot be opened, or the model
                cannot be used.
        """
        if why := _Watch(self.process).gone():
            raise MavfiError(why)
        SetpointGate.warm_up(self.detector, self.mark)
        log = None
        if self.log is not None:
            log = open_own(self.log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        passing = _Passing()
        router = Router(
            self.autopilot, self.companion, passes=passing, allow_unsigned=self.allow_unsigned,
            signing=signing_from_file(self.key_file),
        )  # fmt: skip
        worker = _Worker(self, router, passing, log)
        worker.make_gate()
        port = f"port {router.port}" if router.port else self.companion
        note(f"the gate is ready: {self.detector.name}, companion on {port}")
        judges = True
        with interruptible() as interrupts:
            while True:
                code = _watched(worker, interrupts, judges=judges)
                if code is not None:
                    return code
                if judges:
                    worker.tell(f"the gate has failed {self.settings.on_error}")
                judges = False


class _Passing:
    """The router's rule for passing frames on, which may be replaced while the router runs."""

    def __init__(self) -> None:
        self.rule: Callable[[Message, Side], Iterable[Message]] = lambda message, _: (message,)

    def __call__(self, message: Message, side: Side) -> list[bytes]:
        return [frame_of(own) for own in self.rule(message, side)]


class _Worker:
    """The forked process that routes frames and, unless the gate has failed, judges setpoints."""

    def __init__(
        self, process: GateProcess, router: Router, passing: _Passing, log: int | None
    ) -> None:
        self._process, self._router, self._passing, self._log = process, router, passing, log

    def make_gate(self) -> None:
        """Make the gate in this process, because a worker must soon give a sign of life."""
        process = self._process
        self._gate = SetpointGate(
            process.detector, process.settings, process.mark,
            note=lambda _kind, text: self.tell(text),
            signing=signing_from_file(process.key_file), gone=_Watch(process.process).gone,
        )  # fmt: skip

    def tell(self, text: str) -> None:
        """Print an event, and append it to the log."""
        line = {"unix_s": round(time.time(), 3), "event": text}
        with contextlib.suppress(OSError):  # a full disk or a closed terminal must not end the gate
            note(text)
        with contextlib.suppress(OSError):
            if self._log is not None:
                os.write(self._log, json.dumps(line).encode() + b"\n")

    def work(self, alive: int, *, judges: bool) -> int:
        """Route frames until the parent ends this process. Return the exit code after an error.

        In every turn, write to the pipe `alive`, so that the parent sees a sign of life.
        """
        try:
            return exit_code(lambda: self._route(alive, judges=judges))
        except Exception as error:  # the worker's boundary: the parent forks another
            with contextlib.suppress(OSError):
                self.tell(f"the gate ends: {described(error)}")
            return _FAILED

    def _route(self, alive: int, *, judges: bool) -> None:
        gate = self._gate
        if judges:
            self._passing.rule = lambda message, side: gate.pass_between(
                message, side, time.monotonic(), self._router.sender
            )
        elif self._process.settings.on_error == "closed":
            self._passing.rule = _closed
        announced_s = -math.inf
        while True:
            self._router.turn(_TURN_S, time.monotonic() + _TURN_S)
            os.write(alive, b".")
            if not judges and time.monotonic() - announced_s > _REMIND_S:
                self._announce()  # again and again, because peers connect later
                announced_s = time.monotonic()
            for frame in gate.outbox:
                self._router.send(frame, Side.COMPANION)
            gate.outbox.clear()

    def _announce(self) -> None:
        text = f"mavfi gate: failed {self._process.settings.on_error}".encode()
        codec = Codec(1, dialect.MAV_COMP_ID_ONBOARD_COMPUTER4, signing=self._router.signing)
        for message in text_messages(dialect.MAV_SEVERITY_CRITICAL, text, 1):
            self._router.send(codec.encode(message), Side.COMPANION)


def _closed(message: Message, side: Side) -> Sequence[Message]:
    return () if side is Side.COMPANION and message.get_msgId() in SETPOINTS else (message,)


def _watched(worker: _Worker, interrupts: Sequence[int], *, judges: bool) -> int | None:
    """Fork a worker and watch it until it ends.

    Return its exit code, 0 if this process was interrupted, or None if the worker was killed, hung
    or failed.
    """
    reading, writing = os.pipe()

    def work() -> int:
        os.close(reading)  # a write fails once the parent is gone
        return worker.work(writing, judges=judges)

    child = fork(work)
    os.close(writing)
    try:
        while True:
            ready, _, _ = select.select([reading], [], [], _HANG_S)
            if interrupts:
                return 0
            if not ready:
                worker.tell("the gate hangs")
                return None
            if not os.read(reading, 1 << 16):
                break
    finally:
        os.close(reading)
        os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
    code = os.waitstatus_to_exitcode(status)
    return None if code < 0 or code == _FAILED else code


class _Watch:
    """Checks whether the companion's process is gone."""

    def __init__(self, process: str | None) -> None:
        self._process = process
        self._next_s, self._gone = 0.0, ""
        self._number = 0
        self._watch: EndWatch | None = None

    def gone(self) -> str:
        """Return a message if the companion's process is gone, or an empty string if it is not.

        If no process is watched, the string is always empty.
        """
        if self._process is None or time.monotonic() < self._next_s:
            return self._gone
        self._next_s = time.monotonic() + _LOOK_S
        gone = f"the companion's process ({self._process}) is gone"
        try:
            named = self._process.isdigit()
            number = int(self._process if named else read_bounded(Path(self._process), 100))
            if self._watch is not None and number != self._number:
                self._watch.close()
                self._watch = None
            if self._watch is None:
                self._watch, self._number = EndWatch(number), number
            self._gone = gone if self._watch.look() else ""
        except OSError:
            self._gone = gone
        except (MavfiError, ValueError) as error:
            problem = error if isinstance(error, MavfiError) else f"{self._process}: not a number"
            known = "gone" if self._watch is not None else "unknown"
            self._gone = f"the companion's process is {known} ({problem})"
        return self._gone
