"""Injection of a source-level fault into a mission, and its record on disk."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

from mavfi_cli.companion.executor import Executor
from mavfi_cli.companion.protection import NoProtection, gate_of
from mavfi_cli.core.files import write_json
from mavfi_cli.core.seeds import Stream, generator
from mavfi_cli.core.states import Message
from mavfi_cli.core.types import Briefing, Trajectory
from mavfi_cli.detect.gate import Gate
from mavfi_cli.fi.source.injector import Follower, MemoryInjector, Reader, SourceInjector, Strike
from mavfi_cli.fi.source.schedule import Moment, Schedule
from mavfi_cli.spec.fault import DETECTOR, PROCESS, FaultConfig
from mavfi_cli.spec.mission import MissionConfig

M = TypeVar("M")
SCHEMA = 1


class NoInjection:
    """Null object that leaves every message unchanged.

    Attributes:
        follower: Tracks which node reads which message.
        in_queue: True if the injection site is control's copy of the plan.
    """

    in_queue = False

    def __init__(self) -> None:
        self.follower = Follower()

    def watch(self, moment: Moment) -> None:
        """Observe the mission once per control tick and before every report."""

    def pass_on(self, message: M, moment: Moment) -> M:
        """Return the message unchanged."""
        return message

    def strike_latched(self, trajectory: Trajectory, moment: Moment, index: int) -> Trajectory:
        """Return the trajectory unchanged."""
        return trajectory

    def strike_memory(self, moment: Moment) -> None:
        """Do nothing."""

    def begin(self, path: Path) -> None:
        """Write no record."""

    def arm(self, executor: Executor, config: MissionConfig, briefing: Briefing) -> None:
        """No node needs a process of its own."""

    def news(self) -> list[str]:
        """Return no news."""
        return []

    def finish(self) -> dict[str, Any] | None:
        """Return no record."""
        return None


class _Killer:
    """Decides when the process of a node is killed, which happens once."""

    def __init__(self, config: FaultConfig, shortest_flight_s: float) -> None:
        rng = generator(config.seed, Stream.FAULT, "process")
        self.drawn_time_s = float(rng.uniform(0.0, shortest_flight_s))
        self._schedule = Schedule(config.trigger(), config.corruption(), self.drawn_time_s)
        self.strikes: list[Strike] = []
        self.watch = self._schedule.watch

    @property
    def count(self) -> int:
        """Number of kills."""
        return len(self.strikes)

    @property
    def missed(self) -> str:
        """Reason why the fault has not struck."""
        return self._schedule.missed("control tick")

    def strike(self, moment: Moment) -> Strike | None:
        """Return the kill if it is due now."""
        if not self._schedule.due(moment):
            return None
        self._schedule.acted(moment)
        strike = Strike(
            stamp_s=moment.stamp_s, tick=moment.tick, phase=moment.phase, invocation=moment.tick,
            changes=(),
        )  # fmt: skip
        self.strikes.append(strike)
        return strike


class _Recorded(NoInjection):
    """Record of a fault, written before the flight, at the first strike and at the end.

    A subclass sets its injector, the attacked stage, the unit of each attacked state by name, and
    who reads what is corrupted.
    """

    _injector: SourceInjector | MemoryInjector | _Killer
    _stage: str
    _units: dict[str, str]
    _reader = ""

    def __init__(self, config: FaultConfig) -> None:
        super().__init__()
        self._config = config
        self._path: Path | None = None
        self._state = "planned"
        self._news: list[str] = []
        self._strike: Strike | None = None  # the newest

    def watch(self, moment: Moment) -> None:
        """Update the trigger."""
        self._injector.watch(moment)

    def begin(self, path: Path) -> None:
        """Write the planned fault before the flight."""
        self._path = path
        write_json(path, self.record())

    def news(self) -> list[str]:
        """Return one line per strike since the last call."""
        news, self._news = self._news, []
        return news

    def _on_strike(self, strike: Strike) -> None:
        """Write the first strike to disk before its message is passed on."""
        self._strike = strike
        if self._state == "planned":
            self._news.append(strike_text(strike))
            self._state = "applied"
            if self._path is not None:
                write_json(self._path, self.record())

    def finish(self) -> dict[str, Any] | None:
        """Write and return the record at the end of the mission."""
        if self._state == "planned":
            self._state = "not_injected"
        if self._path is not None:
            write_json(self._path, self.record())
        return self.record()

    def record(self) -> dict[str, Any]:
        """Return the requested fault, the drawn values and the strikes."""
        activation, reader = self._activation()
        trigger, injector = self._config.trigger(), self._injector
        return {
            "schema": SCHEMA,
            "level": "source",
            "state": self._state,
            "reason": injector.missed if self._state == "not_injected" else "",
            "request": self._config.to_dict(),
            "stage": self._stage,
            "states": list(self._units),
            "units": list(self._units.values()),
            "trigger": {
                "when": trigger.when.value,
                "number": trigger.number,
                "phase": trigger.phase,
                "drawn_time_s": injector.drawn_time_s,
            },
            "strikes": [asdict(strike) for strike in injector.strikes],
            "strike_count": injector.count,
            "activation": {
                "activation": activation,
                "first_reader": asdict(reader) if reader else None,
            },
        }

    def _activation(self) -> tuple[str, Reader | None]:
        """Return the activation and the first reader, who reads what is corrupted at once."""
        if not self._injector.strikes:
            return "not_injected", None
        stamp_s = self._injector.strikes[0].stamp_s
        return "read", Reader(name=self._reader, stamp_s=stamp_s, state=next(iter(self._units)))


class SourceInjection(_Recorded):
    """Injection of one fault into the messages between nodes, or into the active plan.

    Args:
        config: Configuration of the fault.
        shortest_flight_s: Interval from which a random trigger is drawn, s.
    """

    def __init__(self, config: FaultConfig, shortest_flight_s: float) -> None:
        super().__init__(config)
        self._injector: SourceInjector = SourceInjector(
            config.draw(),
            seed=config.seed,
            shortest_flight_s=shortest_flight_s,
            listener=self._on_strike,
        )
        states = self._injector.fault.states
        self._stage = states[0].stage.value
        self._units = {state.name: state.unit for state in states}
        self.in_queue = config.strikes_queue

    def pass_on(self, message: M, moment: Moment) -> M:
        """Return the message as its receiver gets it, corrupted if the fault strikes."""
        return self._followed(message, self._injector.pass_on(message, moment))

    def strike_latched(self, trajectory: Trajectory, moment: Moment, index: int) -> Trajectory:
        """Return the active trajectory from this tick on, corrupted if the fault strikes."""
        struck = self._injector.strike_latched(trajectory, moment, index)
        return self._followed(trajectory, struck)

    def _followed(self, message: M, sent: M) -> M:
        if sent is not message and self._strike is not None and isinstance(sent, Message):
            self.follower.struck(sent, self._strike)
        return sent

    def _activation(self) -> tuple[str, Reader | None]:
        return self.follower.activation.value, self.follower.reader


class DetectorInjection(_Recorded):
    """Injection of one fault into the memory of the detector.

    The detector reads all of its memory at its next check, so every fault is activated.

    Args:
        config: Configuration of the fault. Its target is `detector` or `detector.PART`.
        shortest_flight_s: Interval from which a random trigger is drawn, s.
        gate: Gate with the detector's memory.
    """

    def __init__(self, config: FaultConfig, shortest_flight_s: float, gate: Gate) -> None:
        super().__init__(config)
        self._injector: MemoryInjector = MemoryInjector(
            gate.memory,
            config.detector_part,
            trigger=config.trigger(),
            corruption=config.corruption(),
            bits=config.exact_bits,
            seed=config.seed,
            shortest_flight_s=shortest_flight_s,
            listener=self._on_strike,
        )
        self._stage = self._reader = DETECTOR
        self._units = {self._injector.array: "1"}

    def strike_memory(self, moment: Moment) -> None:
        """Strike the detector's memory if the fault is due."""
        self._injector.strike(moment)


