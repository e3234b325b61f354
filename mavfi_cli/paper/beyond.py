"""Analyses that go beyond the paper.

They trace a fault from the kernel to the mission, map where a flipped bit does harm, count failures
per hour, compare what each mechanism saves, measure what restarting a dead node saves, and count
what faults cost a user's companion.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import compress
from operator import itemgetter
from pathlib import Path
from statistics import stdev
from typing import Any, NamedTuple

from mavfi_cli.analysis.pairs import STRUCK, USUAL, Fate, Flights, back
from mavfi_cli.campaigns.missions import Injected, canonical
from mavfi_cli.core.config import read_toml
from mavfi_cli.core.errors import ConfigError
from mavfi_cli.core.types import BY_NAME, DType
from mavfi_cli.paper.items import Regime, printed
from mavfi_cli.report.paper import DETECTOR_TITLES, Printed
from mavfi_cli.spec.detector import PAPER
from mavfi_cli.spec.mission import NOT_OF_GOLDEN, MissionConfig
from mavfi_cli.spec.stack import Stack, load_stack
from mavfi_cli.stats.bootstrap import TABLE_RESAMPLES, interval
from mavfi_cli.stats.paired import McNemar, holm
from mavfi_cli.stats.shares import Interval, Share, cross_layer, wilson

Row = Mapping[str, Any]  # one flight

# What a struck kernel did, as far as the flight shows. `same flight`: the fault was read, and
# every measure equals that of the golden flight.
FATES = ("never read", "same flight", "changed flight", "crashed", "hung")
_UNREAD, _SAME, _CHANGED, _CRASH, _HANG = FATES
_MEASURES = (
    "outcome", "flight_time_s", "distance_m", "min_clearance_m", "goal_distance_m",
    "energy_regression_j", "energy_propeller_j", "replans",
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class KernelFlow:
    """Losses among missions with a fault in one kernel, by what the fault did to the kernel.

    Attributes:
        fates: share of lost missions for each of FATES.
        lost, harmed: shares among all missions with a fault in the kernel.
        silent: share of runs of the isolated kernel that end in SDC; None if it was not run.
        given_silent: probability that a mission is lost, given an SDC in the kernel, and the low
            and high end of its interval; None if unknown.
    """

    kernel: str
    fates: Mapping[str, Share]
    lost: Share
    harmed: Share
    silent: Share | None
    given_silent: tuple[float, ...] | None


def kernel_flows(flights: Flights, alone: Mapping[str, tuple[int, int]]) -> list[KernelFlow]:
    """Return what instruction-level faults did to missions, for each kernel that they struck.

    Args:
        alone: number of SDCs and number of faults in each isolated kernel, keyed by kernel.
    """
    own = {row["pair"]: row for row in flights.golden.rows("pair", *_MEASURES)}
    hit = flights.struck(level="instruction", own_lost=False).by("struck_kernel")
    kernels = {name: those for (name,), those in hit.items() if name}
    return [
        _flow(name, kernels[name], own, alone.get(name))
        for name in sorted(kernels, key=lambda name: (_ORDER.get(name, 9), name))
    ]


_ORDER = {"point_cloud": 0, "octomap": 1, "collision_check": 2, "rrtstar": 3, "control": 8}


def _flow(
    name: str, flights: Flights, own: Mapping[str, Row], alone: tuple[int, int] | None
) -> KernelFlow:
    of_fate = flights.grouped(_fate_of(row, own[row["pair"]]) for row in flights.rows())
    fates = {fate: of_fate[fate].share() if fate in of_fate else wilson(0, 0) for fate in FATES}
    lived = fates[_SAME].count + fates[_CHANGED].count
    layers = None if alone is None else cross_layer(*alone, lived, len(flights))
    return KernelFlow(
        kernel=name,
        fates=fates,
        lost=flights.share(),
        harmed=flights.share("harmed"),
        silent=layers.corruption if layers else None,
        given_silent=layers.failure_given_corruption if layers else None,
    )


def _fate_of(flight: Row, own: Row) -> str:
    """Return which of FATES a flight with an instruction-level fault had, given its golden flight.

    Repeated missions match byte for byte, so only the fault can make a flight differ from its
    golden flight.
    """
    ended = set((flight["node_ended"] or "").split(";")) - {""}
    if ended:
        return _HANG if ended == {"hang"} else _CRASH
    if any(own[name] != flight[name] for name in _MEASURES):
        return _CHANGED
    return _SAME if flight["activation"] == "read" else _UNREAD


# Harm by state, bit and phase of flight -----------------------------------------------------------

_BITS = {  # lowest bit of each class, highest class first
    DType.FLOAT64: (("bit 63, sign", 63), ("exponent 62 to 57", 57), ("exponent 56 to 52", 52),
                    ("mantissa 51 to 26", 26), ("mantissa 25 to 0", 0)),
    DType.INT32: (("bit 31, sign", 31), ("bits 30 to 16", 16), ("bits 15 to 8", 8),
                  ("bits 7 to 0", 0)),
    DType.BOOL: (("flag", 0),),
}  # fmt: skip
BIT_CLASSES = tuple(tuple(name for name, _ in kinds) for kinds in _BITS.values())


@dataclass(frozen=True, slots=True, kw_only=True)
class MapCell:
    """Shares of harmed and lost missions, for faults in one bit class of a state and one phase."""

    state: str
    bits: str
    phase: str
    harmed: Share
    lost: Share


def state_map(flights: Flights) -> list[MapCell]:
    """Return a cell for each combination of state, bit class and phase of flight that was struck.

    The cells are sorted. They count source-level faults that were flown without a detector and have
    a successful golden flight. A fault in several components counts once, for their group and for
    the highest bit that it flips.
    """
    hit = flights.struck(level="source", own_lost=False)
    hit = hit.where([bool(x["struck_state"] and any(x["struck_bits"] or ())) for x in hit.rows()])
    places = ((_state(x), _class(x), x["strike_phase"] or "") for x in hit.rows())
    return [
        MapCell(state=state, bits=bits, phase=phase, harmed=mine.share("harmed"), lost=mine.share())
        for (state, bits, phase), mine in sorted(hit.grouped(places).items())
    ]


def _state(flight: Row) -> str:
    states = str(flight["struck_state"]).split(";")
    return states[0] if len(states) == 1 else str(flight["fault_target"])


def _class(flight: Row) -> str:
    name = str(flight["struck_state"]).split(";")[0]
    highest = max(bit for bits in flight["struck_bits"] for bit in bits)
    kinds = _BITS[BY_NAME[name].dtype if name in BY_NAME else DType.FLOAT64]
    return next(name for name, lowest in kinds if highest >= lowest)


# Failures per flight hour -------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class HourlyFailures:
    """Failures per flight hour of one kind of fault in one world, with and without detectors.

    The mappings have a detector's name as key, or "" for flights without a detector.

    Attributes:
        where: the struck site, the kind of corruption, the world, and the computer.
        lost: share of faults whose mission is lost although its golden flight succeeds.
        per_hour: failure rate and the low and high end of its interval, per flight hour.
    """

    where: str
    lost: Mapping[str, Share]
    per_hour: Mapping[str, tuple[float, float, float]]


def hourly_failures(flights: Flights, upsets_per_hour: float) -> Iterator[HourlyFailures]:
    """Yield the failures per flight hour for each kind of fault in each world.

    Args:
        upsets_per_hour: bit flips that reach the injection sites per flight hour.
    """
    hit = flights.comparable.chosen(struck=True, own_lost=False)
    for place, mine in sorted(hit.grouped(map(_kind, hit.rows())).items()):
        by_detector = mine.by("detector").items()
        lost = dict(sorted((name or "", those.share()) for (name,), those in by_detector))
        hourly = {name: share.per_hour(upsets_per_hour) for name, share in lost.items()}
        yield HourlyFailures(where=place, lost=lost, per_hour=hourly)


_COMPONENTS = Counter(state.group for state in BY_NAME.values())


def _kind(flight: Row) -> str:
    """Describe a fault's level, site, corruption, world and platform; omit the usual values."""
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

