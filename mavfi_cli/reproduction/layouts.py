"""The layout of each item: from flown missions, or from another source, to the paper's table.

A layout of flights takes the item's missions as `reproduction.flights.beside_golden`. It reads
configuration and record only, never labels, so that it serves any campaign with such missions.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from mavfi_cli.analysis.flights import chosen, known, numbers
from mavfi_cli.core.files import read_parquet
from mavfi_cli.core.types import FloatArray
from mavfi_cli.mission.record.run_folder import TRACE
from mavfi_cli.report.tables.paper_table import PaperCell, PaperColumn, PaperRow, PaperTable
from mavfi_cli.reproduction.flights import (
    EVERY_STAGE,
    STAGES,
    comparable,
    faulty,
    golden,
    ratios,
)
from mavfi_cli.reproduction.items import BY_NAME
from mavfi_cli.reproduction.measures import (
    PERCENT,
    increases,
    maximum,
    mean,
    mean_cell,
    recovered,
    share_cell,
    success,
    worst_mean,
)
from mavfi_cli.reproduction.paper import printed, source
from mavfi_cli.stats.shares import Share

DETECTORS = {"gad": "Gaussian", "aad": "autoencoder"}
WORLDS = ("factory", "farm", "sparse", "dense")  # in the paper's order
PROTECTED = (*STAGES, "planning+control", EVERY_STAGE)
EVERY_MISSION = "success: all flown missions, as in the paper, 95 % Wilson interval"
MAXIMUM = "worst: longest flight over the golden one of its mission; a maximum has no interval"
_SUCCESS = PaperColumn(title="success, %", ends=0)
_TIME = PaperColumn(title="mean time, s")
_WORST = PaperColumn(title="worst, %", sign=True)
_ENERGY = PaperColumn(title="mean energy, kJ")
_JOULES = 1e-3  # kJ


def _table(
    name: str,
    labels: Sequence[str],
    columns: Sequence[PaperColumn],
    rows: Sequence[PaperRow],
    *,
    result: str,
    notes: Sequence[str] = (),
) -> PaperTable:
    item = BY_NAME[name]
    return PaperTable(
        name=name,
        title=f"{item.paper}: {item.title}",
        labels=tuple(labels),
        columns=tuple(columns),
        rows=tuple(rows),
        notes=(*notes, source(name)),
        result=result,
    )


def _row(*labels: object, cells: Sequence[PaperCell]) -> PaperRow:
    return PaperRow(labels=tuple(map(str, labels)), cells=tuple(cells))


def _told(cell: PaperCell, column: PaperColumn, unit: str = "") -> str:
    """Our number, with the paper's in brackets if it prints one."""
    paper = column.printed(cell.paper)
    return f"{column.told(cell.value)}{unit}" + (f" (paper {paper}{unit})" if paper else "")


def _largest(rows: Sequence[PaperRow], place: int, least: bool = False) -> PaperRow | None:
    """The row with the largest or the smallest number in a column; None if there is none."""
    filled = [row for row in rows if not math.isnan(row.cells[place].value)]
    if not filled:
        return None
    return (min if least else max)(filled, key=lambda row: row.cells[place].value)


# Faults by place: Figs. 7, 8, 9, Table III ------------------------------------------------------

_EFFECTS = (_SUCCESS, _TIME, _WORST)
_EFFECT_NOTES = (EVERY_MISSION, MAXIMUM)
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


def _golden_row(label: str, table: pa.Table, *more: str) -> PaperRow:
    cells = [success(table), mean(table, "flight_time_s"), PaperCell()]
    return _row(label, *more, cells=cells)


def _struck_row(label: str, flights: pa.Table, *more: str) -> PaperRow:
    cells = [success(flights), mean(flights, "flight_time_s"), maximum(increases(flights))]
    return _row(label, *more, cells=cells)


