"""The whole report as plain values; `mavfi_cli.report.page` makes the page of them."""

from __future__ import annotations

import json
import shlex
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavfi_cli.analysis.pairs import LONGER, Balance, Fate, Flights
from mavfi_cli.campaigns.missions import changes_of, kind_of
from mavfi_cli.core.installed import __version__
from mavfi_cli.paper.beyond import (
    BIT_CLASSES,
    FATES,
    arms,
    hourly_failures,
    kernel_flows,
    state_map,
)
from mavfi_cli.paper.claims import ISOLATED, JudgedClaim, judged
from mavfi_cli.paper.figures import OVER_GOLDEN, draw, panel
from mavfi_cli.paper.items import BY_NAME, ITEMS, LEFT_OUT, FlightsPlan, Item, Source, printed_name
from mavfi_cli.paper.layouts import of_flights
from mavfi_cli.paper.sources import STACKS, CampaignSource, Evidence
from mavfi_cli.paper.status import of_kernels, of_model
from mavfi_cli.paper.verdicts import Verdict
from mavfi_cli.report.paper import DETECTOR_TITLES, PaperTable, draw_strips
from mavfi_cli.stats.paired import excess_over_mean
from mavfi_cli.stats.shares import Share, wilson

if TYPE_CHECKING:
    pass

_DETECTORS = {None: "no detector"} | DETECTOR_TITLES
_LONGEST = 5  # flights of a campaign that are listed although they succeed
_Cells = Mapping[tuple[str, str, str], Mapping[str, Share]]  # by state, class of bits and phase


def document(evidence: Evidence, upsets_per_hour: float = 1.0) -> dict[str, Any]:
    """All parts of the report.

    Args:
        upsets_per_hour: bit flips that reach the injection sites in an hour of flight.
    """
    flown = {stack: evidence.flights(stack) for stack in STACKS}
    as_paper = {stack: those.chosen(as_paper=True) for stack, those in flown.items()}
    flights = {stack: those.chosen(at=(None, "random")) for stack, those in as_paper.items()}
    kernels = evidence.isolated
    sdc = {name: each["outcomes"]["sdc"] for name, each in kernels.items()}
    silent = {name: (each["count"], each["of"]) for name, each in sdc.items()}
    claims = judged(flights, kernels)
    maps = {stack: state_map(as_paper[stack]) for stack in STACKS}
    return {
        "version": __version__,
        "stacks": STACKS,
        "extent": _extent(flights, kernels, claims),
        "summary": _summary(flights, claims),
        "problems": evidence.problems,
        "claims": claims,
        "verdicts": {where: _counted(claims, where) for where in _PLACES},
        "worst": [row for stack in STACKS for row in _worst_flights(stack, flights[stack])],
        "balances": [row for stack in STACKS for row in _balances(stack, flights[stack])],
        "spreads": {stack: _spread(flights[stack]) for stack in STACKS},
        "flows": {stack: kernel_flows(flights[stack], silent) for stack in STACKS},
        "fates": FATES,
        "maps": [part for stack in STACKS for part in _matrices(stack, maps[stack])],
        "map_rows": [row for stack in STACKS for row in _map_rows(stack, maps[stack])],
        "item_titles": {
            name: f"{printed_name(name)}: {BY_NAME[name].title}"
            if name in BY_NAME
            else printed_name(name)
            for name in dict.fromkeys(each.claim.item for each in claims)
        },
        "items": [*_shown_items(evidence, flown)],
        "left_out": {printed_name(name): why for name, why in LEFT_OUT.items()},
        "detectors": ("", *DETECTOR_TITLES),
        "upsets_per_hour": upsets_per_hour,
        "hourly": {s: [*hourly_failures(flights[s], upsets_per_hour)] for s in STACKS},
        "arms": [
            {"campaign": each.name, "arms": found}
            for each in evidence.campaigns
            if (found := arms(each.flights.comparable))
        ],
        "sources": evidence.campaigns,
        "kernel_sources": evidence.kernels,
        "missions": [_worth_a_look(each) for each in evidence.campaigns if len(each.flights)],
    }


# Claims -------------------------------------------------------------------------------------------


def _counted(claims: Sequence[JudgedClaim], where: str) -> dict[Verdict, int]:
    counts = Counter(claim.verdict(where) for claim in claims)
    return {verdict: counts[verdict] for verdict in Verdict}


