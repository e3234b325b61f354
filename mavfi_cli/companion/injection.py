"""Injection of a source-level fault into a mission, and its record on disk."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

from mavfi_cli.companion.executor import Executor
from mavfi_cli.companion.node_process import NodeProcess
from mavfi_cli.companion.protection import NoProtection
from mavfi_cli.core.errors import FaultSpecError
from mavfi_cli.core.files import Json, write_json
from mavfi_cli.core.flight_record import (
    Reader,
    RecordedActivation,
    RecordedTrigger,
    StateFault,
    Strike,
)
from mavfi_cli.core.seeds import Stream
from mavfi_cli.core.types import Briefing
from mavfi_cli.fi.bits import format_distinct
from mavfi_cli.fi.injector import (
    Injector,
    Listener,
    MemoryInjector,
    Moment,
    NoInjector,
    SourceInjector,
)
from mavfi_cli.spec.fault import DETECTOR, PROCESS, FaultConfig
from mavfi_cli.spec.mission import MissionConfig

M = TypeVar("M")


class NoInjection:
    """The injection of a mission without a fault, and the base class of all others.

    Attributes:
        injector: Strikes messages, memory and processes when the fault is due.
        in_queue: True if the injection site is control's copy of the plan.
    """

    in_queue = False

    def __init__(self) -> None:
        self.injector = NoInjector()

    def aim(self, shortest_flight_s: float, protection: NoProtection) -> None:
        """Draw the properties of the fault that depend on the goal's distance or the detector."""

    def begin(self, path: Path) -> None:
        """Write the record of the planned fault to `path`, before the flight."""

    def arm(self, executor: Executor, config: MissionConfig, briefing: Briefing) -> None:
        """Move the attacked node to a process of its own before the flight, if necessary."""

    def news(self) -> list[str]:
        """Return the lines of text about the fault that are new since the last call."""
        return []

    def finish(self) -> Json | None:
        """Write and return the fault's record at the mission's end, or None without a fault."""
        return None

    def close(self) -> None:
        """End all processes that the injection started."""


class Killer(Injector):
    """Decides when a fault strikes a process, and reports the strike. It strikes only once."""

    _awaits = "control tick"

    def __init__(self, config: FaultConfig, shortest_flight_s: float, listener: Listener) -> None:
        rng = Stream.FAULT.generator(config.seed, "process")
        super().__init__(rng, config.trigger(), config.corruption(), shortest_flight_s, listener)

    def strike(self, moment: Moment) -> None:
        """Report the strike to the listener if the fault is due."""
        if self._due(moment):
            self._record(moment, moment.tick, ())


