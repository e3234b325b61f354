"""MAVLink's command protocol: sends a command, awaits its acknowledgement, repeats it.

The caller supplies the time. An acknowledgement names the command only, so the same command is
never pending twice for one component. Source: https://mavlink.io/en/services/command.html.
"""

from __future__ import annotations

from collections import deque
from enum import Enum

from mavfi_cli.link.codec import Message, dialect

TIMEOUT_S = 0.5
PROGRESS_TIMEOUT_S = 5.0  # after MAV_RESULT_IN_PROGRESS
TRIES = 4
REFUSAL_PAUSE_S = 1.0
_MAX_WAITING = 64

_RESULTS = {
    dialect.MAV_RESULT_ACCEPTED: "accepted",
    dialect.MAV_RESULT_TEMPORARILY_REJECTED: "temporarily rejected",
    dialect.MAV_RESULT_DENIED: "denied",
    dialect.MAV_RESULT_UNSUPPORTED: "unsupported",
    dialect.MAV_RESULT_FAILED: "failed",
    dialect.MAV_RESULT_IN_PROGRESS: "in progress",
    dialect.MAV_RESULT_COMMAND_LONG_ONLY: "only as COMMAND_LONG",
    dialect.MAV_RESULT_COMMAND_INT_ONLY: "only as COMMAND_INT",
}
# Refusals that may be temporary.
_PASSING = (dialect.MAV_RESULT_TEMPORARILY_REJECTED, dialect.MAV_RESULT_FAILED)


class CommandState(Enum):
    """State of a command."""

    PENDING = "pending"
    ACCEPTED = "accepted"
    REFUSED = "refused"
    UNANSWERED = "no answer"


class Ticket:
    """A submitted command. `verdict` is its state, `result` the peer's answer in words."""

    __slots__ = (
        "command", "component", "due_s", "parameters", "refusals_left", "result", "sent",
        "sent_since_answer", "verdict",
    )  # fmt: skip

    def __init__(
        self, command: int, parameters: tuple[float, ...], component: int, refusals: int
    ) -> None:
        self.command = command
        self.component = component
        self.parameters = parameters
        self.refusals_left = refusals
        self.verdict = CommandState.PENDING
        self.result = CommandState.UNANSWERED.value
        self.sent = 0
        self.sent_since_answer = 0
        self.due_s = -1.0

    @property
    def pending(self) -> bool:
        """True until the command is accepted, refused or given up."""
        return self.verdict is CommandState.PENDING


class CommandChannel:
    """Commands to the components of one system.

    Args:
        system: Own system id.
        component: Own component id. Acknowledgements for other components are ignored.
    """

    def __init__(self, system: int, component: int) -> None:
        self._own = (system, component)
        self._lanes: dict[tuple[int, int], deque[Ticket]] = {}
        self._now_s = 0.0

    def submit(
        self,
        command: int,
        *parameters: float,
        component: int = dialect.MAV_COMP_ID_AUTOPILOT1,
        unused: float = 0.0,
        refusals: int = 0,
    ) -> Ticket:
        """Queue a COMMAND_LONG.

        Args:
            command: MAV_CMD number.
            parameters: First of its seven parameters; the others are set to `unused`.
            component: Component id of the receiver.
            unused: Value of an unused parameter.
            refusals: Number of temporary refusals after which the command is repeated, 1 s later.
        """
        padded = (*parameters, *[unused] * (7 - len(parameters)))
        ticket = Ticket(command, padded, component, refusals)
        lane = self._lanes.setdefault((component, command), deque())
        if len(lane) >= _MAX_WAITING:
            ticket.verdict = CommandState.UNANSWERED
        else:
            lane.append(ticket)
        return ticket

    def acknowledge(self, message: Message) -> None:
        """Handle a COMMAND_ACK. It is ignored if it answers none of our commands."""
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
            ticket.due_s = self._now_s + PROGRESS_TIMEOUT_S
        elif message.result == dialect.MAV_RESULT_ACCEPTED:
            self._close(lane, CommandState.ACCEPTED)
        elif message.result in _PASSING and ticket.refusals_left > 0:
            ticket.refusals_left -= 1
            ticket.due_s = self._now_s + REFUSAL_PAUSE_S
        else:
            self._close(lane, CommandState.REFUSED)

    def poll(self, stamp_s: float, system: int) -> list[Message]:
        """Return the commands that are due at `stamp_s`, addressed to `system`."""
        self._now_s = stamp_s
        due = []
        for lane in self._lanes.values():
            while lane and lane[0].due_s <= stamp_s:
                ticket = lane[0]
                if ticket.sent_since_answer < TRIES:
                    due.append(self._send(ticket, system))
                    break
                self._close(lane, CommandState.UNANSWERED)
        return due

    def _send(self, ticket: Ticket, system: int) -> Message:
        confirmation = min(ticket.sent, 255)
        ticket.sent += 1
        ticket.sent_since_answer += 1
        ticket.due_s = self._now_s + TIMEOUT_S
        return dialect.MAVLink_command_long_message(
            system, ticket.component, ticket.command, confirmation, *ticket.parameters
        )

    @staticmethod
    def _close(lane: deque[Ticket], verdict: CommandState) -> None:
        lane.popleft().verdict = verdict
