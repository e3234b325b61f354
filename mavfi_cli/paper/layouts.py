"""Turns the missions of each flown item into the rows of the paper's table, by a layout per item.

A layout reads only the configurations and records of the item's missions, not the labels of their
settings, so it works for any campaign with such missions. It yields the rows; paper.toml contains
the headings, columns and notes.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from operator import attrgetter
from pathlib import Path

import numpy as np

from mavfi_cli.analysis.pairs import EVERY_STAGE, PERCENT, STAGES, Flights
from mavfi_cli.campaigns.missions import Changes, changes_of, kind_of
from mavfi_cli.core.files import read_parquet
from mavfi_cli.core.types import FloatArray
from mavfi_cli.mission.run_folder import TRACE
from mavfi_cli.paper.items import BY_NAME, FlightsPlan, Item, printed
from mavfi_cli.report.paper import DETECTOR_TITLES, PaperCell, PaperRow, PaperTable, Printed

PROTECTED = (*STAGES, "planning+control", EVERY_STAGE)
_GOLDEN = "golden"  # prefix of row labels of golden flights
_JOULES = 1e-3  # kJ per J
_NOTHING = "nothing flown yet"


def of_flights(name: str, flights: Flights) -> PaperTable:
    """Return the table of an item, computed from its flights.

    Args:
        name: name of an item whose source is FLIGHTS.
        flights: the item's missions.
    """
    if name in _ONLY_COMPARABLE:
        flights = flights.comparable.shared("world")
    rows = [*OF_FLIGHTS[name](flights)]
    notes = [
        flights.population,
        *(f"rule of the faults in instructions: {rule}" for rule in _rules(flights)),
        *_unpaired(flights),
        *(_unknown_costs(flights) if name == "table5" else []),
    ]
    table = BY_NAME[name].table(rows, flights.worlds, notes)
    return replace(table, result=_RESULTS[name](table))


def _rules(flights: Flights) -> list[str]:
    """Return the names of the rules of the flights' faults, without the usual one."""
    return [rule for rule, mine in flights.by_rules.items() if rule and any(mine["level"])]


def of_kind(item: Item, stack: str, flights: Flights) -> Flights:
    """Select the flights that match a mission of the item on a stack.

    Seeds, the time limit, the injector and, unless a state is struck, the restart delay may differ.
    The result is empty if all of these flights are golden although the item needs faults.

    Args:
        flights: flights under one rule; see `Flights.by_rules`.
    """
    kinds = {
        _kind(changes_of(mission.config))
        for mission in FlightsPlan(items=[item], stack=stack).kinds()
    }
    mine = flights.where([_kind(json.loads(changes)) in kinds for changes in flights["changes"]])
    return (
        mine if any(mine["level"]) or item.name in _GOLDEN_ONLY else mine.where([False] * len(mine))
    )


def _kind(changes: Changes) -> str:
    """Return the kind of a mission, without what may differ from an item's missions."""
    apart = ["seed", "world_seed", "time_limit_s"]
    if changes.get("fault") is None:
        apart.append("node_restart_s")
    if (fault := changes.get("instruction")) is not None:
        changes = {**changes, "instruction": {**fault, "compat": None}}
    return kind_of(changes, apart)


_GOLDEN_ONLY = ("fig11",)
_ONLY_COMPARABLE = ("fig12", "table4", "table5")  # exclude partly protected flights


def _unpaired(flights: Flights) -> list[str]:
    """Return a note on the number of faulty flights without a golden flight, or an empty list."""
    struck = flights.where(level is not None for level in flights["level"])
    alone = list(struck["own_lost"]).count(None)
    if not alone:
        return []
    return [f"{alone:,} of {len(struck):,} flights with a fault: no golden flight of their mission"]


def _row(*labels: object, cells: Iterable[PaperCell]) -> PaperRow:
    return PaperRow(labels=tuple(map(str, labels)), cells=tuple(cells))


# Faults by place: Figs. 7, 8, 9, Table III ------------------------------------------------------

KERNELS_FLOWN = {  # node and planner
    "point cloud": ("point_cloud", "rrtstar"),
    "OctoMap": ("octomap", "rrtstar"),
    "collision check": ("collision_check", "rrtstar"),
    "RRT": ("planner", "rrt"),
    "RRTConnect": ("planner", "rrtconnect"),
    "RRT*": ("planner", "rrtstar"),
    "PID": ("control", "rrtstar"),
}
_PLANNERS = {"rrtstar": "RRT*", "rrt": "RRT", "rrtconnect": "RRTConnect"}


def _effects(flights: Flights) -> list[PaperCell]:
    longest = _maximum(flights.faulty().increases)
    return [_success(flights), _mean(flights, "flight_time_s"), longest]


