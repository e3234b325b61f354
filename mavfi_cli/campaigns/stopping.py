"""Sequential stopping: a setting is flown until the interval of its success rate is narrow enough.

The interval is checked after every batch of a setting, over exactly the first missions of the list
up to there, in whatever order they ended. So the number of workers does not change when a setting
stops. Frequent checks make the true confidence a little lower than the nominal one.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from mavfi_cli.campaigns.missions import COUNTED
from mavfi_cli.campaigns.specification import Stop
from mavfi_cli.stats.shares import rate

Entry = tuple[int, int, dict[str, Any]]  # number, setting, changes of a mission
Row = tuple[str | None, str | None]  # outcome, what happened to the fault


class BatchLimiter:
    """Lets missions through a batch of their setting at a time.

    Args:
        stop: the rule.
        cells: the setting of each mission, in the order of the list.
        over: number, outcome and fate of the fault of every mission that is over.
    """

    def __init__(
        self, stop: Stop, cells: Sequence[int], over: Iterable[tuple[int, Row]] = ()
    ) -> None:
        self._stop = stop
        self._cells = cells
        self._members: dict[int, list[int]] = {}
        self._place: list[int] = []
        for number, cell in enumerate(cells):
            members = self._members.setdefault(cell, [])
            self._place.append(len(members))
            members.append(number)
        self._open = dict.fromkeys(self._members, stop.batch)
        self._over: dict[int, Row] = {}
        self._finished: Counter[int] = Counter()  # missions over below the open boundary
        self.stopped: set[int] = set()
        for number, row in over:
            self.record(number, row)

    def passes(self, number: int) -> bool:
        """True if this mission may begin now."""
        cell = self._cells[number]
        return cell not in self.stopped and self._place[number] < self._open[cell]

    def record(self, number: int, row: Row) -> None:
        """Note that a mission is over."""
        cell = self._cells[number]
        self._over[number] = row
        if self._place[number] < self._open[cell]:
            self._finished[cell] += 1
        while self._complete(cell):
            if self._narrow(cell):
                self.stopped.add(cell)
                return
            first = self._open[cell]
            self._open[cell] += self._stop.batch
            batch = self._members[cell][first : self._open[cell]]
            self._finished[cell] += sum(number in self._over for number in batch)

    def _complete(self, cell: int) -> bool:
        """True if all admitted missions are over and more follow."""
        return cell not in self.stopped and self._finished[cell] == self._open[cell] < len(
            self._members[cell]
        )

    def _narrow(self, cell: int) -> bool:
        rows = [self._over[number] for number in self._members[cell][: self._open[cell]]]
        counted = [outcome for outcome, injected in rows if injected in COUNTED]
        wins = sum(outcome == "success" for outcome in counted)
        share = rate(wins, len(counted), self._stop.confidence)
        return (share.high - share.low) / 2.0 <= self._stop.margin


class Queue:
    """The missing missions in the order of the list, each as soon as its limiter admits it.

    Args:
        missing: number, setting and changes of each mission.
    """

    def __init__(self, missing: Iterator[Entry], gate: BatchLimiter | None) -> None:
        self._missing = missing
        self._gate = gate
        self._held: dict[int, deque[Entry]] = {}  # by setting, in the order of the list

    def next(self) -> Entry | None:
        """The next mission that may begin; None where there is none now."""
        if self._gate is None:
            return next(self._missing, None)
        return self._released(self._gate) or self._fresh(self._gate)

    def _released(self, gate: BatchLimiter) -> Entry | None:
        """The first waiting mission that may begin now."""
        self._held = {
            cell: held for cell, held in self._held.items() if held and cell not in gate.stopped
        }
        ready = [held for held in self._held.values() if gate.passes(held[0][0])]
        return min(ready, key=lambda held: held[0][0]).popleft() if ready else None

    def _fresh(self, gate: BatchLimiter) -> Entry | None:
        for entry in self._missing:
            number, cell, _ = entry
            if gate.passes(number):
                return entry
            if cell not in gate.stopped:
                self._held.setdefault(cell, deque()).append(entry)
        return None