# An arm is a stack with or without a detector. Only faults that were read in the unprotected arm
# count, so all arms are compared on the same faults in the same scenes.
_WORDS, _ = read_toml(Path(__file__).parent / "arms.toml")
PLAIN = "unprotected"


@dataclass(frozen=True, slots=True, kw_only=True)
class Arm:
    """One arm of a campaign: a stack with or without a detector.

    Attributes:
        golden: share of lost golden flights.
        lost, by_site: shares of lost missions, over all faults and by injection site.
        p_value: p-value of McNemar's exact test against the unprotected arm; None for that arm.
        corrected_p: `p_value`, corrected for the number of arms by Holm's method.
    """

    name: str
    golden: Share
    by_site: Mapping[str, Share]
    lost: Share
    p_value: float | None
    corrected_p: float | None

    @staticmethod
    def by_base(flights: Flights, *, every: bool = False) -> dict[str, Flights]:
        """Return the flights of each base stack and its variants, keyed by the base.

        Each variant stands beside its base as in `Flights.beside_base`. The base is that of the
        variants, such as BASE in `BASE:restores_counters=true`. A base without variants is omitted.
        The golden flight of a variant is that of the variant, or else that of the flown variant
        with the most of its settings, or that of the base.

        Args:
            every: keep all variants, and not only those that only add protections.
        """
        variants = [_variant(stack) for stack in flights["stack"]]
        companions = (name is not None for name in flights["companion"])
        kept = [not companion and (every or variant.protects)
                for companion, variant in zip(companions, variants, strict=True)]  # fmt: skip
        mine, variants = flights.where(kept), [*compress(variants, kept)]
        configs = [json.loads(changes) for changes in mine["changes"]]
        scenes = [
            canonical({**{name: value for name, value in config.items()
                          if name not in NOT_OF_GOLDEN}, "stack": variant.base})
            for config, variant in zip(configs, variants, strict=True)
        ]  # fmt: skip
        names = [
            " and ".join(filter(None, (variant.name, _detector(config)))) or None
            for config, variant in zip(configs, variants, strict=True)
        ]
        flown: dict[str, dict[_Settings, int]] = {}
        for place, row in enumerate(mine.rows("level", "detector")):
            if row["level"] is None and row["detector"] is None:
                flown.setdefault(scenes[place], {}).setdefault(variants[place].settings, place)
        golden = [
            max(
                ((len(settings), place) for settings, place in flown.get(scene, {}).items()
                 if settings <= variant.settings),
                default=(0, -1),
            )[1]
            for scene, variant in zip(scenes, variants, strict=True)
        ]  # fmt: skip
        beside = mine.beside_base(scenes, names, golden)
        grouped = beside.grouped(variant.base for variant in variants)
        return {base: those for base, those in grouped.items() if {*those["stack"]} != {base}}