def _fig7(flights: Flights) -> Iterator[PaperRow]:
    """Yield a row for the golden flights with each planner, then for the faults in each kernel."""
    groups = {
        f"{_GOLDEN}, {title}": flights.golden.chosen(planner=name)
        for name, title in _PLANNERS.items()
    } | {
        title: flights.faulty(level="instruction", fault_target=node, planner=planner)
        for title, (node, planner) in KERNELS_FLOWN.items()
    }
    for title, those in groups.items():
        if len(those):
            energy = _mean(those, "energy_regression_j", scale=_JOULES)
            yield _row(title, cells=[*_effects(those), energy])


def _by_value(name: str, column: str) -> Callable[[Flights], Iterator[PaperRow]]:
    """Return a layout that yields a row for the golden flights, and one per value of `column`.

    The rows also state whether the paper calls the value critical.
    """

    def rows(flights: Flights) -> Iterator[PaperRow]:
        yield _row(_GOLDEN, "", cells=_effects(flights.golden))
        for (value,), those in flights.faulty().by(column).items():
            critical = printed(name, "critical", value) or "-"
            yield _row(value, critical, cells=_effects(those))

    return rows


_QUALITY = {  # the paper's name of a measure: our column, and its scale
    "flight_time_s": ("flight_time_s", 1.0),
    "distance_m": ("distance_m", 1.0),
    "energy_kj": ("energy_regression_j", _JOULES),
    "replans": ("replans", 1.0),
}


def _table3(flights: Flights) -> Iterator[PaperRow]:
    """Yield a row with the quality of flight for each number of flipped bits."""
    groups = {0: flights.golden}
    faults = flights.faulty().by("fault_bits")
    groups |= {bits: faults[bits,] for (bits,) in sorted(faults)}
    for bits, those in groups.items():
        means = [
            _mean(those, column, printed("table3", paper, bits), scale)
            for paper, (column, scale) in _QUALITY.items()
        ]
        won = _success(those, printed("table3", "success_percent", bits))
        yield _row(bits or f"0 ({_GOLDEN})", cells=[*means, won])


# Detection and recovery in four worlds: Table IV, Figs. 12 and 14, Table V -----------------------


def _table4(flights: Flights) -> Iterator[PaperRow]:
    """Yield rows with the success rate in each world: golden, with faults, and per detector."""
    settings = [(_GOLDEN, "golden", flights.golden), ("injection", "none", flights.faulty())]
    settings += [(f"{title}-based", x, flights.faulty(x)) for x, title in DETECTOR_TITLES.items()]
    for title, key, those in settings:
        cells = (
            _success(those.chosen(world=world), printed("table4", "success_percent", key, world))
            for world in flights.worlds
        )
        yield _row(title, cells=cells)


def _fig12(flights: Flights) -> Iterator[PaperRow]:
    """Yield each world's worst increase in flight time, and how much each detector recovers."""
    for world in flights.worlds:
        here = flights.chosen(world=world)
        bare, struck = here.golden, here.faulty()
        increase = printed("fig12", "worst_increase_percent", world)
        yield _row(world, cells=[
            _mean(bare, "flight_time_s"),
            _maximum(struck.increases, increase),
            _worst_mean(bare, struck, increase),
            *_recovered(here, "fig12", "recovered_points", world),
        ])  # fmt: skip


def _recovered(flights: Flights, item: str, unit: str, place: str) -> Iterator[PaperCell]:
    """Yield how much of the worst increase each detector recovers, next to the paper's number."""
    measure = "recovered" if unit == "recovered_points" else "recovered_share"
    for name in DETECTOR_TITLES:
        yield _recovery(flights.faulty(name), measure, printed(item, unit, name, place))


def _fig14(flights: Flights) -> Iterator[PaperRow]:
    """Yield how much of the worst increase in flight time each detector recovers, in per cent.

    There is a row for each detector and each set of protected stages.
    """
    for detector, title in DETECTOR_TITLES.items():
        for stages in PROTECTED:
            paper = ("fig14", "recovered_percent", detector)
            cells = (
                _recovery(
                    flights.faulty(detector, protect=stages, world=world),
                    "recovered_share",
                    printed(*paper, world, stages),
                )
                for world in flights.worlds
            )
            yield _row(title, stages, cells=cells)


def _table5(flights: Flights) -> Iterator[PaperRow]:
    """Yield the shares of the flight time that each detector and its recoveries take."""
    for detector in DETECTOR_TITLES:
        for title, (columns, keys) in _parts(detector).items():
            cells = (
                PaperCell.of_mean(
                    PERCENT * flights.faulty(detector, world=world).known(*columns),
                    printed("table5", *keys, world),
                )
                for world in flights.worlds
            )
            yield _row(detector.upper(), title, cells=cells)


def _unknown_costs(flights: Flights) -> list[str]:
    """Return a note if the costs of flights with a detector are unknown, or an empty list."""
    watched = any(flights["detector"])
    if not watched or len(flights.known("check_share")):
        return []
    return ["no numbers: this export does not hold these times; a new one does"]


