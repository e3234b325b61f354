"""Injection of a fault into a mission, and its record on disk."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from mavfi_cli.core.files import write_json
from mavfi_cli.core.seeds import Stream, generator
from mavfi_cli.core.types import CollisionReport, Command, Trajectory
from mavfi_cli.detect.gate import Gate
from mavfi_cli.fi.source.activation import Follower, Reader
from mavfi_cli.fi.source.fault import SourceFault, Trigger
from mavfi_cli.fi.source.injector import SourceInjector, Strike
from mavfi_cli.fi.source.memory import MemoryInjector
from mavfi_cli.fi.source.schedule import Moment, Schedule
from mavfi_cli.spec.fault import PROCESS, FaultConfig

if TYPE_CHECKING:
    from mavfi_cli.mission.briefing import Briefing
    from mavfi_cli.mission.companion.executor import Executor
    from mavfi_cli.spec.mission import MissionConfig

M = TypeVar("M", CollisionReport, Trajectory, Command)

SCHEMA = 1


class NoInjection:
    """Null object that leaves every message unchanged.

    Attributes:
        follower: Tracks which node reads which message.
        in_queue: True if the injection site is control's copy of the plan.
    """

    follower: Follower | None = None
    in_queue = False

    def watch(self, moment: Moment) -> None:
        """Observe the mission once per control tick and before every report."""

    def pass_on(self, message: M, moment: Moment, index: int = 0) -> M:
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


class _Recorded(NoInjection, ABC):
    """Record of a fault, written before the flight, at the first strike and at the end."""

    def __init__(self, config: FaultConfig) -> None:
        self._config = config
        self._path: Path | None = None
        self._state = "planned"
        self._news: list[str] = []
        self._strike: Strike | None = None

    def begin(self, path: Path) -> None:
        """Write the planned fault before the flight."""
        self._path = path
        write_json(path, self.record())

    def news(self) -> list[str]:
        """Return one line per strike since the last call."""
        news, self._news = self._news, []
        return news

    @abstractmethod
    def _missed(self) -> str:
        """Return the reason why the fault has not struck."""

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
        reason = self._missed() if self._state == "not_injected" else ""
        return {
            "schema": SCHEMA,
            "level": "source",
            "state": self._state,
            "reason": reason,
            "request": self._config.to_dict(),
        }


class SourceInjection(_Recorded):
    """Injection of one source-level fault into a mission.

    Args:
        config: Configuration of the fault.
        shortest_flight_s: Interval from which a random trigger is drawn, s.
    """

    def __init__(self, config: FaultConfig, shortest_flight_s: float) -> None:
        super().__init__(config)
        self._fault: SourceFault = config.draw()
        self._injector = SourceInjector(
            self._fault,
            seed=config.seed,
            shortest_flight_s=shortest_flight_s,
            listener=self._on_strike,
        )
        self.follower: Follower = Follower()
        self.in_queue = config.strikes_queue

    def watch(self, moment: Moment) -> None:
        """Update the trigger."""
        self._injector.watch(moment)

    def _missed(self) -> str:
        return self._injector.missed

    def pass_on(self, message: M, moment: Moment, index: int = 0) -> M:
        """Return the message as its receiver gets it, corrupted if the fault strikes."""
        return self._followed(message, self._injector.pass_on(message, moment, index))

    def strike_latched(self, trajectory: Trajectory, moment: Moment, index: int) -> Trajectory:
        """Return the active trajectory from this tick on, corrupted if the fault strikes."""
        struck = self._injector.strike_latched(trajectory, moment, index)
        return self._followed(trajectory, struck)

    def _followed(self, message: M, sent: M) -> M:
        if sent is not message and self._strike is not None:
            self.follower.struck(sent, self._strike)
        return sent

    def record(self) -> dict[str, Any]:
        """Return the requested fault, the drawn values and the strikes."""
        fault, reader = self._fault, self.follower.reader
        return {
            **super().record(),
            "stage": fault.states[0].stage.value,
            "states": [state.name for state in fault.states],
            "units": [state.unit for state in fault.states],
            "trigger": trigger_record(fault.trigger, self._injector.drawn_time_s),
            "strikes": [asdict(strike) for strike in self._injector.strikes],
            "strike_count": self._injector.count,
            "activation": {
                "activation": self.follower.activation.value,
                "first_reader": asdict(reader) if reader else None,
            },
        }


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
        self._trigger = config.trigger()
        self._injector = MemoryInjector(
            gate.memory,
            config.detector_part,
            trigger=self._trigger,
            corruption=config.corruption(),
            bits=config.exact_bits,
            seed=config.seed,
            shortest_flight_s=shortest_flight_s,
            listener=self._on_strike,
        )

    def watch(self, moment: Moment) -> None:
        """Update the trigger."""
        self._injector.watch(moment)

    def _missed(self) -> str:
        return self._injector.missed

    def strike_memory(self, moment: Moment) -> None:
        """Corrupt the detector's memory if the trigger fires."""
        self._injector.strike(moment)

    def record(self) -> dict[str, Any]:
        """Return the requested fault, the drawn values and the strikes."""
        applied = self._state == "applied"
        return {
            **super().record(),
            "stage": "detector",
            "states": [self._injector.array],
            "units": ["1"],
            "trigger": trigger_record(self._trigger, self._injector.drawn_time_s),
            "strikes": [asdict(strike) for strike in self._injector.strikes],
            "strike_count": self._injector.count,
            "activation": {
                "activation": "read" if applied else "not_injected",
                "first_reader": self._reader() if applied else None,
            },
        }

    def _reader(self) -> dict[str, Any]:
        stamp_s = self._injector.strikes[0].stamp_s
        return asdict(Reader(name="detector", stamp_s=stamp_s, state=self._injector.array))