def _with_energy(row: PaperRow, flights: pa.Table) -> PaperRow:
    energy = mean(flights, "energy_regression_j", scale=_JOULES)
    return replace(row, cells=(*row.cells, energy))


def _worst_told(rows: Sequence[PaperRow]) -> str:
    """The row with the longest flight, and the one with the lowest success."""
    longest, lowest = _largest(rows, 2), _largest(rows, 0, least=True)
    if longest is None or lowest is None:
        return "nothing flown yet"
    return (
        f"longest flight {_told(longest.cells[2], _WORST, ' %')} over its own golden one "
        f"({longest.labels[0]}); lowest success {_told(lowest.cells[0], _SUCCESS, ' %')} "
        f"({lowest.labels[0]})"
    )


def _fig7(flights: pa.Table) -> PaperTable:
    """Faults in each kernel beside the golden flights with the same planner."""
    bare = {name: chosen(golden(flights), planner=name) for name in _PLANNERS}
    rows = [
        _with_energy(_golden_row(f"golden, {_PLANNERS[name]}", table), table)
        for name, table in bare.items()
        if table.num_rows
    ]
    struck = []
    for title, (node, planner) in KERNELS_FLOWN.items():
        hit = faulty(flights, level="instruction", fault_target=node, planner=planner)
        if hit.num_rows:
            struck.append(_with_energy(_struck_row(title, hit), hit))
    worst = printed("fig7", "worst_increase_percent")
    lost = printed("fig7", "success_lost_points")
    return _table(
        "fig7", ["kernel"], [*_EFFECTS, _ENERGY], [*rows, *struck],
        notes=[*_EFFECT_NOTES, f"paper, planning and control: up to +{worst} %, -{lost} points"],
        result=f"{_worst_told(struck)}; paper: up to +{worst} % and -{lost} points",
    )  # fmt: skip


def _by_value(name: str, column: str, heading: str, flights: pa.Table) -> PaperTable:
    """Faults by the values of a column, and what the paper says of each."""
    bare, struck = golden(flights), faulty(flights)
    values = list(dict.fromkeys(struck[column].to_pylist()))
    rows = [
        _struck_row(
            str(value), chosen(struck, **{column: value}),
            str(printed(name, "critical", value) or "-"),
        )
        for value in values
    ]  # fmt: skip
    return _table(
        name, [heading, "paper: critical"], _EFFECTS,
        [_golden_row("golden", bare, ""), *rows],
        notes=_EFFECT_NOTES, result=_worst_told(rows),
    )  # fmt: skip


def _fig8(flights: pa.Table) -> PaperTable:
    """Faults in each inter-kernel state."""
    return _by_value("fig8", "fault_target", "state", flights)


def _fig9(flights: pa.Table) -> PaperTable:
    """Faults in each field of float64."""
    return _by_value("fig9", "fault_field", "field", flights)


_QUALITY = {  # the paper's name of a measure, its column, its scale, and its column here
    "flight_time_s": ("flight_time_s", 1.0, PaperColumn(title="flight time, s")),
    "distance_m": ("distance_m", 1.0, PaperColumn(title="distance, m")),
    "energy_kj": ("energy_regression_j", _JOULES, PaperColumn(title="energy, kJ")),
    "replans": ("replans", 1.0, PaperColumn(title="replans", digits=2)),
}


def _table3(flights: pa.Table) -> PaperTable:
    """Quality of flight by the number of flipped bits."""
    struck = faulty(flights)
    groups = {0: golden(flights)} | {
        bits: chosen(struck, fault_bits=bits)
        for bits in sorted(set(struck["fault_bits"].to_pylist()))
    }
    rows = []
    for bits, table in groups.items():
        cells = [
            mean(table, column, printed("table3", paper, bits), scale)
            for paper, (column, scale, _) in _QUALITY.items()
        ]
        cells.append(success(table, printed("table3", "success_percent", bits)))
        rows.append(_row("0 (golden)" if bits == 0 else bits, cells=cells))
    most = rows[-1]
    return _table(
        "table3", ["flipped bits"], [*(each[2] for each in _QUALITY.values()), _SUCCESS], rows,
        notes=[EVERY_MISSION, "means: successful flights, bootstrap interval"],
        result=f"{most.labels[0]} bits: flight time {_told(most.cells[0], _TIME, ' s')}, "
        f"success {_told(most.cells[-1], _SUCCESS, ' %')}",
    )  # fmt: skip