def _parts(detector: str) -> dict[str, tuple[Sequence[str], Sequence[str]]]:
    """Return the columns to sum and the keys of the paper's number, for each row of a detector."""
    recovery = [f"recovery_share_{stage}" for stage in STAGES]
    apart = {
        stage: ([column], ["recovery", detector, stage])
        for stage, column in zip(STAGES, recovery, strict=True)
    }
    if detector == "aad":  # recomputes control only
        apart = {"recovery": (recovery, ["recovery", detector, "control"])}
    return {
        **apart,
        "detection": (["check_share"], ["detection", detector]),
        "sum": (["check_share", *recovery], ["sum", detector]),
    }


# Paths and states: Figs. 11 and 13 ---------------------------------------------------------------

SHOWN_STATES = ("waypoint_x", "waypoint_vx", "waypoint_ax")


def values_and_deltas(flights: Flights) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Return the values of SHOWN_STATES at all control ticks, and their changes between ticks.

    They come from the traces of the successful flights whose run folders exist. The result is keyed
    by state.
    """
    runs = [Path(path) for path in flights.chosen(lost=False)["path"] if path]
    traces = [read_parquet(run / TRACE, "trace") for run in runs if (run / TRACE).is_file()]
    by_state = {}
    for state in SHOWN_STATES:
        columns = [Flights(trace).known(state) for trace in traces]
        by_state[state] = (
            np.concatenate([np.zeros(0), *columns]),
            np.concatenate([np.zeros(0), *(np.diff(values) for values in columns)]),
        )
    return by_state


def _fig11(flights: Flights) -> Iterator[PaperRow]:
    """Yield the ranges of three states and of their changes between ticks."""
    for state, (values, deltas) in values_and_deltas(flights.golden).items():
        spans = [_span(values, 1.0), _span(deltas, 1.0)]
        middle = [_span(values, 0.99), _span(deltas, 0.99)]
        reduced = [_reduction(*spans), _reduction(*middle)]
        cells = [PaperCell(value=value, count=len(values)) for value in (*spans, *reduced)]
        cells[2] = replace(cells[2], paper=printed("fig11", "reduction_percent", state))
        yield _row(state, cells=cells)


def _span(values: FloatArray, share: float) -> float:
    """Return the range of the middle `share` of the values, or NaN if there are no values."""
    if not len(values):
        return math.nan
    low, high = np.quantile(values, (0.5 - share / 2.0, 0.5 + share / 2.0))
    return float(high - low)


def _reduction(values: float, deltas: float) -> float:
    return PERCENT * (1.0 - deltas / values) if values else math.nan


def _fig13(flights: Flights) -> Iterator[PaperRow]:
    """Yield each stage's largest increase in flight time, without and with the autoencoder."""
    for (stage,), struck in flights.faulty().by("fault_target").items():
        yield _row(stage, cells=[
            _maximum(struck.increases, printed("fig13", "increase_percent", stage)),
            _maximum(_with(struck, flights.faulty("aad", fault_target=stage))),
            PaperCell.of_mean(struck.increases),
        ])  # fmt: skip


def _with(struck: Flights, protected: Flights) -> FloatArray:
    """Return the increase in flight time, in per cent, that protection leaves of the worst fault.

    The worst fault is that with the longest flight in `struck`. The array has shape (1,), or (0,)
    if there is no successful protected flight with this fault.
    """
    if not len(struck.ratios):
        return np.zeros(0)
    pair, fault = struck.faults[int(np.nanargmax(struck.numbers("over_own")))]
    return protected.chosen(pair=pair, fault=fault).increases


# Platforms: Fig. 16 ------------------------------------------------------------------------------


def _fig16(flights: Flights) -> Iterator[PaperRow]:
    """Yield each platform's worst flight-time ratio, and how much of it each detector recovers."""
    for (platform,), here in flights.by("platform").items():
        struck = here.faulty()
        yield _row(platform, cells=[
            _mean(here.golden, "flight_time_s"),
            _success(struck),
            _maximum(struck.ratios, printed("fig16", "worst_ratio", platform)),
            *_recovered(here, "fig16", "recovered_percent", platform),
        ])  # fmt: skip


OF_FLIGHTS: Mapping[str, Callable[[Flights], Iterator[PaperRow]]] = {
    "fig7": _fig7, "fig8": _by_value("fig8", "fault_target"),
    "fig9": _by_value("fig9", "fault_field"), "fig11": _fig11, "fig12": _fig12, "fig13": _fig13,
    "fig14": _fig14, "fig16": _fig16, "table3": _table3, "table4": _table4, "table5": _table5,
}  # fmt: skip


# Results in one line ------------------------------------------------------------------------------


