"""The whole report as plain values; `mavfi_cli.report.page` makes the page of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from mavfi_cli.analysis.kernel_runs import silent_of_all
from mavfi_cli.campaigns.specification_file import to_toml
from mavfi_cli.claims.arms import arms
from mavfi_cli.claims.beyond import (
    BIT_CLASSES,
    Fate,
    StateCell,
    hourly_failures,
    kernel_flows,
    state_map,
)
from mavfi_cli.claims.catalogue import CLAIMS, Claim
from mavfi_cli.claims.effects import Finding, Protected, lost_share, struck, worst_flights
from mavfi_cli.claims.findings import Kernels, instruction_faults
from mavfi_cli.claims.flights import FlownMission, GoldenFlights, comparable, where
from mavfi_cli.claims.sources import STACKS, CampaignSource, Evidence
from mavfi_cli.core.installed import __version__
from mavfi_cli.report.tables.paper_table import count_of
from mavfi_cli.reproduction.items import ITEMS, LEFT_OUT, printed_name
from mavfi_cli.stats.effects import ClaimVerdict, judge
from mavfi_cli.stats.shares import wilson

_DETECTORS = (None, "gad", "aad")
_LONGEST = 5  # flights of a campaign that are listed although they succeed
_ISOLATED = "isolated kernels"


def document(
    evidence: Evidence, items: Iterable[Any], upsets_per_hour: float = 1.0
) -> dict[str, Any]:
    """All parts of the report.

    Args:
        items: the paper's tables and figures, as `claims.items.shown_items`.
        upsets_per_hour: bit flips that reach the injection sites in an hour of flight.
    """
    flights = {
        stack: [each for each in evidence.missions(stack) if each.as_paper] for stack in STACKS
    }
    kernels = _kernels(evidence)
    silent = {name: silent_of_all(each) for name, each in kernels.items()}
    claims = [_judged(claim, flights, kernels) for claim in CLAIMS]
    maps = {stack: state_map(flights[stack]) for stack in STACKS}
    return {
        "version": __version__,
        "stacks": STACKS,
        "summary": _summary(evidence, flights, kernels, claims),
        "problems": evidence.problems,
        "claims": claims,
        "verdicts": {where: _counted(claims, where) for where in (*STACKS, _ISOLATED)},
        "worst": [row for stack in STACKS for row in _worst(stack, flights[stack])],
        "spreads": [row for stack in STACKS for row in _spreads(stack, flights[stack])],
        "flows": {stack: kernel_flows(flights[stack], silent) for stack in STACKS},
        "fates": [*Fate],
        "maps": [part for stack in STACKS for part in _matrices(stack, maps[stack])],
        "map_rows": [row for stack in STACKS for row in _map_rows(stack, maps[stack])],
        "item_titles": {item.name: f"{item.paper}: {item.title}" for item in ITEMS},
        "items": _items(items),
        "left_out": {printed_name(name): why for name, why in LEFT_OUT.items()},
        "detectors": ("", "gad", "aad"),
        "upsets_per_hour": upsets_per_hour,
        "hourly": {stack: hourly_failures(flights[stack], upsets_per_hour) for stack in STACKS},
        "arms": [
            {"campaign": each.name, "arms": found}
            for each in evidence.campaigns
            if (found := arms(comparable(each.flights)))
        ],
        "sources": [*map(_source, evidence.campaigns)],
        "kernel_sources": [
            {"path": each.path, "summary": each.summary} for each in evidence.kernels
        ],
        "missions": [_worth_a_look(each) for each in evidence.campaigns if each.flights],
    }


def _items(shown: Iterable[Any]) -> list[dict[str, Any]]:
    """The paper's tables and figures, each on all stacks."""
    found: dict[str, dict[str, Any]] = {}
    for each in shown:
        told = found.setdefault(each.item.name, {"item": each.item, "shown": [], "missing": []})
        if each.table is None:
            told["missing"].append(each.stack)
        else:
            told["shown"].append(each)
    return [*found.values()]


def _kernels(evidence: Evidence) -> Kernels:
    return {
        each["kernel"]: each for source in evidence.kernels for each in source.summary["kernels"]
    }


# Claims -------------------------------------------------------------------------------------------


def _judged(
    claim: Claim, flights: Mapping[str, Sequence[FlownMission]], kernels: Kernels
) -> dict[str, Any]:
    if claim.isolated:
        found = {_ISOLATED: claim.find(kernels)}
    else:
        found = {stack: claim.find(those) for stack, those in flights.items()}
    told = {name: getattr(claim, name) for name in claim.__slots__ if name != "find"}
    return {**told, "cells": {name: _cell(claim, each) for name, each in found.items()}}


