"""Watch of the extended states, each judged alone by its range of changes in error-free flights.

The extended states are `collision` of a report, and `plan_trajectory_seq` and
`plan_future_collision_seq` of a plan. They are integers, which are their own codes; see
`preprocess`. The change since the last accepted message must lie between the smallest and the
largest change in the training flights. All counters begin at 0 without a predicted collision, so
the first message is judged, too. A planner with its own counter also counts plans that never took
effect. After n messages that were not accepted, n + 1 changes may therefore add up.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mavfi_cli.core.types import BY_NAME, CollisionReport, Message, Scalar, Trajectory
from mavfi_cli.detect.preprocess import LIMIT, Codes

EXTENDED = tuple(
    BY_NAME[name] for name in ("collision", "plan_trajectory_seq", "plan_future_collision_seq")
)
# Smallest and largest change of each extended state by name.
Ranges = dict[str, tuple[int, int]]
# Distance of the worst change from its range, in codes, and names of the states, worst first.
Finding = tuple[float, tuple[str, ...]]
_PLACES = {
    kind: [place for place, state in enumerate(EXTENDED) if state.message is kind]
    for kind in (CollisionReport, Trajectory)
}
_REFERENCE, _LOWEST = 0, 1  # rows of the array; the third is the largest change


class ExtendedWatch:
    """Watch of the extended states of one mission's messages.

    Attributes:
        memory: Last accepted codes, smallest and largest changes, (3, 3) int16 with one column per
            state. A modification takes effect at once.
    """

    def __init__(self, ranges: Ranges) -> None:
        self.memory: Codes = np.array(
            [[0] * len(EXTENDED), *zip(*(ranges[s.name] for s in EXTENDED), strict=True)], np.int16
        )
        self._lost = dict.fromkeys(_PLACES, 0)  # messages since the last accepted one
        self._accepted: dict[float, dict[str, Scalar]] = {}  # states of each plan by its stamp

    def judge(self, message: CollisionReport | Trajectory) -> Finding | None:
        """Judge a message on its arrival. `accept` or `lose` must follow."""
        references = self.memory[_REFERENCE].tolist()
        return self._find(message, references, self._lost[type(message)] + 1)

    def accept(self, message: CollisionReport | Trajectory) -> None:
        """Accept a message, which takes effect and becomes the reference."""
        kind = type(message)
        for place in _PLACES[kind]:
            self.memory[_REFERENCE, place] = _code(EXTENDED[place].read(message, 0))
        self._lost[kind] = 0
        if isinstance(message, Trajectory):
            self._accepted[message.stamp_s] = {
                EXTENDED[place].name: EXTENDED[place].read(message, 0) for place in _PLACES[kind]
            }

    def lose(self, kind: type[CollisionReport | Trajectory]) -> None:
        """Note that a message of that kind did not take effect."""
        self._lost[kind] += 1

    def judge_flown(self, plan: Trajectory) -> Finding | None:
        """Judge the active plan, whose states may have changed since it was accepted."""
        accepted = self._accepted.get(plan.stamp_s)
        if accepted is None:
            return None
        references = [_code(accepted.get(state.name, 0)) for state in EXTENDED]
        return self._find(plan, references, 1)

    def mended(self, plan: Trajectory) -> Trajectory:
        """Return the active plan with its accepted extended states."""
        mended: Message = plan
        for name, value in self._accepted[plan.stamp_s].items():
            mended = BY_NAME[name].write(mended, 0, value)
        assert isinstance(mended, Trajectory)
        return mended

    def _find(
        self, message: CollisionReport | Trajectory, references: Sequence[int], steps: int
    ) -> Finding | None:
        found: list[tuple[int, int]] = []
        for place in _PLACES[type(message)]:
            delta = _within(_code(EXTENDED[place].read(message, 0)) - references[place])
            lowest, highest = self.memory[_LOWEST:, place].tolist()
            distance = max(steps * lowest - delta, delta - steps * highest)
            if distance > 0:
                found.append((-distance, place))
        if not found:
            return None
        found.sort()
        return float(-found[0][0]), tuple(EXTENDED[place].name for _, place in found)


def changes(messages: Sequence[CollisionReport | Trajectory]) -> Codes:
    """Return the changes (n, 3) of the extended states between messages of one kind."""
    found = np.zeros((len(messages), len(EXTENDED)), np.int16)
    before = [0] * len(EXTENDED)
    for row, message in enumerate(messages):
        for place in _PLACES[type(message)]:
            code = _code(EXTENDED[place].read(message, 0))
            found[row, place], before[place] = _within(code - before[place]), code
    return found


def ranges_of(deltas: Codes) -> Ranges:
    """Return the smallest and largest change of each extended state (n, 3); ranges include 0."""
    return {
        state.name: (min(0, *column), max(0, *column))
        for state, column in zip(EXTENDED, deltas.T.tolist(), strict=True)
    }


def _code(value: Scalar) -> int:
    return _within(int(value))


def _within(value: int) -> int:
    return min(max(value, -LIMIT), LIMIT)
