"""The missions of all items as one list, in which missions that items share stand once."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from operator import itemgetter

from mavfi_cli.campaigns.ledger import Ledger
from mavfi_cli.campaigns.missions import PlannedMission, canonical, changes_of
from mavfi_cli.campaigns.specification import Keep, Spec
from mavfi_cli.campaigns.specification_file import load_spec
from mavfi_cli.reproduction.items import ITEMS, Item

Key = str  # the configuration of a mission as text; equal missions have equal keys


def spec_of(item: Item, stack: str, scale: float = 1.0) -> Spec:
    """The campaign of an item on a stack, at a fraction of the paper's size.

    Raises:
        ConfigError: the scale leaves nothing.
    """
    spec = load_spec(item.preset).scaled(scale)
    return replace(spec, fixed={**spec.fixed, "stack": stack})


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
    """The campaigns of items, each once, in the order of ITEMS."""
    asked = set(items)
    first: dict[str, Item] = {}
    for item in ITEMS:
        if item in asked and item.preset:
            first.setdefault(item.preset, item)
    return [spec_of(item, stack, scale) for item in first.values()]