def arms(flights: Flights, *, every: bool = False) -> dict[str, list[Arm]]:
    """Return the arms of a campaign with variants of a stack, keyed by this base stack.

    The unprotected arm is the first. A base is omitted if no fault that was read in its unprotected
    arm was flown in all its arms.

    Args:
        every: compare all variants, and not only protections.
    """
    by_base = {base: _arms(mine) for base, mine in Arm.by_base(flights, every=every).items()}
    return {base: found for base, found in by_base.items() if found}


def _arms(flights: Flights) -> list[Arm]:
    """Return the arms of one base stack, from `Arm.by_base`."""
    golden: dict[str, list[Row]] = {}
    trials: dict[str, dict[tuple[Any, ...], Row]] = {}
    for flight in flights.rows(*_READ):
        name = flight["detector"] or PLAIN
        if flight["level"] is None:
            golden.setdefault(name, []).append(flight)
        else:
            trial = (flight["pair"], flight["fault"], flight["restart_s"])
            trials.setdefault(name, {})[trial] = flight
    plain = trials.get(PLAIN, {}).items()
    read = (trial for trial, flight in plain if flight["activation"] == "read")
    shared = sorted(set(read).intersection(*trials.values()))
    if not shared or len(trials) < 2:
        return []
    order = sorted(trials, key=lambda name: name != PLAIN)
    kept = {name: [trials[name][trial] for trial in shared] for name in order}
    won = {name: [not flight["lost"] for flight in mine] for name, mine in kept.items()}
    tests = {name: McNemar.of(won[PLAIN], won[name]).p_value for name in order if name != PLAIN}
    corrected = dict(zip(tests, holm([*tests.values()]), strict=True))
    return [
        Arm(
            name=name,
            golden=_lost(golden.get(name, [])),
            by_site=_by_site(mine),
            lost=_lost(mine),
            p_value=tests.get(name),
            corrected_p=corrected.get(name),
        )
        for name, mine in kept.items()
    ]


