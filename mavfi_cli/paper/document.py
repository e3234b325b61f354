"""The whole report as plain values; `mavfi_cli.report.page` makes the page of them."""

from __future__ import annotations

import json
import math
import shlex
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa
import pyarrow.compute as pc

from mavfi_cli.analysis.flights import chosen
from mavfi_cli.analysis.kernel_runs import silent_of_all
from mavfi_cli.campaigns.missions import changes_of, kind_of
from mavfi_cli.core.installed import __version__
from mavfi_cli.paper.beyond import (
    BIT_CLASSES,
    Fate,
    StateCell,
    arms,
    hourly_failures,
    kernel_flows,
    state_map,
)
from mavfi_cli.paper.claims import CLAIMS, Claim, Finding, Kernels, protected
from mavfi_cli.paper.figures import OVER_GOLDEN, draw, panel
from mavfi_cli.paper.flights import (
    LONGER,
    beside_golden,
    by_value,
    comparable,
    pooled,
    ratios,
    share,
    struck,
    timed,
)
from mavfi_cli.paper.items import ITEMS, LEFT_OUT, FlightsPlan, Item, Source, printed_name
from mavfi_cli.paper.layouts import of_flights
from mavfi_cli.paper.sources import STACKS, CampaignSource, Evidence
from mavfi_cli.paper.status import of_kernels, of_model
from mavfi_cli.report.paper import DETECTOR_TITLES, PaperTable, count_of, draw_strips
from mavfi_cli.stats.effects import ClaimVerdict, excess_over_mean, judge
from mavfi_cli.stats.shares import Share, wilson

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_DETECTORS = {None: "no detector"} | DETECTOR_TITLES
_LONGEST = 5  # flights of a campaign that are listed although they succeed
_ISOLATED = "isolated kernels"


def document(evidence: Evidence, upsets_per_hour: float = 1.0) -> dict[str, Any]:
    """All parts of the report.

    Args:
        upsets_per_hour: bit flips that reach the injection sites in an hour of flight.
    """
    flown = {stack: evidence.flights(stack) for stack in STACKS}
    as_paper = {stack: chosen(those, as_paper=True) for stack, those in flown.items()}
    flights = {stack: chosen(those, at=(None, "random")) for stack, those in as_paper.items()}
    kernels = evidence.isolated
    silent = {name: silent_of_all(each) for name, each in kernels.items()}
    claims = [_judged(claim, flights, kernels) for claim in CLAIMS]
    maps = {stack: state_map(as_paper[stack]) for stack in STACKS}
    return {
        "version": __version__,
        "stacks": STACKS,
        "extent": _extent(flights, kernels, claims),
        "summary": _summary(flights, claims),
        "problems": evidence.problems,
        "claims": claims,
        "verdicts": {where: _counted(claims, where) for where in (*STACKS, _ISOLATED)},
        "worst": [row for stack in STACKS for row in _worst_flights(stack, flights[stack])],
        "spreads": {stack: _spread(flights[stack]) for stack in STACKS},
        "flows": {stack: kernel_flows(flights[stack], silent) for stack in STACKS},
        "fates": [*Fate],
        "maps": [part for stack in STACKS for part in _matrices(stack, maps[stack])],
        "map_rows": [row for stack in STACKS for row in _map_rows(stack, maps[stack])],
        "item_titles": {item.name: f"{item.paper}: {item.title}" for item in ITEMS},
        "items": [*shown_items(evidence, flown)],
        "left_out": {printed_name(name): why for name, why in LEFT_OUT.items()},
        "detectors": ("", *DETECTOR_TITLES),
        "upsets_per_hour": upsets_per_hour,
        "hourly": {s: [*hourly_failures(flights[s], upsets_per_hour)] for s in STACKS},
        "arms": [
            {"campaign": each.name, "arms": found}
            for each in evidence.campaigns
            if (found := arms(comparable(each.flights)))
        ],
        "sources": evidence.campaigns,
        "kernel_sources": evidence.kernels,
        "missions": [_worth_a_look(each) for each in evidence.campaigns if each.flights.num_rows],
    }


# Claims -------------------------------------------------------------------------------------------


def _judged(claim: Claim, flights: Mapping[str, pa.Table], kernels: Kernels) -> dict[str, Any]:
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
    known = found.effect is not None and not math.isnan(found.effect.low)
    return {"verdict": verdict, "effect": found.effect if known else None, "told": found.told}


def _counted(claims: Sequence[Mapping[str, Any]], where: str) -> dict[ClaimVerdict, int]:
    found = Counter(each["cells"][where]["verdict"] for each in claims if where in each["cells"])
    return {verdict: found[verdict] for verdict in ClaimVerdict}


# Five sentences -----------------------------------------------------------------------------------