# Detection and recovery in four worlds: Table IV, Figs. 12 and 14, Table V -----------------------


def worlds_of(flights: pa.Table) -> list[str]:
    """The worlds that were flown, the paper's first."""
    found = set(flights["world"].to_pylist())
    return [*(world for world in WORLDS if world in found), *sorted(found - set(WORLDS))]


def _settings(flights: pa.Table) -> dict[str, tuple[str, pa.Table]]:
    """The paper's four rows: key of the paper's numbers, and flights."""
    return {
        "golden": ("golden", golden(flights)),
        "injection": ("none", faulty(flights)),
        **{f"{told}-based": (name, faulty(flights, name)) for name, told in DETECTORS.items()},
    }


def _table4(flights: pa.Table) -> PaperTable:
    """Success in each world: golden, with faults, with each detector."""
    flights = comparable(flights)
    worlds = worlds_of(flights)
    rows = [
        _row(title, cells=[
            success(chosen(table, world=world), printed("table4", "success_percent", key, world))
            for world in worlds
        ])
        for title, (key, table) in _settings(flights).items()
    ]  # fmt: skip
    dense = worlds[-1] if worlds else "no world"
    told = [f"{row.labels[0]} {_told(row.cells[-1], _SUCCESS, ' %')}" for row in rows if row.cells]
    return _table(
        "table4", ["success, %"], [PaperColumn(title=world, ends=0) for world in worlds], rows,
        notes=[EVERY_MISSION], result=f"{dense}: {', '.join(told)}",
    )  # fmt: skip


def _fig12(flights: pa.Table) -> PaperTable:
    """Worst flight time with faults, and what each detector recovers of it, in points."""
    flights = comparable(flights)
    rows = []
    for world in worlds_of(flights):
        here = chosen(flights, world=world)
        bare, struck = golden(here), faulty(here)
        increase = printed("fig12", "worst_increase_percent", world)
        rows.append(_row(world, cells=[
            mean(bare, "flight_time_s"),
            maximum(increases(struck), increase),
            worst_mean(bare, struck, increase),
            *(recovered(faulty(here, name), printed("fig12", "recovered_points", name, world),
                        lambda case: case.recovered) for name in DETECTORS),
        ]))  # fmt: skip
    columns = (
        PaperColumn(title="golden, s"), _WORST,
        PaperColumn(title="over mean, %", sign=True),
        PaperColumn(title="GAD, points"), PaperColumn(title="AAD, points"),
    )  # fmt: skip
    most = _largest(rows, 1)
    return _table(
        "fig12", ["world"], columns, rows,
        notes=[MAXIMUM, "over mean: the longest flight over the mean golden one",
               "GAD, AAD: what they recover of the worst of the same faults, in points of the "
               "golden flight time"],
        result="nothing flown yet" if most is None else
        f"worst flight {_told(most.cells[1], _WORST, ' %')} in {most.labels[0]}, GAD recovers "
        f"{_told(most.cells[3], columns[3])} and AAD {_told(most.cells[4], columns[4])} points",
    )  # fmt: skip


