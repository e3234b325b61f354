"""The flown missions of a campaign, gathered by setting or by some of its factors."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.campaign.ledger import COLUMNS, Ledger
from mavfi_cli.campaign.missions import canonical
from mavfi_cli.campaign.outcome import Injected, State
from mavfi_cli.campaign.stopping import COUNTED
from mavfi_cli.core.errors import UnknownName
from mavfi_cli.core.types import FloatArray

BoolArray = NDArray[np.bool_]

INACTIVE = frozenset(each.value for each in Injected) - COUNTED
_PAIR = 2  # place of the pair in a row of the ledger's table; its COLUMNS follow


@dataclass(frozen=True)  # no slots: what is asked of all rows is computed once
class Group:
    """Missions that are counted together.

    Attributes:
        labels: what they have in common.
        planned, errors: on the list; of them such that could not begin.
        rows: of the ledger's table, the flown ones, in the order of the list.
    """

    labels: Mapping[str, Any]
    planned: int
    errors: int
    rows: list[tuple[Any, ...]] = field(default_factory=list)

    def column(self, name: str) -> list[Any]:
        """One of the ledger's COLUMNS, (n,)."""
        place = _PAIR + 1 + COLUMNS.index(name)
        return [row[place] for row in self.rows]

    def numbers(self, name: str) -> FloatArray:
        """A column of numbers, (n,); not a number where a mission has none."""
        if name not in self._numbers:
            self._numbers[name] = np.array(self.column(name), dtype=np.float64)
        return self._numbers[name]

    @cached_property
    def _numbers(self) -> dict[str, FloatArray]:
        return {}

    @cached_property
    def succeeded(self) -> BoolArray:
        """Whether each mission reached its goal, (n,)."""
        return np.array([outcome == "success" for outcome in self.column("outcome")], dtype=bool)

    def of(self, fates: frozenset[str]) -> BoolArray:
        """Whether the fault of each mission had one of these fates, (n,)."""
        if fates not in self._masks:
            self._masks[fates] = np.array(
                [fate in fates for fate in self.column("injected")], dtype=bool
            )
        return self._masks[fates]

    @cached_property
    def _masks(self) -> dict[frozenset[str], BoolArray]:
        return {}

    def successes(self, name: str, fates: frozenset[str]) -> FloatArray:
        """A column of the successful ones among them that have the number."""
        found = self.numbers(name)[self.succeeded & self.of(fates)]
        return found[~np.isnan(found)]

    def counts(self, column: str) -> dict[str, int]:
        """How often each value of a column comes."""
        return dict(sorted(Counter(map(str, self.column(column))).items()))

    @cached_property
    def golden(self) -> bool:
        """Whether no fault was asked for."""
        return bool(self.of(frozenset((Injected.GOLDEN.value,))).all())

    @cached_property
    def pairs(self) -> dict[str, list[int]]:
        """The rows that are counted, by what golden, faulty and protected flights share."""
        found: dict[str, list[int]] = {}
        for place in np.flatnonzero(self.of(COUNTED)).tolist():
            found.setdefault(self.rows[place][_PAIR], []).append(place)
        return found


def groups(ledger: Ledger, by: Sequence[str] = ()) -> list[Group]:
    """The settings, or those together that have equal values of the labels `by`.

    Raises:
        UnknownName: no setting has such a label.
    """
    labels = ledger.cells()
    known = {name for each in labels for name in each}
    for name in by:
        if name not in known:
            raise UnknownName("label", name, known)
    errors = Counter[int]()
    for cell, state, _, _, count in ledger.counts():
        errors[cell] += count if state == State.ERROR.value else 0
    kept = [{name: each[name] for name in by or each if name in each} for each in labels]
    members: dict[str, list[int]] = {}
    for cell, each in enumerate(kept):
        members.setdefault(canonical(each), []).append(cell)
    planned = ledger.planned_by_cell()
    found = [
        Group(kept[cells[0]], sum(planned[c] for c in cells), sum(errors[c] for c in cells))
        for cells in members.values()
    ]
    place = {cell: group for group, cells in zip(found, members.values(), strict=True)
             for cell in cells}  # fmt: skip
    for row in ledger.table():
        place[row[1]].rows.append(row)
    return found
