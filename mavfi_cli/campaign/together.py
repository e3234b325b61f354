"""Which missing missions fly as one: those that differ in their fault only."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

from mavfi_cli.campaign.missions import canonical, config_from
from mavfi_cli.campaign.stopping import Entry, Queue
from mavfi_cli.mission.branching import can_branch

LOOK_AHEAD = 200  # entries among which partners are looked for
MOST = 8  # of one flight: its missions come one after the other


def trunk_of(changes: Mapping[str, Any]) -> str | None:
    """A name for what missions have in common that can branch off one flight; None: it cannot."""
    if not can_branch(config_from(changes)):
        return None
    return canonical({name: value for name, value in changes.items() if name != "fault"})


class Together:
    """The missing missions, those that can fly as one together.

    Args:
        queue: of all.
        jobs: flights at the same time; the last missions are shared out among them.
    """

    def __init__(self, queue: Queue, jobs: int) -> None:
        self._queue = queue
        self._jobs = jobs
        self._ahead: deque[tuple[Entry, str | None]] = deque()

    def next(self) -> list[Entry]:
        """The missions of the next flight; empty where there is none now."""
        while len(self._ahead) < LOOK_AHEAD and (entry := self._queue.next()) is not None:
            self._ahead.append((entry, trunk_of(entry[2])))
        if not self._ahead:
            return []
        most = min(MOST, -(-len(self._ahead) // self._jobs))
        first, trunk = self._ahead.popleft()
        found = [first]
        if trunk is None or most == 1:
            return found
        bare = "fault" not in first[2]
        for place in [n for n, (_, other) in enumerate(self._ahead) if other == trunk]:
            entry = self._ahead[place][0]
            if len(found) == most:
                break
            if "fault" in entry[2] or not bare:
                bare = bare or "fault" not in entry[2]
                found.append(entry)
        taken = {entry[0] for entry in found}
        self._ahead = deque(each for each in self._ahead if each[0][0] not in taken)
        return found
