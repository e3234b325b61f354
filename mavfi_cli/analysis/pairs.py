"""Flown missions as one table, each matched with its golden and its unprotected flight.

Items and claims select rows of this table and count the values in its columns.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from enum import Enum
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from mavfi_cli.analysis import flights as tables
from mavfi_cli.analysis.flights import BITS, COSTS, BoolArray, IntArray
from mavfi_cli.campaigns.ledger import STRATUM
from mavfi_cli.campaigns.missions import Injected, canonical
from mavfi_cli.core.errors import ConfigError
from mavfi_cli.core.types import FloatArray, Outcome, Stage
from mavfi_cli.spec.detector import PAPER
from mavfi_cli.spec.fault import FaultConfig, InstructionConfig
from mavfi_cli.spec.mission import LIMITS, MissionConfig
from mavfi_cli.stats.paired import OWN, McNemar, WorstCase
from mavfi_cli.stats.shares import Share, design_effect, wilson

STAGES = tuple(stage.value for stage in Stage)
WORLDS = ("factory", "farm", "sparse", "dense")  # in the paper's order
PERCENT = 100.0
EVERY_STAGE = "+".join(STAGES)
LONGER = 1.10  # a flight is longer if its time is above this multiple of its golden flight's
_COLUMNS: Mapping[str, pa.DataType] = {
    **dict.fromkeys(
        ("number", "seed", "world_seed", "fault_seed", "fault_bits", "alarm_count"), pa.int64()
    ),
    **dict.fromkeys((
        "pair", "world", "planner", "platform", "stack", "level", "fault_target", "fault_field",
        "detector", "protect", "state", "outcome", "injected", "activation",
        "strike_phase", "struck_state", "struck_kernel", "node_ended", "path",
        "changes",
    ), pa.string()),
    "struck_bits": BITS,
    **dict.fromkeys((
        "flight_time_s", "distance_m", "min_clearance_m", "goal_distance_m", "energy_regression_j",
        "energy_propeller_j", "replans", "response_median_s", "response_p95_s", *COSTS,
    ), pa.float64()),
    "counted": pa.bool_(),
}  # fmt: skip
_MOST_NAMED = 8  # worlds that a line lists, and rules that are judged
STRUCK = (
    Injected.ACTIVE.value, Injected.UNREAD.value, Injected.CAUGHT.value,
    Injected.NOT_ACTIVATED.value,
)  # fmt: skip
"""The fates of faults that struck, as in the column `injected`."""
_FAULTS = ("fault", "instruction")
# A mission is one of the paper's if it differs from the defaults only in these, and its fault only
# in _DRAWN. Unless its fault strikes a state, the restart delay may differ, too.
_PAPER = {*_FAULTS, "detector", "isolate", "stack", "world", "seed", "world_seed", "planner",
          "platform", "time_limit_s"}  # fmt: skip
_DRAWN = {"target", "seed", "field", "bits", "together", "at", "compat"}
USUAL: Mapping[str, Any] = json.loads(canonical({
    "fault": asdict(FaultConfig(target="")), "instruction": asdict(InstructionConfig(target="")),
}))  # fmt: skip
"""The default fields of a fault in a state and of one in an instruction."""
_RESTART = "node_restart_s"
_NO_FAULT = canonical([None] * len(_FAULTS))
_NO, _YES = pa.scalar(False), pa.scalar(True)  # noqa: FBT003


class Fate(Enum):
    """A class of faults, by their effect on the node that they strike."""

    ALL = "all faults"
    SILENT = "silent"  # the node continues, with or without a wrong value
    DEAD = "dead node"  # it crashes or hangs


@dataclass(frozen=True, slots=True, kw_only=True)
class Balance:
    """How many missions a detector saves from harm, and how many it harms, for the same faults.

    Attributes:
        pairs: number of faults that were flown both without and with the detector.
        before: number of missions that are harmed without the detector.
        undone: number of missions that are harmed only without the detector.
        caused: number of missions that are harmed only with the detector.
        p_value: p-value of McNemar's exact test.
    """

    pairs: int
    before: int
    undone: int
    caused: int
    p_value: float


@dataclass(frozen=True, slots=True)
class Flights:
    """A table of flown missions, one per row, each compared with its golden flight.

    The paper's items and claims and the comparison of platforms select rows and count values. A
    column that an export lacks is filled with nulls. Columns in addition to those of
    `analysis.flights`:
        fault: the configured fault as text; equal faults have equal texts.
        together: whether the fault strikes all components of a group at once.
        at: the trigger of a source-level fault; null without such a fault.
        as_paper: whether vehicle, speed, sensors, the single flip of random bits and the 13 watched
            states are those of the paper. Stack, detector model and `at` may differ. Unless a
            fault strikes a state, `restart_s` and `injector` may differ, too.
        struck: whether the fault flipped a bit, read or not, as in the paper's counts.
        killed: whether the fault ended a process, which is no flip of a bit.
        lost: whether the mission did not end in success.
        ended: whether a node crashed or hung.
        restart_s: time after which a dead node is restarted; the default without a fault.
        injector: the copied injector of a fault in an instruction, or an empty string.
        companion: the file of a user's companion; null for mavfi's companion. Most flights of
            users' companions are not repeatable, so none is paired with a golden flight.
        mission: the mission's fields as text, without the restart delay if there is no fault; equal
            missions have equal texts.
    Columns about the golden flight of the same mission:
        own_lost: whether the golden flight is lost; null without a golden flight.
        own_flight_time_s: golden flight time.
        over_own: flight time / golden flight time; null if either flight is lost.
        added_s: flight time - golden flight time; null if either flight is lost.
        harmed: whether the flight is lost, or takes more than LONGER times as long as the golden
            flight; null unless the golden flight succeeds.
    Columns about the flight with the same fault and no detector, null without such a flight:
    bare_struck, bare_ended, bare_lost, bare_over_own, bare_harmed.
    """

    table: pa.Table

    @classmethod
    def of(cls, table: pa.Table) -> Flights:
        """Create the object from a table of `analysis.flights.flights` or an exported campaign.

        Missions that could not begin are omitted.

        Raises:
            ConfigError: the flights are a stratified sample, whose missions have unequal weights.
        """
        there = set(table.column_names)
        if STRATUM in there and table[STRATUM].null_count < table.num_rows:
            raise ConfigError(
                "the paper's tables and claims cannot be computed from a stratified sample, "
                "because they count all missions equally, but its missions have weights; "
                "use `mavfi campaign status --full`"
            )
        return cls(_beside_golden(_flown(pa.table({
            name: table[name].cast(kind) if name in there else pa.nulls(table.num_rows, kind)
            for name, kind in _COLUMNS.items()
        }))))  # fmt: skip

    @classmethod
    def pooled(cls, several: Iterable[Flights], stack: str | None = None) -> Flights:
        """Merge several tables, keeping only the first of several missions with equal settings.

        Args:
            stack: keep only the flights of this stack; None keeps all.
        """
        own = [flights.table.select(_NOTHING_FLOWN.column_names) for flights in several]
        whole = cls(pa.concat_tables([_NOTHING_FLOWN, *own]).combine_chunks())
        whole = whole if stack is None else whole.chosen(stack=stack)
        first: dict[str, int] = {}
        for place, mission in enumerate(whole["mission"]):
            first.setdefault(mission, place)
        return cls(_beside_golden(whole.table.take(pa.array(first.values(), pa.int64()))))

    def without(self, left_out: Iterable[bool]) -> Flights:
        """Return the table without the flights for which `left_out`, of shape (n,), is true.

        The remaining flights are matched again with golden and unprotected flights among them.
        """
        kept = pa.array([not own for own in left_out], pa.bool_())
        return Flights(_beside_golden(self.table.select(_NOTHING_FLOWN.column_names).filter(kept)))

    def beside_base(
        self, pairs: Sequence[str], arms: Sequence[str | None], golden: Sequence[int]
    ) -> Flights:
        """Return the flights with protections as arms beside the flights without a protection.

        An arm stands in the column `detector`, and watches all stages, so `balance` compares it as
        it compares a detector.

        Args:
            pairs: a text for each flight, equal for flights that differ only in fault and arm.
            arms: the arm of each flight, or None if it is unprotected.
            golden: the index of each flight's golden flight, or -1 without one.
        """
        table = self.table.select(_NOTHING_FLOWN.column_names)
        everywhere = [name and EVERY_STAGE for name in arms]
        for column, values in (("pair", pairs), ("detector", arms), ("protect", everywhere)):
            place = table.column_names.index(column)
            table = table.set_column(place, column, pa.array(values, pa.string()))
        return Flights(_beside_golden(table, np.array(golden, dtype=np.int64)))

    def __len__(self) -> int:
        return int(self.table.num_rows)

    def __getitem__(self, name: str) -> list[Any]:
        """Return the values of a column as a list, with None for nulls."""
        return list(self.table[name].to_pylist())

    def rows(self, *names: str) -> list[dict[str, Any]]:
        """Return one dictionary per flight, with these columns, or all if none are given."""
        return list((self.table.select(names) if names else self.table).to_pylist())

    def numbers(self, name: str) -> FloatArray:
        """Return a column as an array of floats of shape (n,), with NaN for nulls."""
        return tables.numbers(self.table, name)

    def known(self, *names: str) -> FloatArray:
        """Return the sum of the columns for each flight that has values in all of them."""
        return tables.known(np.sum([self.numbers(name) for name in names], axis=0))

    def flags(self, name: str) -> BoolArray:
        """Return a column as a boolean array of shape (n,), with False for nulls."""
        return tables.flags(self.table, name)

    # Rows

    def where(self, chosen: Iterable[bool]) -> Flights:
        """Return the flights for which `chosen`, of shape (n,), is true."""
        return Flights(self.table.filter(pa.array(chosen, pa.bool_())))

    def chosen(self, **values: Any) -> Flights:
        """Return the flights whose columns have the given values.

        None matches a null, and a tuple matches any of its items.
        """
        return Flights(tables.chosen(self.table, **values))

    def faulty(self, detector: str | None = None, **values: object) -> Flights:
        """Return the flights that have a fault and run this detector.

        Args:
            detector: name of the detector; None selects flights without a detector.
            values: further conditions on columns, as in `chosen`.
        """
        struck = Flights(self.table.filter(pc.is_valid(self.table["level"])))
        return struck.chosen(detector=detector, **values)

    def struck(self, **values: object) -> Flights:
        """Return the flights without a detector whose fault flipped a bit.

        `values` are further conditions on columns, as in `chosen`. They may replace the condition
        on `detector`.
        """
        return self.chosen(**{"struck": True, "detector": None, **values})

    def protected(self, detector: str, protect: str = EVERY_STAGE, **values: object) -> Flights:
        """Return the flights with this detector whose fault struck, if the golden flight succeeds.

        Whether the fault struck is taken from the flight with the same fault and no detector.

        Args:
            protect: stages that the detector watches, joined by `+`.
            values: further conditions on columns, as in `chosen`. They may replace that on
                `bare_struck`.
        """
        seen = {"detector": detector, "protect": protect, "own_lost": False, "bare_struck": True}
        return self.chosen(**{**seen, **values})

    def of_fate(self, fate: Fate) -> Flights:
        """Return the flights without a fault, and those whose fault has this fate.

        The fate of a fault is that in its flight without a detector. A fault that was not flown
        without a detector has no fate, so it belongs only to ALL.
        """
        if fate is Fate.ALL:
            return self
        bare = pc.is_null(self.table["detector"])
        ended = pc.if_else(bare, self.table["ended"], self.table["bare_ended"])
        same = pc.fill_null(pc.equal(ended, fate is Fate.DEAD), _NO)
        return Flights(self.table.filter(pc.or_(pc.is_null(self.table["level"]), same)))

    @property
    def population(self) -> str:
        """A sentence that says for which worlds the intervals of these flights hold."""
        return self.population_of(zip(self["world"], self["world_seed"], strict=True))

    @staticmethod
    def population_of(worlds: Iterable[tuple[str, int | None]]) -> str:
        """Return a sentence that says for which worlds intervals hold.

        Args:
            worlds: the world of each flight and its seed, which is None if every seed has another
                world.
        """
        places = [*worlds]
        named = sorted({place for place in places if place[1] is not None})
        each = ", ".join(f"{world} {seed}" for world, seed in named)
        fixed = each if len(named) <= _MOST_NAMED else f"{len(named)} of them"
        many = sum(seed is None for _, seed in places)
        if not fixed:
            return "worlds: another one for each seed; intervals hold for such worlds"
        if not many:
            return f"worlds: fixed ({fixed}); intervals hold for these worlds only"
        return (
            f"worlds: fixed ({fixed}) in {len(places) - many:,} flights, another one for each seed "
            f"in {many:,}; intervals hold for neither kind alone"
        )

    @property
    def by_worlds(self) -> dict[str, Flights]:
        """The flights in `fixed` worlds, and those in `many` worlds, another one for each seed.

        A kind without flights is omitted. Flights outside the paper's environments, such as those
        that train detectors, belong to both kinds.
        """
        fixed = pc.is_valid(self.table["world_seed"])
        ours = pc.is_in(self.table["world"], pa.array(WORLDS))
        kinds = {"fixed": fixed, "many": pc.invert(fixed)}
        return {
            name: Flights(self.table.filter(pc.or_(kind, pc.invert(ours))))
            for name, kind in kinds.items()
            if pc.any(pc.and_(kind, ours)).as_py()
        }

    @staticmethod
    def rule(injector: str | None, restart_s: float) -> str:
        """Return an injector and a restart rule as a key of `by_rules`.

        Args:
            injector: the copied injector; None or an empty string for mavfi's own.
            restart_s: time after which a dead node is restarted, s.
        """
        usual = restart_s == MissionConfig().node_restart_s
        return ", ".join(filter(None, (injector, "" if usual else f"dead nodes {back(restart_s)}")))

    @property
    def by_rules(self) -> dict[str, Flights]:
        """The flights by injector and restart rule of their faults in instructions.

        The first key is an empty string: mavfi's own injector, and dead nodes that come back after
        1 s. All other faults belong to it, and flights without a fault to every rule. Of the other
        rules, only the _MOST_NAMED with the most faults are kept.
        """
        levels = zip(self["level"], self["injector"], self["restart_s"], strict=True)
        rules = [
            level and (self.rule(*how) if level == "instruction" else "") for level, *how in levels
        ]
        counts = Counter(rule for rule in sorted(filter(None, rules)))
        names = ["", *sorted(name for name, _ in counts.most_common(_MOST_NAMED))]
        return {name: self.where(rule in (None, name) for rule in rules) for name in names}

    @property
    def seeds(self) -> list[tuple[str, int]]:
        """The world and the seed of each flight. Flights that share both are not independent."""
        return list(zip(self["world"], self["seed"], strict=True))

    def balance(
        self, detector: str, protect: str = EVERY_STAGE, column: str = "harmed", **values: object
    ) -> Balance:
        """Count the missions that a detector saves from harm, and those that it harms.

        Only faults that were flown both without and with the detector count.

        Args:
            protect: stages that the detector watches, joined by `+`.
            column: the kind of harm, `harmed` or `lost`.
            values: further conditions on columns, as in `chosen`.
        """
        seen = self.protected(detector, protect, **values)
        pairs = zip(seen[f"bare_{column}"], seen[column], strict=True)
        known = [(a, b) for a, b in pairs if a is not None and b is not None]
        test = McNemar.of([a for a, _ in known], [b for _, b in known])
        return Balance(
            pairs=test.pairs,
            before=test.both + test.only_first,
            undone=test.only_first,
            caused=test.only_second,
            p_value=test.p_value,
        )

    @property
    def golden(self) -> Flights:
        """The flights with neither a fault nor a detector."""
        return self.chosen(level=None, detector=None)

    @property
    def timed(self) -> Flights:
        """The flights with a fault that succeed and whose golden flights succeed too."""
        faulty, known = (pc.is_valid(self.table[name]) for name in ("level", "over_own"))
        return Flights(self.table.filter(pc.and_(faulty, known)))

    @property
    def comparable(self) -> Flights:
        """The flights without a detector, or with one that watches all stages."""
        return self.chosen(protect=(None, EVERY_STAGE))

    def shared(self, *names: str, arm: Sequence[str] = ("detector",)) -> Flights:
        """Return the flights without a fault, and those whose fault was flown in every arm.

        The arms are the values of columns, such as the detectors.

        Args:
            names: columns that split the flights into groups. Each group has its own arms, and a
                fault is kept if it was flown in every arm of one of the groups.
            arm: columns whose values are the arms; a null, such as no detector, is an arm too.
        """
        arms = self.where(level is not None for level in self["level"]).by(*names, *arm)
        groups: dict[tuple[Any, ...], list[set[tuple[str, str]]]] = {}
        for key, flights in arms.items():
            groups.setdefault(key[: len(names)], []).append(set(flights.faults))
        shared = {fault for group in groups.values() for fault in set.intersection(*group)}
        faults = zip(self["level"], self.faults, strict=True)
        return self.where(level is None or fault in shared for level, fault in faults)

    def by(self, *names: str) -> dict[tuple[Any, ...], Flights]:
        """Group the flights by the values of these columns.

        The result is keyed by tuples of values, in the order in which they first occur.
        """
        return self.grouped(zip(*map(self.__getitem__, names), strict=True))

    def grouped(self, keys: Iterable[Any]) -> dict[Any, Flights]:
        """Group the flights by `keys`, which has one key per flight.

        The result is keyed in the order in which the keys first occur.
        """
        places: dict[Any, list[int]] = {}
        for place, key in enumerate(keys):
            places.setdefault(key, []).append(place)
        return {key: Flights(self.table.take(pa.array(rows))) for key, rows in places.items()}

    # Numbers

    def share(self, column: str = "lost", *, value: bool = True, clustered: bool = False) -> Share:
        """Return the share of flights whose `column` is `value`, among those where it is not null.

        Args:
            clustered: whether the interval is widened by the design effect of flights that share a
                seed.
        """
        there = Flights(self.table.filter(pc.is_valid(self.table[column])))
        hits = [cell is value for cell in there[column]]
        clusters = [(world, (world, seed)) for world, seed in there.seeds]
        effect = design_effect(hits, clusters) if clustered else 1.0
        return wilson(sum(hits), len(hits), design_effect=effect)

    @property
    def ratios(self) -> FloatArray:
        """The ratio of each flight's time to that of its golden flight, where both succeed."""
        return self.known("over_own")

    @property
    def increases(self) -> FloatArray:
        """The increase of flight time over the golden flight, in per cent, where both succeed."""
        return PERCENT * (self.ratios - 1.0)

    @property
    def worst(self) -> WorstCase:
        """The largest ratio of flight time to golden flight time, with and without the detector.

        The flights without the detector are those with the same faults. No others count, because a
        maximum grows with the number of flights.
        """
        return WorstCase.of(OWN, self.known("bare_over_own").tolist(), self.ratios.tolist())

    @property
    def faults(self) -> list[tuple[str, str]]:
        """The pair and the fault of each flight. Flights with equal entries differ in detector."""
        return list(zip(self["pair"], self["fault"], strict=True))

    @property
    def worlds(self) -> list[str]:
        """The names of the worlds in which these flights took place, the paper's first."""
        flown = set(self["world"])
        return [*(world for world in WORLDS if world in flown), *sorted(flown - set(WORLDS))]


