"""Faults in the messages and in the processes of a user's companion."""

from __future__ import annotations

import contextlib
import math
import os
import signal
from collections.abc import Callable, Iterator, Mapping
from types import MappingProxyType
from typing import Any

from mavfi_cli.companion.injection import Killer, NoInjection, SourceInjection
from mavfi_cli.core.errors import FaultSpecError, UnknownName
from mavfi_cli.core.flight_record import NodeEnds, Strike
from mavfi_cli.core.seeds import Stream
from mavfi_cli.fi.bits import NUMPY_TYPES
from mavfi_cli.fi.fault import Effect, When
from mavfi_cli.fi.injector import Injector, Listener, Moment, Pattern, change_of
from mavfi_cli.link.codec import Message, Signing, frame_of, renewed, sent_again
from mavfi_cli.link.fields import is_ignored
from mavfi_cli.link.router import Side
from mavfi_cli.link.telemetry import ARDUCOPTER, PX4
from mavfi_cli.mission.programs import RunningProgram, Throttle
from mavfi_cli.spec.companion import CompanionConfig
from mavfi_cli.spec.fault import PROCESS, FaultConfig, InstructionConfig

_SIDES = {None: None, "output": Side.COMPANION, "input": Side.AUTOPILOT}
_LOCKED = "the frames are signed, and key_file names no key to sign them again"
_RECEIVERS = {Side.COMPANION: "autopilot", Side.AUTOPILOT: "companion"}


class LinkInjector(Injector):
    """Strikes messages of one kind that pass between the autopilot and the companion.

    Args:
        shortest_flight_s, listener: As for `Injector`.
        signing: Key with which struck, repeated and delayed frames are signed again; None for an
            unsigned link.

    Attributes:
        units: Unit of each struck field by name; for a whole message, its name with an empty unit.
        side: Sender of the struck messages; None before the first strike.
    """

    def __init__(
        self,
        request: FaultConfig,
        *,
        shortest_flight_s: float,
        listener: Listener,
        signing: Signing | None = None,
    ) -> None:
        assert request.wire_target is not None
        fields, fault = request.draw_wire()
        corruption, rng = request.corruption(), Stream.FAULT.generator(request.seed, "strike")
        super().__init__(rng, request.trigger(), corruption, shortest_flight_s, listener)
        self._awaits = fields.name
        self._number, self._signing = fields.number, signing
        self._only = _SIDES[request.wire_target[0]]
        self._states = () if fault is None else fault.states
        bits = None if request.exact_bits is None else tuple(sorted(request.exact_bits))
        self._patterns = [Pattern(corruption, rng, bits) for _ in self._states]
        self.units = {state.name: state.unit for state in self._states} or {fields.name: ""}
        self.side: Side | None = None
        self._count = 0
        self._swapped: dict[Side, Message] = {}
        self._late: list[tuple[float, Message, Side]] = []
        self._obstacle = ""  # the reason why a message could not be struck

    @property
    def missed(self) -> str:
        """The reason why the fault never struck, as text for the record."""
        return self._obstacle or super().missed

    def pass_between(self, message: Message, side: Side, moment: Moment) -> list[Message]:
        """Return the messages to pass on in place of `message`.

        Unless the fault strikes, they are the message itself. A swapped message follows the next
        one of the same side.
        """
        if message.get_msgId() != self._number or self._only not in (None, side):
            return [message]
        self._count += 1
        if side in self._swapped:
            return [message, self._again(self._swapped.pop(side))]
        if not self._due(moment, self._count):
            return [message]
        if self._states:
            return [self._corrupt(message, side, moment)]
        effect = self._corruption.effect
        if effect is not Effect.DROP and sent_again(message, self._signing) is None:
            self._obstacle = _LOCKED
            return [message]
        self.side = side
        self._record(moment, self._count, ())
        if effect is Effect.SWAP:
            self._swapped[side] = message
        elif effect is Effect.LATE:
            self._late.append((moment.stamp_s + self._corruption.amount, message, side))
        return [message, self._again(message)] if effect is Effect.TWICE else []

    def release(self, stamp_s: float) -> Iterator[tuple[Message, Side]]:
        """Yield the late messages that are due, with their senders."""
        due = [late for late in self._late if late[0] <= stamp_s]
        self._late = [late for late in self._late if late[0] > stamp_s]
        for _, message, side in due:
            yield self._again(message), side

    def _again(self, message: Message) -> Message:
        again = sent_again(message, self._signing)
        assert again is not None
        return again

    def _corrupt(self, message: Message, side: Side, moment: Moment) -> Message:
        changed, changes = message, []
        for state, pattern in zip(self._states, self._patterns, strict=True):
            kind = NUMPY_TYPES[state.dtype.value]
            change = change_of(state.name, 0, state.read(changed, 0), kind, pattern)
            assert change.after is not None
            changed = state.write(changed, 0, change.after)
            changes.append(change)
        valid = renewed(changed, self._signing)
        flips = any(change.bits for change in changes)
        if valid is None:
            self._obstacle = _LOCKED
            return message
        if flips and frame_of(valid) == frame_of(message):
            self._obstacle = "the frames are MAVLink 1, which does not carry this field"
            return message
        self.side = side
        struck = valid if flips else message
        self.follower.struck(struck, self._record(moment, self._count, changes))
        return struck

    def deliver(self, message: Message, side: Side, stamp_s: float) -> None:
        """Record that a message has arrived, and which of its fields the receiver reads."""
        read = {state.name for state in self._states if not is_ignored(message, state)}
        self.follower.read(message, _RECEIVERS[side], stamp_s, read)