_READ = (
    "pair", "detector", "level", "fault", "restart_s", "fault_target", "activation", "lost",
)  # fmt: skip


_Settings = frozenset[tuple[str, str]]  # keys of a stack and their values as canonical JSON


class _Variant(NamedTuple):
    """A stack as an arm: its base, its differences, and whether all of them protect."""

    base: str
    settings: _Settings = frozenset()
    name: str = ""
    protects: bool = True


@cache
def _variant(stack: str) -> _Variant:
    try:
        base, changes = Stack.split(stack)
    except ConfigError:  # not a text that this version can read
        return _Variant(stack)
    settings = _settings(changes)
    whole = _PARTS.get(settings)
    parts = [words for part, words in _PARTS.items() if len(part) == 1 and part <= settings]
    known = len(parts) == len(settings)
    words = [whole] if whole else parts if known else [stack.partition(":")[2]]
    protects = known and {*parts} <= _PROTECTIONS
    if (protected := _WORDS["protected_stacks"].get(base)) is not None:
        words.insert(0, protected)
        settings |= {(base, "")}
        base = load_stack(base).base
    return _Variant(base, settings, " with ".join(words), protects)


def _settings(changes: Mapping[str, Any]) -> _Settings:
    return frozenset((key, canonical(value)) for key, value in changes.items())


_PARTS = {
    _settings(Stack.split(f":{text}")[1]): words
    for table in ("protections", "variants")
    for text, words in _WORDS[table].items()
}
_PROTECTIONS = frozenset(_WORDS["protections"].values())


def _detector(config: Mapping[str, Any]) -> str:
    """Return the name of a mission's detector, with its watch if it is not that of the paper."""
    detector = config.get("detector")
    if detector is None:
        return ""
    watch = detector.get("watch", PAPER)
    name = str(detector.get("name", "")).upper()
    return name + ("" if watch == PAPER else f" ({watch} watch)")


def _lost(flights: Sequence[Row]) -> Share:
    return wilson(sum(flight["lost"] for flight in flights), len(flights))


def _by_site(flights: Sequence[Row]) -> dict[str, Share]:
    by_site: dict[str, list[Row]] = {}
    for flight in flights:
        target = str(flight["fault_target"])
        by_site.setdefault(_WORDS["sites"].get(target, target), []).append(flight)
    order = dict.fromkeys((*_WORDS["sites"].values(), *sorted(by_site)))
    return {name: _lost(by_site[name]) for name in order if name in by_site}


# What restarting a dead node saves ----------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class RestartComparison:
    """Success of a stack in a world on the same faults, with different restart delays.

    Attributes:
        place: the stack, the injector that is copied, if any, and the kind of its worlds if the
            missions have both kinds.
        paper: success rates in Table IV, in per cent, for golden flights and for flights with a
            fault, alone and with each detector; None if the table lacks the world.
        golden: share of golden flights that succeed.
        success: share of missions with instruction-level faults that succeed, by restart rule.
        watched: share of missions that succeed without a detector (the key None) and with each,
            by restart rule; only faults of the paper's kind that were flown in all of these. Empty
            unless detectors were flown under several rules.
        lost: share of missions that are lost, by restart rule and fate of the fault.
        p_value: p-value of McNemar's exact test between the earliest and the latest restart.
    """

    place: str
    world: str
    paper: Sequence[Printed]
    golden: Share
    success: Mapping[str, Share]
    watched: Mapping[str, Mapping[str | None, Share]]
    lost: Mapping[str, Mapping[Fate, Share]]
    p_value: float

    @property
    def rules(self) -> tuple[str, ...]:
        """The restart rules, earliest restart first."""
        return tuple(self.success)