def _cell(claim: Claim, found: Finding) -> dict[str, Any]:
    verdict = judge(found.effect, claim.low, claim.high)
    if verdict is ClaimVerdict.NOT_FLOWN and found.told:
        verdict = ClaimVerdict.NOT_JUDGED
    return {
        "verdict": verdict,
        "effect": found.effect,
        "told": found.told,
    }


def _counted(claims: Sequence[Mapping[str, Any]], where: str) -> dict[ClaimVerdict, int]:
    found = Counter(each["cells"][where]["verdict"] for each in claims if where in each["cells"])
    return {verdict: found[verdict] for verdict in ClaimVerdict}


# Five sentences -----------------------------------------------------------------------------------


def _summary(
    evidence: Evidence,
    flights: Mapping[str, Sequence[FlownMission]],
    kernels: Kernels,
    claims: Sequence[Mapping[str, Any]],
) -> list[str]:
    missions = len(evidence.missions())
    runs = sum(each["runs"] for each in kernels.values())
    attacked = f" and {runs:,} runs of isolated kernels" if runs else ""
    return [
        f"This page judges {len(claims)} claims of the paper by {missions:,} missions{attacked}.",
        _verdict_sentence(claims),
        _cost_sentence(flights),
        _saved_sentence(flights),
        _crash_sentence(flights),
    ]


def _verdict_sentence(claims: Sequence[Mapping[str, Any]]) -> str:
    parts = []
    for name in (*STACKS, _ISOLATED):
        found = _counted(claims, name)
        known = sum(found[each] for each, _ in _VERDICTS)
        if known:
            place = f"about {name}" if name == _ISOLATED else f"flown on {name}"
            verdicts = [f"{_are(found[each])} {told}" for each, told in _VERDICTS if found[each]]
            claims_told = f"of {known} claim{'s'[known == 1 :]} {place}"
            parts.append(f"{claims_told}, {_listed_in_words(verdicts)}")
    if not parts:
        return "None of the claims has been flown yet."
    return _sentence(parts)


_VERDICTS = (
    (ClaimVerdict.REPRODUCED, "reproduced"),
    (ClaimVerdict.NOT_REPRODUCED, "not"),
    (ClaimVerdict.OPEN, "not distinguishable at this n"),
)


def _are(number: int) -> str:
    return f"{number} {'is' if number == 1 else 'are'}"


def _listed_in_words(parts: Sequence[str]) -> str:
    *first, last = parts
    return f"{', '.join(first)} and {last}" if first else last


def _cost_sentence(flights: Mapping[str, Sequence[FlownMission]]) -> str:
    parts = []
    for stack, those in flights.items():
        faulty = instruction_faults(those) or struck(where(those, level="source"))
        kind = "an instruction" if instruction_faults(those) else "a state"
        golden = GoldenFlights(those)
        faulty = golden.paired(faulty)
        if faulty:
            parts.append(
                f"on {stack}, a bit flip in {kind} loses {_rate(lost_share(faulty))} of the "
                "missions whose golden flight succeeds"
            )
    if not parts:
        return "No flight with a fault has a golden flight beside it, so the cost is not known."
    return _sentence(parts)


def _saved_sentence(flights: Mapping[str, Sequence[FlownMission]]) -> str:
    parts = []
    for stack, those in flights.items():
        for level, kind in (("instruction", "an instruction"), ("source", "a state")):
            saved = []
            for detector, name in (("gad", "the Gaussian detector"), ("aad", "the autoencoder")):
                pairs = Protected.of(those, detector).pairs
                lost = [each for own, each in pairs if own.lost and own.level == level]
                share = wilson(sum(not each.lost for each in lost), len(lost))
                saved += [f"{name} saves {_rate(share)}"] if lost else []
            if saved:
                place = f"on {stack}, of the missions that a fault in {kind} loses"
                parts.append(f"{place}, {_listed_in_words(saved)}")
    if not parts:
        return "No mission that a fault loses was flown again with a detector."
    return _sentence(parts)


def _crash_sentence(flights: Mapping[str, Sequence[FlownMission]]) -> str:
    lost = [each for those in flights.values() for each in instruction_faults(those) if each.lost]
    if not lost:
        return "No fault in an instruction has lost a mission."
    ended = wilson(sum(bool(each.node_ended) for each in lost), len(lost))
    if ended.count == ended.total:
        return (
            f"All {ended.total:,} missions that a fault in an instruction loses follow a node that "
            "crashed or hung, and none follows silent corruption."
        )
    return (
        f"Of the {ended.total:,} missions that a fault in an instruction loses, {_rate(ended)} "
        "follow a node that crashed or hung; the others follow silent corruption."
    )


def _sentence(parts: Sequence[str]) -> str:
    text = "; ".join(parts) + "."
    return text[0].upper() + text[1:]


