"""The place of the one autopilot at an endpoint, for which several senders may compete."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Generic, TypeVar

from mavfi_cli.link.codec import Message, dialect

Sender = TypeVar("Sender")
SILENCE_S = 5.0  # time after which another sender may take a silent one's place
TWO_AUTOPILOTS = "two autopilots send here"


def is_of_autopilot(message: Message) -> bool:
    """Return True if an autopilot has sent the message, by its component id."""
    return bool(message.get_srcComponent() == dialect.MAV_COMP_ID_AUTOPILOT1)


def two_autopilots(address: str, rival_address: str) -> str:
    """Return the text that tells the senders, also as a STATUSTEXT of a camera."""
    return f"{TWO_AUTOPILOTS}, {address} and {rival_address}"


class SenderSlot(Generic[Sender]):
    """The place of one sender. Another one may take it after 5 s of silence.

    Args:
        clock: Monotonic clock, s.

    Attributes:
        holder: The sender that counts; None before the first.
        rival: A sender that spoke although the place was taken, and whom the holder has outlived;
            None without one. An autopilot that restarts at another port has no rival.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self.holder: Sender | None = None
        self.rival: Sender | None = None
        self._challenger: Sender | None = None
        self._silent_from_s = 0.0  # then the holder has been silent for too long

    @property
    def is_free(self) -> bool:
        """True if there is no holder, or if it has been silent for too long."""
        return self.holder is None or self._clock() >= self._silent_from_s

    def take(self, sender: Sender) -> None:
        """Give the place to a sender."""
        self.holder, self._challenger = sender, None
        self.hears(sender)

    def leave(self, sender: Sender) -> None:
        """Free the place if a sender holds it."""
        if sender == self.holder:
            self.holder = None

    def hears(self, sender: Sender) -> bool:
        """Note that a sender has spoken. Return True if it holds the place."""
        if sender != self.holder:
            return False
        if self._challenger is not None:
            self.rival, self._challenger = self._challenger, None
        self._silent_from_s = self._clock() + SILENCE_S
        return True

    def challenge(self, sender: Sender) -> None:
        """Note that a sender claims a place that is taken."""
        self._challenger = sender
