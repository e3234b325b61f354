"""What a reproduction flies: the missions of its items as one list, each once."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from pathlib import Path

from mavfi_cli.campaigns.ledger import Ledger
from mavfi_cli.campaigns.missions import PlannedMission, canonical, changes_of
from mavfi_cli.campaigns.specification import Keep, Spec
from mavfi_cli.campaigns.specification_file import folder_name, load_spec
from mavfi_cli.reproduction.items import ITEMS, Item

Key = str  # the configuration of a mission as text; equal missions have equal keys
OUT, KERNELS_FOLDER = Path("reproduction"), "kernels"
_META = "reproduction"  # key of the ledger's `meta`


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightsPlan:
    """The flights of items on one stack.

    Attributes:
        scale: fraction of the paper's number of missions.
        out: folder of all reproductions; each stack has its own folder in it.
    """

    items: Sequence[Item]
    stack: str
    scale: float = 1.0
    out: Path = OUT

    @property
    def folder(self) -> Path:
        """The folder of the flights."""
        return self.out / folder_name(self.stack)

    @property
    def meta(self) -> dict[str, str]:
        """What the ledger of the flights stores of the plan."""
        asked = {"stack": self.stack, "scale": self.scale}
        return {"name": self.folder.name, _META: json.dumps(asked)}

    @property
    def command(self) -> str:
        """The command that flies the plan's stack for all items."""
        return f"mavfi reproduce --stack {self.stack} --scale {self.scale:g} --out {self.out}"

    def keys(self, *items: Item) -> list[Key]:
        """The missions of items of the plan, without any of all of them."""
        return [key_of(each) for each in missions_of(items or self.items, self.stack, self.scale)]


def stored_plan(ledger: Ledger) -> FlightsPlan | None:
    """The plan with which a reproduction was begun, for all items; None of another campaign."""
    text = ledger.meta(_META)
    if text is None:
        return None
    return FlightsPlan(items=ITEMS, out=ledger.folder.parent, **json.loads(text))


def missions_of(items: Iterable[Item], stack: str, scale: float = 1.0) -> list[PlannedMission]:
    """The missions of items, each once, repetition by repetition, so that all items grow together.

    Raises:
        ConfigError: the scale leaves nothing, or the stack cannot be used.
    """
    planned = [
        (mission.config.seed - spec.first_seed, mission)
        for spec in _specs(items, stack, scale)
        for mission in spec.missions()
    ]
    once: dict[Key, PlannedMission] = {}
    for _, mission in sorted(planned, key=itemgetter(0)):
        once.setdefault(key_of(mission), mission)
    return list(once.values())


def kinds_of(items: Iterable[Item], stack: str) -> list[PlannedMission]:
    """The first mission of each kind; the others differ in seeds."""
    return [mission for spec in _specs(items, stack, 1.0) for mission in spec.kinds()]


def kept_keys(items: Iterable[Item], stack: str, scale: float = 1.0) -> frozenset[Key]:
    """The missions whose run folders an item needs."""
    return frozenset(
        key_of(mission)
        for spec in _specs(items, stack, scale)
        if spec.keep is Keep.ALL
        for mission in spec.missions()
    )


def numbers_of(ledger: Ledger, keys: Iterable[Key]) -> list[int]:
    """The numbers of missions in a ledger, in the order of its list."""
    wanted = frozenset(keys)
    return [number for number, _, _, changes in ledger.rows() if changes in wanted]


def key_of(mission: PlannedMission) -> Key:
    """The configuration of a mission, as the ledger stores it."""
    return canonical(changes_of(mission.config))


def _specs(items: Iterable[Item], stack: str, scale: float) -> list[Spec]:
    """The campaigns of items on a stack, each once, in the order of ITEMS."""
    asked = set(items)
    presets = dict.fromkeys(item.preset for item in ITEMS if item in asked and item.preset)
    specs = (load_spec(preset).scaled(scale) for preset in presets)
    return [replace(spec, fixed={**spec.fixed, "stack": stack}) for spec in specs]
