"""What the paper does not ask of its flights.

From the kernel to the mission, where a bit hurts, failures an hour, and what each mechanism saves.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from mavfi_cli.analysis.flights import chosen, flags
from mavfi_cli.campaigns.missions import canonical
from mavfi_cli.core.config import read_toml
from mavfi_cli.core.types import BY_NAME, DType
from mavfi_cli.paper.flights import (
    by_value,
    comparable,
    golden,
    share,
    struck,
    with_columns,
)
from mavfi_cli.stats.paired import holm, mcnemar
from mavfi_cli.stats.shares import Share, cross_layer, failures_per_hour, wilson

Row = Mapping[str, Any]  # one flight


class Fate(Enum):
    """What a struck kernel did, as far as the flight shows it."""

    UNREAD = "never read"
    SAME = "same flight"  # it was read, and every measure of the flight is that of the golden one
    CHANGED = "changed flight"
    CRASH = "crashed"
    HANG = "hung"


_MEASURES = (
    "outcome", "flight_time_s", "distance_m", "min_clearance_m", "goal_distance_m",
    "energy_regression_j", "energy_propeller_j", "replans",
)  # fmt: skip


def _fate_of(flight: Row, own: Row) -> Fate:
    """What a kernel did after an instruction-level fault struck it.

    Missions repeat to the byte, so a flight that differs from its golden one does so by the fault.
    """
    ended = set((flight["node_ended"] or "").split(";")) - {""}
    if ended:
        return Fate.HANG if ended == {"hang"} else Fate.CRASH
    if any(own[name] != flight[name] for name in _MEASURES):
        return Fate.CHANGED
    return Fate.SAME if flight["activation"] == "read" else Fate.UNREAD


@dataclass(frozen=True, slots=True, kw_only=True)
class _KernelFlow:
    """Faults in one kernel: what it did, and what became of the missions.

    Attributes:
        fates: lost missions among those of each fate.
        lost, harmed: of all.
        silent: share of silent corruption of the isolated kernel; None without its runs.
        given_silent: probability that a mission is lost given silent corruption of the kernel, with
            the ends of its interval; None where it cannot be told.
    """

    kernel: str
    fates: Mapping[Fate, Share]
    lost: Share
    harmed: Share
    silent: Share | None = None
    given_silent: tuple[float, float, float] | None = None


def kernel_flows(flights: pa.Table, alone: Mapping[str, tuple[int, int]]) -> list[_KernelFlow]:
    """The flow from kernel to mission, for each kernel that instruction-level faults struck.

    Args:
        flights: of `paper.flights.beside_golden`.
        alone: silent corruptions and faults of each isolated kernel.
    """
    own = {row["pair"]: row for row in golden(flights).select(["pair", *_MEASURES]).to_pylist()}
    hit = by_value(struck(flights, level="instruction", own_lost=False), "struck_kernel")
    kernels = {name: those for (name,), those in hit.items() if name}
    return [
        _flow(name, kernels[name], own, alone.get(name))
        for name in sorted(kernels, key=lambda each: (_ORDER.get(each, 9), each))
    ]


_ORDER = {"point_cloud": 0, "octomap": 1, "collision_check": 2, "rrtstar": 3, "control": 8}


def _flow(
    name: str, flights: pa.Table, own: Mapping[str, Row], alone: tuple[int, int] | None
) -> _KernelFlow:
    fates = [_fate_of(each, own[each["pair"]]) for each in flights.to_pylist()]
    lost = {fate: flags(flights, "lost")[np.array(fates) == fate] for fate in Fate}
    lived = int(lost[Fate.SAME].sum() + lost[Fate.CHANGED].sum())
    layers = None if alone is None else cross_layer(*alone, lived, flights.num_rows)
    return _KernelFlow(
        kernel=name,
        fates={fate: wilson(int(each.sum()), len(each)) for fate, each in lost.items()},
        lost=share(flights),
        harmed=share(flights, "harmed"),
        silent=None if layers is None else Share(**layers["corruption"]),
        given_silent=None if layers is None else layers["failure_given_corruption"],
    )


# State by bit by phase of flight ------------------------------------------------------------------

_BITS = {  # lowest bit of each class, highest class first
    DType.FLOAT64: (("bit 63, sign", 63), ("exponent 62 to 57", 57), ("exponent 56 to 52", 52),
                    ("mantissa 51 to 26", 26), ("mantissa 25 to 0", 0)),
    DType.INT32: (("bit 31, sign", 31), ("bits 30 to 16", 16), ("bits 15 to 8", 8),
                  ("bits 7 to 0", 0)),
    DType.BOOL: (("flag", 0),),
}  # fmt: skip
BIT_CLASSES = tuple(tuple(name for name, _ in kinds) for kinds in _BITS.values())


@dataclass(frozen=True, slots=True, kw_only=True)
class StateCell:
    """Faults in one class of bits of a state, in one phase of flight."""

    harmed: Share
    lost: Share


def state_map(flights: pa.Table) -> dict[tuple[str, str, str], StateCell]:
    """The map by state, class of bits and phase.

    It counts source-level faults without a detector whose golden flights succeed.

    A fault in several components is told by its group, and by the highest bit that it flips.

    Args:
        flights: of `paper.flights.beside_golden`.
    """
    hit = struck(flights, level="source", own_lost=False)
    hit = hit.filter(
        pc.and_(pc.not_equal(hit["struck_state"], ""), pc.is_valid(hit["struck_bits"]))
    )
    rows = hit.to_pylist()
    cells = by_value(
        with_columns(
            hit,
            name=pa.array(map(_state, rows), pa.string()),
            bits=pa.array(map(_class, rows), pa.string()),
            phase=pc.fill_null(hit["strike_phase"], ""),
        ),
        "name", "bits", "phase",
    )  # fmt: skip
    return {
        place: StateCell(harmed=share(cells[place], "harmed"), lost=share(cells[place]))
        for place in sorted(cells)
    }


def _state(flight: Row) -> str:
    states = str(flight["struck_state"]).split(";")
    return states[0] if len(states) == 1 else str(flight["fault_target"])


def _class(flight: Row) -> str:
    name = str(flight["struck_state"]).split(";")[0]
    bits = max(map(int, str(flight["struck_bits"]).replace(";", " ").split()))
    kinds = _BITS[BY_NAME[name].dtype if name in BY_NAME else DType.FLOAT64]
    return next(each for each, lowest in kinds if bits >= lowest)


# Failures a flight hour ---------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class _HourlyFailures:
    """Failures of missions a flight hour, for one kind of fault in one world.

    Attributes:
        where: what is struck, how, and in which world.
        lost: share of faults that lose a mission whose golden flight succeeds, by detector; the
            empty name is no detector.
        per_hour: point, low and high, by detector.
    """

    where: str
    lost: Mapping[str, Share]
    per_hour: Mapping[str, tuple[float, float, float]]


def hourly_failures(flights: pa.Table, upsets_per_hour: float) -> Iterator[_HourlyFailures]:
    """Failures an hour of every kind of fault, by world and detector.

    Args:
        flights: of `paper.flights.beside_golden`.
        upsets_per_hour: bit flips that reach the injection sites in an hour of flight.
    """
    hit = chosen(comparable(flights), struck=True, own_lost=False)
    hit = with_columns(hit, kind=pa.array(map(_kind, hit.to_pylist()), pa.string()))
    for (place,), those in sorted(by_value(hit, "kind").items()):
        by_detector = by_value(those, "detector").items()
        lost = dict(sorted((name or "", share(each)) for (name,), each in by_detector))
        hourly = {name: failures_per_hour(upsets_per_hour, each) for name, each in lost.items()}
        yield _HourlyFailures(where=place, lost=lost, per_hour=hourly)


_COMPONENTS = Counter(state.group for state in BY_NAME.values())


def _kind(flight: Row) -> str:
    """What is struck, how unless it is one bit of any field, and where it flies."""
    level = "instruction" if flight["level"] == "instruction" else "state"
    components = _COMPONENTS[str(flight["fault_target"]).rpartition(".")[2]]
    how = [
        None if flight["fault_field"] == "any" else flight["fault_field"],
        None if flight["fault_bits"] == 1 else f"{flight['fault_bits']} bits",
        "all components" if flight["together"] and components > 1 else None,
    ]
    computer = None if flight["platform"] == "x86" else flight["platform"]
    parts = (flight["fault_target"], *how, flight["world"], computer)
    return f"{level}: {', '.join(part for part in parts if part)}"


# What each mechanism saves ------------------------------------------------------------------------

# An arm is a stack with or without a detector. Its faults are those that the arm without protection
# has read, so all arms are counted on the same faults in the same scenes.
_BASE = "mavbench"
_WORDS, _ = read_toml(Path(__file__).parent / "arms.toml")
PLAIN = _WORDS["stacks"][""]


@dataclass(frozen=True, slots=True, kw_only=True)
class Arm:
    """One row of the table.

    Attributes:
        golden: lost golden flights.
        by_site: lost missions of each injection site.
        lost: lost missions of all sites.
        p_value: McNemar's exact test against the unprotected arm; None of that arm itself.
        corrected_p: by Holm, over all arms.
    """

    name: str
    golden: Share
    by_site: Mapping[str, Share]
    lost: Share
    p_value: float | None
    corrected_p: float | None


def arms(flights: pa.Table) -> list[Arm]:
    """The arms of a campaign, the unprotected one first; none unless it flew several stacks.

    Args:
        flights: of `paper.flights.flown_missions`.
    """
    if pc.count_distinct(flights["stack"]).as_py() < 2:
        return []
    golden: dict[str, list[Row]] = {}
    trials: dict[str, dict[str, Row]] = {}
    for flight in flights.select(_READ).to_pylist():
        name = _arm_of(flight)
        if flight["level"] is None:
            golden.setdefault(name, []).append(flight)
        elif name:
            trials.setdefault(name, {})[_trial_of(flight)] = flight
    read = (each for each, x in trials.get(PLAIN, {}).items() if x["activation"] == "read")
    shared = sorted(set(read).intersection(*trials.values()))
    if not shared or len(trials) < 2:
        return []
    order = sorted(trials, key=lambda name: name != PLAIN)
    kept = {name: [trials[name][trial] for trial in shared] for name in order}
    won = {name: [not each["lost"] for each in those] for name, those in kept.items()}
    tests = {name: mcnemar(won[PLAIN], won[name]).p_value for name in order if name != PLAIN}
    corrected = dict(zip(tests, holm([*tests.values()]), strict=True))
    return [
        Arm(
            name=name,
            golden=_lost(golden.get(name, [])),
            by_site=_by_site(those),
            lost=_lost(those),
            p_value=tests.get(name),
            corrected_p=corrected.get(name),
        )
        for name, those in kept.items()
    ]


_READ = ["stack", "detector", "level", "fault", "fault_target", "activation", "lost", "changes"]


def _arm_of(flight: Row) -> str:
    """The name of a flight's arm; empty if its stack is no variant of mavbench."""
    base, _, changes = flight["stack"].partition(":")
    if base not in (_BASE, f"{_BASE}-protected"):
        return ""
    told = _WORDS["stacks"].get(changes, changes)
    name = told if base == _BASE else "all four checks" + (f", {told}" if changes else "")
    detector = (flight["detector"] or "").upper()
    if not detector:
        return name
    return detector if name == PLAIN else f"{name} and {detector}"


def _trial_of(flight: Row) -> str:
    """Fault, world, start, noise and computer as text: what the flights of all arms share."""
    config = json.loads(flight["changes"])
    scene = {name: value for name, value in config.items() if name not in _APART}
    return canonical([scene, flight["fault"]])


_APART = ("fault", "instruction", "detector", "isolate", "stack")


def _lost(flights: Sequence[Row]) -> Share:
    return wilson(sum(each["lost"] for each in flights), len(flights))


def _by_site(flights: Sequence[Row]) -> dict[str, Share]:
    found: dict[str, list[Row]] = {}
    for each in flights:
        target = str(each["fault_target"])
        found.setdefault(_WORDS["sites"].get(target, target), []).append(each)
    order = dict.fromkeys((*_WORDS["sites"].values(), *sorted(found)))
    return {name: _lost(found[name]) for name in order if name in found}
