"""Flies the missions that items need into one folder for each stack, and tells the cost before."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from mavfi_cli.campaigns.begin import check_kinds
from mavfi_cli.campaigns.ledger import LEDGER, RUNS, Ledger
from mavfi_cli.campaigns.progress import Spectator
from mavfi_cli.campaigns.run import Options, fly_missing, require_unchanged, store_plan
from mavfi_cli.campaigns.specification_file import folder_name
from mavfi_cli.core.errors import ConfigError
from mavfi_cli.reproduction.items import ITEMS, Item
from mavfi_cli.reproduction.missions import (
    kept_keys,
    key_of,
    kinds_of,
    missions_of,
    numbers_of,
)

OUT, KERNELS_FOLDER = Path("reproduction"), "kernels"
_META = "reproduction"  # key of the ledger's `meta`
_MEASURED = 12  # missions that are flown before the forecast
_RUN_BYTES = 2_000_000  # of a kept run folder, until one is there


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


@dataclass(frozen=True, slots=True, kw_only=True)
class Forecast:
    """What is left to fly, and what it takes on this machine.

    Attributes:
        missions, over: missions of the items; those of them that are over.
        seconds: wall time of the rest.
        disk_bytes: space for the rest.
        measured: number of missions that the forecast is from.
        jobs: missions or runs at the same time.
        runs: runs of isolated kernels that are missing.
    """

    missions: int = 0
    over: int = 0
    seconds: float = 0.0
    disk_bytes: float = 0.0
    measured: int = 0
    jobs: int = 1
    runs: int = 0


def fly_items(
    plan: FlightsPlan,
    options: Options,
    spectator: Spectator,
    on_forecast: Callable[[Forecast], None],
) -> None:
    """Fly the missions of the items that the folder lacks.

    Args:
        on_forecast: hears what is left before it is flown, after a few missions are measured.

    Raises:
        ConfigError: the folder holds another stack, more missions, or another campaign.
        MavfiError: as `run_campaign`.
    """
    with _opened(plan) as ledger:
        keys = [key_of(each) for each in missions_of(plan.items, plan.stack, plan.scale)]
        wanted = frozenset(numbers_of(ledger, keys))
        kept = frozenset(numbers_of(ledger, kept_keys(ITEMS, plan.stack, plan.scale)))
        options = replace(options, only=wanted, kept=kept)
        missing = _missing(ledger, wanted)
        if len(wanted) - len(missing) < _MEASURED and len(missing) > _MEASURED:
            spectator.on_note(f"measuring {_MEASURED} missions")
            fly_missing(ledger, replace(options, only=_spread(missing, ledger)), Spectator())
            missing = _missing(ledger, wanted)
        on_forecast(_forecast(ledger, wanted, missing, options))
        fly_missing(ledger, options, spectator)


def stored_plan(ledger: Ledger) -> FlightsPlan | None:
    """The plan with which a reproduction was begun, for all items; None of another campaign."""
    text = ledger.meta(_META)
    if text is None:
        return None
    stored = json.loads(text)
    return FlightsPlan(
        items=ITEMS, stack=stored["stack"], scale=stored["scale"], out=ledger.folder.parent
    )


def _opened(plan: FlightsPlan) -> Ledger:
    """The ledger of the plan's stack with the list of all items at the plan's scale."""
    if (plan.folder / LEDGER).is_file():
        with Ledger(plan.folder) as ledger:
            _require_same(plan, stored_plan(ledger))
    else:
        check_kinds(kinds_of(ITEMS, plan.stack))
    ledger = Ledger(plan.folder, writing=True)
    try:
        require_unchanged(ledger)
        asked = {"stack": plan.stack, "scale": plan.scale}
        ledger.set_meta({"name": plan.folder.name, _META: json.dumps(asked)})
        store_plan(ledger, missions_of(ITEMS, plan.stack, plan.scale), append=True)
    except BaseException:
        ledger.close()
        raise
    return ledger


def _require_same(plan: FlightsPlan, stored: FlightsPlan | None) -> None:
    """Refuse a folder that cannot grow to the plan."""
    if stored is None:
        raise ConfigError(
            "holds a campaign that is no reproduction; another --out starts anew", path=plan.folder
        )
    if stored.stack != plan.stack:
        raise ConfigError(
            f"flies the stack {stored.stack}, not {plan.stack}; another --out starts anew",
            path=plan.folder,
        )
    if plan.scale < stored.scale:
        raise ConfigError(
            f"was begun at --scale {stored.scale:g}, which cannot shrink to {plan.scale:g}; "
            "another --out starts anew",
            path=plan.folder,
        )


def _missing(ledger: Ledger, wanted: frozenset[int]) -> list[int]:
    return [number for number, _, _ in ledger.missing() if number in wanted]


def _spread(missing: Sequence[int], ledger: Ledger) -> frozenset[int]:
    """Missions of as many settings as possible: of the first repetition, evenly."""
    first = missing[: len(ledger.cells())]
    step = max(1, len(first) // _MEASURED)
    return frozenset(first[::step][:_MEASURED])


def _forecast(
    ledger: Ledger, wanted: frozenset[int], missing: Sequence[int], options: Options
) -> Forecast:
    over = sorted(wanted - set(missing))
    flown = list(ledger.results(over[-2000:]))
    jobs = options.jobs or len(os.sched_getaffinity(0))
    each_s = sum(each.wall_s for each in flown) / len(flown) if flown else 0.0
    losses = sum(each.outcome != "success" for each in flown) / len(flown) if flown else 0.0
    kept = sum(number in options.kept for number in missing)
    rows = sum(path.stat().st_size for path in ledger.folder.glob(f"{LEDGER}*"))
    runs = [each for each in (ledger.folder / RUNS).glob("*") if each.is_dir()]
    run_bytes = _size(runs[-20:]) / len(runs[-20:]) if runs else _RUN_BYTES
    return Forecast(
        missions=len(wanted),
        over=len(over),
        seconds=len(missing) * each_s / jobs,
        disk_bytes=len(missing) * rows / max(1, ledger.over())
        + (kept + losses * len(missing)) * run_bytes,
        measured=len(flown),
        jobs=jobs,
    )


def _size(folders: Sequence[Path]) -> int:
    return sum(
        path.stat().st_size for each in folders for path in each.rglob("*") if path.is_file()
    )