def back(restart_s: float) -> str:
    """Return a restart rule in words, such as `back after 1 s`."""
    never = restart_s >= LIMITS[_RESTART][1]
    return "never back" if never else f"back after {restart_s:g} s"


def _flown(table: pa.Table) -> pa.Table:
    table = tables.flown(table)
    configs = [_checked(json.loads(changes)) for changes in table["changes"].to_pylist()]
    flips = pc.is_in(table["injected"], pa.array(STRUCK))
    kills = pc.fill_null(pc.starts_with(table["fault_target"], "process."), _NO)
    lost = pc.fill_null(pc.not_equal(table["outcome"], Outcome.SUCCESS.value), _YES)
    faults = (canonical([config.get(name) for name in _FAULTS]) for config in configs)
    at = ((config.get("fault") or {}).get("at") for config in configs)
    together = (bool((config.get("fault") or {}).get("together")) for config in configs)
    return _with_columns(
        table,
        fault=pa.array(faults, pa.string()),
        together=pa.array(together, pa.bool_()),
        at=pa.array(at, pa.string()),
        as_paper=pa.array(map(_as_paper, configs), pa.bool_()),
        struck=pc.and_not(flips, kills),
        killed=pc.and_(flips, kills),
        lost=lost,
        ended=pc.is_valid(table["node_ended"]),
        restart_s=pa.array(map(_restart_s, configs), pa.float64()),
        injector=pa.array(map(_injector, configs), pa.string()),
        companion=pa.array((config.get("companion") for config in configs), pa.string()),
        mission=pa.array(
            [
                changes if _faulty(config) or _RESTART not in config
                else canonical({name: config[name] for name in config if name != _RESTART})
                for changes, config in zip(table["changes"].to_pylist(), configs, strict=True)
            ],
            pa.string(),
        ),
    )  # fmt: skip


