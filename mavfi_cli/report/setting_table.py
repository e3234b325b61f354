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

UNPAIRED = (
    "a user's companion: the fault repeats and the flight does not, so settings are compared "
    "unpaired"
)


class SettingRow(NamedTuple):
    """The labels and the name of a setting, and its cells in a table."""

    labels: Labels
    name: str
    cells: Sequence[str]


@dataclass(frozen=True, slots=True)
class SettingColumns:
    """Columns and common labels of some settings.

    Attributes:
        keys: the labels that have a column, in order.
        common: other labels, which have one value in all settings that have them.
    """

    keys: tuple[str, ...]
    common: Labels

    @classmethod
    def of(cls, settings: Sequence[Labels]) -> SettingColumns:
        """Choose the columns that distinguish settings, and leave out their common labels.

        A single setting has no columns, because its name is enough.
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
        """Headings of the labels' columns."""
        return self.keys or ("setting",)

    @property
    def notes(self) -> list[str]:
        """The line above a table that lists the common labels; no line if there are none."""
        return [f"in all settings that have it: {label_text(self.common)}"] if self.common else []

    def lines(self, head: Sequence[str], rows: Iterable[SettingRow]) -> list[str]:
        """Return one line per setting, in several tables if one would be wider than WIDTH.

        Args:
            head: headings of the cells.
        """
        table = [[*self.cells(row.labels, row.name), *row.cells] for row in rows]
        return Table([[*self.heads, *head], *table], labels=len(self.heads)).lines(WIDTH)

    def cells(self, labels: Labels, name: str) -> list[str]:
        """Return the cells of a setting's labels; the first empty one has the rest of its name."""
        if not self.keys:
            return [name]
        cells = _cells(labels, self.keys)
        beyond = name.removeprefix(label_text(labels)).strip()
        if beyond and "" in cells:
            cells[cells.index("")] = beyond
        return cells


def _cells(labels: Labels, keys: Sequence[str]) -> list[str]:
    return [label_value(labels[key]) if key in labels else "" for key in keys]
