"""The items of the paper: its figures and tables of experiments, with their numbers and missions.

paper.toml contains the items and all numbers that the paper prints. The missions of several items
are merged into one list without duplicates.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

from mavfi_cli.analysis.pairs import Flights
from mavfi_cli.campaigns.ledger import Ledger
from mavfi_cli.campaigns.missions import PlannedMission, canonical, changes_of
from mavfi_cli.campaigns.specification import Keep, Setting, Spec
from mavfi_cli.campaigns.specification_file import folder_name, load_spec
from mavfi_cli.core.config import read_toml
from mavfi_cli.core.errors import ConfigError, UnknownName
from mavfi_cli.report.paper import PaperColumn, PaperRow, PaperTable, Printed
from mavfi_cli.spec.mission import MissionConfig

_PAPER, _ = read_toml(Path(__file__).parent / "paper.toml")
_META = "reproduction"  # key of the ledger's `meta`
STACKS = ("mavbench", "mavbench-replica", "hardened")  # the paper's, rebuilt twice, and ours
WORLDS = {"fixed": "fixed worlds", "many": "another world for each seed"}  # kinds, as --worlds
OUT, KERNELS_FOLDER = Path("reproduction"), "kernels"
Key = str  # the configuration of a mission as text; equal missions have equal keys
_ROMAN = ("", "I", "II", "III", "IV", "V", "VI", "VII")


class Regime(NamedTuple):
    """The flights that are judged together: a stack in one kind of worlds under one rule.

    Attributes:
        worlds: kind of worlds, a key of WORLDS; empty if only one kind was flown.
        rule: injector and restart rule, a key of `Flights.by_rules`.
    """

    stack: str
    worlds: str = ""
    rule: str = ""

    @classmethod
    def of(cls, name: str) -> Regime:
        """Return the regime with a name such as `mavbench, fixed worlds, dead nodes never back`."""
        stack, *parts = name.split(_AND)
        worlds = next((kind for kind, words in WORLDS.items() if words in parts), "")
        rule = _AND.join(part for part in parts if part not in WORLDS.values())
        return cls(stack, worlds, rule)

    @staticmethod
    def split(stack: str, flights: Flights) -> dict[str, Flights]:
        """Split a stack's flights by rule, and by kind of worlds if both kinds were flown.

        The keys are names of regimes. The intervals of a table with both kinds of worlds would hold
        for neither. A rule other than the usual one is omitted if no fault was flown under it.
        """
        kinds = flights.by_worlds
        return {
            Regime(stack, kind, rule).name: mine
            for kind, those in (kinds if len(kinds) > 1 else {"": flights}).items()
            for rule, mine in those.by_rules.items()
        }

    @property
    def name(self) -> str:
        """The regime in words."""
        return _AND.join(filter(None, (self.stack, WORLDS.get(self.worlds), self.rule)))


_AND = ", "


class Source(Enum):
    """The source of the numbers in an item."""

    FLIGHTS = "flights"
    KERNELS = "kernels"  # runs of isolated kernels
    MODEL = "model"  # the performance model; no missions are flown


@dataclass(frozen=True, slots=True, kw_only=True)
class Item:
    """A figure or a table of the paper.

    Attributes:
        name: its name on the command line, such as `fig6`.
        labels, columns, notes: parts of its table; paper.toml explains them.
        origin: where the paper prints its numbers, and which results it only plots.
        preset: campaign that contains the item's missions; empty if its source is not FLIGHTS.
    """

    name: str
    title: str
    labels: tuple[str, ...]
    columns: tuple[PaperColumn, ...]
    notes: tuple[str, ...]
    origin: str
    preset: str
    source: Source

    @property
    def paper(self) -> str:
        """The paper's name for the item, such as `Fig. 6`."""
        return printed_name(self.name)

    def table(
        self, rows: Sequence[PaperRow], worlds: Sequence[str] = (), notes: Sequence[str] = ()
    ) -> PaperTable:
        """Return the item's table with the given rows and additional notes.

        Args:
            worlds: a column without a title is repeated for each world, with its name as title.
        """
        return PaperTable(
            name=self.name,
            title=f"{self.paper}: {self.title}",
            labels=self.labels,
            columns=tuple(
                column if column.title else replace(column, title=world)
                for column in self.columns
                for world in ([column.title] if column.title else worlds)
            ),
            rows=tuple(rows),
            notes=(*self.notes, *notes, self.origin),
        )


def printed_name(name: str) -> str:
    """Return the paper's name for a figure, table or section, such as `Fig. 6` for `fig6`."""
    kind, number = name.rstrip("0123456789"), int(name.lstrip("abcdefghijklmnopqrstuvwxyz"))
    return f"Fig. {number}" if kind == "fig" else f"{kind.capitalize()} {_ROMAN[number]}"