def _rate(share: Any) -> str:
    ends = f"{100 * share.low:.0f} to {100 * share.high:.0f}"
    return f"{100 * share.share:.0f} % ({count_of(share)}; 95 % interval {ends} %)"


# Worst cases and spreads --------------------------------------------------------------------------


def _worst(stack: str, flights: Sequence[FlownMission]) -> list[dict[str, Any]]:
    rows = []
    golden = GoldenFlights(flights)
    faulty = where(comparable(flights), struck=True)
    kinds = sorted({(str(each.level), each.world, str(each.platform)) for each in faulty})
    for level, world, platform in kinds:
        for detector in _DETECTORS:
            those = where(faulty, level=level, world=world, platform=platform, detector=detector)
            if golden.ratios(those):
                rows.append(
                    {"stack": stack, "level": level, "world": world, "platform": platform,
                     "detector": detector, "longest": worst_flights(golden, those)}
                )  # fmt: skip
    return rows


def _spreads(stack: str, flights: Sequence[FlownMission]) -> list[dict[str, Any]]:
    """Every flight with a fault in a state over its own golden one, by world and detector."""
    golden = GoldenFlights(flights)
    found: dict[tuple[str, str | None], list[FlownMission]] = {}
    for each in where(comparable(flights), level="source", platform="x86", struck=True):
        found.setdefault((each.world, each.detector), []).append(each)
    return [
        {"stack": stack, "world": world, "detector": detector, "ratios": golden.ratios(those)}
        for (world, detector), those in sorted(found.items(), key=str)
        if golden.ratios(those)
    ]


# Where a bit hurts --------------------------------------------------------------------------------


def _matrices(stack: str, cells: Sequence[StateCell]) -> list[dict[str, Any]]:
    """A matrix a phase and a kind of state: states as rows, classes of bits as columns."""
    found = []
    for phase in sorted({each.phase for each in cells}):
        here = [each for each in cells if each.phase == phase]
        for columns in BIT_CLASSES:
            those = [each for each in here if each.bits in columns]
            used = [bits for bits in columns if any(each.bits == bits for each in those)]
            by_place = {(each.state, each.bits): each for each in those}
            if those:
                rows = [
                    {"state": state, "cells": [by_place.get((state, bits)) for bits in used]}
                    for state in dict.fromkeys(each.state for each in those)
                ]
                found.append({"stack": stack, "phase": phase, "columns": used, "rows": rows})
    return found


def _map_rows(stack: str, cells: Sequence[StateCell]) -> list[dict[str, Any]]:
    return [
        {"stack": stack, "state": each.state, "bits": each.bits, "phase": each.phase,
         "faults": each.harmed.total, "harmful": each.harmed.count, "lost": each.lost.count}
        for each in cells
    ]  # fmt: skip


# Where it comes from ------------------------------------------------------------------------------


def _source(source: CampaignSource) -> dict[str, Any]:
    spec = source.spec
    seeds = sorted({each.seed for each in source.flights})
    return {
        "name": source.name,
        "path": source.path,
        "about": spec.about if spec else "",
        "toml": to_toml(spec) if spec else "",
        "planned": source.planned,
        "flown": len(source.flights),
        "errors": source.errors,
        "stacks": sorted({each.stack for each in source.flights}),
        "seeds": (seeds[0], seeds[-1]) if seeds else None,
        "root": spec.seed if spec else None,
        "versions": source.versions,
        "host": {name: source.host.get(name) for name in ("machine", "cores", "started")},
        "digest": source.digest,
    }


def _worth_a_look(source: CampaignSource) -> dict[str, Any]:
    """The lost missions of a campaign, and the longest of the others."""
    golden = GoldenFlights(source.flights)
    lost = [each for each in source.flights if each.lost]
    longer = sorted(
        (each for each in source.flights if not each.golden and golden.ratio(each)),
        key=lambda each: -(golden.ratio(each) or 0.0),
    )[:_LONGEST]
    return {
        "name": source.name,
        "lost": [_listed(each, golden) for each in lost],
        "longest": [_listed(each, golden) for each in longer],
    }


def _listed(flight: FlownMission, golden: GoldenFlights) -> dict[str, Any]:
    """One line of the list; the command repeats the flight."""
    struck_state = f"{flight.fault_target}, {flight.fault_field or 'any'}"
    what = "golden" if flight.golden else struck_state
    kept = flight.path is not None and Path(flight.path).is_dir()
    place = flight.path if kept else f"{flight.source} --mission {flight.number}"
    return {
        "number": flight.number,
        "what": " + ".join(filter(None, (what, flight.detector))),
        "world": flight.world,
        "seed": flight.seed,
        "stack": flight.stack,
        "outcome": flight.outcome,
        "reason": flight.reason,
        "flight_time_s": flight.flight_time_s,
        "ratio": golden.ratio(flight),
        "command": f"mavfi replay {place}",
    }