class ProcessInjection(_Recorded):
    """Injection that kills the process of a node once.

    Args:
        config: Configuration of the fault. Its target is `process.NODE`.
        shortest_flight_s: Interval from which a random trigger is drawn, s.

    Attributes:
        node: Node whose process is killed.
        kill: Function that kills a node's process at a stamp, s. Set it before the flight.
    """

    def __init__(self, config: FaultConfig, shortest_flight_s: float) -> None:
        super().__init__(config)
        assert config.killed_node is not None
        self.node = config.killed_node
        self.kill: Callable[[str, float], None] = lambda _node, _stamp_s: None
        rng = generator(config.seed, Stream.FAULT, "process")
        self._drawn_time_s = float(rng.uniform(0.0, shortest_flight_s))
        self._schedule = Schedule(config.trigger(), config.corruption(), self._drawn_time_s)

    def arm(self, executor: Executor, config: MissionConfig, briefing: Briefing) -> None:
        """Have the node that is killed work in a process of its own."""
        executor.isolate(self.node)
        self.kill = executor.kill

    def watch(self, moment: Moment) -> None:
        """Update the trigger."""
        self._schedule.watch(moment)

    def _missed(self) -> str:
        return self._schedule.missed("control tick")

    def strike_memory(self, moment: Moment) -> None:
        """Kill the process if the trigger fires."""
        if not self._schedule.due(moment):
            return
        self._schedule.acted(moment)
        strike = Strike(
            stamp_s=moment.stamp_s, tick=moment.tick, phase=moment.phase, invocation=moment.tick,
            changes=(),
        )  # fmt: skip
        self._on_strike(strike)
        self.kill(self.node, moment.stamp_s)

    def record(self) -> dict[str, Any]:
        """Return the requested fault, the drawn values and the kill."""
        strike = self._strike
        reader = None
        if strike is not None:
            target = self._config.target
            reader = asdict(Reader(name=self.node, stamp_s=strike.stamp_s, state=target))
        return {
            **super().record(),
            "stage": PROCESS,
            "states": [self._config.target],
            "units": [""],
            "trigger": trigger_record(self._config.trigger(), self._drawn_time_s),
            "strikes": [] if strike is None else [asdict(strike)],
            "strike_count": int(strike is not None),
            "activation": {
                "activation": "not_injected" if strike is None else "read",
                "first_reader": reader,
            },
        }


def trigger_record(trigger: Trigger, drawn_time_s: float) -> dict[str, Any]:
    """Return a trigger as plain values."""
    return {
        "when": trigger.when.value,
        "number": trigger.number,
        "phase": trigger.phase,
        "drawn_time_s": drawn_time_s,
    }


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