def _checked(config: Any) -> Mapping[str, Any]:
    """Return a mission's fields if those that this module reads have values that it can use.

    Raises:
        ValueError: a fault or a detector is no table, an injector's name has other characters than
            letters, digits, `_`, `.` and `-`, or a restart delay is not a number in its limits.
    """
    parts = [config.get(name) for name in (*_FAULTS, "detector")]
    if not all(part is None or isinstance(part, dict) for part in parts):
        raise ValueError("a fault or a detector is no table")
    if not re.fullmatch(r"[\w.-]{0,40}", _injector(config), re.ASCII):
        raise ValueError("the name of an injector is not allowed")
    least, most = LIMITS[_RESTART]
    if not least <= float(config.get(_RESTART, least)) <= most:
        raise ValueError("a restart delay is outside its limits")
    return dict(config)


def _faulty(config: Mapping[str, Any]) -> bool:
    return any(config.get(name) is not None for name in _FAULTS)


def _restart_s(config: Mapping[str, Any]) -> float:
    usual_s = MissionConfig().node_restart_s
    return float(config.get(_RESTART, usual_s)) if _faulty(config) else usual_s


def _injector(config: Mapping[str, Any]) -> str:
    return (config.get("instruction") or {}).get("compat") or ""


def _with_columns(table: pa.Table, **columns: Any) -> pa.Table:
    for name, column in columns.items():
        table = table.append_column(name, column)
    return table


