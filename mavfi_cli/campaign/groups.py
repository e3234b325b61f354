"""The flown missions of a campaign, gathered by setting or by some of its factors."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from mavfi_cli.campaign.ledger import COLUMNS, Ledger
from mavfi_cli.campaign.missions import canonical
from mavfi_cli.campaign.outcome import Injected, State
from mavfi_cli.campaign.stopping import COUNTED
from mavfi_cli.core.errors import UnknownName

Row = tuple[Any, ...]  # number, cell, pair and the ledger's COLUMNS
INACTIVE = frozenset(each.value for each in Injected) - COUNTED
_PLACE = {name: 3 + index for index, name in enumerate(COLUMNS)}


@dataclass(frozen=True)  # no slots: what is asked of all rows is asked once
class Group:
    """Missions that are counted together.

    Attributes:
        labels: what they have in common.
        planned, errors: on the list; of them such that could not begin.
        rows: the flown ones, in the order of the list.
    """

    labels: Mapping[str, Any]
    planned: int
    errors: int
    rows: list[Row] = field(default_factory=list)

    def of(self, fates: frozenset[str]) -> Iterator[Row]:
        """The missions whose fault had one of these fates."""
        return (row for row in self.rows if value(row, "injected") in fates)

    def successes(self, name: str, fates: frozenset[str]) -> list[float]:
        """A column of the successful ones among them."""
        found = (value(row, name) for row in self.of(fates) if succeeded(row))
        return [float(each) for each in found if each is not None]

    def counts(self, column: str) -> dict[str, int]:
        """How often each value of a column comes."""
        return dict(sorted(Counter(str(value(row, column)) for row in self.rows).items()))

    @cached_property
    def golden(self) -> bool:
        """Whether no fault was asked for."""
        none = Injected.GOLDEN.value
        return all(value(row, "injected") == none for row in self.rows)

    @cached_property
    def pairs(self) -> frozenset[str]:
        """Of the missions that are counted."""
        return frozenset(pair_of_row(row) for row in self.of(COUNTED))


def value(row: Row, column: str) -> Any:
    """One of the ledger's COLUMNS."""
    return row[_PLACE[column]]


def pair_of_row(row: Row) -> str:
    """What its golden, faulty and protected flights share."""
    return str(row[2])


def succeeded(row: Row) -> bool:
    """Whether the mission reached its goal."""
    return bool(value(row, "outcome") == "success")


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
