"""Result of a campaign's mission, as the ledger keeps it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from mavfi_cli.campaign.missions import PlannedMission


class ResultState(Enum):
    """Whether a mission has a result."""

    FLOWN = "flown"  # it ended, well or badly: `outcome` says how
    ERROR = "error"  # it could not begin: no result, and counted nowhere


class Injected(Enum):
    """What happened to the fault of a flown mission."""

    GOLDEN = "golden"  # none was asked for
    ACTIVE = "active"  # it struck, and what it struck was read afterwards
    UNREAD = "unread"  # it struck, and nothing read it as long as it was followed
    CAUGHT = "caught"  # it struck, and a detector withheld it before anything read it
    NOT_ACTIVATED = "not_activated"  # it struck what nothing read before it was over
    NOT_INJECTED = "not_injected"  # the mission ended, or the run parted, before the trigger
    NULL = "null"  # everything but the flip, as was asked for


# Missions whose success the fault, if there was one, could affect.
COUNTED = frozenset(
    each.value for each in (Injected.GOLDEN, Injected.ACTIVE, Injected.UNREAD, Injected.CAUGHT)
)


@dataclass(frozen=True, slots=True, kw_only=True)
class MissionResult:
    """One row of the ledger.

    Attributes:
        number: the mission's place in the list.
        result: its result.json, the same as of `mavfi fly`; of a mission that crashed or hung
            before it could write one, what is known of it. Empty for an error.
        injected: what happened to its fault; None for an error.
        reason: the record's reason for the outcome, or why the mission could not begin.
        wall_s: wall time of the attempt that counts, s.
        attempts: number of attempts; more than one if something outside killed it.
        path: absolute path of the kept run folder; None if it was not kept.
    """

    number: int
    mission: PlannedMission
    state: ResultState
    outcome: str | None
    reason: str
    result: Mapping[str, Any]
    injected: Injected | None
    wall_s: float
    attempts: int
    path: Path | None


_BY_ACTIVATION = {
    "read": Injected.ACTIVE,
    "withheld": Injected.ACTIVE,
    "unchanged": Injected.NOT_ACTIVATED,
    "not_read": Injected.NOT_ACTIVATED,
    "not_injected": Injected.NOT_INJECTED,
    "overwritten": Injected.NOT_ACTIVATED,
    "ended_before_read": Injected.NOT_ACTIVATED,
    "not_read_in_window": Injected.UNREAD,
}


def injected_of(result: Mapping[str, Any], *, asked: bool) -> Injected:
    """Read from the record of the mission what happened to its fault.

    Args:
        result: result.json.
        asked: true if the mission was to have a fault.
    """
    fault = result.get("fault")
    if not asked:
        return Injected.GOLDEN
    if fault is None or fault["state"] in ("planned", "not_injected"):
        return Injected.NOT_INJECTED
    if fault["state"] == "null":
        return Injected.NULL
    activation = fault.get("activation") or {"activation": "read"}  # cut off: it may have been
    found = _BY_ACTIVATION.get(activation["activation"], Injected.ACTIVE)
    return Injected.CAUGHT if found is Injected.NOT_ACTIVATED and _caught(result) else found


def _caught(result: Mapping[str, Any]) -> bool:
    """True if an alarm withheld the struck value: at its stamp, or by the name of its state."""
    strikes = result["fault"].get("strikes") or []
    stamps = {strike["stamp_s"] for strike in strikes}
    states = {change["state"] for strike in strikes for change in strike["changes"]}
    alarms = (result.get("detection") or {}).get("alarms", [])
    return any(
        alarm["response"] != "accept"
        and (
            alarm["stamp_s"] in stamps
            or (alarm["stamp_s"] >= min(stamps) and not states.isdisjoint(alarm["states"]))
        )
        for alarm in (alarms if stamps else [])
    )
