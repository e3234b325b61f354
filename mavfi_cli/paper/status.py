"""Tables that compare a campaign with the paper, and the campaign's state on one screen."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

from mavfi_cli.analysis.flights import flights
from mavfi_cli.analysis.kernels import KERNELS, OUTCOMES, IsolatedKernel, KernelSummary
from mavfi_cli.analysis.pairs import Flights
from mavfi_cli.analysis.summary import Group, groups
from mavfi_cli.campaigns.ledger import Ledger
from mavfi_cli.campaigns.progress import duration
from mavfi_cli.campaigns.specification_file import PRESETS
from mavfi_cli.core.errors import RecordError, UnknownName
from mavfi_cli.paper.items import (
    BY_NAME,
    ITEMS,
    KERNELS_FOLDER,
    FlightsPlan,
    Item,
    Source,
    items_named,
    printed,
)
from mavfi_cli.paper.layouts import of_flights, of_kind
from mavfi_cli.report.paper import PaperCell, PaperColumn, PaperRow, PaperTable
from mavfi_cli.report.setting_table import BY_WEIGHT, UNPAIRED, SettingColumns
from mavfi_cli.vpm.model import ModelVehicle, schemes_with
from mavfi_cli.vpm.report import Choices, report

_ROWS = 14  # rows of a table on one screen
_WIDE = 2  # columns of the table of settings on one screen
_DEVIATION = "SD of time, s"  # if flights are not repeatable; also kept on one screen
_SETTINGS = "settings"  # name of the table of a user's own campaign


def shown(ledger: Ledger, name: str | None = None) -> tuple[PaperTable, Flights | None]:
    """Return the main table of a campaign, and the flights from which its figure is drawn.

    The flights are None if the table is not that of an item that flies missions.

    The table is that of the named item or, without a name, of the preset's item. Without either, or
    for a stratified campaign without a name, it lists the items of a reproduction, or the settings
    of any other campaign. In a reproduction or an export, any item may be named.

    Raises:
        UnknownName: the campaign has no item of this name.
        ConfigError: the named figure or table of the paper is not an experiment.
        RecordError: the kernels were not run, or an export contains no flights for the item or
            those of several stacks.
    """
    item, plan = _item_of(ledger, name), FlightsPlan.stored(ledger)
    if item is None or (ledger.stratified and name is None):
        return _settings_table(ledger) if plan is None else _progress_table(ledger, plan), None
    if item.source is not Source.FLIGHTS:
        return _unflown(item, ledger.folder.parent), None
    table = Flights.pooled([Flights.of(flights(ledger))])
    left_out: list[str] = []
    if plan is not None:
        mine = _flights_of(item, plan, table)
    elif ledger.export is None:
        mine, left_out = _of_one_rule(table)
    else:
        mine, left_out = _of_export(item, table, ledger.folder)
    layout = of_flights(item.name, mine)
    notes = [f"not in this table: {rule}" for rule in left_out]
    return replace(layout, notes=(*notes, *layout.notes)), mine


def _of_one_rule(flights: Flights) -> tuple[Flights, list[str]]:
    """Return the flights under the first rule with a fault, and the names of the other rules.

    `Flights.by_rules` gives the rules and their order.
    """
    rules = {rule or "the usual rule": mine for rule, mine in flights.by_rules.items()}
    first, *others = [rule for rule, mine in rules.items() if any(mine["level"])] or [*rules]
    return rules[first], others


def _of_export(item: Item, flights: Flights, path: Path) -> tuple[Flights, list[str]]:
    """Select an item's flights from an export by their kinds, since an export has no plan.

    Return them as `_of_one_rule` does.
    """
    parts = [
        (of_kind(item, stack, mine), left_out)
        for stack in sorted(set(flights["stack"]))
        for mine, left_out in [_of_one_rule(flights.chosen(stack=stack))]
    ]
    flown = [part for part in parts if len(part[0])]
    if len(flown) > 1:
        raise RecordError(
            f"{path}: contains flights for {item.paper} on several stacks; export each stack "
            "separately"
        )
    if not flown:
        raise RecordError(f"{path}: contains no flights for {item.paper}")
    return flown[0]


def _item_of(ledger: Ledger, name: str | None) -> Item | None:
    """Return the named item or, without a name, the item of the campaign's preset.

    Return None if there is no name and the campaign was not made from the preset of an item.
    """
    preset = (ledger.meta("name") or "").partition("-")[0]  # without the suffix for changes
    own = [item for item in ITEMS if item.preset == preset] if preset in PRESETS.names else []
    if name is None:
        return min(own, key=lambda item: item.name != preset, default=None)
    (item,) = items_named([name])
    known = own if FlightsPlan.stored(ledger) is None and ledger.export is None else ITEMS
    if item not in known:
        raise UnknownName(
            "item of this campaign", name, [other.name for other in known] or ["none"]
        )
    return item


def _flights_of(item: Item, plan: FlightsPlan, flights: Flights) -> Flights:
    keys = set(plan.keys(item))
    return flights.where([changes in keys for changes in flights["changes"]])


def tables(plan: FlightsPlan) -> Iterator[PaperTable]:
    """Yield the table of each item of a plan, from the flights and kernel runs done so far.

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
                table = Flights.of(flights(ledger))
        yield of_flights(item.name, _flights_of(item, plan, table))


