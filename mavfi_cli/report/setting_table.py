"""Settings as rows of a table: a column per distinguishing label, common labels printed once."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from mavfi_cli.campaigns.missions import Label, Labels, label_text, label_value, ordered
from mavfi_cli.report.table import WIDTH, Table

BY_WEIGHT = (
    "stratified sample: rates and means are by weight; effective n uniform missions would give the "
    "same interval"
)

UNPAIRED = "a user's companion: its flights may not repeat, so settings are compared unpaired"


class SettingRow(NamedTuple):
    """One row in a table of settings: the setting's labels and name, and its formatted cells."""

    labels: Labels
    name: str
    cells: Sequence[str]


@dataclass(frozen=True, slots=True)
class SettingColumns:
    """The label columns in a table of settings, and the labels that the settings share.

    Attributes:
        keys: names of the labels that have a column, in display order.
        common: the other labels, each with the one value that it has in all settings that have it.
    """

    keys: tuple[str, ...]
    common: Labels

    @classmethod
    def of(cls, settings: Sequence[Labels]) -> SettingColumns:
        """Choose the label columns that distinguish the settings; the other labels are common.

        A single setting has no label columns, because its name is enough.
        """
        if len(settings) == 1:
            return cls((), {})
        keys = ordered({key for labels in settings for key in labels})
        common: dict[str, Label] = {}
        for key in reversed(keys):
            values = {label_value(labels[key]): labels[key] for labels in settings if key in labels}
            left = [other for other in keys if other not in common and other != key]
            apart = {tuple(_cells(labels, left)) for labels in settings}
            if len(values) == 1 and len(apart) == len(settings):
                (common[key],) = values.values()
        return cls(tuple(key for key in keys if key not in common), common)

    @property
    def heads(self) -> tuple[str, ...]:
        """The headings of the label columns, or of the column of names if there are none."""
        return self.keys or ("setting",)

    @property
    def notes(self) -> list[str]:
        """A line that lists the common labels, for above the table; empty if there are none."""
        return [f"in all settings that have it: {label_text(self.common)}"] if self.common else []

    def lines(self, head: Sequence[str], rows: Iterable[SettingRow]) -> list[str]:
        """Return the lines of a table with one row per setting.

        If the table is wider than WIDTH, it is split into several tables.

        Args:
            head: headings of the rows' `cells`.
        """
        table = [[*self.cells(row.labels, row.name), *row.cells] for row in rows]
        return Table([[*self.heads, *head], *table], labels=len(self.heads)).lines(WIDTH)

    def cells(self, labels: Labels, name: str) -> list[str]:
        """Return a setting's cells in the label columns.

        The first empty cell holds the part of the name that the labels do not contain. Without
        label columns, the only cell is the name.
        """
        if not self.keys:
            return [name]
        cells = _cells(labels, self.keys)
        beyond = name.removeprefix(label_text(labels)).strip()
        if beyond and "" in cells:
            cells[cells.index("")] = beyond
        return cells


def _cells(labels: Labels, keys: Sequence[str]) -> list[str]:
    return [label_value(labels[key]) if key in labels else "" for key in keys]