def _joined(
    form: str,
    before: str = "",
    between: str = "; ",
    rows: Callable[[PaperTable], Sequence[PaperRow]] = attrgetter("rows"),
) -> Callable[[PaperTable], str]:
    """Return a function that formats each selected row and joins the results.

    Args:
        form: format string for a row. Its fields are the row's labels by position; the lists of the
            row's numbers `c` in per cent, `s` in seconds and `n` without a unit; the `last` number
            of `c`; and the titles of the first and the last column, `one` and `end`.
    """

    def joined(table: PaperTable) -> str:
        names = [column.title for column in table.columns]
        titles = {"one": names[0], "end": names[-1]} if names else {}
        parts = []
        for row in rows(table):
            if row.cells:
                c, s, n = (
                    [table.beside(row, place, unit) for place in range(len(row.cells))]
                    for unit in (" %", " s", "")
                )
                parts.append(form.format(*row.labels, c=c, s=s, n=n, last=c[-1], **titles))
        return before.format(**titles) + between.join(parts) if parts else _NOTHING

    return joined


def _labelled(label: str) -> Callable[[PaperTable], Sequence[PaperRow]]:
    return lambda table: [row for row in table.rows if row.labels[1] == label]


def _worst_and_lowest(table: PaperTable) -> str:
    """Describe the rows with the longest flight and with the lowest success."""
    struck = [row for row in table.rows if not row.labels[0].startswith(_GOLDEN)]
    longest = table.ranked(2)
    if not longest:
        return _NOTHING
    lowest = min(struck, key=lambda row: row.cells[0].value)
    summary = (
        f"longest flight {table.beside(longest[0], 2)} over its own golden one "
        f"({longest[0].labels[0]}); lowest success {table.beside(lowest, 0)} ({lowest.labels[0]})"
    )
    worst, lost = (printed("fig7", x) for x in ("worst_increase_percent", "success_lost_points"))
    paper = f"; paper: up to +{worst} % and -{lost} points"
    return summary + (paper if table.name == "fig7" else "")


_RESULTS: Mapping[str, Callable[[PaperTable], str]] = {
    **dict.fromkeys(("fig7", "fig8", "fig9"), _worst_and_lowest),
    "fig11": _joined("{c[2]} ({0})", "range reduced by ", ", "),
    "fig12": _joined("worst flight {c[1]} in {0}, GAD recovers {n[3]} and AAD {n[4]} points",
                     rows=lambda table: table.ranked(1)[:1]),
    "fig13": _joined("{0}: {c[0]}, with AAD {c[1]}"),
    "fig14": _joined("{0} recovers {c[0]} in {one}", "all stages, ", rows=_labelled(EVERY_STAGE)),
    "fig16": _joined("{0}: worst x {n[2]}, GAD recovers {c[3]}, AAD {c[4]}"),
    "table3": _joined("{0} bits: flight time {s[0]}, success {last}",
                      rows=lambda table: table.rows[-1:]),
    "table4": _joined("{0} {last}", "{end}: ", ", "),
    "table5": _joined("{0} {last} in {end}", "detection and recovery, ", rows=_labelled("sum")),
}  # fmt: skip


# Cells --------------------------------------------------------------------------------------------


def _success(flights: Flights, paper: Printed = None) -> PaperCell:
    return PaperCell.of_share(flights.share(value=False), paper)


def _mean(flights: Flights, name: str, paper: Printed = None, scale: float = 1.0) -> PaperCell:
    """Return a cell with the mean of a measure over the successful missions."""
    return PaperCell.of_mean(scale * _of_successes(flights, name), paper)


def _of_successes(flights: Flights, name: str) -> FloatArray:
    return flights.chosen(lost=False).known(name)


def _maximum(values: FloatArray, paper: Printed = None) -> PaperCell:
    if not len(values):
        return PaperCell(paper=paper)
    return PaperCell(value=float(np.max(values)), count=len(values), paper=paper)


def _worst_mean(bare: Flights, flights: Flights, paper: Printed = None) -> PaperCell:
    """Return a cell with the longest flight time over the mean golden one, as an increase in %."""
    golden_s, times_s = (_of_successes(those, "flight_time_s") for those in (bare, flights))
    if not (len(golden_s) and len(times_s)):
        return PaperCell(paper=paper)
    increase = float(times_s.max() / golden_s.mean()) - 1.0
    return PaperCell(value=PERCENT * increase, count=len(times_s), paper=paper)


def _recovery(protected: Flights, measure: str, paper: Printed) -> PaperCell:
    """Return a cell with how much of the worst case a protection recovers, in per cent or points.

    Args:
        measure: name of an attribute of `WorstCase`.
    """
    value = PERCENT * getattr(protected.worst, measure)
    count = 0 if math.isnan(value) else len(protected.ratios)
    return PaperCell(value=value, count=count, paper=paper)
