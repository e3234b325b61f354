"""Implements MAVLink's command protocol: sends a command and repeats it until it is acknowledged.

The caller supplies the time. An acknowledgement names only the command, so equal commands to one
component are sent one after the other. Source: https://mavlink.io/en/services/command.html.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import NoReturn

from mavfi_cli.core.errors import CommandRefused
from mavfi_cli.link.codec import SLOW_STREAMS_US, STATE_STREAMS, Message, dialect
from mavfi_cli.link.telemetry import Telemetry

TIMEOUT_S = 0.5
PROGRESS_TIMEOUT_S = 5.0  # after MAV_RESULT_IN_PROGRESS
TRIES = 4
REFUSAL_PAUSE_S = 1.0
_MAX_WAITING = 64

_RESULTS = {
    number: entry.name.removeprefix("MAV_RESULT_").replace("_", " ").lower()
    for number, entry in dialect.enums["MAV_RESULT"].items()
}
# Refusals that may be temporary.
_PASSING = (dialect.MAV_RESULT_TEMPORARILY_REJECTED, dialect.MAV_RESULT_FAILED)

_SETTLE_S = 0.5  # wait for status texts after a refusal
_EFFECT_S = 3.0  # wait for the effect of an accepted command
_MODE_TRIES = 5
_MODE_PATIENCE_S = 1.5  # wait for a mode change; HEARTBEAT arrives once a second
_LOOK_INTERVAL_S = 0.2
_HOME_INTERVAL_S = 1.0
_WARNING = dialect.MAV_SEVERITY_WARNING
_MOST_TEXTS = 5  # maximum number of the autopilot's texts that an error quotes


@dataclass(slots=True, kw_only=True)
class Ticket:
    """A submitted command, with its progress and its result."""

    command: int
    component: int
    parameters: tuple[float, ...]
    refusals_left: int
    accepted: bool | None = None  # None until it is decided; False if refused or given up
    result: str = "no answer"  # description of the peer's answer
    sent: int = 0
    sent_since_answer: int = 0
    due_s: float = -1.0

    @property
    def pending(self) -> bool:
        """True until the command is accepted, refused or given up."""
        return self.accepted is None


class Commands:
    """The commands that a session sends to the components of one MAVLink system.

    Several submitted commands may be pending at once. In addition, each phase of the session makes
    one request at a time, which is repeated until telemetry shows its effect. Set `now_s`, the
    current stamp, before any request. Acknowledgements of other senders' commands are ignored.
    """

    def __init__(self, system: int, component: int, telemetry: Telemetry) -> None:
        self._own = (system, component)
        self._telemetry = telemetry
        self.now_s = 0.0
        self._lanes: dict[tuple[int, int], deque[Ticket]] = {}
        self._requested: dict[
            int, tuple[Ticket, float]
        ] = {}  # message id -> request, earliest time of the next
        self.begin()

    def submit(
        self,
        command: int,
        *parameters: float,
        component: int = dialect.MAV_COMP_ID_AUTOPILOT1,
        unused: float = 0.0,
        refusals: int = 0,
    ) -> Ticket:
        """Queue a COMMAND_LONG with the given parameters, and return its ticket.

        The remaining parameters are set to `unused`. After a temporary refusal the command is
        repeated 1 s later, at most `refusals` times. If too many equal commands to this component
        are queued, the new one is given up at once.
        """
        padded = (*parameters, *[unused] * (7 - len(parameters)))
        ticket = Ticket(
            command=command, component=component, parameters=padded, refusals_left=refusals
        )
        lane = self._lanes.setdefault((component, command), deque())
        if len(lane) >= _MAX_WAITING:
            ticket.accepted = False
        else:
            lane.append(ticket)
        return ticket

    def acknowledge(self, message: Message) -> None:
        """Handle a COMMAND_ACK. Acknowledgements of other senders' commands are ignored."""
        if message.target_system not in (0, self._own[0]):
            return
        if message.target_component not in (0, self._own[1]):
            return
        lane = self._lanes.get((message.get_srcComponent(), message.command))
        if not lane or lane[0].sent == 0:
            return
        ticket = lane[0]
        ticket.result = _RESULTS.get(message.result, f"result {message.result}")
        ticket.sent_since_answer = 0
        if message.result == dialect.MAV_RESULT_IN_PROGRESS:
            ticket.due_s = self.now_s + PROGRESS_TIMEOUT_S
        elif message.result == dialect.MAV_RESULT_ACCEPTED:
            lane.popleft().accepted = True
        elif message.result in _PASSING and ticket.refusals_left > 0:
            ticket.refusals_left -= 1
            ticket.due_s = self.now_s + REFUSAL_PAUSE_S
        else:
            lane.popleft().accepted = False

    def poll(self, system: int) -> list[Message]:
        """Return the COMMAND_LONG messages that are due now, addressed to `system`."""
        due = []
        for lane in filter(None, self._lanes.values()):
            while lane and lane[0].due_s <= self.now_s:
                ticket = lane[0]
                if ticket.sent_since_answer < TRIES:
                    confirmation = min(ticket.sent, 255)
                    ticket.sent += 1
                    ticket.sent_since_answer += 1
                    ticket.due_s = self.now_s + TIMEOUT_S
                    command = (system, ticket.component, ticket.command, confirmation)
                    due.append(dialect.MAVLink_command_long_message(*command, *ticket.parameters))
                    break
                lane.popleft().accepted = False
        return due

    # Requests of the current phase

    def begin(self) -> None:
        """Begin a phase and discard the requests of the previous one."""
        self._ticket: Ticket | None = None  # the command that the phase depends on
        self._decided_s: float | None = None
        self._mode_since_s, self._mode_tries = -math.inf, 0
        self._texts_before = self._telemetry.texts.total

    @property
    def commanded(self) -> bool:
        """True once this phase has sent a command."""
        return self._ticket is not None

    def refuse(self, command: str, result: str) -> NoReturn:
        """Raise CommandRefused, quoting the autopilot's newest warnings since the phase began."""
        texts = self._telemetry.texts
        texts.expire(self.now_s, 0.0)
        warnings = (text for text in texts.since(self._texts_before) if text.severity <= _WARNING)
        words = "; ".join([*dict.fromkeys(text.text for text in warnings)][-_MOST_TEXTS:])
        quoted = f" ({words})" if words else ""
        raise CommandRefused(f"autopilot refused {command}: {result}{quoted}")

    def insist(self, name: str, command: int, *parameters: float, unused: float = 0.0) -> bool:
        """Send a command until the autopilot accepts it. Return True once it has accepted it.

        If the phase continues for 3 s after that, the command is sent again. Raises CommandRefused,
        with `name` for the command, if the autopilot refused it permanently or did not answer.
        """
        if self._ticket is None:
            self._ticket = self.submit(command, *parameters, unused=unused, refusals=2)
            self._decided_s = None
        ticket = self._ticket
        if ticket.pending:
            return False
        if self._decided_s is None:
            self._decided_s = self.now_s
        waited_s = self.now_s - self._decided_s
        if ticket.accepted:
            if waited_s >= _EFFECT_S:
                self._ticket = None
            return True
        if waited_s >= _SETTLE_S:
            self.refuse(name, ticket.result)
        return False

    def request_mode(self, mode: str) -> bool:
        """Request a flight mode. Return True once a HEARTBEAT shows that mode.

        Acknowledgements do not count. Raises CommandRefused if the mode has not changed after the
        maximum number of requests.
        """
        if self._telemetry.mode == mode:
            return True
        pending = self._ticket is not None and self._ticket.pending
        if not pending and self.now_s - self._mode_since_s >= _MODE_PATIENCE_S:
            if self._mode_tries >= _MODE_TRIES:
                result = self._ticket.result if self._ticket is not None else ""
                self.refuse(f"mode {mode}", f"{result}, the mode is still {self._telemetry.mode}")
            self._mode_tries += 1
            self._mode_since_s = self.now_s
            enabled = dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
            if self._telemetry.armed:
                enabled |= dialect.MAV_MODE_FLAG_SAFETY_ARMED
            self._ticket = self.submit(
                dialect.MAV_CMD_DO_SET_MODE,
                enabled,
                *self._telemetry.autopilot.mode_parameters(mode),
            )
        self.request_heartbeat()
        return False

    def request_heartbeat(self) -> None:
        """Request a HEARTBEAT now instead of waiting up to a second for the next."""
        self._request_message(dialect.MAVLINK_MSG_ID_HEARTBEAT, _LOOK_INTERVAL_S)

    def request_home(self) -> None:
        """Request HOME_POSITION, at most once a second."""
        self._request_message(dialect.MAVLINK_MSG_ID_HOME_POSITION, _HOME_INTERVAL_S)

    def _request_message(self, message_id: int, interval_s: float) -> None:
        if message_id in self._requested:
            ticket, next_s = self._requested[message_id]
            if ticket.pending or self.now_s < next_s:
                return
        ticket = self.submit(dialect.MAV_CMD_REQUEST_MESSAGE, message_id)
        self._requested[message_id] = ticket, self.now_s + interval_s

    def request_streams(self, state_rate_hz: float) -> None:
        """Request the message streams that a flight needs.

        The vehicle state is requested at `state_rate_hz`, the other streams at fixed rates.
        """
        state = dict.fromkeys(STATE_STREAMS, 1e6 / state_rate_hz)
        for message_id, interval_us in {**state, **SLOW_STREAMS_US}.items():
            self.submit(dialect.MAV_CMD_SET_MESSAGE_INTERVAL, message_id, interval_us)
