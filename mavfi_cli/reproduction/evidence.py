"""What the items' tables are computed from: flown missions, runs of kernels, the model."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from mavfi_cli.analysis.flights import flights
from mavfi_cli.analysis.kernel_runs import KERNELS, kernel_summary
from mavfi_cli.campaigns.ledger import Ledger
from mavfi_cli.core.errors import RecordError
from mavfi_cli.report.tables.paper_table import PaperTable
from mavfi_cli.reproduction.flights import beside_golden, flown_missions
from mavfi_cli.reproduction.flying import KERNELS_FOLDER, FlightsPlan, stored_plan
from mavfi_cli.reproduction.items import ITEMS, Item, Source
from mavfi_cli.reproduction.layouts import of_flights, of_kernels, of_model
from mavfi_cli.reproduction.missions import key_of, missions_of
from mavfi_cli.vpm.model import schemes_with
from mavfi_cli.vpm.report import Choices, report
from mavfi_cli.vpm.vehicle import ModelVehicle

_VEHICLES = ("airsim", "spark")


def flights_of(item: Item, plan: FlightsPlan, table: pa.Table) -> pa.Table:
    """The flights of an item among those of a reproduction.

    Args:
        table: all flights of the reproduction, as `reproduction.flights.beside_golden`.
    """
    keys = [key_of(each) for each in missions_of([item], plan.stack, plan.scale)]
    return table.filter(pc.is_in(table["changes"], value_set=pa.array(keys, pa.string())))


def items_of_preset(name: str) -> tuple[Item, ...]:
    """The items that a preset flies; the one of its own name first."""
    found = [item for item in ITEMS if item.preset == name]
    return tuple(sorted(found, key=lambda item: item.name != name))


def model_report() -> Mapping[str, Any]:
    """The performance model of the paper's two vehicles, with the paper's overheads."""
    vehicles = [ModelVehicle.load(name) for name in _VEHICLES]
    return report(vehicles, Choices(), schemes_with({}))


def item_flights(item: Item, ledger: Ledger) -> pa.Table:
    """The flights of an item in a campaign: a reproduction, or one with the item's missions."""
    table, plan = beside_golden(flown_missions(flights(ledger))), stored_plan(ledger)
    return table if plan is None else flights_of(item, plan, table)


def table_of_item(item: Item, ledger: Ledger) -> PaperTable:
    """The table of an item in a campaign.

    Raises:
        RecordError: the kernels were not run.
    """
    if item.source is not Source.FLIGHTS:
        return _unflown(item, ledger.folder.parent)
    return of_flights(item.name, item_flights(item, ledger))


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
        yield of_flights(item.name, flights_of(item, plan, table))


def _unflown(item: Item, out: Path) -> PaperTable:
    if item.source is Source.MODEL:
        return of_model(model_report())
    path = out / KERNELS_FOLDER / KERNELS
    if not path.is_file():
        raise RecordError(f"{path.parent}: no runs of kernels (mavfi reproduce fig6)")
    return of_kernels(kernel_summary(path))