def _as_paper(config: Mapping[str, Any]) -> bool:
    watch = (config.get("detector") or {}).get("watch", PAPER)
    changed = {
        name
        for level in _FAULTS
        for name, value in (config.get(level) or {}).items()
        if value != USUAL[level].get(name)
    }
    known = _PAPER if config.get("fault") else _PAPER | {_RESTART}
    return config.keys() <= known and changed <= _DRAWN and watch == PAPER


def _beside_golden(table: pa.Table, golden: IntArray | None = None) -> pa.Table:
    """Add the columns that compare each flight with its golden and its unprotected flight.

    The class `Flights` describes these columns.

    Args:
        golden: the index of each flight's golden flight, of shape (n,), or -1 without one; None for
            that of the same pair.
    """
    unprotected = pc.and_(pc.is_null(table["detector"]), pc.is_null(table["companion"]))
    if golden is None:
        unharmed = pc.and_(unprotected, pc.equal(table["fault"], _NO_FAULT))
        golden = partners(table, table, ("pair",), only=unharmed)
    own = _places(golden)
    fault = ("pair", "fault", "restart_s")
    bare = _places(partners(table, table, fault, only=unprotected))
    own_lost, own_time = (table[name].take(own) for name in ("lost", "flight_time_s"))
    over_own, harmed = against_golden(own_lost, own_time, table["lost"], table["flight_time_s"])
    longer = pc.subtract(table["flight_time_s"], own_time)
    added = pc.if_else(pc.is_valid(over_own), longer, pa.scalar(None, longer.type))
    table = _with_columns(
        table,
        own_lost=own_lost,
        own_flight_time_s=own_time,
        over_own=over_own,
        added_s=added,
        harmed=harmed,
    )
    names = ("struck", "ended", "lost", "over_own", "harmed")
    return _with_columns(table, **{f"bare_{name}": table[name].take(bare) for name in names})