def printed(item: str, *keys: object) -> Printed:
    """Return the number or text that the paper prints, or None if it prints nothing there.

    Args:
        keys: keys of the nested tables of the item in paper.toml.
    """
    entry: Any = _PAPER.get(item, {})
    for key in keys:
        entry = entry.get(str(key)) if isinstance(entry, Mapping) else None
    if entry is None or isinstance(entry, str):
        return entry
    return float(entry)


def _item(name: str, entry: Mapping[str, Any]) -> Item:
    drawn = f"; {entry['unprinted']}: drawn only" if "unprinted" in entry else ""
    return Item(
        name=name,
        title=entry["title"],
        labels=tuple(entry["labels"]),
        columns=tuple(PaperColumn(**column) for column in entry["columns"]),
        notes=tuple(_PAPER["notes"].get(note, note) for note in entry["notes"]),
        origin=f"paper: {entry['source']}{drawn}",
        preset=entry.get("preset", ""),
        source=Source(entry.get("computed_from", "flights")),
    )


ITEMS = tuple(_item(name, entry) for name, entry in _PAPER.items() if "title" in entry)
BY_NAME = {item.name: item for item in ITEMS}
LEFT_OUT: Mapping[str, str] = _PAPER["left_out"]
"""Figures and tables of the paper that are not experiments, and why."""


def items_named(names: Sequence[str]) -> tuple[Item, ...]:
    """Return the named items in the order of ITEMS, or all items if no names are given.

    Raises:
        UnknownName: no item has this name. The message suggests the nearest name.
        ConfigError: the named figure or table is not an experiment. The message says what it is.
    """
    for name in names:
        if name in LEFT_OUT:
            raise ConfigError(f"is not an experiment: it {LEFT_OUT[name]}", key=name)
        if name not in BY_NAME:
            raise UnknownName("item", name, BY_NAME)
    return tuple(item for item in ITEMS if not names or item.name in names)