class _ProgramKiller(Killer):
    """Decides when a fault strikes a program. A program that does not run then is not struck.

    Args:
        runs: Returns True if the program is running.
    """

    def __init__(self, *args: Any, runs: Callable[[], bool]) -> None:
        super().__init__(*args)
        self._runs, self._gone = runs, False

    @property
    def missed(self) -> str:
        """The reason why the fault never struck, as text for the record."""
        return "the program was not running" if self._gone else super().missed

    def strike(self, moment: Moment) -> None:
        """Report the strike to the listener if the fault is due and the program runs."""
        if not self._gone and self._due(moment):
            self._gone = not self._runs()
            if not self._gone:
                self._record(moment, moment.tick, ())


class CompanionFault(NoInjection):
    """Injection of a fault in a user's companion. This base class injects no fault.

    Attributes:
        running: The started programs by name.
        link: Injector for messages; None for a fault in a process.
        ends: How a struck process ended, by the name of its program.
    """

    running: Mapping[str, RunningProgram] = MappingProxyType({})
    link: LinkInjector | None = None
    ends: Mapping[str, NodeEnds] = MappingProxyType({})

    def aim_at(self, shortest_flight_s: float) -> None:
        """Draw the fault. A random trigger time falls within `shortest_flight_s` of take-over."""

    def tick(self, moment: Moment) -> None:
        """Strike a process if the fault is due, and end a temporary effect when its time is up."""


class CompanionInjection(CompanionFault, SourceInjection):
    """Injection of one fault into the messages or the processes of a user's companion.

    Args:
        config: A fault that `check_companion_fault` accepts.
        signing: As for `LinkInjector`.
    """

    def __init__(self, config: FaultConfig, signing: Signing | None = None) -> None:
        super().__init__(config)
        self._signing = signing
        self._throttle: Throttle | None = None
        self._usual_share: float | None = None  # of a program that its own file slows down
        self._until_s = math.inf

    def aim_at(self, shortest_flight_s: float) -> None:
        """Draw the fault, as described in `CompanionFault.aim_at`."""
        config = self._config
        if config.killed_node is not None:
            self.injector = _ProgramKiller(
                config, shortest_flight_s, self._on_strike, runs=self._target_runs
            )
            self._reader = config.killed_node
            self._stage, self._units = PROCESS, {config.target: ""}
            return
        self.link = LinkInjector(
            config, shortest_flight_s=shortest_flight_s, listener=self._on_strike,
            signing=self._signing,
        )  # fmt: skip
        assert config.wire_target is not None
        self.injector, self._units = self.link, self.link.units
        self._stage = config.wire_target[0] or "message"

    def tick(self, moment: Moment) -> None:
        """Strike a process if the fault is due, and end a slowdown when its time is up."""
        self.injector.watch(moment)
        self.injector.strike(moment)
        if moment.stamp_s >= self._until_s:
            self.close()

    def close(self) -> None:
        """End a slowdown that still lasts, so that the stopped program can end."""
        if self._throttle is not None and self._usual_share is not None:
            self._throttle.share = self._usual_share
        elif self._throttle is not None:
            self._throttle.end()
        self._throttle = None

    @property
    def _target(self) -> RunningProgram | None:
        return self.running.get((self._config.killed_node or "").partition("/")[0])

    @property
    def _struck_pid(self) -> int | None:
        """Id of the process that the fault strikes; None while it does not run."""
        if (program := self._target) is None or not program.poll():
            return None
        return program.process((self._config.killed_node or "").partition("/")[2] or None)

    def _target_runs(self) -> bool:
        return self._struck_pid is not None

    def _on_strike(self, strike: Strike) -> None:
        """Record the first strike before it takes effect, then kill or slow a targeted process."""
        first = self._state == "planned"
        super()._on_strike(strike)
        if first and not strike.changes:
            self._news[-1:] = [f"fault: {self._config.describe()}"]
        if self.link is not None:
            if not strike.changes and self.link.side is not None:
                self._reader = _RECEIVERS[self.link.side]
            return
        program, corruption = self._target, self._config.corruption()
        assert program is not None
        if corruption.effect is Effect.FLIP:
            if (pid := self._struck_pid) is not None:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            return
        if program.throttle is None:
            self._throttle = Throttle(program, corruption.amount)
        else:
            self._throttle, self._usual_share = program.throttle, program.throttle.share
            self._throttle.share = corruption.amount * self._usual_share
        self._until_s = strike.stamp_s + corruption.duration_s


def check_companion_fault(
    config: FaultConfig | InstructionConfig, companion: CompanionConfig
) -> None:
    """Check that a fault can be injected into a user's companion.

    Raises:
        FaultSpecError: The target does not exist in a user's companion, or settings contradict each
            other.
        UnknownName: The companion has no such program, MAVLink no such message or field, or the
            autopilots no such flight mode.
    """
    programs = companion.program
    kind, _, phase = config.at.partition("=")
    if kind == When.PHASE.value and phase not in (modes := {**PX4.modes, **ARDUCOPTER.modes}):
        raise UnknownName("flight mode", phase, modes)
    moment = config.moment() if isinstance(config, InstructionConfig) else config
    moment.check_within(companion.time_limit_s or math.inf)
    if isinstance(config, InstructionConfig):
        config.check_program(programs)
    elif config.wire_target is not None:
        config.draw_wire()
    elif config.killed_node is not None:
        config.check_program(programs)
    else:
        raise FaultSpecError(
            f"{config.target}: a user's companion has no such target: give a MAVLink message or "
            "field such as SET_POSITION_TARGET_LOCAL_NED.vx, or process.PROGRAM (an "
            "instruction-level fault takes just PROGRAM)"
        )
