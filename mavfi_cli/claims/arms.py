"""What each arm of a campaign loses of the same faults: hardening, ablation.

An arm is a stack with or without a detector. Its faults are those that the arm without protection
has read, so all arms are counted on the same faults in the same scenes.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from mavfi_cli.campaigns.missions import canonical
from mavfi_cli.core.config import read_toml
from mavfi_cli.stats.paired import holm, mcnemar
from mavfi_cli.stats.shares import Share, wilson

Row = Mapping[str, Any]  # one flight
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
        flights: of `reproduction.flights.flown_missions`.
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