_NOTHING_FLOWN = _flown(pa.table({name: pa.nulls(0, kind) for name, kind in _COLUMNS.items()}))


def against_golden(
    own_lost: pa.ChunkedArray, own_time_s: pa.ChunkedArray, lost: pa.ChunkedArray,
    time_s: pa.ChunkedArray,
) -> tuple[pa.ChunkedArray, pa.ChunkedArray]:  # fmt: skip
    """Return the ratio of each flight's time to its golden flight's, and whether it is harmed.

    All columns have the shape (n,). Those of the golden flights may have nulls.

    Args:
        own_lost, own_time_s: whether the golden flight is lost, and its flight time.
        lost, time_s: whether the flight itself is lost, and its flight time.

    Returns:
        The column of flight time / golden flight time, null if either flight is lost. And the
        column that tells whether the flight is harmed, which means that it is lost or that its
        ratio is above LONGER; null unless the golden flight succeeds.
    """
    succeeds = pc.equal(own_lost, _NO)
    ratio = pc.divide(time_s, own_time_s)
    over_own = pc.if_else(pc.and_not(succeeds, lost), ratio, pa.scalar(None, ratio.type))
    harmed = pc.or_(lost, pc.fill_null(pc.greater(over_own, LONGER), _NO))
    return over_own, pc.if_else(succeeds, harmed, pa.scalar(None, pa.bool_()))


