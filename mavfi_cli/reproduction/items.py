"""The items of the paper: its figures and tables that are experiments, and what each needs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

from mavfi_cli.core.errors import ConfigError, UnknownName


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
        preset: the campaign that flies it; empty if its source is not flights.
    """

    name: str
    title: str
    preset: str = ""
    source: Source = Source.FLIGHTS

    @property
    def paper(self) -> str:
        """The paper's name of it."""
        return printed_name(self.name)


_ROMAN = ("", "I", "II", "III", "IV", "V")


def printed_name(name: str) -> str:
    """The paper's name of a figure or table, such as `Fig. 6` of `fig6`."""
    table = name.removeprefix("table")
    return f"Fig. {name.removeprefix('fig')}" if table == name else f"Table {_ROMAN[int(table)]}"


ITEMS = (
    Item(name="fig6", title="outcomes of faults in isolated kernels", source=Source.KERNELS),
    Item(name="fig7", title="faults in each kernel of the flight", preset="fig7"),
    Item(name="fig8", title="faults in each inter-kernel state", preset="fig8"),
    Item(name="fig9", title="faults in each field of float64", preset="fig9"),
    Item(name="fig11", title="ranges of the states' values and of their deltas", preset="fig11"),
    Item(name="fig12", title="flight time with detection and recovery", preset="table4"),
    Item(name="fig13", title="trajectories: golden, with a fault, recovered", preset="fig13"),
    Item(name="fig14", title="worst flight time by protected stages", preset="fig14"),
    Item(name="fig15", title="flight time with redundant computers", source=Source.MODEL),
    Item(name="fig16", title="two computing platforms", preset="fig16"),
    Item(name="table3", title="number of flipped bits", preset="table3"),
    Item(name="table4", title="success rate in four worlds", preset="table4"),
    Item(name="table5", title="compute time of detection and recovery", preset="table4"),
)
BY_NAME = {item.name: item for item in ITEMS}

LEFT_OUT = {
    "table1": "compares the speed of injectors at other levels, from the literature",
    "table2": "compares the features of injectors, from the literature",
    "fig1": "draws the pipeline",
    "fig2": "draws the system",
    "fig3": "plots Table I",
    "fig4": "draws the framework",
    "fig5": "draws the injector",
    "fig10": "draws the detectors",
}
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
