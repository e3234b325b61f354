"""Judges the end of a mission's process: a result, an error, or an attempt that does not count."""

from __future__ import annotations

import json
import shutil
import signal
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mavfi_cli.campaign.outcome import ResultState
from mavfi_cli.campaign.workers.base import AttemptEnd
from mavfi_cli.core.errors import Interrupted, MavfiError, RecordError
from mavfi_cli.core.fork_server import ERRORS, SCRATCH
from mavfi_cli.core.types import Outcome
from mavfi_cli.mission.record.run_folder import RunFolder

FULL_BYTES = 16 << 20  # with less free space a disk counts as full
# A fault can make a process kill itself by other signals than these; these come from outside.
_FROM_OUTSIDE = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT)
_OUTSIDE_WORDS = tuple(f"killed by {number.name}" for number in _FROM_OUTSIDE)
# Errors that the machine may have caused, so that another attempt may succeed.
_BY_CHANCE = ("VehicleProcessError", "LinkLost", "NoAutopilot", "TargetError")
# Errors that every other mission would have too.
_OF_THE_MACHINE = ("RecordError", "TracingForbidden", "BuildMismatch")


class CampaignStopped(MavfiError):
    """The machine has a problem that does not concern one mission only."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """The judgement of an attempt.

    Attributes:
        state: state of the mission; None if something outside ended the attempt.
        result: the mission's record; empty if there is none.
        reason: the reason in words.
        run: its run folder; None if there is none.
        doubtful: true if there is a record, but something outside may have affected it.
    """

    state: ResultState | None
    result: Mapping[str, Any]
    reason: str
    run: Path | None = None
    doubtful: bool = False


def judge(ended: AttemptEnd, out: Path, config: Mapping[str, Any], limit_s: float) -> Verdict:
    """Judge the end of an attempt.

    Args:
        ended: how it ended.
        out: the attempt's own folder.
        config: configuration of the mission, as in records.
        limit_s: its limit of wall time, s.

    Raises:
        CampaignStopped: the machine keeps missions from being flown, for example by a full disk.
    """
    report = ended.report or {}
    if ended.exit == 0 and "folder" in report:
        return _recorded(out / report["folder"], config)
    _require_space(out)
    if "error" in report:
        return _refused(report["error"], report["text"])
    if ended.timeout:
        reason = f"no end within {limit_s:g} s of wall time"
        return _cut_off(Outcome.HANG, reason, out, config)
    if ended.signal is None and ended.exit is None:
        return Verdict(state=None, result={}, reason=ended.lost)
    if ended.signal is not None:
        name = signal.Signals(ended.signal).name
        if ended.signal in _FROM_OUTSIDE:
            return Verdict(state=None, result={}, reason=f"killed by {name}")
        return _cut_off(Outcome.CRASH, f"the companion was killed by {name}", out, config)
    if "traceback" in report:  # our own defect; the ledger shows where
        return Verdict(state=ResultState.ERROR, result={}, reason=report["traceback"].rstrip())
    return _cut_off(Outcome.CRASH, f"the companion ended with code {ended.exit}", out, config)


def _require_space(out: Path) -> None:
    if shutil.disk_usage(out if out.is_dir() else out.parent).free < FULL_BYTES:
        raise CampaignStopped(f"{out.parent}: the disk is full; run again when there is room")


def _recorded(run: Path, config: Mapping[str, Any]) -> Verdict:
    """Judge a mission that wrote its record."""
    try:
        result = json.loads((run / "result.json").read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise RecordError(f"{run}: {error}") from None
    outcome, reason = result["outcome"], result["reason"]
    if outcome == Outcome.INTERRUPTED.value:
        return Verdict(state=None, result={}, reason="interrupted")
    crashes = [
        crash["how"] for node in result.get("nodes", {}).values() for crash in node["crashes"]
    ]
    if config.get("link") is None:  # no fault of the companion can kill the simulated vehicle
        if outcome == Outcome.LINK_LOST.value and reason.endswith(_OUTSIDE_WORDS):
            return Verdict(state=None, result={}, reason=reason)
        if result.get("referee", {}) is None:
            reason = "the vehicle died before it had saved the truth"
            return Verdict(state=None, result={}, reason=reason)
    doubts = [how for how in crashes if how.endswith(_OUTSIDE_WORDS)]
    return Verdict(
        state=ResultState.FLOWN, result=result, reason=reason, run=run, doubtful=bool(doubts)
    )


def _refused(kind: str, text: str) -> Verdict:
    """Judge a mission that could not begin or could not write its record."""
    if kind in _OF_THE_MACHINE:
        raise CampaignStopped(text)
    if kind == Interrupted.__name__:
        return Verdict(state=None, result={}, reason="interrupted")
    if kind in _BY_CHANCE and text.endswith(_OUTSIDE_WORDS):
        return Verdict(state=None, result={}, reason=text)
    return Verdict(state=ResultState.ERROR, result={}, reason=text, doubtful=kind in _BY_CHANCE)


def _cut_off(outcome: Outcome, reason: str, out: Path, config: Mapping[str, Any]) -> Verdict:
    """Judge a mission whose process ended before it wrote its record, by what is known of it."""
    runs = [path for path in out.glob("[!.]*/") if path.name != SCRATCH]
    run = runs[0] if len(runs) == 1 else None
    fault = None
    if run is not None and (written := RunFolder(run).fault).is_file():
        fault = json.loads(written.read_text(encoding="utf-8"))
    if run is not None and (errors := out / ERRORS).is_file() and errors.stat().st_size:
        errors.replace(run / ERRORS)
    asked = config.get("fault") or config.get("instruction")
    result = {
        "schema": 1,
        "outcome": outcome.value,
        "reason": reason,
        "config": config,
        "seeds": {"root": config["seed"], "fault": asked["seed"] if asked else None},
        "quality_of_flight": {},
        "fault": fault,
    }
    return Verdict(state=ResultState.FLOWN, result=result, reason=reason, run=run)
