"""The items of the paper: its figures and tables that are experiments, and the numbers it prints.

paper.toml has them all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import Any

from mavfi_cli.core.config import read_toml
from mavfi_cli.core.errors import ConfigError, UnknownName
from mavfi_cli.report.tables.paper_table import PaperColumn, PaperRow, PaperTable, Printed

_PAPER, _ = read_toml(Path(__file__).parent / "paper.toml")
_ROMAN = ("", "I", "II", "III", "IV", "V")


class Source(Enum):
    """What an item is computed from."""

    FLIGHTS = "flights"
    KERNELS = "kernels"  # runs of isolated kernels
    MODEL = "model"  # the performance model, which flies nothing


@dataclass(frozen=True, slots=True, kw_only=True)
class Item:
    """A figure or a table of the paper.

    Attributes:
        name: as on the command line, such as `fig6`.
        title: what it shows.
        labels: headings of its table's labels.
        columns: of its table; a column without a title stands for one of each world.
        notes: below its table.
        origin: where the paper prints its numbers, and what it only draws.
        preset: the campaign that flies it; empty if its source is not flights.
    """

    name: str
    title: str
    labels: tuple[str, ...]
    columns: tuple[PaperColumn, ...]
    notes: tuple[str, ...]
    origin: str
    preset: str
    source: Source

    @property
    def paper(self) -> str:
        """The paper's name of it."""
        return printed_name(self.name)

    def table(
        self, rows: Sequence[PaperRow], worlds: Sequence[str] = (), notes: Sequence[str] = ()
    ) -> PaperTable:
        """The item's table with these rows, and with more notes."""
        return PaperTable(
            name=self.name,
            title=f"{self.paper}: {self.title}",
            labels=self.labels,
            columns=tuple(
                column if column.title else replace(column, title=world)
                for column in self.columns
                for world in ([column.title] if column.title else worlds)
            ),
            rows=tuple(rows),
            notes=(*self.notes, *notes, self.origin),
        )


def printed_name(name: str) -> str:
    """The paper's name of a figure or table, such as `Fig. 6` of `fig6`."""
    table = name.removeprefix("table")
    return f"Fig. {name.removeprefix('fig')}" if table == name else f"Table {_ROMAN[int(table)]}"


def printed(item: str, *keys: object) -> Printed:
    """A number that the paper prints, or its words; None if it prints nothing there."""
    found: Any = _PAPER.get(item, {})
    for key in keys:
        found = found.get(str(key)) if isinstance(found, Mapping) else None
    if found is None or isinstance(found, str):
        return found
    return float(found)


def _item(name: str, told: Mapping[str, Any]) -> Item:
    drawn = f"; {told['unprinted']}: drawn only" if "unprinted" in told else ""
    return Item(
        name=name,
        title=told["title"],
        labels=tuple(told["labels"]),
        columns=tuple(PaperColumn(**each) for each in told["columns"]),
        notes=tuple(_PAPER["notes"].get(each, each) for each in told["notes"]),
        origin=f"paper: {told['source']}{drawn}",
        preset=told.get("preset", ""),
        source=Source(told.get("computed_from", "flights")),
    )


ITEMS = tuple(_item(name, told) for name, told in _PAPER.items() if "title" in told)
BY_NAME = {item.name: item for item in ITEMS}
LEFT_OUT: Mapping[str, str] = _PAPER["left_out"]
"""Figures and tables of the paper that are no experiment, and why."""


def items_named(names: Sequence[str]) -> tuple[Item, ...]:
    """The items of these names, in the order of ITEMS; no names mean all.

    Raises:
        UnknownName: there is no such item. Suggests the nearest.
        ConfigError: the paper has it, but it is no experiment; says what it is.
    """
    for name in names:
        if name in LEFT_OUT:
            raise ConfigError(f"is no experiment: it {LEFT_OUT[name]}", key=name)
        if name not in BY_NAME:
            raise UnknownName("item", name, BY_NAME)
    return tuple(item for item in ITEMS if not names or item.name in names)