class SourceInjection(NoInjection):
    """Injection of one source-level fault, and its record on disk.

    The record is written before the flight, at the first strike and at the end.
    """

    injector: Injector

    def __init__(self, config: FaultConfig) -> None:
        super().__init__()
        self._config = config
        self._path: Path | None = None
        self._state = "planned"
        self._news: list[str] = []
        self._executor: Executor | None = None
        self.in_queue = config.strikes_queue
        self._reader = ""  # first reader of the corrupted value; empty: the follower determines it

    def aim(self, shortest_flight_s: float, protection: NoProtection) -> None:
        """Draw the fault.

        Args:
            shortest_flight_s: Length, in seconds, of the interval from which a random trigger time
                is drawn.
            protection: Protection whose detector the fault may corrupt.

        Raises:
            FaultSpecError: The fault targets a detector, but the mission has none.
        """
        config = self._config
        common: Any = {
            "seed": config.seed,
            "shortest_flight_s": shortest_flight_s,
            "listener": self._on_strike,
        }
        if config.killed_node is not None:
            self.injector = Killer(config, shortest_flight_s, self._on_strike)
            self._reader = config.killed_node
            self._stage, self._units = PROCESS, {config.target: ""}
        elif config.attacks_detector:
            if protection.gate is None:
                raise FaultSpecError(
                    "a fault in the detector needs a detector: give --detector NAME"
                )
            memory = MemoryInjector(
                protection.gate.memory,
                config.detector_part,
                trigger=config.trigger(),
                corruption=config.corruption(),
                bits=config.exact_bits,
                **common,
            )
            self.injector, self._stage, self._reader = memory, DETECTOR, DETECTOR
            self._units = {memory.array: "1"}
        else:
            fault = config.draw()
            self.injector = SourceInjector(fault, **common)
            self._stage = fault.states[0].stage.value
            self._units = {state.name: state.unit for state in fault.states}

    def arm(self, executor: Executor, config: MissionConfig, briefing: Briefing) -> None:
        """Move the node that the fault will kill, if any, to a process of its own."""
        if self._config.killed_node is not None:
            self._executor = executor
            executor.isolate(self._config.killed_node)

    def begin(self, path: Path) -> None:
        """Write the record of the planned fault to `path`."""
        self._path = path
        self._write()

    def news(self) -> list[str]:
        """Return a description of the first strike, but only in the first call after it."""
        news, self._news = self._news, []
        return news

    def _on_strike(self, strike: Strike) -> None:
        """Write the first strike to disk before it takes effect, and kill the targeted process."""
        if self._state == "planned":
            self._news.append(_strike_text(strike))
            self._state = "applied"
            self._write()
        if self._executor is not None:
            self._executor.kill(self._reader)

    def finish(self) -> Json | None:
        """Write and return the fault's record at the end of the mission."""
        if self._state == "planned":
            self._state = "not_injected"
        return self._write()

    def _write(self) -> Json:
        trigger, injector = self._config.trigger(), self.injector
        written = asdict(
            StateFault(
                state=self._state,
                reason=injector.missed if self._state == "not_injected" else "",
                request=asdict(self._config),
                stage=self._stage,
                states=list(self._units),
                units=list(self._units.values()),
                trigger=RecordedTrigger(
                    when=trigger.when.value,
                    number=trigger.number,
                    phase=trigger.phase,
                    drawn_time_s=injector.drawn_time_s,
                ),
                strikes=injector.strikes,
                strike_count=injector.count,
                activation=self._activation(),
            )
        )
        assert self._path is not None
        write_json(self._path, written)
        return written

    def _activation(self) -> RecordedActivation:
        follower, strikes = self.injector.follower, self.injector.strikes
        if not self._reader:
            kind = follower.activation.value
            return RecordedActivation(activation=kind, first_reader=follower.reader)
        if not strikes:
            return RecordedActivation(activation="not_injected")
        state = next(iter(self._units))
        reader = Reader(name=self._reader, stamp_s=strikes[0].stamp_s, state=state)
        return RecordedActivation(activation="read", first_reader=reader)


class StruckNode(NoInjection):
    """Injection of a fault that has already struck its node outside the flight, in a rehearsal.

    Attributes:
        node: name of the struck node.
        order: number, from 1, of the request to the node during which the fault struck.
        effect: what the fault did to the node, in one word.
        process: process that serves this request and all later ones; None if the fault left the
            node unchanged.
        how: how the node ended or hung; empty if it answers.
    """

    how = ""

    def __init__(
        self, node: str, order: int, effect: str, process: NodeProcess | None, text: str
    ) -> None:
        super().__init__()
        self.node, self.order, self.effect, self.process = node, order, effect, process
        self._news, self._text = list[str](), text
        if process is not None:
            process.answered = self.note_answer

    def note_answer(self) -> None:
        """Note that the flight has received the node's answer, or has noticed its loss."""
        self._news, self._text = [self._text] if self._text else [], ""

    def news(self) -> list[str]:
        """Return the text about the fault once, after the node has answered or was lost."""
        news, self._news = self._news, []
        return news


def _strike_text(strike: Strike) -> str:
    if not strike.changes:
        return "fault: the process is killed"
    changes = [
        f"{c.state}: {' -> '.join(format_distinct(c.before, c.after))} "
        f"(bit{'s' if len(c.bits) != 1 else ''} {', '.join(map(str, c.bits)) or 'none'})"
        for c in strike.changes
    ]
    return "fault in " + "; ".join(changes)