# Missions -----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightsPlan:
    """The flights that a set of the paper's items needs on one stack.

    Methods that take items apply to all items of the plan if none are given.

    Attributes:
        scale: fraction of the paper's number of missions.
        worlds: `fixed` for one world per environment, or `many` for one per seed.
        node_restart_s: after a fault in an instruction, time until a dead node is restarted, s.
        compat: injector whose operands and bits faults in instructions have; None for mavfi's.
        out: folder of all reproductions; each stack has its own folder in it.
    """

    items: Sequence[Item]
    stack: str
    scale: float = 1.0
    worlds: str = "fixed"
    node_restart_s: float = MissionConfig().node_restart_s
    compat: str | None = None
    out: Path = OUT

    @classmethod
    def stored(cls, ledger: Ledger) -> FlightsPlan | None:
        """Return the plan of a reproduction, as stored in its ledger, for all items.

        Return None for any other campaign.

        Raises:
            ConfigError: another version of mavfi stored the plan, or it is damaged.
        """
        text = ledger.meta(_META)
        if text is None:
            return None
        try:
            stored = {"worlds": "many", **json.loads(text)}  # older plans lack `worlds`
            plan = cls(items=ITEMS, out=ledger.folder.parent, **stored)
        except (TypeError, ValueError):
            problem = "holds the plan of another version of mavfi, or a damaged one"
            raise ConfigError(problem, path=ledger.folder) from None
        return replace(plan, items=plan.every)

    @property
    def rule(self) -> str:
        """Injector and restart rule, as a key of `Flights.by_rules`; empty for the usual ones."""
        return Flights.rule(self.compat, self.node_restart_s)

    @property
    def regime(self) -> Regime:
        """The regime of the plan's flights, without their kind of worlds."""
        return Regime(self.stack, rule=self.rule)

    @property
    def every(self) -> tuple[Item, ...]:
        """All items of the paper, or those with faults in instructions if the plan has a rule."""
        return tuple(item for item in ITEMS if not self.rule or self._strikes_instructions(item))

    def named(self, names: Sequence[str]) -> tuple[Item, ...]:
        """Return the named items in the order of ITEMS, or `every` item if no names are given.

        Raises:
            UnknownName: as `items_named`.
            ConfigError: as `items_named`, or a named item has no flights to which the plan's
                rule applies.
        """
        if not names:
            return self.every
        items = items_named(names)
        for item in items:
            if item not in self.every:
                known = ", ".join(own.name for own in self.every)
                raise ConfigError(
                    "has no faults in instructions, so --restart and --compat do not apply; choose "
                    f"from {known}", key=item.name,
                )  # fmt: skip
        return items

    @property
    def folder(self) -> Path:
        """The folder of the campaign with these flights."""
        return self.out / folder_name(self.stack)

    @property
    def meta(self) -> dict[str, str]:
        """The metadata that the campaign's ledger stores about the plan."""
        stored = {"stack": self.stack, "scale": self.scale, "worlds": self.worlds}
        stored |= self._rule  # an older plan lacks it, as one with the usual rule does
        return {"name": self.folder.name, _META: json.dumps(stored)}

    @property
    def command(self) -> str:
        """The command that flies all items on the plan's stack."""
        options = ("--stack", self.stack, "--scale", f"{self.scale:g}", "--worlds", self.worlds,
                   "--out", str(self.out))  # fmt: skip
        names = {"node_restart_s": "--restart", "compat": "--compat"}
        rule = [f"{names[name]}={value}" for name, value in self._rule.items()]
        return shlex.join(["mavfi", "reproduce", *options, *rule])

    def missions(self, *items: Item) -> list[PlannedMission]:
        """List the missions without duplicates, by repetition, so that all items grow together.

        Raises:
            ConfigError: the scale is not above 0, there are too many missions, or the stack cannot
                be used.
        """
        planned = [
            (mission.config.seed - spec.first_seed, mission)
            for spec in self._specs(items, self.scale)
            for mission in spec.missions()
        ]
        once: dict[Key, PlannedMission] = {}
        for _, mission in sorted(planned, key=itemgetter(0)):
            once.setdefault(key_of(mission), mission)
        return list(once.values())

    def kinds(self, *items: Item) -> list[PlannedMission]:
        """Return the first mission of each kind. Missions of one kind differ only in seeds."""
        return [mission for spec in self._specs(items, 1.0) for mission in spec.kinds()]

    def numbered(self, item: Item, first: int, end: int) -> list[tuple[PlannedMission, int]]:
        """Return an item's missions in repetitions `first` to `end` - 1, with their repetitions."""
        specs = (spec.scaled(end / spec.repetitions) for spec in self._specs([item], 1.0))
        missions = ((mission, mission.config.seed - spec.first_seed)
                    for spec in specs for mission in spec.missions())  # fmt: skip
        return [own for own in missions if own[1] >= first]

    def keys(self, *items: Item) -> list[Key]:
        """Return the missions' configurations as text, as the ledger stores them."""
        return [key_of(mission) for mission in self.missions(*items)]

    def numbers(self, ledger: Ledger, *items: Item) -> list[int]:
        """Return the numbers that a ledger gives the missions, in the order of its list."""
        return _numbers_of(ledger, self.keys(*items))

    def kept(self, ledger: Ledger) -> list[int]:
        """Return the numbers of the missions whose run folders must be kept for an item."""
        specs = (spec for spec in self._specs(self.every, self.scale) if spec.keep is Keep.ALL)
        return _numbers_of(
            ledger, (key_of(mission) for spec in specs for mission in spec.missions())
        )

    def _specs(self, items: Iterable[Item], scale: float) -> list[Spec]:
        """Return the distinct campaigns of the items, in the order of ITEMS."""
        wanted = set(items) or set(self.items)
        presets = dict.fromkeys(item.preset for item in ITEMS if item in wanted and item.preset)
        specs = [load_spec(preset).scaled(scale) for preset in presets]
        return [
            replace(
                spec if spec.fixed_world is None else spec.in_worlds(self.worlds),
                fixed={**spec.fixed, "stack": self.stack},
                settings=tuple(map(self._under_rule, spec.settings)),
            )
            for spec in specs
        ]

    @property
    def _rule(self) -> dict[str, Any]:
        """The factors of faults in instructions that are not the usual ones, with their values."""
        own = {"node_restart_s": self.node_restart_s, "compat": self.compat}
        usual = FlightsPlan(items=(), stack=self.stack)
        return {name: value for name, value in own.items() if value != getattr(usual, name)}

    def _under_rule(self, setting: Setting) -> Setting:
        if not _of_instructions(setting):
            return setting
        rule = {name: (value,) for name, value in self._rule.items()}
        return replace(setting, axes={**setting.axes, **rule})

    def _strikes_instructions(self, item: Item) -> bool:
        settings = (own for spec in self._specs([item], 1.0) for own in spec.settings)
        return bool(item.preset) and any(map(_of_instructions, settings))


def _of_instructions(setting: Setting) -> bool:
    return "instruction" in setting.axes.get("level", ())


def _numbers_of(ledger: Ledger, keys: Iterable[Key]) -> list[int]:
    wanted = frozenset(keys)
    return [number for number, _, _, changes in ledger.rows() if changes in wanted]


def key_of(mission: PlannedMission) -> Key:
    """Return a mission's configuration as text, as the ledger stores it."""
    return canonical(changes_of(mission.config))
