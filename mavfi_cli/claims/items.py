"""The paper's tables and figures from all flights that are of the same kind as an item's missions.

Two missions are of one kind if they differ in seeds and time limit only. So flights of any campaign
serve an item, whatever the campaign's name and size.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa
import pyarrow.compute as pc

from mavfi_cli.campaigns.missions import changes_of, kind_of
from mavfi_cli.claims.sources import STACKS, Evidence
from mavfi_cli.report.tables.paper_table import PaperTable
from mavfi_cli.reproduction.figures import draw
from mavfi_cli.reproduction.flights import pooled, ratios, timed
from mavfi_cli.reproduction.items import ITEMS, FlightsPlan, Item, Source
from mavfi_cli.reproduction.layouts import of_flights
from mavfi_cli.reproduction.status import of_kernels, of_model

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_NEED_RUNS = ("fig11", "fig13")  # their figures read kept run folders
_GOLDEN_ONLY = ("fig11",)
_SETTING = ("world", "platform", "planner", "fault_target", "fault_field", "fault_bits",
            "detector", "protect")  # fmt: skip
_SEEDS = ("seed", "world_seed", "time_limit_s")


@dataclass(frozen=True, slots=True, kw_only=True)
class _OnStack:
    """A table or figure of the paper, on one stack.

    Attributes:
        stack: or what else it is computed from.
        table: None if nothing was flown for it.
        figure: None without a table, or if the figure needs run folders that were not kept.
        flights: the flights in the figure: their setting, and time over that of the golden flight.
    """

    stack: str
    table: PaperTable | None = None
    figure: Figure | None = None
    flights: Sequence[Mapping[str, Any]] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class _ShownItem:
    """A table or figure of the paper, on all stacks."""

    item: Item
    parts: Sequence[_OnStack]

    @property
    def shown(self) -> list[_OnStack]:
        """The stacks that have a table."""
        return [each for each in self.parts if each.table is not None]

    @property
    def missing(self) -> list[str]:
        """The stacks without one."""
        return [each.stack for each in self.parts if each.table is None]


def shown_items(evidence: Evidence, flights: Mapping[str, pa.Table]) -> Iterator[_ShownItem]:
    """Every item on every stack, in the paper's order.

    Args:
        flights: of each stack, as `Evidence.flights`.
    """
    kernels = [*evidence.isolated.values()]
    for item in ITEMS:
        if item.source is Source.FLIGHTS:
            parts = [_flown(item, stack, flights[stack], evidence) for stack in STACKS]
        elif item.source is Source.MODEL:
            parts = [_drawn("performance model", of_model())]
        elif kernels:
            parts = [_drawn("isolated kernels", of_kernels({"kernels": kernels}))]
        else:
            parts = [_OnStack(stack="isolated kernels")]
        yield _ShownItem(item=item, parts=parts)


def _drawn(stack: str, table: PaperTable) -> _OnStack:
    return _OnStack(stack=stack, table=table, figure=draw(table, None, "one"))


def _flown(item: Item, stack: str, flights: pa.Table, evidence: Evidence) -> _OnStack:
    mine = _of_kind(item, stack, flights)
    struck = mine.filter(pc.is_valid(mine["level"])).num_rows
    if not struck and not (mine.num_rows and item.name in _GOLDEN_ONLY):
        return _OnStack(stack=stack)
    told = of_flights(item.name, mine)
    drawn = _with_runs(item, stack, evidence) if item.name in _NEED_RUNS else mine
    if drawn is None:
        return _OnStack(stack=stack, table=told)
    figure = draw(told, drawn, "one")
    return _OnStack(stack=stack, table=told, figure=figure, flights=[*_over_own(mine)])


def _with_runs(item: Item, stack: str, evidence: Evidence) -> pa.Table | None:
    """The item's flights in the first campaign that has kept the run folders of all of them."""
    each_own = (_of_kind(item, stack, pooled([x.flights], stack)) for x in evidence.campaigns)
    return next((own for own in each_own if own.num_rows and _kept(own)), None)


def _kept(table: pa.Table) -> bool:
    """Whether the run folders of all these flights are there."""
    return all(each is not None and Path(each).is_dir() for each in table["path"].to_pylist())


def _over_own(flights: pa.Table) -> Iterator[dict[str, Any]]:
    """The successful faulty flights, with the columns in which they differ."""
    known = timed(flights)
    rows = known.select(_SETTING).to_pylist()
    varying = [name for name in _SETTING if len({row[name] for row in rows}) > 1]
    for row, ratio in zip(rows, ratios(known), strict=True):
        yield {**{name: row[name] for name in varying}, "over_golden": f"{ratio:.4f}"}


def _of_kind(item: Item, stack: str, table: pa.Table) -> pa.Table:
    """The flights that differ from the item's missions on a stack in _SEEDS only."""
    kinds = {
        kind_of(changes_of(mission.config), _SEEDS)
        for mission in FlightsPlan(items=[item], stack=stack).kinds()
    }
    changes = map(json.loads, table["changes"].to_pylist())
    wanted = [kind_of(each, _SEEDS) in kinds for each in changes]
    return table.filter(pa.array(wanted, pa.bool_()))