# Five sentences -----------------------------------------------------------------------------------


def _extent(
    flights: Mapping[str, Flights], kernels: Mapping[str, Any], claims: Sequence[JudgedClaim]
) -> str:
    """What the page judges, and by how much."""
    missions = sum(len(those) for those in flights.values())
    runs = sum(each["runs"] for each in kernels.values())
    attacked = f" and {runs:,} runs of isolated kernels" if runs else ""
    decided = sum(
        any(claim.verdict(where) not in (None, Verdict.NOT_DECIDABLE) for where in _PLACES)
        for claim in claims
    )
    return f"{decided} of {len(claims)} claims are judged by {missions:,} missions{attacked}."


def _summary(flights: Mapping[str, Flights], claims: Sequence[JudgedClaim]) -> list[str]:
    return [
        _verdict_sentence(claims),
        _cost_sentence(flights),
        _saved_sentence(flights, "instruction", "an instruction"),
        _saved_sentence(flights, "source", "a state"),
        _crash_sentence(flights),
    ]


def _verdict_sentence(claims: Sequence[JudgedClaim]) -> str:
    parts = []
    for name in _PLACES:
        found = _counted(claims, name)
        known = sum(found[each] for each, _ in _VERDICTS)
        if known:
            place = f"about {name}" if name == ISOLATED else f"flown on {name}"
            verdicts = [f"{_are(found[each])} {told}" for each, told in _VERDICTS if found[each]]
            claims_told = f"of {known} claim{'s'[known == 1 :]} {place}"
            parts.append(f"{claims_told}, {_listed_in_words(verdicts)}")
    if not parts:
        return "None of the claims has been flown yet."
    return _sentence(parts)


_PLACES = (*STACKS, ISOLATED)
_VERDICTS = (
    (Verdict.REPRODUCED, "reproduced"),
    (Verdict.CONTRADICTED, "contradicted"),
    (Verdict.UNDECIDED, "undecided"),
)


def _are(number: int) -> str:
    return f"{number} {'is' if number == 1 else 'are'}"


def _listed_in_words(parts: Sequence[str]) -> str:
    *first, last = parts
    return f"{', '.join(first)} and {last}" if first else last


def _cost_sentence(flights: Mapping[str, Flights]) -> str:
    parts = []
    for stack, those in flights.items():
        instructions = _instruction_faults(those)
        kind = "an instruction" if len(instructions) else "a state"
        hit = instructions if len(instructions) else those.struck(level="source")
        hit = hit.chosen(own_lost=False)
        if len(hit):
            parts.append(
                f"on {stack}, a bit flip in {kind} loses {_rate(hit.share())} of the "
                "missions whose golden flight succeeds"
            )
    if not parts:
        return "No flight with a fault has a golden flight beside it, so the cost is not known."
    return _sentence(parts)


def _instruction_faults(flights: Flights) -> Flights:
    return flights.struck(level="instruction", platform="x86")


def _saved_sentence(flights: Mapping[str, Flights], level: str, kind: str) -> str:
    """What the detectors save of faults of one level, on the first stack flown with one."""
    for stack, those in flights.items():
        saved = []
        for detector, name in (("gad", "the Gaussian detector"), ("aad", "the autoencoder")):
            found = those.protected(detector, level=level, bare_lost=True).share(value=False)
            saved += [f"{name} saves {_rate(found)}"] if found.total else []
        if saved:
            place = f"On {stack}, of the missions that a fault in {kind} loses"
            return f"{place}, {_listed_in_words(saved)}."
    return f"No mission that a fault in {kind} loses was flown again with a detector."


def _crash_sentence(flights: Mapping[str, Flights]) -> str:
    lost = [_instruction_faults(x).chosen(own_lost=False, lost=True) for x in flights.values()]
    nodes = [each for those in lost for each in those["node_ended"]]
    if not nodes:
        return "No fault in an instruction has lost a mission."
    ended = wilson(sum(map(bool, nodes)), len(nodes))
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


def _rate(found: Share) -> str:
    ends = f"{100 * found.low:.0f} to {100 * found.high:.0f}"
    return f"{100 * found.share:.0f} % ({found.counts}; 95 % interval {ends} %)"


# Worst cases and spreads --------------------------------------------------------------------------


