"""What a campaign shows of the paper: the tables of its items, and its state on one screen."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc

from mavfi_cli.analysis.flights import flights
from mavfi_cli.analysis.groups import METRICS, Group, groups
from mavfi_cli.analysis.kernel_runs import KERNELS, kernel_summary
from mavfi_cli.campaigns.ledger import Ledger
from mavfi_cli.campaigns.progress import duration
from mavfi_cli.campaigns.specification_file import presets
from mavfi_cli.core.errors import RecordError, UnknownName
from mavfi_cli.report.tables.campaign import SettingColumns
from mavfi_cli.report.tables.paper_table import PaperCell, PaperColumn, PaperRow, PaperTable
from mavfi_cli.reproduction.flights import beside_golden, flown_missions
from mavfi_cli.reproduction.items import ITEMS, Item, Source, items_named
from mavfi_cli.reproduction.layouts import of_flights, of_kernels, of_model
from mavfi_cli.reproduction.measures import mean_cell, share_cell
from mavfi_cli.reproduction.plan import KERNELS_FOLDER, FlightsPlan, numbers_of, stored_plan
from mavfi_cli.stats.shares import rate

ROWS = 14  # of a table on one screen
WIDE = 2  # columns of settings on one screen
SETTINGS = "settings"  # name of the table of a user's own campaign


# Items --------------------------------------------------------------------------------------------


def item_flights(item: Item | None, ledger: Ledger) -> pa.Table | None:
    """The flights of an item in a campaign: a reproduction, or one with the item's missions.

    None if the item is not flown, or if there is none.
    """
    if item is None or item.source is not Source.FLIGHTS:
        return None
    table, plan = beside_golden(flown_missions(flights(ledger))), stored_plan(ledger)
    return table if plan is None else _flights_of(item, plan, table)


def _flights_of(item: Item, plan: FlightsPlan, table: pa.Table) -> pa.Table:
    """The flights of an item among those of a reproduction."""
    keys = pa.array(plan.keys(item), pa.string())
    return table.filter(pc.is_in(table["changes"], value_set=keys))


def tables(plan: FlightsPlan) -> Iterator[PaperTable]:
    """The table of each item of a plan, from what is there.

    Raises:
        RecordError: nothing was flown, or the kernels were not run.
    """
    table = None
    for item in plan.items:
        if item.source is not Source.FLIGHTS:
            yield _unflown(item, plan.out)
            continue
        if table is None:
            with Ledger(plan.folder) as ledger:
                table = beside_golden(flown_missions(flights(ledger)))
        yield of_flights(item.name, _flights_of(item, plan, table))


def _unflown(item: Item, out: Path) -> PaperTable:
    if item.source is Source.MODEL:
        return of_model()
    path = out / KERNELS_FOLDER / KERNELS
    if not path.is_file():
        raise RecordError(f"{path.parent}: no runs of kernels (mavfi reproduce fig6)")
    return of_kernels(kernel_summary(path))


def _preset_of(ledger: Ledger) -> str | None:
    """The preset that a campaign was begun from, with or without changes; None of others."""
    name = ledger.meta("name") or ""
    found = name.partition("-")[0]
    return found if found in presets() else None


def item_of(ledger: Ledger) -> Item | None:
    """The paper's item of a campaign; None if the paper has none."""
    preset = _preset_of(ledger)
    found = [item for item in ITEMS if preset and item.preset == preset]
    return min(found, key=lambda item: item.name != preset, default=None)


def asked_item(ledger: Ledger, name: str | None) -> Item | None:
    """The named item of a campaign, or the one of its preset.

    Raises:
        UnknownName: the campaign flies no such item.
        ConfigError: the paper has it, but it is no experiment.
    """
    if name is None:
        return item_of(ledger)
    preset = _preset_of(ledger)
    whole = stored_plan(ledger) is not None
    known = [each.name for each in ITEMS if whole or (each.preset and each.preset == preset)]
    (found,) = items_named([name])
    if found.name not in known:
        raise UnknownName("item of this campaign", name, known or ["none"])
    return found


