"""What a phase of the session wants of the autopilot: asked for until it shows, or refused.

An acknowledgement alone is not believed: an autopilot may accept and do nothing, so what counts
is the effect that its telemetry shows.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from mavfi_cli.link.codec import dialect
from mavfi_cli.link.commands import CommandChannel, Ticket, Verdict
from mavfi_cli.link.telemetry import Telemetry

_SETTLE_S = 0.5  # an autopilot's words may follow its refusal
_EFFECT_S = 3.0  # what was accepted shows an effect within this
_MODE_TRIES = 5
_MODE_PATIENCE_S = 1.5  # HEARTBEAT comes once a second
_LOOK_INTERVAL_S = 0.2


class Question:
    """Asks for one message, again and again but never twice at a time.

    Args:
        commands: by which it asks.
        message_id: of the message.
        interval_s: it asks no more often.
    """

    def __init__(self, commands: CommandChannel, message_id: int, interval_s: float) -> None:
        self._commands = commands
        self._message_id = message_id
        self._interval_s = interval_s
        self._next_s = -math.inf
        self._ticket: Ticket | None = None

    def ask(self, now_s: float) -> None:
        """Ask now, unless it was asked for just now or an answer is awaited."""
        if now_s >= self._next_s and not (self._ticket and self._ticket.pending):
            self._next_s = now_s + self._interval_s
            self._ticket = self._commands.submit(dialect.MAV_CMD_REQUEST_MESSAGE, self._message_id)


class Errand:
    """The one command that the present phase hangs on.

    Args:
        commands: by which it asks.
        telemetry: tells the time and shows effects.
        refuse: called with the name of what was asked for and the autopilot's answer, where that
            answer is final.
    """

    def __init__(
        self, commands: CommandChannel, telemetry: Telemetry, refuse: Callable[[str, str], None]
    ) -> None:
        self._commands = commands
        self._telemetry = telemetry
        self._refuse = refuse
        self._heartbeat = Question(commands, dialect.MAVLINK_MSG_ID_HEARTBEAT, _LOOK_INTERVAL_S)
        self.begin()

    def begin(self) -> None:
        """Another phase: nothing is asked for yet."""
        self._ticket: Ticket | None = None
        self._decided_s: float | None = None
        self._mode_since_s, self._mode_tries = -math.inf, 0

    @property
    def asked(self) -> bool:
        """Whether the phase's command is under way, or answered and its effect awaited."""
        return self._ticket is not None

    def insist(self, name: str, command: int, *parameters: float, unused: float = 0.0) -> bool:
        """Bring one command home; True once it is accepted. A final refusal ends the session.

        An accepted one that shows no effect is sent again, for as long as the phase calls this.

        Args:
            name: for people.
            command: a MAV_CMD number.
            parameters: the first of its seven parameters; the others become `unused`.
            unused: value of a parameter without meaning.
        """
        now_s = self._telemetry.now_s
        if self._ticket is None:
            self._ticket = self._commands.submit(command, *parameters, unused=unused, refusals=2)
            self._decided_s = None
        ticket = self._ticket
        if ticket.pending:
            return False
        if self._decided_s is None:
            self._decided_s = now_s
        waited_s = now_s - self._decided_s
        if ticket.verdict is Verdict.ACCEPTED:
            if waited_s >= _EFFECT_S:
                self._ticket = None
            return True
        if waited_s >= _SETTLE_S:
            self._refuse(name, ticket.result)
        return False

    def seek_mode(self, mode: str) -> bool:
        """Ask for a mode until HEARTBEAT shows it; whether it does."""
        telemetry = self._telemetry
        if telemetry.mode == mode:
            return True
        pending = self._ticket is not None and self._ticket.pending
        if not pending and telemetry.now_s - self._mode_since_s >= _MODE_PATIENCE_S:
            if self._mode_tries >= _MODE_TRIES:
                result = self._ticket.result if self._ticket is not None else ""
                self._refuse(f"mode {mode}", f"{result}, mode stays {telemetry.mode}")
                return False
            self._mode_tries += 1
            self._mode_since_s = telemetry.now_s
            enabled = dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
            if telemetry.armed:
                enabled |= dialect.MAV_MODE_FLAG_SAFETY_ARMED
            self._ticket = self._commands.submit(
                dialect.MAV_CMD_DO_SET_MODE, enabled, *telemetry.autopilot.mode_parameters(mode)
            )
        self.look_at_heartbeat()
        return False

    def look_at_heartbeat(self) -> None:
        """Ask for a HEARTBEAT now, to see a change sooner than once a second shows it."""
        self._heartbeat.ask(self._telemetry.now_s)