class ProcessInjection(_Recorded):
    """Injection that kills the process of a node once.

    Args:
        config: Configuration of the fault. Its target is `process.NODE`.
        shortest_flight_s: Interval from which a random trigger is drawn, s.
    """

    def __init__(self, config: FaultConfig, shortest_flight_s: float) -> None:
        super().__init__(config)
        assert config.killed_node is not None
        self._node = self._reader = config.killed_node
        self._injector: _Killer = _Killer(config, shortest_flight_s)
        self._stage, self._units = PROCESS, {config.target: ""}
        self._executor: Executor | None = None

    def arm(self, executor: Executor, config: MissionConfig, briefing: Briefing) -> None:
        """Have the node that is killed work in a process of its own."""
        self._executor = executor
        executor.isolate(self._node)

    def strike_memory(self, moment: Moment) -> None:
        """Kill the process if the trigger fires."""
        strike = self._injector.strike(moment)
        if strike is not None:
            self._on_strike(strike)
            assert self._executor is not None
            self._executor.kill(self._node)


def injection_of(
    config: FaultConfig | None, shortest_flight_s: float, protection: NoProtection
) -> NoInjection:
    """Create the injection of a source-level fault, or the null object without a fault.

    Args:
        config: Fault.
        shortest_flight_s: Interval from which a random trigger is drawn, s.
        protection: Protection whose detector the fault may corrupt.

    Raises:
        FaultSpecError: A fault in the detector needs one.
    """
    if config is None:
        return NoInjection()
    if config.killed_node is not None:
        return ProcessInjection(config, shortest_flight_s)
    if config.attacks_detector:
        return DetectorInjection(config, shortest_flight_s, gate_of(protection))
    return SourceInjection(config, shortest_flight_s)


def strike_text(strike: Strike) -> str:
    """Describe the changes of a strike in one line."""
    if not strike.changes:
        return "fault: the process is killed"
    changes = [
        f"{c.state}: {_value(c.before)} -> {_value(c.after)} "
        f"(bit{'s' if len(c.bits) != 1 else ''} {', '.join(map(str, c.bits)) or 'none'})"
        for c in strike.changes
    ]
    return "fault in " + "; ".join(changes)


def _value(value: float | int | bool) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
