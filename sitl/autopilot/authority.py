"""Who commands the vehicle when several clients are connected."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from mavfi_cli.link.codec import dialect
from sitl.autopilot.commander import Severity
from sitl.autopilot.streams import Link

_TOLD = 64  # senders that are remembered as told

_HARMLESS = frozenset(
    {
        dialect.MAV_CMD_REQUEST_MESSAGE,
        dialect.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES,
        dialect.MAV_CMD_SET_MESSAGE_INTERVAL,
        dialect.MAV_CMD_GET_MESSAGE_INTERVAL,
        dialect.MAV_CMD_GET_HOME_POSITION,
        dialect.MAV_CMD_RUN_PREARM_CHECKS,
    }
)
"""Commands that anybody may send, because they change nothing but the sender's own streams."""

_COMMANDS = (dialect.MAVLINK_MSG_ID_COMMAND_LONG, dialect.MAVLINK_MSG_ID_COMMAND_INT)
_COMMANDING = frozenset(
    {
        *_COMMANDS,
        dialect.MAVLINK_MSG_ID_SET_MODE,
        dialect.MAVLINK_MSG_ID_MANUAL_CONTROL,
        dialect.MAVLINK_MSG_ID_PARAM_SET,
        dialect.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED,
        dialect.MAVLINK_MSG_ID_SET_POSITION_TARGET_GLOBAL_INT,
        dialect.MAVLINK_MSG_ID_SET_ATTITUDE_TARGET,
    }
)

_Sender = tuple[Link, int, int]  # link, system, component


class Authority:
    """Decides whose commands and whose setpoints count.

    Commands of every trusted system count. Setpoints of one sender count at a time: of the first
    that sends them, until it has been silent for as long as OFFBOARD tolerates.

    Args:
        trusted: MAVLink systems that may command; empty for all.
        say: Queues a status text for every client.
    """

    def __init__(self, trusted: Sequence[int], say: Callable[[Severity, str], None]) -> None:
        self._trusted = frozenset(trusted)
        self._say = say
        self._holder: _Sender | None = None
        self._held_us = 0
        self._told: set[_Sender] = set()

    def may_command(self, message: Any, link: Link) -> bool:
        """Return False if a message commands the vehicle and its sender is not trusted."""
        system = message.get_srcSystem()
        if not self._trusted or system in self._trusted:
            return True
        number = message.get_msgId()
        if number not in _COMMANDING or (number in _COMMANDS and message.command in _HARMLESS):
            return True
        names = ", ".join(str(each) for each in sorted(self._trusted))
        self._tell((link, system, 0), f"Commands of system {system} refused, trusted: {names}")
        return False

    def follows(self, message: Any, link: Link, stamp_us: int, silence_us: float) -> bool:
        """Return True if a setpoint counts, and remember its sender.

        Args:
            message: Valid setpoint.
            link: Link on which it arrived.
            stamp_us: Boot clock, us.
            silence_us: Time after which another sender may take over.
        """
        sender = (link, message.get_srcSystem(), message.get_srcComponent())
        if self._holder not in (None, sender):
            if stamp_us - self._held_us <= silence_us:
                self._tell(sender, f"Setpoints of {_name(sender)} ignored: {self._name} commands")
                return False
            self._say(Severity.WARNING, f"{_name(sender)} commands instead of {self._name}")
            self._told.clear()
        self._holder, self._held_us = sender, stamp_us
        return True

    @property
    def _name(self) -> str:
        return "" if self._holder is None else _name(self._holder)

    def _tell(self, sender: _Sender, text: str) -> None:
        """Say a text once for each sender."""
        if sender not in self._told:
            if len(self._told) >= _TOLD:
                self._told.clear()
            self._told.add(sender)
            self._say(Severity.WARNING, text)


def _name(sender: _Sender) -> str:
    return f"{sender[1]}/{sender[2]}"