def _worst_flights(stack: str, flights: Flights) -> Iterator[dict[str, Any]]:
    """The longest flights of each setting, paired and unpaired, as the paper may have read them."""
    hit = flights.comparable.timed.chosen(struck=True, detector=(*_DETECTORS,))
    groups = hit.by("detector", "level", "world", "platform")
    order = [*_DETECTORS]
    for place in sorted(groups, key=lambda each: (*map(str, each[1:]), order.index(each[0]))):
        detector, level, world, platform = place
        those = groups[place]
        golden = dict(zip(those["pair"], those["own_flight_time_s"], strict=True)).values()
        longest_golden, longest = excess_over_mean([*golden], those["flight_time_s"])
        found = those.ratios
        yield {
            "stack": stack,
            "level": level,
            "world": world,
            "platform": platform,
            "detector": detector,
            "flights": len(found),
            "longer": float((found > LONGER).mean()),
            "paired": found.max() - 1.0,
            "unpaired": longest,
            "golden": longest_golden,
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectorBalance:
    """What a detector undoes and what it causes on the same faults.

    Attributes:
        level: `source` or `instruction`.
        fate: what the faults do to their nodes.
        harmed, lost: of harmed and of lost missions.
    """

    stack: str
    level: str
    computer: str
    detector: str
    fate: Fate
    harmed: Balance
    lost: Balance


def _balances(stack: str, flights: Flights) -> Iterator[DetectorBalance]:
    """A row for each level, computer, detector and fate of which pairs were flown."""
    watched = flights.comparable.chosen(detector=(*DETECTOR_TITLES,), bare_struck=True)
    for level, computer, detector in sorted(watched.by("level", "platform", "detector"), key=str):
        for fate in Fate:
            where = {"level": level, "platform": computer}
            harmed, lost = (
                flights.of_fate(fate).balance(detector, column=column, **where)
                for column in ("harmed", "lost")
            )
            if harmed.pairs:
                yield DetectorBalance(
                    stack=stack, level=level, computer=computer, detector=detector, fate=fate,
                    harmed=harmed, lost=lost,
                )  # fmt: skip


def _spread(flights: Flights) -> dict[str, Any] | None:
    """Every flight with a fault in a state over its own golden one, by world and detector."""
    seen = {"level": "source", "platform": "x86", "struck": True, "detector": (*_DETECTORS,)}
    hit = flights.comparable.timed.chosen(**seen)
    groups = hit.by("world", "detector")
    places = sorted(groups, key=str)
    if not places:
        return None
    panels = {
        world: panel(
            (told, name, hit.chosen(world=world, detector=name))
            for name, told in _DETECTORS.items()
        )
        for world, _ in places
    }
    rows = [
        {"world": world, "detector": detector or "", "over_golden": f"{ratio:.4f}"}
        for world, detector in places
        for ratio in groups[world, detector].ratios
    ]
    return {"figure": draw_strips(panels, OVER_GOLDEN), "rows": rows}


# Where a bit hurts --------------------------------------------------------------------------------


def _matrices(stack: str, cells: _Cells) -> Iterator[dict[str, Any]]:
    """A matrix a phase and a kind of state: states as rows, classes of bits as columns."""
    for phase in sorted({phase for _, _, phase in cells}):
        for columns in BIT_CLASSES:
            places = [each for each in cells if each[1] in columns and each[2] == phase]
            used = [bits for bits in columns if any(each[1] == bits for each in places)]
            rows = [
                {"state": state, "cells": [cells.get((state, bits, phase)) for bits in used]}
                for state in dict.fromkeys(state for state, _, _ in places)
            ]
            if rows:
                yield {"stack": stack, "phase": phase, "columns": used, "rows": rows}


def _map_rows(stack: str, cells: _Cells) -> Iterator[dict[str, Any]]:
    for (state, bits, phase), each in cells.items():
        yield {"stack": stack, "state": state, "bits": bits, "phase": phase,
               "faults": each["harmed"].total, "harmful": each["harmed"].count,
               "lost": each["lost"].count}  # fmt: skip


# Where to look -----------------------------------------------------------------------------------


def _worth_a_look(source: CampaignSource) -> dict[str, Any]:
    flights = source.flights
    longest = sorted(flights.timed.rows(), key=lambda each: -each["over_own"])[:_LONGEST]
    return {
        "name": source.name,
        "lost": [_listed(each, source.path) for each in flights.chosen(lost=True).rows()],
        "longest": [_listed(each, source.path) for each in longest],
    }


def _listed(flight: Mapping[str, Any], source: Path) -> dict[str, Any]:
    """One line of the list; the command repeats the flight."""
    struck_state = f"{flight['fault_target']}, {flight['fault_field'] or 'any'}"
    what = "golden" if flight["level"] is None else struck_state
    place = (
        [flight["path"]]
        if _is_kept(flight["path"])
        else [str(source), "--mission", str(flight["number"])]
    )
    return {
        **flight,
        "what": " + ".join(filter(None, (what, flight["detector"]))),
        "ratio": flight["over_own"],
        "command": shlex.join(["mavfi", "replay", *place]),
    }


# Tables and figures, from all flights that are of the same kind as an item's missions -------------

_NEED_RUNS = ("fig11", "fig13")  # their figures read kept run folders
_GOLDEN_ONLY = ("fig11",)
_SETTING = ("world", "platform", "planner", "fault_target", "fault_field", "fault_bits",
            "detector", "protect")  # fmt: skip
_SEEDS = ("seed", "world_seed", "time_limit_s")


def _shown_items(evidence: Evidence, flights: Mapping[str, Flights]) -> Iterator[dict[str, Any]]:
    """Every item of the paper in its order: the stacks that show it, and those that do not.

    A stack, or what else an item is computed from, has the table, the figure, and of flights their
    setting and their time over that of the golden flight. Without the run folders that a figure
    needs there is none.

    Args:
        flights: of each stack, as `Evidence.flights`.
    """
    for item in ITEMS:
        if item.source is Source.FLIGHTS:
            parts = {stack: _flown(item, stack, flights[stack], evidence) for stack in STACKS}
        elif item.source is Source.MODEL:
            parts = {"performance model": _drawn(of_model())}
        else:
            kernels = [*evidence.isolated.values()]
            parts = {ISOLATED: _drawn(of_kernels({"kernels": kernels})) if kernels else None}
        yield {
            "item": item,
            "shown": [{"stack": stack, **part} for stack, part in parts.items() if part],
            "missing": [stack for stack, part in parts.items() if part is None],
        }


def _drawn(table: PaperTable) -> dict[str, Any]:
    return {"table": table, "figure": draw(table, None, "one"), "flights": ()}


def _flown(item: Item, stack: str, flights: Flights, evidence: Evidence) -> dict[str, Any] | None:
    mine = _of_kind(item, stack, flights)
    if not any(mine["level"]) and not (len(mine) and item.name in _GOLDEN_ONLY):
        return None
    told = of_flights(item.name, mine)
    drawn = _with_runs(item, stack, evidence) if item.name in _NEED_RUNS else mine
    if drawn is None:
        return {"table": told, "figure": None, "flights": ()}
    return {"table": told, "figure": draw(told, drawn, "one"), "flights": [*_over_own(mine)]}


def _with_runs(item: Item, stack: str, evidence: Evidence) -> Flights | None:
    """The item's flights in the first campaign that has kept the run folders of all of them."""
    several = (Flights.pooled([each.flights], stack) for each in evidence.campaigns)
    each_own = (_of_kind(item, stack, flights) for flights in several)
    return next((own for own in each_own if len(own) and all(map(_is_kept, own["path"]))), None)


def _is_kept(run: str | None) -> bool:
    return run is not None and Path(run).is_dir()


def _over_own(flights: Flights) -> Iterator[dict[str, Any]]:
    """The successful faulty flights, with the columns in which they differ."""
    rows = flights.timed.rows(*_SETTING)
    varying = [name for name in _SETTING if len({row[name] for row in rows}) > 1]
    for row, ratio in zip(rows, flights.timed.ratios, strict=True):
        yield {**{name: row[name] for name in varying}, "over_golden": f"{ratio:.4f}"}


def _of_kind(item: Item, stack: str, flights: Flights) -> Flights:
    """The flights that differ from the item's missions on a stack in _SEEDS only."""
    kinds = {
        kind_of(changes_of(mission.config), _SEEDS)
        for mission in FlightsPlan(items=[item], stack=stack).kinds()
    }
    changes = map(json.loads, flights["changes"])
    return flights.where([kind_of(each, _SEEDS) in kinds for each in changes])