def restarts(flights: Flights) -> list[RestartComparison]:
    """Compare restart rules on the same instruction-level faults, for each stack and world.

    Only missions count whose golden flight succeeds. Fixed worlds are compared apart from other
    worlds, and a copied injector apart from mavfi's own.
    """
    kinds = flights.by_worlds
    kinds = kinds if len(kinds) > 1 else {"": flights}
    return [row for kind, mine in kinds.items() for row in _of_kind(kind, mine)]


def _of_kind(kind: str, flights: Flights) -> Iterator[RestartComparison]:
    hit = flights.struck(level="instruction", own_lost=False)
    hit = hit.shared("stack", "world", arm=("restart_s",))
    watched = flights.chosen(level="instruction", as_paper=True, own_lost=False, bare_struck=True)
    with_detector = watched.chosen(detector=(None, *DETECTOR_TITLES)).by(*_PLACE)
    by_place = {place: mine.by("restart_s") for place, mine in hit.by(*_PLACE).items()}
    for stack, injector in sorted({(stack, injector) for stack, injector, _ in by_place}):
        for world in hit.worlds:
            if len(rules := by_place.get((stack, injector, world), {})) > 1:
                row = _restarts(stack, world, rules, flights.golden)
                those = with_detector.get((stack, injector, world))
                yield replace(
                    row,
                    place=Regime(stack, kind, injector).name,
                    watched={} if those is None else _watched(those),
                )


_PLACE = ("stack", "injector", "world")


def _watched(flights: Flights) -> dict[str, dict[str | None, Share]]:
    """Return `RestartComparison.watched` of the flights in a place, without and with detectors."""
    rules = {row["restart_s"] for row in flights.rows("restart_s", "detector") if row["detector"]}
    if len(rules) < 2:
        return {}
    shared = flights.chosen(restart_s=(*rules,)).shared(arm=("restart_s", "detector"))
    return {
        back(delay_s): {
            name: mine.chosen(detector=name).share(value=False) for name in (None, *DETECTOR_TITLES)
        }
        for (delay_s,), mine in sorted(shared.by("restart_s").items(), key=itemgetter(0))
    }


def _restarts(
    stack: str, world: str, rules: Mapping[tuple[float], Flights], golden: Flights
) -> RestartComparison:
    flown = {back(delay_s): mine for (delay_s,), mine in sorted(rules.items(), key=itemgetter(0))}
    lost = [dict(zip(mine.faults, mine["lost"], strict=True)) for mine in flown.values()]
    first, last = ([not those[fault] for fault in sorted(lost[0])] for those in (lost[0], lost[-1]))
    return RestartComparison(
        place=stack,
        world=world,
        paper=[
            printed("table4", "success_percent", kind, world)
            for kind in ("golden", "none", *DETECTOR_TITLES)
        ],
        golden=golden.chosen(stack=stack, world=world).share(value=False),
        success={rule: mine.share(value=False) for rule, mine in flown.items()},
        watched={},
        lost={
            rule: {fate: mine.of_fate(fate).share() for fate in (Fate.SILENT, Fate.DEAD)}
            for rule, mine in flown.items()
        },
        p_value=McNemar.of(first, last).p_value,
    )


# What faults cost a user's companion --------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class CompanionArm:
    """Flights of a user's companion with one kind of fault, without the gate or with it.

    Most of these flights are not repeatable, so arms are compared as independent samples.
    `means` and `differences` have the keys `flight_time_s` and `distance_m`.

    Attributes:
        companion: the companion's file, the autopilot if it is not mavfi's own, and the world.
        fault: the struck process, message or field, and what else differs from the defaults; empty
            for flights without a fault.
        gate: the gate's detector, model and threshold; empty without a gate.
        lost: share of lost flights: of all, of the silent faults (read, and no process ended), and
            of those that ended a process. Without a fault, it has only the share of all.
        golden: the companion's flights with neither a fault nor a gate; None if there are none, and
            for these flights themselves.
        means: mean over the successful flights, with its interval; flight time in s, distance in m.
        deviations: standard deviation of the same values; NaN if there are fewer than two.
        differences: mean minus that of `golden`, with Welch's interval; empty without `golden`.
        alarmed: share of flights in which the gate raised an alarm; None without a gate.
        hours: duration of all flights together.
        p_value: p-value of Fisher's exact test of all lost flights against those without a gate,
            corrected for the arms of the campaign by Holm's method; None without a gate or a
            fault, and if the fault was flown only with a gate.
    """

    companion: str
    fault: str
    gate: str
    lost: Mapping[Fate, Share]
    golden: CompanionArm | None
    means: Mapping[str, Interval]
    deviations: Mapping[str, float]
    differences: Mapping[str, Interval]
    alarmed: Share | None
    hours: float
    p_value: float | None = None


