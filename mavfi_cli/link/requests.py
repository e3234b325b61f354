"""Requests of a session to the autopilot, repeated until telemetry shows their effect."""

from __future__ import annotations

import math
from typing import NoReturn

from mavfi_cli.core.errors import CommandRefused
from mavfi_cli.link.codec import dialect
from mavfi_cli.link.commands import CommandChannel, CommandState, Ticket
from mavfi_cli.link.telemetry import Telemetry

_SETTLE_S = 0.5  # wait for status texts after a refusal
_EFFECT_S = 3.0  # wait for the effect of an accepted command
_MODE_TRIES = 5
_MODE_PATIENCE_S = 1.5  # wait for a mode change; HEARTBEAT arrives once a second
_LOOK_INTERVAL_S = 0.2
_HOME_INTERVAL_S = 1.0
_WARNING = dialect.MAV_SEVERITY_WARNING


class Requests:
    """Requests of one phase of the session at a time.

    Args:
        commands: Channel to the autopilot.
        telemetry: Telemetry that shows the effect of commands.

    Attributes:
        now_s: Present stamp. Set it before any request.
    """

    def __init__(self, commands: CommandChannel, telemetry: Telemetry) -> None:
        self._commands = commands
        self._telemetry = telemetry
        self.now_s = 0.0
        self._look: Ticket | None = None
        self._next_look_s = -math.inf
        self._home: Ticket | None = None
        self._next_home_s = -math.inf
        self.begin()

    def begin(self) -> None:
        """Begin a phase and forget the requests of the last one."""
        self._ticket: Ticket | None = None  # the command that the phase depends on
        self._decided_s: float | None = None
        self._mode_since_s, self._mode_tries = -math.inf, 0
        self._texts_before = self._telemetry.texts.total

    @property
    def asked(self) -> bool:
        """True once this phase has sent a command."""
        return self._ticket is not None

    def refuse(self, command: str, result: str) -> NoReturn:
        """Give up a request and quote the autopilot's texts since the start of the phase.

        Raises:
            CommandRefused: Always.
        """
        texts = self._telemetry.texts
        texts.expire(self.now_s, 0.0)
        said = (each for each in texts.since(self._texts_before) if each.severity <= _WARNING)
        raise CommandRefused(command, result, dict.fromkeys(text.text for text in said))

    def insist(self, name: str, command: int, *parameters: float, unused: float = 0.0) -> bool:
        """Send a command until it is accepted. Return True from then on.

        If an accepted command shows no effect, further calls send it again.

        Raises:
            CommandRefused: The command was refused permanently.
        """
        if self._ticket is None:
            self._ticket = self._commands.submit(command, *parameters, unused=unused, refusals=2)
            self._decided_s = None
        ticket = self._ticket
        if ticket.pending:
            return False
        if self._decided_s is None:
            self._decided_s = self.now_s
        waited_s = self.now_s - self._decided_s
        if ticket.verdict is CommandState.ACCEPTED:
            if waited_s >= _EFFECT_S:
                self._ticket = None
            return True
        if waited_s >= _SETTLE_S:
            self.refuse(name, ticket.result)
        return False

    def mode(self, mode: str) -> bool:
        """Request a mode until HEARTBEAT shows it. An acknowledgement alone does not count.

        Raises:
            CommandRefused: The mode did not change after the maximum number of requests.
        """
        if self._telemetry.mode == mode:
            return True
        pending = self._ticket is not None and self._ticket.pending
        if not pending and self.now_s - self._mode_since_s >= _MODE_PATIENCE_S:
            if self._mode_tries >= _MODE_TRIES:
                result = self._ticket.result if self._ticket is not None else ""
                self.refuse(f"mode {mode}", f"{result}, mode stays {self._telemetry.mode}")
            self._mode_tries += 1
            self._mode_since_s = self.now_s
            enabled = dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
            if self._telemetry.armed:
                enabled |= dialect.MAV_MODE_FLAG_SAFETY_ARMED
            self._ticket = self._commands.submit(
                dialect.MAV_CMD_DO_SET_MODE,
                enabled,
                *self._telemetry.autopilot.mode_parameters(mode),
            )
        self.look_at_heartbeat()
        return False

    def look_at_heartbeat(self) -> None:
        """Request a HEARTBEAT now instead of waiting up to a second for the next."""
        if self.now_s >= self._next_look_s and not (self._look and self._look.pending):
            self._next_look_s = self.now_s + _LOOK_INTERVAL_S
            self._look = self._commands.submit(
                dialect.MAV_CMD_REQUEST_MESSAGE, dialect.MAVLINK_MSG_ID_HEARTBEAT
            )

    def home(self) -> None:
        """Request HOME_POSITION once a second."""
        if self.now_s >= self._next_home_s and not (self._home and self._home.pending):
            self._next_home_s = self.now_s + _HOME_INTERVAL_S
            self._home = self._commands.submit(
                dialect.MAV_CMD_REQUEST_MESSAGE, dialect.MAVLINK_MSG_ID_HOME_POSITION
            )

    def streams(self, state_rate_hz: float) -> None:
        """Request the message streams of a flight: the state at this rate, the others slower."""
        state_us = 1e6 / state_rate_hz
        for message_id, interval_us in (
            (dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, state_us),
            (dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED, state_us),
            (dialect.MAVLINK_MSG_ID_EXTENDED_SYS_STATE, 2e5),
            (dialect.MAVLINK_MSG_ID_SYS_STATUS, 5e5),
            (dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT, 5e5),
        ):
            self._commands.submit(dialect.MAV_CMD_SET_MESSAGE_INTERVAL, message_id, interval_us)