def table_of(ledger: Ledger, item: Item | None, flights: pa.Table | None) -> PaperTable:
    """The one table of a campaign: an item's, the items of a reproduction, or the settings.

    Args:
        flights: as `item_flights`.

    Raises:
        RecordError: the kernels were not run.
    """
    if item is not None and flights is not None:
        return of_flights(item.name, flights)
    if item is not None:
        return _unflown(item, ledger.folder.parent)
    if stored_plan(ledger) is not None:
        return _progress_table(ledger)
    return _settings_table(ledger)


def _settings_table(ledger: Ledger) -> PaperTable:
    """Success and quality of flight of each setting."""
    scales = {"flight_time_s": ("time, s", 1.0), "distance_m": ("distance, m", 1.0),
              "energy_regression_j": ("energy, kJ", 1e-3), "replans": ("replans", 1.0)}  # fmt: skip
    assert tuple(scales) == METRICS
    found = groups(ledger)
    settings = SettingColumns.of([group.labels for group in found])
    return PaperTable(
        name=SETTINGS,
        title=f"{ledger.meta('name') or ledger.folder.name}: settings",
        labels=settings.heads,
        columns=(
            PaperColumn(title="success, %", ends=0),
            *(PaperColumn(title=title) for title, _ in scales.values()),
        ),
        rows=tuple(
            PaperRow(
                labels=tuple(settings.cells(group.labels, group.name)),
                cells=(
                    _success(group),
                    *(mean_cell(scale * group.successes(name))
                      for name, (_, scale) in scales.items()),
                ),
            )
            for group in found
        ),
        notes=(
            *settings.told(),
            "success: golden missions and faults that struck; means: the successful of them",
        ),
    )  # fmt: skip


def _success(group: Group) -> PaperCell:
    won = group.succeeded[group.counted]
    return share_cell(rate(int(won.sum()), len(won)))


def _progress_table(ledger: Ledger) -> PaperTable:
    """How much of each item of a reproduction is flown."""
    plan = stored_plan(ledger)
    assert plan is not None
    over = {number for number, _ in ledger.fates()}
    rows = []
    for item in plan.items:
        if item.preset:
            numbers = numbers_of(ledger, plan.keys(item))
            done = sum(number in over for number in numbers)
            counts = (float(done), 100.0 * done / len(numbers))
            cells = tuple(PaperCell(value=value, count=len(numbers)) for value in counts)
            rows.append(PaperRow(labels=(item.name, item.title), cells=cells))
    return PaperTable(
        name="items",
        title=f"Reproduction on {plan.stack} at scale {plan.scale:g}; n: missions of the item",
        labels=("item", "what it shows"),
        columns=(PaperColumn(title="flown", digits=0), PaperColumn(title="%", digits=0)),
        rows=tuple(rows),
        notes=("mavfi campaign report FOLDER --item ITEM prints its table",),
    )


def short(table: PaperTable) -> PaperTable:
    """The table cut to one screen: its first rows, and of settings the first columns."""
    wide = len(table.columns) if table.name != SETTINGS else WIDE
    left = [column.title.partition(",")[0] for column in table.columns[wide:]]
    left += [f"{len(table.rows) - ROWS} more rows"] if len(table.rows) > ROWS else []
    if not left:
        return table
    return replace(
        table,
        columns=table.columns[:wide],
        rows=tuple(replace(row, cells=row.cells[:wide]) for row in table.rows[:ROWS]),
        notes=(f"mavfi campaign report has {', '.join(left)}", *table.notes),
    )


def progress_lines(ledger: Ledger) -> list[str]:
    """What is done, and the time left at the pace so far."""
    planned, over = ledger.planned(), ledger.over()
    errors = sum(ledger.errors_by_cell().values())
    lines = [f"{ledger.meta('name') or ledger.folder.name}: {over} of {planned} missions"]
    if errors:
        lines.append(f"{errors} could not begin; run --retry-errors repeats them")
    if over < planned:
        lines.append(_time_left(ledger, planned - over))
    return lines


def _time_left(ledger: Ledger, missing: int) -> str:
    walls = [wall for portion in ledger.columns(["wall_s"]) for wall in portion[0]]
    if not walls:
        return f"{missing} missing; time left: not known before a mission is over"
    jobs, each_s = len(os.sched_getaffinity(0)), sum(walls) / len(walls)
    return (
        f"{missing} missing: about {duration(missing * each_s / jobs)} with {jobs} at a time "
        f"({each_s:.1f} s each so far)"
    )
