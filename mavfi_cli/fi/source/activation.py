"""Activation of a source-level fault: whether a corrupted value was read before it was replaced.

A flip in a value that nobody reads is not a fault that the system survived. The two are told apart
with the words of the instruction level (`fi.tracer.inject.BitActivation`).
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from enum import Enum

from mavfi_cli.core.states import Message
from mavfi_cli.fi.source.injector import Strike


class Activation(Enum):
    """What happened to the corrupted values, over all strikes of a fault."""

    READ = "read"  # a receiver worked with a corrupted value
    WITHHELD = "withheld"  # the detector's gate kept it from its receivers
    OVERWRITTEN = "overwritten"  # the message was replaced before anyone read it
    NOT_READ = "not_read"  # the mission ended before anyone read it
    UNCHANGED = "unchanged"  # the strike did not change the value
    NOT_INJECTED = "not_injected"


@dataclass(frozen=True, slots=True, kw_only=True)
class Reader:
    """The first receiver that worked with a corrupted value, and when."""

    name: str
    stamp_s: float
    state: str


class Follower:
    """Follows the struck message until one of its corrupted values is read.

    Attributes:
        activation: the activation so far; READ is final, WITHHELD holds until a value is read.
        reader: the first one.
    """

    def __init__(self) -> None:
        self.activation = Activation.NOT_INJECTED
        self.reader: Reader | None = None
        self._message: Message | None = None
        self._corrupted: dict[str, int] = {}  # state -> waypoint

    @property
    def waits(self) -> bool:
        """True while a struck message is on its way and nobody has read it."""
        return self._message is not None

    def struck(self, message: Message, strike: Strike) -> None:
        """Note that a message was corrupted; it goes on as `message`."""
        if self.activation is Activation.READ:
            return
        self._corrupted = {c.state: c.index for c in strike.changes if c.bits}
        if self._corrupted:
            self._message = message
            self._become(Activation.NOT_READ)
        elif self.activation is Activation.NOT_INJECTED:
            self.activation = Activation.UNCHANGED

    def read(
        self,
        message: Message | None,
        by: str,
        stamp_s: float,
        states: Collection[str],
        index: int | None = None,
    ) -> None:
        """Note that a receiver works with a message's states, at one waypoint or at all of them."""
        if self._message is None or message is not self._message:
            return
        for state, at in self._corrupted.items():
            if state in states and index in (None, at):
                self.activation, self._message = Activation.READ, None
                self.reader = Reader(name=by, stamp_s=stamp_s, state=state)
                return

    def withheld(self, message: Message) -> None:
        """Note that the gate withheld a message, or the struck part of it."""
        if message is self._message:
            self.activation, self._message = Activation.WITHHELD, None

    def settle(self, held: Callable[[Message], bool]) -> None:
        """Note the message as overwritten if `held` says that it no longer counts."""
        if self._message is not None and not held(self._message):
            self._message = None
            self._become(Activation.OVERWRITTEN)

    def _become(self, activation: Activation) -> None:
        """Raise the activation; a later strike never lowers that of an earlier one."""
        if self.activation is not Activation.WITHHELD:
            self.activation = activation
