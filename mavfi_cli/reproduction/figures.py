"""The figure of each item, from the same flights as its table."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import pyarrow as pa

from mavfi_cli.analysis.flights import chosen, flown
from mavfi_cli.analysis.trajectories import pair
from mavfi_cli.campaigns.ledger import Ledger
from mavfi_cli.core.errors import RecordError
from mavfi_cli.core.types import FloatArray
from mavfi_cli.report.paper_figures import (
    SMALLEST,
    WIDTHS_IN,
    Strip,
    StripPanel,
    draw_dots,
    draw_histograms,
    draw_stack,
    draw_strips,
)
from mavfi_cli.report.tables.paper_table import PaperTable
from mavfi_cli.report.top_view import draw_trajectories, panels_of
from mavfi_cli.reproduction.evidence import item_flights
from mavfi_cli.reproduction.items import Item
from mavfi_cli.reproduction.layouts import (
    DETECTORS,
    KERNELS_FLOWN,
    PROTECTED,
    STAGES,
    values_and_deltas,
    whole,
    worlds_of,
)
from mavfi_cli.reproduction.measures import PERCENT, faulty, golden, over_own
from mavfi_cli.reproduction.paper import printed

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_QUANTITY = "flight time over the golden flight of the same mission, %"
_SETTINGS = {None: "fault", "gad": "fault, GAD", "aad": "fault, AAD"}


def draw(table: PaperTable, ledger: Ledger, item: Item | None, columns: str) -> Figure:
    """Draw the figure of an item, or the dots of another table.

    Args:
        columns: width, `one` or `two`.
    """
    if item is None or item.name not in DRAWN:
        return draw_table(table, columns)
    return draw_flights(item.name, table, item_flights(item, ledger), columns)


def draw_table(table: PaperTable, columns: str) -> Figure:
    """Draw a table whose item has no figure of its flights."""
    return (draw_stack if table.name == "fig6" else draw_dots)(table, columns)


def draw_flights(name: str, table: PaperTable, flights: pa.Table, columns: str) -> Figure:
    """Draw the figure of an item from its flights, or the dots of its table.

    Args:
        flights: as `analysis.flights.flights`. `fig13` needs their kept run folders,
            of one campaign.

    Raises:
        RecordError: these are not there.
    """
    drawn = DRAWN.get(name)
    return draw_table(table, columns) if drawn is None else drawn(flown(flights), columns)


def _increase(bare: pa.Table, struck: pa.Table) -> FloatArray:
    return PERCENT * (over_own(bare, struck) - 1.0)


def _number(name: str, *keys: object) -> float | None:
    found = printed(name, *keys)
    return found if isinstance(found, float) else None


def _fig7(table: pa.Table, columns: str) -> Figure:
    strips = []
    for title, (node, planner) in KERNELS_FLOWN.items():
        struck = faulty(table, level="instruction", fault_target=node, planner=planner)
        bare = chosen(golden(table), planner=planner)
        strips.append(Strip(label=title, values=_increase(bare, struck), style=1))
    return draw_strips([StripPanel(title="fault in", strips=strips)], _QUANTITY, columns)


def _by_value(column: str) -> Callable[[pa.Table, str], Figure]:
    def draw_values(table: pa.Table, columns: str) -> Figure:
        bare, struck = golden(table), faulty(table)
        strips = [
            Strip(
                label=str(value), values=_increase(bare, chosen(struck, **{column: value})), style=1
            )
            for value in dict.fromkeys(struck[column].to_pylist())
        ]
        return draw_strips([StripPanel(title="fault in", strips=strips)], _QUANTITY, columns)

    return draw_values


def _beside_detectors(title: str, table: pa.Table, paper: float | None) -> StripPanel:
    """A row for the flights with faults, and one for those with each detector.

    Args:
        paper: the largest increase without a detector.
    """
    strips = [
        Strip(
            label=label,
            values=_increase(golden(table), faulty(table, name)),
            style=style,
            paper=None if name else paper,
        )
        for style, (name, label) in enumerate(_SETTINGS.items(), start=1)
    ]
    return StripPanel(title=title, strips=strips)


def _fig12(table: pa.Table, columns: str) -> Figure:
    table = whole(table)
    panels = []
    for world in worlds_of(table):
        here = chosen(table, world=world)
        worst = _number("fig12", "worst_increase_percent", world)
        panels.append(_beside_detectors(world, here, worst))
    return draw_strips(panels, _QUANTITY, columns)


def _fig14(table: pa.Table, columns: str) -> Figure:
    panels = []
    for world in worlds_of(table):
        here = chosen(table, world=world)
        bare = golden(here)
        strips = [Strip(label="no protection", values=_increase(bare, faulty(here)), style=1)]
        for style, detector in enumerate(DETECTORS, start=2):
            strips += [
                Strip(
                    label=f"{detector.upper()} {_short(stages)}",
                    values=_increase(bare, faulty(here, detector, protect=stages)),
                    style=style,
                )
                for stages in PROTECTED
            ]
        panels.append(StripPanel(title=world, strips=strips))
    return draw_strips(panels, _QUANTITY, columns)


def _short(stages: str) -> str:
    """Protected stages as the paper abbreviates them."""
    if stages in STAGES:
        return stages
    return "".join(stage[0].upper() for stage in stages.split("+"))


def _fig16(table: pa.Table, columns: str) -> Figure:
    panels = []
    for platform in dict.fromkeys(table["platform"].to_pylist()):
        here = chosen(table, platform=platform)
        ratio = _number("fig16", "worst_ratio", platform)
        worst = None if ratio is None else PERCENT * (ratio - 1.0)
        panels.append(_beside_detectors(platform, here, worst))
    return draw_strips(panels, _QUANTITY, columns)


def _fig11(table: pa.Table, columns: str) -> Figure:
    found = values_and_deltas(golden(table))
    return draw_histograms([(name, *both) for name, both in found.items()], columns)


def _fig13(table: pa.Table, columns: str) -> Figure:
    """The pair of missions that a fault prolongs most, from above."""
    kept = [Path(path) for path in table["path"].to_pylist() if path]
    if not kept:
        raise RecordError("fig13 draws recorded flights, and no run folder was kept (--keep all)")
    with Ledger(kept[0].parents[1]) as ledger:
        panels = panels_of(pair(ledger, among=frozenset(table["number"].to_pylist())))
    figure = draw_trajectories(panels, across=1 if columns == "one" else 2)
    for axes in figure.axes:  # room for the legend below the smaller panel
        axes.tick_params(labelsize=SMALLEST, pad=1)
        axes.set_xlabel(axes.get_xlabel(), fontsize=SMALLEST, labelpad=0)
        axes.set_ylabel(axes.get_ylabel(), fontsize=SMALLEST, labelpad=0)
    width, height = figure.get_size_inches()
    figure.set_size_inches(WIDTHS_IN[columns], height * WIDTHS_IN[columns] / width + 0.6)
    return figure


DRAWN: Mapping[str, Callable[[pa.Table, str], Figure]] = {
    "fig7": _fig7,
    "fig8": _by_value("fault_target"),
    "fig9": _by_value("fault_field"),
    "fig11": _fig11,
    "fig12": _fig12,
    "fig13": _fig13,
    "fig14": _fig14,
    "fig16": _fig16,
}
