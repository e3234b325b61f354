"""What became of a struck value: was it read at all before it was replaced?

A flip in a value that nobody reads is not a fault that the system survived. It is told apart, in
the words of the instruction level (`fi.tracer.inject.Activation`).
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from enum import Enum

from mavfi_cli.core.states import Message
from mavfi_cli.fi.source.injector import Strike


class Activation(Enum):
    """What became of the corrupted values, over all strikes of a fault."""

    READ = "read"  # some receiver worked with a corrupted value
    WITHHELD = "withheld"  # the detector's gate kept it from its receivers
    OVERWRITTEN = "overwritten"  # the message was replaced before
    NOT_READ = "not_read"  # the mission ended before
    UNCHANGED = "unchanged"  # the value was that already
    NOT_INJECTED = "not_injected"


@dataclass(frozen=True, slots=True, kw_only=True)
class Reader:
    """Who first worked with a corrupted value, and when."""

    name: str
    stamp_s: float
    state: str


class Follower:
    """Follows the struck message until one of its corrupted values is read.

    Attributes:
        activation: the best that is known; READ once, so for ever; WITHHELD, until one is read.
        reader: the first one.
    """

    def __init__(self) -> None:
        self.activation = Activation.NOT_INJECTED
        self.reader: Reader | None = None
        self._message: Message | None = None
        self._corrupted: dict[str, int] = {}  # state -> waypoint

    @property
    def waits(self) -> bool:
        """Whether a struck message is on its way that nobody has read."""
        return self._message is not None

    def struck(self, message: Message, strike: Strike) -> None:
        """A message was corrupted; it goes on as `message`."""
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
        """A receiver works with the states of a message; at one waypoint, or at all of them."""
        if self._message is None or message is not self._message:
            return
        for state, at in self._corrupted.items():
            if state in states and index in (None, at):
                self.activation, self._message = Activation.READ, None
                self.reader = Reader(name=by, stamp_s=stamp_s, state=state)
                return

    def withheld(self, message: Message) -> None:
        """The gate does not let a message, or the struck part of it, pass."""
        if message is self._message:
            self.activation, self._message = Activation.WITHHELD, None

    def settle(self, held: Callable[[Message], bool]) -> None:
        """Anyone who asks whether the message still counts: if not, it was overwritten."""
        if self._message is not None and not held(self._message):
            self._message = None
            self._become(Activation.OVERWRITTEN)

    def _become(self, activation: Activation) -> None:
        """Of a later strike of a lasting fault: less than what befell an earlier one is no news."""
        if self.activation is not Activation.WITHHELD:
            self.activation = activation
