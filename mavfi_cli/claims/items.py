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

from mavfi_cli.analysis.flights import COSTS, chosen, flown
from mavfi_cli.campaigns.missions import canonical
from mavfi_cli.claims.sources import STACKS, Evidence
from mavfi_cli.core.types import Outcome
from mavfi_cli.report.tables.paper_table import PaperTable
from mavfi_cli.reproduction.evidence import model_report
from mavfi_cli.reproduction.figures import draw_flights, draw_table
from mavfi_cli.reproduction.items import ITEMS, Item, Source
from mavfi_cli.reproduction.layouts import of_flights, of_kernels, of_model
from mavfi_cli.reproduction.measures import golden, with_own
from mavfi_cli.reproduction.missions import key_of, kinds_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_NEED_RUNS = ("fig11", "fig13")  # their figures read kept run folders
_GOLDEN_ONLY = ("fig11",)
_SETTING = ("world", "platform", "planner", "fault_target", "fault_field", "fault_bits",
            "detector", "protect")  # fmt: skip
_SEEDS = ("seed", "world_seed", "time_limit_s")
_FAULTS = ("fault", "instruction")
_TEXTS = ("world", "planner", "platform", "stack", "vehicle", "level", "fault_target",
          "fault_field", "detector", "protect", "state", "outcome", "path", "changes",
          "pair")  # fmt: skip
_NUMBERS = ("flight_time_s", "distance_m", "energy_regression_j", "replans", *COSTS)
_KINDS = dict.fromkeys(_TEXTS, pa.string()) | dict.fromkeys(_NUMBERS, pa.float64())


@dataclass(frozen=True, slots=True, kw_only=True)
class _ShownItem:
    """A table or figure of the paper, on one stack.

    Attributes:
        stack: or what else it is computed from.
        table: None if nothing was flown for it.
        figure: None without a table, or if the figure needs run folders that were not kept.
        flights: the flights in the figure: their setting, and time over that of the golden flight.
    """

    item: Item
    stack: str
    table: PaperTable | None = None
    figure: Figure | None = None
    flights: Sequence[Mapping[str, Any]] = ()


def shown_items(evidence: Evidence) -> Iterator[_ShownItem]:
    """Every item on every stack, in the paper's order."""
    exports = [each.table for each in evidence.campaigns]
    tables = {stack: pooled(exports, stack) for stack in STACKS}
    summaries = [each.summary for each in evidence.kernels]
    for item in ITEMS:
        if item.source is Source.FLIGHTS:
            yield from (_flown_item(item, stack, tables[stack], exports) for stack in STACKS)
        elif item.source is Source.MODEL:
            yield _drawn(item, "performance model", of_model(model_report()))
        elif summaries:
            yield from (_drawn(item, "isolated kernels", of_kernels(each)) for each in summaries)
        else:
            yield _ShownItem(item=item, stack="isolated kernels")


def _drawn(item: Item, stack: str, table: PaperTable) -> _ShownItem:
    return _ShownItem(item=item, stack=stack, table=table, figure=draw_table(table, "one"))


def _flown_item(item: Item, stack: str, table: pa.Table, exports: Sequence[pa.Table]) -> _ShownItem:
    mine = _of_kind(item, stack, table)
    struck = mine.filter(pc.is_valid(mine["level"])).num_rows
    if not struck and not (mine.num_rows and item.name in _GOLDEN_ONLY):
        return _ShownItem(item=item, stack=stack)
    told = of_flights(item.name, mine)
    drawn = _with_runs(item, stack, exports) if item.name in _NEED_RUNS else mine
    if drawn is None:
        return _ShownItem(item=item, stack=stack, table=told)
    figure = draw_flights(item.name, told, drawn, "one")
    return _ShownItem(item=item, stack=stack, table=told, figure=figure, flights=[*_over_own(mine)])


def _with_runs(item: Item, stack: str, exports: Sequence[pa.Table]) -> pa.Table | None:
    """The item's flights in the first campaign that has kept the run folders of all of them."""
    each_own = (_of_kind(item, stack, pooled([each], stack)) for each in exports)
    return next((own for own in each_own if own.num_rows and _kept(own)), None)


def _kept(table: pa.Table) -> bool:
    """Whether the run folders of all these flights are there."""
    return all(each is not None and Path(each).is_dir() for each in table["path"].to_pylist())


def _over_own(table: pa.Table) -> Iterator[dict[str, Any]]:
    """The successful faulty flights, with the columns in which they differ."""
    both, ratios = with_own(golden(table), table.filter(pc.is_valid(table["level"])))
    rows = both.select(_SETTING).to_pylist()
    varying = [name for name in _SETTING if len({row[name] for row in rows}) > 1]
    for row, ratio in zip(rows, ratios, strict=True):
        yield {**{name: row[name] for name in varying}, "over_golden": f"{ratio:.4f}"}


def pooled(tables: Sequence[pa.Table], stack: str) -> pa.Table:
    """The missions that flew on a stack in several tables, each once.

    Args:
        tables: of `analysis.flights.flights`, or of an export, which lacks some of their columns.
    """
    kept = [_filled(chosen(flown(each), stack=stack)) for each in tables]
    if not kept:
        return pa.table({name: pa.array([], kind) for name, kind in _KINDS.items()})
    whole = pa.concat_tables(kept, promote_options="permissive").combine_chunks()
    first: dict[str, int] = {}
    for place, changes in enumerate(whole["changes"].to_pylist()):
        first.setdefault(changes, place)
    return whole.take(pa.array(first.values(), pa.int64()))


def _filled(table: pa.Table) -> pa.Table:
    """The table without its labels, and with empty columns in place of those that it lacks."""
    kept = [name for name in table.column_names if not name.startswith("label")]
    table = table.select([name for name in kept if name not in ("alarms", "struck_sites")])
    if "succeeded" not in kept:
        succeeded = pc.equal(table["outcome"], Outcome.SUCCESS.value)
        table = table.append_column("succeeded", pc.fill_null(succeeded, False))  # noqa: FBT003
    for name, kind in _KINDS.items():
        if name in kept:
            place = table.column_names.index(name)
            table = table.set_column(place, name, table[name].cast(kind))
        else:
            table = table.append_column(name, pa.nulls(table.num_rows, kind))
    return table


def _of_kind(item: Item, stack: str, table: pa.Table) -> pa.Table:
    kinds = {_kind(key_of(mission)) for mission in kinds_of([item], stack)}
    known: dict[str, bool] = {}
    wanted = [
        known.setdefault(kind, kind in kinds) for kind in map(_kind, table["changes"].to_pylist())
    ]
    return table.filter(pa.array(wanted, pa.bool_()))


def _kind(changes: str) -> str:
    """The configuration without seeds, as text."""
    config = {name: each for name, each in json.loads(changes).items() if name not in _SEEDS}
    for name in _FAULTS:
        if config.get(name):
            config[name] = {**config[name], "seed": 0}
    return canonical(config)