def companion_arms(flights: Flights) -> list[CompanionArm]:
    """Return the arms of a campaign's flights of users' companions, those without a fault first.

    Null faults, and faults that did not strike, are omitted.
    """
    mine = flights.chosen(injected=(Injected.GOLDEN.value, *STRUCK))
    mine = mine.where(name is not None for name in mine["companion"])
    by_arm = mine.grouped(map(_arm_key, mine["changes"]))
    goldens = {key: those for key, those in by_arm.items() if not (key.fault or key.gate)}
    found: dict[_ArmKey, CompanionArm] = {}
    for key in sorted(by_arm):  # golden flights come first
        own = key._replace(fault="", gate="")
        found[key] = _companion_arm(key, by_arm[key], goldens.get(own), found.get(own))
    tested = {
        key: plain.lost[Fate.ALL].fisher(arm.lost[Fate.ALL])
        for key, arm in found.items()
        if key.fault and key.gate and (plain := found.get(key._replace(gate="")))
    }
    corrected = dict(zip(tested, holm([*tested.values()]), strict=True))
    return [replace(arm, p_value=corrected.get(key)) for key, arm in found.items()]


class _ArmKey(NamedTuple):
    companion: str
    fault: str
    gate: str


def _arm_key(changes: str) -> _ArmKey:
    config = json.loads(changes)
    level = "fault" if config.get("fault") else "instruction"
    fault = config.get(level) or {}
    gate = config.get("detector") or {}
    autopilot = f" on {config['autopilot']}" if config.get("autopilot") else ""
    return _ArmKey(
        companion=f"{config['companion']}{autopilot}, {config.get('world', _WORLD)}",
        fault=", ".join(
            [str(fault.get("target") or "")]
            + [f"{name}={own}" for name, own in sorted(fault.items())
               if name not in _UNNAMED and own != USUAL[level].get(name)]
        ) if fault else "",
        gate=", ".join(str(gate[name]) for name in ("name", "model", "threshold")
                       if gate.get(name) is not None),
    )  # fmt: skip


_WORLD = MissionConfig().world
_UNNAMED = ("target", "seed", "invocation_seed")  # fields of a fault that tell no kinds apart


def _companion_arm(
    key: _ArmKey, flights: Flights, own: Flights | None, golden: CompanionArm | None
) -> CompanionArm:
    alarms = [bool(count) for count in flights["alarm_count"]]
    fates = {Fate.ALL: flights}
    if key.fault:
        fates[Fate.SILENT] = flights.chosen(ended=False, activation="read")
        fates[Fate.DEAD] = flights.chosen(ended=True)
    values = {name: flights.chosen(lost=False).known(name) for name in _COMPANION_MEASURES}
    return CompanionArm(
        **key._asdict(),
        lost={fate: those.share() for fate, those in fates.items()},
        golden=golden,
        means={name: interval(mine, resamples=TABLE_RESAMPLES) for name, mine in values.items()},
        deviations={
            name: stdev(mine.tolist()) if len(mine) > 1 else math.nan
            for name, mine in values.items()
        },
        differences={
            name: Interval.welch(own.chosen(lost=False).known(name), mine)
            for name, mine in values.items()
        } if own and golden else {},
        alarmed=wilson(sum(alarms), len(alarms)) if key.gate else None,
        hours=float(flights.known("flight_time_s").sum()) / 3600.0,
    )  # fmt: skip


_COMPANION_MEASURES = ("flight_time_s", "distance_m")
