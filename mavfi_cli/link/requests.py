"""What a session asks of the autopilot, again and again until HEARTBEAT or the ground shows it."""

from __future__ import annotations

import math
from typing import NoReturn

from mavfi_cli.core.errors import CommandRefused
from mavfi_cli.link.codec import dialect
from mavfi_cli.link.commands import CommandChannel, Ticket, Verdict
from mavfi_cli.link.telemetry import Telemetry

_SETTLE_S = 0.5  # an autopilot's words may follow its refusal
_EFFECT_S = 3.0  # what was accepted shows an effect within this
_MODE_TRIES = 5
_MODE_PATIENCE_S = 1.5  # HEARTBEAT comes once a second
_LOOK_INTERVAL_S = 0.2
_HOME_INTERVAL_S = 1.0
_WARNING = dialect.MAV_SEVERITY_WARNING


class Requests:
    """Asks in the name of one phase of the session at a time.

    Args:
        commands: takes the commands to the link.
        telemetry: where their effect shows.

    Attributes:
        now_s: the stamp; set it before anything is asked.
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
        """A phase begins: nothing was asked in it yet."""
        self._ticket: Ticket | None = None  # the one command that the phase hangs on
        self._decided_s: float | None = None
        self._mode_since_s, self._mode_tries = -math.inf, 0
        self._texts_before = self._telemetry.texts.total

    @property
    def asked(self) -> bool:
        """Whether a command of this phase is under way or was decided."""
        return self._ticket is not None

    def refuse(self, command: str, result: str) -> NoReturn:
        """Give up what was asked for, with what the autopilot has said since the phase began.

        Raises:
            CommandRefused: always.
        """
        texts = self._telemetry.texts
        texts.expire(self.now_s, 0.0)
        said = (each for each in texts.since(self._texts_before) if each.severity <= _WARNING)
        raise CommandRefused(command, result, dict.fromkeys(text.text for text in said))

    def insist(self, name: str, command: int, *parameters: float, unused: float = 0.0) -> bool:
        """Bring one command home; True once it is accepted.

        An accepted one that shows no effect is sent again, for as long as this is called.

        Raises:
            CommandRefused: it was refused for good.
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
        if ticket.verdict is Verdict.ACCEPTED:
            if waited_s >= _EFFECT_S:
                self._ticket = None
            return True
        if waited_s >= _SETTLE_S:
            self.refuse(name, ticket.result)
        return False

    def mode(self, mode: str) -> bool:
        """Ask for a mode until HEARTBEAT shows it; an acknowledgement alone is not believed.

        Raises:
            CommandRefused: it was asked for in vain too often.
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
        """Ask for a HEARTBEAT now, to see a change sooner than once a second shows it."""
        if self.now_s >= self._next_look_s and not (self._look and self._look.pending):
            self._next_look_s = self.now_s + _LOOK_INTERVAL_S
            self._look = self._commands.submit(
                dialect.MAV_CMD_REQUEST_MESSAGE, dialect.MAVLINK_MSG_ID_HEARTBEAT
            )

    def home(self) -> None:
        """Ask for HOME_POSITION, once a second."""
        if self.now_s >= self._next_home_s and not (self._home and self._home.pending):
            self._next_home_s = self.now_s + _HOME_INTERVAL_S
            self._home = self._commands.submit(
                dialect.MAV_CMD_REQUEST_MESSAGE, dialect.MAVLINK_MSG_ID_HOME_POSITION
            )

    def streams(self, state_rate_hz: float) -> None:
        """Ask for what a flight needs to hear: the state at this rate, the rest slower."""
        state_us = 1e6 / state_rate_hz
        for message_id, interval_us in (
            (dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, state_us),
            (dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED, state_us),
            (dialect.MAVLINK_MSG_ID_EXTENDED_SYS_STATE, 2e5),
            (dialect.MAVLINK_MSG_ID_SYS_STATUS, 5e5),
            (dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT, 5e5),
        ):
            self._commands.submit(dialect.MAV_CMD_SET_MESSAGE_INTERVAL, message_id, interval_us)