def _extent(
    flights: Mapping[str, pa.Table], kernels: Kernels, claims: Sequence[Mapping[str, Any]]
) -> str:
    """What the page judges, and by how much."""
    missions = sum(those.num_rows for those in flights.values())
    runs = sum(each["runs"] for each in kernels.values())
    attacked = f" and {runs:,} runs of isolated kernels" if runs else ""
    return f"{len(claims)} claims are judged by {missions:,} missions{attacked}."


def _summary(flights: Mapping[str, pa.Table], claims: Sequence[Mapping[str, Any]]) -> list[str]:
    return [
        _verdict_sentence(claims),
        _cost_sentence(flights),
        _saved_sentence(flights, "instruction", "an instruction"),
        _saved_sentence(flights, "source", "a state"),
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


def _cost_sentence(flights: Mapping[str, pa.Table]) -> str:
    parts = []
    for stack, those in flights.items():
        instructions = _instruction_faults(those)
        kind = "an instruction" if instructions.num_rows else "a state"
        hit = chosen(
            instructions if instructions.num_rows else struck(those, level="source"), own_lost=False
        )
        if hit.num_rows:
            parts.append(
                f"on {stack}, a bit flip in {kind} loses {_rate(share(hit))} of the "
                "missions whose golden flight succeeds"
            )
    if not parts:
        return "No flight with a fault has a golden flight beside it, so the cost is not known."
    return _sentence(parts)


def _instruction_faults(flights: pa.Table) -> pa.Table:
    """Unprotected flights on the host's computer with a fault in an instruction."""
    return struck(flights, level="instruction", platform="x86")


def _saved_sentence(flights: Mapping[str, pa.Table], level: str, kind: str) -> str:
    """What the detectors save of faults of one level, on the first stack flown with one."""
    for stack, those in flights.items():
        saved = []
        for detector, name in (("gad", "the Gaussian detector"), ("aad", "the autoencoder")):
            lost = protected(those, detector, level=level, bare_lost=True)
            found = share(lost, value=False)
            saved += [f"{name} saves {_rate(found)}"] if found.total else []
        if saved:
            place = f"On {stack}, of the missions that a fault in {kind} loses"
            return f"{place}, {_listed_in_words(saved)}."
    return f"No mission that a fault in {kind} loses was flown again with a detector."


def _crash_sentence(flights: Mapping[str, pa.Table]) -> str:
    hit = (chosen(_instruction_faults(those), own_lost=False) for those in flights.values())
    lost = [chosen(those, lost=True) for those in hit]
    nodes = [each for those in lost for each in those["node_ended"].to_pylist()]
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
    return f"{100 * found.share:.0f} % ({count_of(found)}; 95 % interval {ends} %)"


# Worst cases and spreads --------------------------------------------------------------------------


def _worst_flights(stack: str, flights: pa.Table) -> Iterator[dict[str, Any]]:
    """The longest flights of each setting, paired and unpaired, as the paper may have read them."""
    hit = chosen(timed(comparable(flights)), struck=True, detector=(*_DETECTORS,))
    groups = by_value(hit, "detector", "level", "world", "platform")
    order = [*_DETECTORS]
    for place in sorted(groups, key=lambda each: (*map(str, each[1:]), order.index(each[0]))):
        detector, level, world, platform = place
        names = ("pair", "flight_time_s", "own_flight_time_s")
        pairs, times, own_times = (groups[place][name].to_pylist() for name in names)
        golden = dict(zip(pairs, own_times, strict=True)).values()
        longest_golden, longest = excess_over_mean([*golden], times)
        found = ratios(groups[place])
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


def _spread(flights: pa.Table) -> dict[str, Any] | None:
    """Every flight with a fault in a state over its own golden one, by world and detector."""
    seen = {"level": "source", "platform": "x86", "struck": True, "detector": (*_DETECTORS,)}
    hit = chosen(timed(comparable(flights)), **seen)
    groups = by_value(hit, "world", "detector")
    places = sorted(groups, key=str)
    if not places:
        return None
    panels = {
        world: panel(
            (told, name, groups.get((world, name), hit[:0])) for name, told in _DETECTORS.items()
        )
        for world, _ in places
    }
    rows = [
        {"world": world, "detector": detector or "", "over_golden": f"{ratio:.4f}"}
        for world, detector in places
        for ratio in ratios(groups[world, detector])
    ]
    return {"figure": draw_strips(panels, OVER_GOLDEN), "rows": rows}


# Where a bit hurts --------------------------------------------------------------------------------


def _matrices(
    stack: str, cells: Mapping[tuple[str, str, str], StateCell]
) -> Iterator[dict[str, Any]]:
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


def _map_rows(
    stack: str, cells: Mapping[tuple[str, str, str], StateCell]
) -> Iterator[dict[str, Any]]:
    for (state, bits, phase), each in cells.items():
        yield {"stack": stack, "state": state, "bits": bits, "phase": phase,
               "faults": each.harmed.total, "harmful": each.harmed.count,
               "lost": each.lost.count}  # fmt: skip


# Where to look -----------------------------------------------------------------------------------


def _worth_a_look(source: CampaignSource) -> dict[str, Any]:
    """The lost missions of a campaign, and the longest of the others."""
    flights = beside_golden(source.flights)
    longest = sorted(timed(flights).to_pylist(), key=lambda each: -each["over_own"])[:_LONGEST]
    return {
        "name": source.name,
        "lost": [_listed(each, source.path) for each in chosen(flights, lost=True).to_pylist()],
        "longest": [_listed(each, source.path) for each in longest],
    }


def _listed(flight: Mapping[str, Any], source: Path) -> dict[str, Any]:
    """One line of the list; the command repeats the flight."""
    struck_state = f"{flight['fault_target']}, {flight['fault_field'] or 'any'}"
    what = "golden" if flight["level"] is None else struck_state
    kept = flight["path"] is not None and Path(flight["path"]).is_dir()
    place = [flight["path"]] if kept else [str(source), "--mission", str(flight["number"])]
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


@dataclass(frozen=True, slots=True, kw_only=True)
class _OnStack:
    """A table or figure of the paper, on one stack.

    Attributes:
        stack: or what else it is computed from.
        table: None if nothing was flown for it.
        figure: None without a table, or if the figure needs run folders that were not kept.
        flights: the flights in the figure: their setting, and time over that of the golden flight.
    """

    stack: str
    table: PaperTable | None = None
    figure: Figure | None = None
    flights: Sequence[Mapping[str, Any]] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class _ShownItem:
    """A table or figure of the paper, on all stacks."""

    item: Item
    parts: Sequence[_OnStack]

    @property
    def shown(self) -> list[_OnStack]:
        """The stacks that have a table."""
        return [each for each in self.parts if each.table is not None]

    @property
    def missing(self) -> list[str]:
        """The stacks without one."""
        return [each.stack for each in self.parts if each.table is None]


def shown_items(evidence: Evidence, flights: Mapping[str, pa.Table]) -> Iterator[_ShownItem]:
    """Every item on every stack, in the paper's order.

    Args:
        flights: of each stack, as `Evidence.flights`.
    """
    kernels = [*evidence.isolated.values()]
    for item in ITEMS:
        if item.source is Source.FLIGHTS:
            parts = [_flown(item, stack, flights[stack], evidence) for stack in STACKS]
        elif item.source is Source.MODEL:
            parts = [_drawn("performance model", of_model())]
        elif kernels:
            parts = [_drawn("isolated kernels", of_kernels({"kernels": kernels}))]
        else:
            parts = [_OnStack(stack="isolated kernels")]
        yield _ShownItem(item=item, parts=parts)


def _drawn(stack: str, table: PaperTable) -> _OnStack:
    return _OnStack(stack=stack, table=table, figure=draw(table, None, "one"))


def _flown(item: Item, stack: str, flights: pa.Table, evidence: Evidence) -> _OnStack:
    mine = _of_kind(item, stack, flights)
    struck = mine.filter(pc.is_valid(mine["level"])).num_rows
    if not struck and not (mine.num_rows and item.name in _GOLDEN_ONLY):
        return _OnStack(stack=stack)
    told = of_flights(item.name, mine)
    drawn = _with_runs(item, stack, evidence) if item.name in _NEED_RUNS else mine
    if drawn is None:
        return _OnStack(stack=stack, table=told)
    figure = draw(told, drawn, "one")
    return _OnStack(stack=stack, table=told, figure=figure, flights=[*_over_own(mine)])


def _with_runs(item: Item, stack: str, evidence: Evidence) -> pa.Table | None:
    """The item's flights in the first campaign that has kept the run folders of all of them."""
    each_own = (_of_kind(item, stack, pooled([x.flights], stack)) for x in evidence.campaigns)
    return next((own for own in each_own if own.num_rows and _kept(own)), None)


def _kept(table: pa.Table) -> bool:
    """Whether the run folders of all these flights are there."""
    return all(each is not None and Path(each).is_dir() for each in table["path"].to_pylist())


def _over_own(flights: pa.Table) -> Iterator[dict[str, Any]]:
    """The successful faulty flights, with the columns in which they differ."""
    known = timed(flights)
    rows = known.select(_SETTING).to_pylist()
    varying = [name for name in _SETTING if len({row[name] for row in rows}) > 1]
    for row, ratio in zip(rows, ratios(known), strict=True):
        yield {**{name: row[name] for name in varying}, "over_golden": f"{ratio:.4f}"}


def _of_kind(item: Item, stack: str, table: pa.Table) -> pa.Table:
    """The flights that differ from the item's missions on a stack in _SEEDS only."""
    kinds = {
        kind_of(changes_of(mission.config), _SEEDS)
        for mission in FlightsPlan(items=[item], stack=stack).kinds()
    }
    changes = map(json.loads, table["changes"].to_pylist())
    wanted = [kind_of(each, _SEEDS) in kinds for each in changes]
    return table.filter(pa.array(wanted, pa.bool_()))