# Items that are not flown: Figs. 6 and 15 --------------------------------------------------------

_PAPER_KERNELS = {"control": "pid"}  # the paper's name where it differs


def _unflown(item: Item, out: Path) -> PaperTable:
    if item.source is Source.MODEL:
        return of_model()
    path = out / KERNELS_FOLDER / KERNELS
    if not path.is_file():
        raise RecordError(
            f"{path.parent}: contains no kernel runs; make them with `mavfi reproduce fig6`"
        )
    return of_kernels(KernelSummary.read(path).kernels)


def of_kernels(kernels: Iterable[IsolatedKernel]) -> PaperTable:
    """Return the table of Fig. 6, from runs of isolated kernels."""
    rows = []
    for kernel in kernels:
        paper = printed("fig6", "benign_percent", _PAPER_KERNELS.get(kernel.name, kernel.name))
        shares = [kernel.outcomes[outcome] for outcome in OUTCOMES]
        cells = (PaperCell.of_share(shares[0], paper), *map(PaperCell.of_share, shares[1:]))
        rows.append(PaperRow(labels=(kernel.title,), cells=cells))
    table = BY_NAME["fig6"].table(rows)
    most = table.ranked(1)
    result = f"most SDC: {most[0].labels[0]}, {most[0].cells[1].value:.1f} %" if most else ""
    return replace(table, result=f"{result} (paper: OctoMap)" if most else "no runs")


def of_model() -> PaperTable:
    """Return the table of Fig. 15, from the performance model with the paper's overheads."""
    item = BY_NAME["fig15"]
    names = [column.title for column in item.columns]
    model = report([ModelVehicle.load(name) for name in names], Choices(), schemes_with({}))
    rows = {}
    for of_vehicles in zip(*(vehicle.schemes for vehicle in model.vehicles), strict=True):
        scheme = of_vehicles[0].scheme
        cells = (
            PaperCell(
                value=math.nan if row.ratios is None else row.ratios.flight_time_ratio,
                paper=printed("fig15", "time_ratio", scheme, name),
            )
            for name, row in zip(names, of_vehicles, strict=True)
        )
        rows[scheme] = PaperRow(labels=(scheme,), cells=tuple(cells))
    table = item.table([*rows.values()])
    times = (f"{name} {table.beside(rows['tmr'], place, '')}" for place, name in enumerate(names))
    return replace(table, result=f"flight time with TMR: x {', x '.join(times)}")


# Campaigns that belong to no item -----------------------------------------------------------------