def _fig14(flights: pa.Table) -> PaperTable:
    """Share of the worst increase that each detector recovers, by protected stages."""
    worlds = worlds_of(flights)
    rows = []
    for detector, told in DETECTORS.items():
        for stages in PROTECTED:
            cells = [
                recovered(
                    faulty(flights, detector, protect=stages, world=world),
                    printed("fig14", "recovered_percent", detector, world, stages),
                    lambda case: case.recovered_share,
                )
                for world in worlds
            ]
            rows.append(_row(told, stages, cells=cells))
    column = PaperColumn(title="")
    protected = [row for row in rows if row.labels[1] == EVERY_STAGE and row.cells]
    return _table(
        "fig14", ["recovered, %", "protected stages"],
        [PaperColumn(title=world) for world in worlds], rows,
        notes=[MAXIMUM, "recovered: share of the worst increase of the same faults; a dash: they "
               "prolong no flight"],
        result="all stages, " + "; ".join(
            f"{row.labels[0]} recovers {_told(row.cells[0], column, ' %')} in {worlds[0]}"
            for row in protected
        ),
    )  # fmt: skip


def _table5(flights: pa.Table) -> PaperTable:
    """Shares of the flight time that detection and recovery take."""
    flights = comparable(flights)
    worlds = worlds_of(flights)
    rows = []
    for detector in DETECTORS:
        watched = {world: faulty(chosen(flights, world=world), detector) for world in worlds}
        rows += [
            _row(detector.upper(), title, cells=[
                mean_cell(PERCENT * _summed(table, columns),
                          printed("table5", *keys, world))
                for world, table in watched.items()
            ])
            for title, (columns, keys) in _parts(detector).items()
        ]  # fmt: skip
    shown = PaperColumn(title="", digits=4)
    sums = [row for row in rows if row.labels[1] == "sum" and row.cells]
    return _table(
        "table5", ["%", "of flight time"],
        [PaperColumn(title=world, digits=4, ends=2) for world in worlds], rows,
        notes=["stages: their recovery, simulated time; detection: one check for all stages, "
               "host time", *_unknown_costs(flights)],
        result="detection and recovery, " + "; ".join(
            f"{row.labels[0]} {_told(row.cells[-1], shown, ' %')} in {worlds[-1]}" for row in sums
        ),
    )  # fmt: skip


def _unknown_costs(flights: pa.Table) -> list[str]:
    """Why watched flights have no costs."""
    watched = flights.num_rows > flights["detector"].null_count
    if not watched or len(known(numbers(flights, "check_share"))):
        return []
    return ["no numbers: this export does not hold these times; a new one does"]


def _parts(detector: str) -> dict[str, tuple[Sequence[str], Sequence[str]]]:
    """Rows of a detector: columns that add up, and the keys of the paper's number."""
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


def _summed(table: pa.Table, columns: Sequence[str]) -> FloatArray:
    """The sum of columns in each flight that has them."""
    return known(np.sum([numbers(table, column) for column in columns], axis=0))


# Paths and states: Figs. 11 and 13 ---------------------------------------------------------------

SHOWN_STATES = ("waypoint_x", "waypoint_vx", "waypoint_ax")