# Pairing ------------------------------------------------------------------------------------------


def partners(
    rows: pa.Table,
    others: pa.Table,
    on: Sequence[str],
    *,
    only: pa.ChunkedArray | BoolArray | None = None,
    repeats: bool = False,
) -> IntArray:
    """For each row, return the index of the first row of `others` with equal values in `on`.

    That row of `others` is called the partner. Nulls are equal to each other.

    Args:
        rows, others: tables with n and m rows; may be the same table.
        on: columns of both tables, of equal types.
        only: whether each row of `others` may be a partner, of shape (m,); None allows all.
        repeats: match the second of several equal rows with the second equal partner, and so on.
            Otherwise all of them have the same partner.

    Returns:
        The index in `others` of each row's partner, of shape (n,), or -1 for a row without one.
    """
    allowed = np.arange(others.num_rows)
    if only is not None:
        allowed = np.flatnonzero(np.asarray(only, dtype=bool))
    both = pa.concat_tables(
        [rows.select(on), others.select(on).take(allowed)], promote_options="permissive"
    )
    key = np.zeros(both.num_rows, dtype=np.int64)
    for name in on:
        column = both[name].combine_chunks().dictionary_encode(null_encoding="encode")
        value = column.indices.to_numpy().astype(np.int64)
        key = np.unique(key * both.num_rows + value, return_inverse=True)[1]
    here, there = key[: rows.num_rows], key[rows.num_rows :]
    if repeats:
        here, there = (own * both.num_rows + _repeat(own) for own in (here, there))
    known, first = np.unique(there, return_index=True)
    if not len(known):
        return np.full(rows.num_rows, -1)
    place = np.searchsorted(known, here).clip(max=len(known) - 1)
    return np.where(known[place] == here, allowed[first[place]], -1)


def paired(rows: pa.Table, others: pa.Table, on: Sequence[str]) -> tuple[pa.Table, pa.Table]:
    """Return the rows that have a partner in `others`, and these partners in the same order.

    `partners` defines the partner of a row by the columns `on`.
    """
    places = partners(rows, others, on)
    return rows.filter(places >= 0), others.take(places[places >= 0])


def _repeat(keys: IntArray) -> IntArray:
    """Return, for each of the n keys, how many earlier keys equal it."""
    order = np.argsort(keys, kind="stable")
    _, begins, counts = np.unique(keys[order], return_index=True, return_counts=True)
    earlier = np.empty(len(keys), dtype=np.int64)
    earlier[order] = np.arange(len(keys)) - np.repeat(begins, counts)
    return earlier


def _places(partner: IntArray) -> pa.Array:
    """Convert indices of partners for pyarrow's `take`, which gives a null for each -1."""
    return pa.array(partner, mask=partner < 0)