_MEANS = {
    "time, s": ("flight_time_s", 1.0), "distance, m": ("distance_m", 1.0),
    "energy, kJ": ("energy_regression_j", 1e-3), "replans": ("replans", 1.0),
}  # fmt: skip


def _settings_table(ledger: Ledger) -> PaperTable:
    merged = groups(ledger)
    apart = bool(Group.parts(merged, repeats=False))
    settings = SettingColumns.of([group.labels for group in merged])
    rows = []
    for group in merged:
        share = group.share(group.succeeded, group.counted)
        success = PaperCell.of_share(share)
        means = [PaperCell.of_interval(group.mean(name), k) for name, k in _MEANS.values()]
        if apart:
            deviation_s = group.deviation("flight_time_s")
            means.insert(1, PaperCell(value=deviation_s, count=means[0].count))
        if ledger.stratified:
            means.insert(0, PaperCell(value=float(share.effective), count=share.total))
        labels = tuple(settings.cells(group.labels, group.name))
        rows.append(PaperRow(labels=labels, cells=(success, *means)))
    about = "success: golden missions and faults that struck; means: the successful of them"
    by_weight = [PaperColumn(title="effective n", digits=0)] if ledger.stratified else []
    means_of = [PaperColumn(title=x) for x in _MEANS]
    if apart:
        means_of.insert(1, PaperColumn(title=_DEVIATION, digits=2))
    return PaperTable(
        name=_SETTINGS,
        title=f"{ledger.meta('name') or ledger.folder.name}: settings",
        labels=settings.heads,
        columns=(
            PaperColumn(title="success, %", ends=0),
            *by_weight,
            *means_of,
        ),
        rows=tuple(rows),
        notes=(
            *settings.notes,
            about,
            *([BY_WEIGHT] if ledger.stratified else []),
            *([UNPAIRED] if apart else []),
        ),
    )


def _progress_table(ledger: Ledger, plan: FlightsPlan) -> PaperTable:
    over = {number for number, _ in ledger.fates()}
    rows = []
    for item in plan.items:
        if item.preset:
            numbers = plan.numbers(ledger, item)
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
    """Shorten a table to one screen: its first rows and, in a table of settings, first columns."""
    titles = [column.title for column in table.columns]
    wide = _WIDE + (_DEVIATION in titles) if table.name == _SETTINGS else len(titles)
    left = [title.partition(",")[0] for title in titles[wide:]]
    left += [f"{len(table.rows) - _ROWS} more rows"] if len(table.rows) > _ROWS else []
    if not left:
        return table
    return replace(
        table,
        columns=table.columns[:wide],
        rows=tuple(replace(row, cells=row.cells[:wide]) for row in table.rows[:_ROWS]),
        notes=(f"mavfi campaign report has {', '.join(left)}", *table.notes),
    )


def progress_lines(ledger: Ledger) -> list[str]:
    """Describe a campaign's progress, and the time left at the pace so far, in a few lines."""
    planned, over = ledger.planned(), ledger.over()
    errors = sum(ledger.errors_by_cell().values())
    name = ledger.meta("name") or ledger.folder.name
    if ledger.export is not None:
        lines = [f"{name}: {over} missions in an export"]
    else:
        lines = [f"{name}: {over} of {planned} missions"]
    if errors:
        lines.append(f"{errors} could not begin; run --retry-errors repeats them")
    if over < planned:
        lines.append(_time_left(ledger, planned - over))
    return lines


def _time_left(ledger: Ledger, missing: int) -> str:
    walls = [wall for portion in ledger.columns(["wall_s"]) for wall in portion[0]]
    if not walls:
        return f"{missing} missing; time left: not known before a mission is over"
    jobs, mission_s = len(os.sched_getaffinity(0)), sum(walls) / len(walls)
    return (
        f"{missing} missing: about {duration(missing * mission_s / jobs)} with {jobs} at a time "
        f"({mission_s:.1f} s each so far)"
    )