def values_and_deltas(flights: pa.Table) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Values of SHOWN_STATES at all control ticks, and their changes from tick to tick.

    Reads the traces of the successful flights whose run folders are there.
    """
    runs = [Path(each) for each in chosen(flights, lost=False)["path"].to_pylist() if each]
    traces = [read_parquet(run / TRACE, "trace") for run in runs if (run / TRACE).is_file()]
    found = {}
    for state in SHOWN_STATES:
        columns = [known(numbers(trace, state)) for trace in traces]
        found[state] = (
            np.concatenate([np.zeros(0), *columns]),
            np.concatenate([np.zeros(0), *(np.diff(each) for each in columns)]),
        )
    return found


def _fig11(flights: pa.Table) -> PaperTable:
    """Ranges of the values of three states, and of their changes."""
    rows = []
    for state, (values, deltas) in values_and_deltas(golden(flights)).items():
        spans = [_span(values, 1.0), _span(deltas, 1.0)]
        middle = [_span(values, 0.99), _span(deltas, 0.99)]
        numbers_shown = [*spans, _reduction(*spans), _reduction(*middle)]
        paper = [None, None, printed("fig11", "reduction_percent", state), None]
        rows.append(_row(state, cells=[
            PaperCell(value=value, count=len(values), paper=each)
            for value, each in zip(numbers_shown, paper, strict=True)
        ]))  # fmt: skip
    columns = (
        PaperColumn(title="range of values", digits=2),
        PaperColumn(title="range of deltas", digits=2),
        PaperColumn(title="reduction, %"),
        PaperColumn(title="of the middle 99 %, %"),
    )
    return _table(
        "fig11", ["state"], columns, rows,
        notes=["n: control ticks of error-free flights; values in m, m/s and m/s^2; a range has "
               "no interval"],
        result="range reduced by " + ", ".join(
            f"{_told(row.cells[2], columns[2], ' %')} ({row.labels[0]})" for row in rows
        ),
    )  # fmt: skip


def _span(values: FloatArray, share: float) -> float:
    """The range of the middle share of the values; NaN without any."""
    if not len(values):
        return math.nan
    low, high = np.quantile(values, (0.5 - share / 2.0, 0.5 + share / 2.0))
    return float(high - low)


def _reduction(values: float, deltas: float) -> float:
    return PERCENT * (1.0 - deltas / values) if values else math.nan


def _fig13(flights: pa.Table) -> PaperTable:
    """The flight that a fault prolongs most, of each stage, and the same with the autoencoder."""
    rows = []
    for stage in dict.fromkeys(faulty(flights)["fault_target"].to_pylist()):
        struck = faulty(flights, fault_target=stage)
        cells = [
            maximum(increases(struck), printed("fig13", "increase_percent", stage)),
            maximum(_with(struck, faulty(flights, "aad", fault_target=stage))),
            mean_cell(increases(struck)),
        ]
        rows.append(_row(stage, cells=cells))
    columns = (
        _WORST,
        PaperColumn(title="the same with AAD, %", sign=True),
        PaperColumn(title="mean of all, %", sign=True),
    )
    return _table(
        "fig13", ["fault in"], columns, rows, notes=[MAXIMUM],
        result="; ".join(
            f"{row.labels[0]}: {_told(row.cells[0], _WORST, ' %')}, with AAD "
            f"{_told(row.cells[1], columns[1], ' %')}" for row in rows
        ) or "nothing flown yet",
    )  # fmt: skip


def _with(struck: pa.Table, protected: pa.Table) -> FloatArray:
    """Increase of the protected flight whose unprotected one is prolonged most, (1,) or (0,)."""
    if not len(ratios(struck)):
        return np.zeros(0)
    pair = struck["pair"][int(np.nanargmax(numbers(struck, "over_own")))].as_py()
    return increases(chosen(protected, pair=pair))


# Platforms: Fig. 16 ------------------------------------------------------------------------------


def _fig16(flights: pa.Table) -> PaperTable:
    """Worst flight time on each platform, and what each detector recovers of it."""
    rows = []
    for platform in dict.fromkeys(flights["platform"].to_pylist()):
        here = chosen(flights, platform=platform)
        bare, struck = golden(here), faulty(here)
        rows.append(_row(platform, cells=[
            mean(bare, "flight_time_s"),
            success(struck),
            maximum(ratios(struck), printed("fig16", "worst_ratio", platform)),
            *(recovered(faulty(here, name), printed("fig16", "recovered_percent", name, platform),
                        lambda case: case.recovered_share) for name in DETECTORS),
        ]))  # fmt: skip
    columns = (
        PaperColumn(title="golden, s"), PaperColumn(title="success with faults, %"),
        PaperColumn(title="worst, x own golden", digits=2),
        PaperColumn(title="GAD recovers, %"), PaperColumn(title="AAD recovers, %"),
    )  # fmt: skip
    return _table(
        "fig16", ["platform"], columns, rows, notes=[MAXIMUM, EVERY_MISSION],
        result="; ".join(
            f"{row.labels[0]}: worst x {_told(row.cells[2], columns[2])}, GAD recovers "
            f"{_told(row.cells[3], columns[3], ' %')}, AAD {_told(row.cells[4], columns[4], ' %')}"
            for row in rows
        ) or "nothing flown yet",
    )  # fmt: skip


OF_FLIGHTS: Mapping[str, Callable[[pa.Table], PaperTable]] = {
    "fig7": _fig7, "fig8": _fig8, "fig9": _fig9, "fig11": _fig11, "fig12": _fig12, "fig13": _fig13,
    "fig14": _fig14, "fig16": _fig16, "table3": _table3, "table4": _table4, "table5": _table5,
}  # fmt: skip


def of_flights(name: str, flights: pa.Table) -> PaperTable:
    """The table of an item that is flown.

    Args:
        flights: the item's missions, as `reproduction.flights.beside_golden`.
    """
    return OF_FLIGHTS[name](flights)


# Isolated kernels: Fig. 6 ------------------------------------------------------------------------

_OUTCOMES = {"benign": "benign, %", "sdc": "SDC, %", "crash": "crash, %", "hang": "hang, %"}
_PAPER_KERNELS = {"control": "pid"}  # the paper's name where it is another


def of_kernels(summary: Mapping[str, Any]) -> PaperTable:
    """The table of Fig. 6.

    Args:
        summary: `kernels.json` of `mavfi kernels`.
    """
    rows = []
    for kernel in summary["kernels"]:
        name = kernel["kernel"]
        paper = printed("fig6", "benign_percent", _PAPER_KERNELS.get(name, name))
        cells = [
            share_cell(_share(kernel["outcomes"][outcome]), paper if outcome == "benign" else None)
            for outcome in _OUTCOMES
        ]
        rows.append(_row(kernel["title"], cells=cells))
    most = _largest(rows, 1)
    return _table(
        "fig6", ["kernel"], [PaperColumn(title=title) for title in _OUTCOMES.values()], rows,
        notes=["of the runs in which a bit was flipped, Wilson interval"],
        result="no runs" if most is None else
        f"most SDC: {most.labels[0]}, {most.cells[1].value:.1f} % (paper: OctoMap)",
    )  # fmt: skip


def _share(row: Mapping[str, Any]) -> Share:
    low, high = row["wilson95"]
    return Share(count=row["count"], total=row["of"], share=row["share"] or 0.0, low=low, high=high)


# Performance model: Fig. 15 ----------------------------------------------------------------------


def of_model(report: Mapping[str, Any]) -> PaperTable:
    """The table of Fig. 15.

    Args:
        report: what `mavfi_cli.vpm.report.report` tells of the paper's vehicles.
    """
    vehicles = report["vehicles"]
    schemes = [row["scheme"] for row in vehicles[0]["schemes"]]
    rows = [
        _row(scheme, cells=[
            PaperCell(
                value=_ratio(one, scheme),
                paper=printed("fig15", "time_ratio", scheme, one["vehicle"]),
            )
            for one in vehicles
        ])
        for scheme in schemes
    ]  # fmt: skip
    columns = [PaperColumn(title=one["vehicle"], digits=3) for one in vehicles]
    told = [
        f"{column.title} {_told(cell, column)}"
        for row in rows if row.labels[0] == "tmr"
        for column, cell in zip(columns, row.cells, strict=True)
    ]  # fmt: skip
    return _table(
        "fig15", ["flight time, x detection"], columns, rows,
        notes=["an analytic model: no missions, no interval; calibrated so that TMR takes the "
               "paper's ratio"],
        result=f"flight time with TMR: x {', x '.join(told)}",
    )  # fmt: skip


def _ratio(vehicle: Mapping[str, Any], scheme: str) -> float:
    (row,) = [each for each in vehicle["schemes"] if each["scheme"] == scheme]
    ratio = row["flight_time_ratio"]
    return math.nan if ratio is None else float(ratio)
