"""The content of the results page. `mavfi_cli.report.page` inserts it into the template."""

from __future__ import annotations

import base64
import math
import shlex
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavfi_cli.analysis.kernels import IsolatedKernel, KernelSummary
from mavfi_cli.analysis.pairs import Flights
from mavfi_cli.core.installed import __version__
from mavfi_cli.mission.run_folder import RunFolder
from mavfi_cli.paper.answers import (
    LEVELS,
    Delays,
    DetectorBalance,
    Disagreement,
    Family,
    Safeguard,
    answer,
    crash_sentence,
    delay_sentence,
    disagreements,
    judgement_of,
    protections,
    reason_of,
    short_name,
)
from mavfi_cli.paper.beyond import (
    BIT_CLASSES,
    Arm,
    CompanionArm,
    HourlyFailures,
    KernelFlow,
    MapCell,
    RestartComparison,
    arms,
    companion_arms,
    hourly_failures,
    kernel_flows,
    restarts,
    state_map,
)
from mavfi_cli.paper.claims import judged
from mavfi_cli.paper.figures import OVER_GOLDEN, draw, panel
from mavfi_cli.paper.items import (
    ITEMS,
    LEFT_OUT,
    STACKS,
    Item,
    Regime,
    Source,
    printed_name,
)
from mavfi_cli.paper.layouts import of_flights, of_kind
from mavfi_cli.paper.sources import CampaignSource, Evidence
from mavfi_cli.paper.status import of_kernels, of_model
from mavfi_cli.paper.verdicts import ISOLATED, JudgedClaim, Verdict
from mavfi_cli.report.charts import (
    ForestRow,
    Picture,
    draw_arms,
    draw_delays,
    draw_flows,
    draw_forest,
)
from mavfi_cli.report.paper import DETECTOR_TITLES, PaperTable, draw_strips
from mavfi_cli.report.table import Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_DETECTORS = {None: "no detector"} | DETECTOR_TITLES
_LONGEST = 5  # maximum number of successful flights listed per campaign
_PICTURES, _LARGEST_PICTURE = 40, 500_000  # maximum pictures on the page; maximum bytes of one
Step = Callable[[str], object]  # called with the name of each step


@dataclass(frozen=True, slots=True, kw_only=True)
class _StateMatrix:
    """The state map of one flight phase, with states as rows and bit classes as columns.

    Attributes:
        columns: names of the bit classes.
        rows: for each state, its cell in every column; None if no fault struck there.
    """

    stack: str
    phase: str
    columns: Sequence[str]
    rows: Mapping[str, Sequence[MapCell | None]]


@dataclass(frozen=True, slots=True, kw_only=True)
class _ItemPart:
    """The part of an item that comes from one stack, the isolated kernels or the model.

    Attributes:
        picture: the item's figure; None if it needs run folders that do not exist.
    """

    place: str
    table: PaperTable
    picture: Picture | None


@dataclass(frozen=True, slots=True, kw_only=True)
class _ShownItem:
    """An item of the paper on the page.

    Attributes:
        missing: for each place without a part, the command that makes the part.
    """

    item: Item
    parts: Sequence[_ItemPart]
    missing: Mapping[str, str]


@dataclass(frozen=True, slots=True, kw_only=True)
class _ListedMission:
    """A lost or unusually long mission that the page lists.

    Attributes:
        ratio: flight time divided by that of the golden flight; None if the mission is lost.
        command: command that repeats the flight; empty for a flight of a user's companion.
        picture: its top view as a data URL; empty if the page does not show it.
    """

    number: int
    fault: str
    world: str
    seed: int
    outcome: str
    ratio: float | None
    command: str
    picture: str


@dataclass(frozen=True, slots=True, kw_only=True)
class _CampaignMissions:
    """The lost missions of a campaign, and the successful ones with the highest `ratio`."""

    name: str
    lost: Sequence[_ListedMission]
    longest: Sequence[_ListedMission]


@dataclass(frozen=True, slots=True, kw_only=True)
class Document:
    """The content of the results page.

    Attributes:
        places: names of regimes. The page shows the first one, and collapses the others.
        companions: for each campaign, the flights of users' companions.
        only_companions: whether there is nothing else, so that the page leaves the paper out.
        answers: for each place, a sentence on how far it reproduces the paper.
    """

    version: str
    places: Sequence[str]
    answers: Mapping[str, str]
    crashes: str
    extent: str
    problems: Sequence[str]
    claims: Sequence[JudgedClaim]
    families: Sequence[Family]
    populations: Mapping[str, str]
    forest: Picture | None
    disagreements: Sequence[Disagreement]
    protections: Sequence[Safeguard]
    advice: str
    balances: Sequence[DetectorBalance]
    delays: Picture | None
    delay_sentence: str
    spreads: Sequence[Picture]
    items: Sequence[_ShownItem]
    left_out: Mapping[str, str]
    flows: Mapping[str, Sequence[KernelFlow]]
    flow_pictures: Sequence[Picture]
    maps: Sequence[_StateMatrix]
    map_csv: str
    upsets_per_hour: float
    hourly: Mapping[str, Sequence[HourlyFailures]]
    arms: Mapping[str, Sequence[Arm]]
    arm_pictures: Mapping[str, Picture]
    restarts: Sequence[RestartComparison]
    companions: Mapping[str, Sequence[CompanionArm]]
    only_companions: bool
    sources: Sequence[CampaignSource]
    kernel_sources: Sequence[KernelSummary]
    missions: Sequence[_CampaignMissions]

    @property
    def place(self) -> str:
        """The place whose verdicts are shown first: the paper's stack, or the first one flown."""
        return self.places[0]

    @property
    def kinds(self) -> list[str]:
        """The kinds of faults against which protections were flown."""
        return [
            kind
            for kind in (self.protections[0].against if self.protections else ())
            if any(guard.against[kind] for guard in self.protections)
        ]

    @property
    def answer(self) -> str:
        """The sentence on how far `place` reproduces the paper."""
        return self.answers[self.place]

    def reason(self, judged: JudgedClaim) -> str:
        """Return the known reason why a claim is contradicted at `place`, or an empty string."""
        return reason_of(judged, self.place)

    def verdicts(self) -> dict[str, dict[str, int]]:
        """Return the number of claims per verdict, keyed by place or ISOLATED, then by verdict."""
        by_place = {
            place: [claim.verdict(place) for claim in self.claims]
            for place in (*self.places, ISOLATED)
        }
        return {
            place: {verdict.value: verdicts.count(verdict) for verdict in Verdict}
            for place, verdicts in by_place.items()
        }


def document(evidence: Evidence, upsets_per_hour: float = 1.0, step: Step = str) -> Document:
    """Compute the content of the results page from the campaigns and kernel summaries.

    Args:
        upsets_per_hour: bit flips that reach the injection sites per flight hour.
        step: called with the name of each step when it begins.
    """
    flown = {
        place: mine
        for place, mine in evidence.by_place(STACKS).items()
        if len(mine) or place != STACKS[1]  # the second rebuild is shown only if it was flown
    }
    as_paper = {place: mine.chosen(as_paper=True) for place, mine in flown.items()}
    flights = {place: those.chosen(at=(None, "random")) for place, those in as_paper.items()}
    faulty = {place for place, mine in flights.items() if any(mine["level"])}
    places = sorted(flown, key=lambda place: (place not in faulty, not len(flights[place])))
    as_paper, flights = ({place: those[place] for place in places} for those in (as_paper, flights))
    usual = [place for place in places[1:] if not Regime.of(place).rule]
    kernels = evidence.isolated
    sdc = {name: kernel.outcomes["sdc"] for name, kernel in kernels.items()}
    silent = {name: (share.count, share.total) for name, share in sdc.items()}
    step("judging the claims")
    claims = judged(flights, kernels, evidence.settled)
    step("counting what protects")
    maps = {place: state_map(as_paper[place]) for place in places}
    flows = {place: kernel_flows(flights[place], silent) for place in places}
    names = Counter(source.name for source in evidence.campaigns)
    named = {
        source.name if names[source.name] == 1 else str(source.path): source.flights
        for source in evidence.campaigns
    }
    by_arm = {
        Regime(name if base == STACKS[0] else f"{name} on {base}", rule=rule).name: found
        for name, mine in named.items()
        for rule, those in mine.comparable.by_rules.items()
        for base, found in arms(those).items()
    }
    everything = evidence.flights()
    beside = dict[str, Flights]()
    for base, mine in Arm.by_base(everything.comparable).items():
        beside |= Regime.split(base, mine)
    added = [*Delays.of(places[0], flights[places[0]])]
    guards = protections(flights, beside)
    step("drawing the figures")
    return Document(
        version=__version__,
        places=places,
        answers={place: answer(claims, place) for place in places},
        crashes=crash_sentence(claims, places[0], flights[places[0]]),
        extent=_extent(flights, kernels, claims),
        problems=evidence.problems,
        claims=claims,
        families=Family.of(claims),
        populations={place: those.population for place, those in flights.items() if len(those)},
        forest=_forest(claims, [places[0], *usual]),
        disagreements=disagreements(claims, places[0]),
        protections=guards,
        advice=_advice(guards),
        balances=[row for place in places for row in DetectorBalance.of(place, flights[place])],
        delays=_delay_picture(added),
        delay_sentence=delay_sentence(added),
        spreads=[part for place in places if (part := _spread(place, flights[place]))],
        items=[*_items(evidence, {place: flown[place] for place in places})],
        left_out={printed_name(name): why for name, why in LEFT_OUT.items()},
        flows=flows,
        flow_pictures=[_flow_picture(place, mine) for place, mine in flows.items() if mine],
        maps=[part for place in places for part in _matrices(place, maps[place])],
        map_csv=Table.of_records(_map_rows(maps)).csv(),
        upsets_per_hour=upsets_per_hour,
        hourly={own: [*hourly_failures(flights[own], upsets_per_hour)] for own in places},
        arms=by_arm,
        arm_pictures={name: _arm_picture(name, mine) for name, mine in by_arm.items()},
        restarts=restarts(everything.comparable),
        companions={
            name: flown_arms for name, mine in named.items() if (flown_arms := companion_arms(mine))
        },
        only_companions=not evidence.kernels and None not in everything["companion"],
        sources=evidence.campaigns,
        kernel_sources=evidence.kernels,
        missions=[*_missions(evidence.campaigns)],
    )


def _advice(guards: Sequence[Safeguard]) -> str:
    """Return advice for a designer, with one sentence for each kind of fault that did harm."""
    sentences = []
    for kind in guards[0].against if guards else ():
        cells = [(guard, cell.effect) for guard in guards if (cell := guard.against[kind])]
        helping: dict[str, list[str]] = {}
        for guard, effect in cells:
            if effect == "helps":
                helping.setdefault(guard.place, []).append(guard.name)
        parts = []
        for place, names in helping.items():
            helps = "helps" if len(names) == 1 else "help"
            comma = "," if names[2:] else ""
            listed = f"{', '.join(names[:-1])}{comma} and {names[-1]}" if names[1:] else names[0]
            parts.append(f"{listed} {helps}" + (f" ({place})" if place else ""))
        if parts:
            sentences.append(f"Against {kind}, {'; '.join(parts)}.")
        elif {effect for _, effect in cells} - {"nothing to undo"}:
            sentences.append(f"Against {kind}, nothing flown here is proven to help.")
    return " ".join(sentences)


def _extent(
    flights: Mapping[str, Flights],
    kernels: Mapping[str, IsolatedKernel],
    claims: Sequence[JudgedClaim],
) -> str:
    """State how many claims are judged, and from how many missions and runs."""
    missions = len({mission for mine in flights.values() for mission in mine["mission"]})
    runs = sum(kernel.runs for kernel in kernels.values())
    attacked = f" and {runs:,} runs of isolated kernels" if runs else ""
    places = (*flights, ISOLATED)
    count = sum(
        any(claim.verdict(place) not in (None, Verdict.NOT_DECIDABLE) for place in places)
        for claim in claims
    )
    return (
        f"{missions:,} missions{attacked} judge {count} of {len(claims)} claims in one regime at "
        "least."
    )


# Pictures of answers ------------------------------------------------------------------------------


def _forest(claims: Sequence[JudgedClaim], stacks: Sequence[str]) -> Picture | None:
    rows = [
        ForestRow(
            label=short_name(judged_claim),
            low=judged_claim.claim.low,
            high=judged_claim.claim.high,
            number=judged_claim.claim.unit == "number",
            effects=[
                judgement.effect if judgement else None
                for stack in (stacks[:1] if judged_claim.claim.isolated else stacks)
                for judgement in [judgement_of(judged_claim, stack)]
            ],
            verdict=judgement_of(judged_claim, stacks[0]).verdict.value,  # type: ignore[union-attr]
        )
        for judged_claim in claims
    ]
    rows = [row for row in rows if any(row.effects)]
    if not rows:
        return None
    csv = Table.of_records(
        {"claim": row.label, "range_low": row.low, "range_high": row.high, "stack": stack,
         "effect": effect.value, "low": effect.low, "high": effect.high, "n": effect.count}
        for row in rows
        for stack, effect in zip(stacks, row.effects, strict=False)
        if effect
    ).csv()  # fmt: skip
    title = (
        "Effects with their 95 % intervals beside the ranges that the paper's claims give. "
        "The colour of a full mark is that of its verdict"
    )
    broad, narrow = (draw_forest(rows, stacks, columns) for columns in ("two", "one"))
    return Picture.of("forest", title, broad, csv, narrow)


def _delay_picture(parts: Sequence[Delays]) -> Picture | None:
    """Plot the share of faulty flights that exceed a delay, against the delay."""
    if not parts:
        return None
    curves = {
        f"{part.stack}: faults in {LEVELS[part.level]}": [
            (_DETECTORS[name], name or "none", added) for name, added in part.added_s.items()
        ]
        for part in parts
    }
    golden_s = [part.golden_s for part in parts]
    csv = Table.of_records(
        {"stack": part.stack, "level": part.level, "detector": name or "",
         "added_s": "lost" if added == float("inf") else f"{added:.3f}"}
        for part in parts
        for name, values in part.added_s.items()
        for added in values
    ).csv()  # fmt: skip
    title = "Share of faulty flights that take longer than golden by more than so many seconds"
    broad, narrow = (draw_delays(curves, golden_s, columns) for columns in ("two", "one"))
    return Picture.of("delays", title, broad, csv, narrow)


def _spread(stack: str, flights: Flights) -> Picture | None:
    """Plot flight times with state faults, relative to golden flights, by world and detector."""
    seen = {"level": "source", "platform": "x86", "struck": True, "detector": (*_DETECTORS,)}
    hit = flights.comparable.timed.chosen(**seen)
    groups = hit.by("world", "detector")
    places = sorted(groups, key=str)
    if not places:
        return None
    panels = {
        world: panel(
            (title, name, hit.chosen(world=world, detector=name), None)
            for name, title in _DETECTORS.items()
        )
        for world, _ in places
    }
    csv = Table.of_records(
        {"world": world, "detector": detector or "", "over_golden": f"{ratio:.4f}"}
        for world, detector in places
        for ratio in groups[world, detector].ratios
    ).csv()
    title = f"Faults in states, {stack}"
    return Picture.of(f"states-{stack}", title, draw_strips(panels, OVER_GOLDEN), csv)


def _flow_picture(stack: str, flows: Sequence[KernelFlow]) -> Picture:
    csv = Table.of_records(
        {"kernel": flow.kernel, "fate": fate, "missions": share.total, "lost": share.count}
        for flow in flows
        for fate, share in flow.fates.items()
    ).csv()
    bars = {flow.kernel.replace("_", " "): flow.fates for flow in flows}
    return Picture.of(
        f"kernels-{stack}", f"What struck kernels did, {stack}", draw_flows(bars), csv
    )


def _arm_picture(campaign: str, rows: Sequence[Arm]) -> Picture:
    csv = Table.of_records(
        {"arm": arm.name, "lost": arm.lost.count, "of": arm.lost.total, "low": arm.lost.low,
         "high": arm.lost.high, "p": arm.corrected_p}
        for arm in rows
    ).csv()  # fmt: skip
    figure = draw_arms([(arm.name, arm.lost, arm.corrected_p) for arm in rows])
    return Picture.of(f"arms-{campaign}", f"Lost missions of each arm of {campaign}", figure, csv)


# Where a bit hurts --------------------------------------------------------------------------------


def _matrices(stack: str, cells: Sequence[MapCell]) -> Iterator[_StateMatrix]:
    """Yield a matrix for each flight phase and type of state that has cells."""
    for phase in sorted({cell.phase for cell in cells}):
        for columns in BIT_CLASSES:
            mine = [cell for cell in cells if cell.bits in columns and cell.phase == phase]
            used = [bits for bits in columns if any(cell.bits == bits for cell in mine)]
            place = {(cell.state, cell.bits): cell for cell in mine}
            states = dict.fromkeys(cell.state for cell in mine)
            if mine:
                rows = {state: [place.get((state, bits)) for bits in used] for state in states}
                yield _StateMatrix(stack=stack, phase=phase, columns=used, rows=rows)


def _map_rows(maps: Mapping[str, Sequence[MapCell]]) -> Iterator[dict[str, Any]]:
    for stack, cells in maps.items():
        for cell in cells:
            yield {"stack": stack, "state": cell.state, "bits": cell.bits, "phase": cell.phase,
                   "faults": cell.harmed.total, "harmful": cell.harmed.count,
                   "lost": cell.lost.count}  # fmt: skip


# Missions to look at ------------------------------------------------------------------------------


def _missions(campaigns: Sequence[CampaignSource]) -> Iterator[_CampaignMissions]:
    left = _PICTURES
    for source in campaigns:
        flights = source.flights
        longest = sorted(flights.timed.rows(), key=lambda row: -row["over_own"])[:_LONGEST]
        lost = [_listed(row, source, left > place)
                for place, row in enumerate(flights.chosen(lost=True).rows())]  # fmt: skip
        left -= sum(bool(mission.picture) for mission in lost)
        if len(flights):
            yield _CampaignMissions(
                name=source.name,
                lost=lost,
                longest=[_listed(row, source) for row in longest],
            )


def _listed(
    flight: Mapping[str, Any], source: CampaignSource, pictured: bool = False
) -> _ListedMission:
    """Return the page's entry for a mission.

    In the command, the absolute path of an export is shortened to the file name.
    """
    struck_state = f"{flight['fault_target']}, {flight['fault_field'] or 'any'}"
    fault = "golden" if flight["level"] is None else struck_state
    kept = source.may_have_runs and _is_kept(flight["path"])
    path = source.path
    place = path.name if path.suffix and path.is_absolute() else str(path)
    run = [flight["path"]] if kept else [place, "--mission", str(flight["number"])]
    return _ListedMission(
        number=flight["number"],
        fault=" + ".join(filter(None, (fault, flight["detector"]))),
        world=flight["world"],
        seed=flight["seed"],
        outcome=flight["outcome"],
        ratio=flight["over_own"],
        command=shlex.join(["mavfi", "replay", *run]) if flight["companion"] is None else "",
        picture=_flight_picture(Path(flight["path"])) if kept and pictured else "",
    )


def _flight_picture(run: Path) -> str:
    """Return a run's top view as a data URL, or "" if the file is missing, a link or too large.

    A browser runs no scripts in an image that it loads from a data URL.
    """
    path = RunFolder(run).picture
    if path.is_symlink() or not path.is_file() or path.stat().st_size > _LARGEST_PICTURE:
        return ""
    return "data:image/svg+xml;base64," + base64.b64encode(path.read_bytes()).decode()


# Tables and figures, from all flights that are of the same kind as an item's missions -------------

_NEED_RUNS = ("fig11", "fig13")  # their figures read kept run folders
_SETTING = ("world", "platform", "planner", "fault_target", "fault_field", "fault_bits",
            "detector", "protect")  # fmt: skip


def _items(evidence: Evidence, flights: Mapping[str, Flights]) -> Iterator[_ShownItem]:
    """Yield every item of the paper, in the paper's order.

    Args:
        flights: flights by place, from `Evidence.by_place`.
    """
    for item in ITEMS:
        if item.source is Source.FLIGHTS:
            parts = {
                place: _flown(item, place, those, evidence) for place, those in flights.items()
            }
        elif item.source is Source.MODEL:
            parts = {"performance model": _drawn(item, "performance model", of_model())}
        else:
            kernels = evidence.isolated.values()
            table = of_kernels(kernels) if kernels else None
            parts = {ISOLATED: None if table is None else _drawn(item, ISOLATED, table)}
        yield _ShownItem(
            item=item,
            parts=[part for part in parts.values() if part],
            missing={
                place: _command(item, place)
                for place, part in parts.items()
                if part is None and not Regime.of(place).rule
            },
        )


def _command(item: Item, place: str) -> str:
    """Return the command that makes an item's part for a place."""
    if place == ISOLATED:
        return "mavfi kernels --runs 5000 --out kernels"
    where = Regime.of(place)
    many = " --worlds many" if where.worlds == "many" else ""
    return f"mavfi reproduce {item.name} --stack {where.stack}{many}"


def _drawn(item: Item, place: str, table: PaperTable) -> _ItemPart:
    picture = _item_picture(item, place, draw(table, None, "one"), table.csv())
    return _ItemPart(place=place, table=table, picture=picture)


def _flown(item: Item, place: str, flights: Flights, evidence: Evidence) -> _ItemPart | None:
    mine = of_kind(item, Regime.of(place).stack, flights)
    if not len(mine):
        return None
    table = of_flights(item.name, mine)
    drawn = _with_runs(item, place, evidence) if item.name in _NEED_RUNS else mine
    picture = None
    if drawn is not None:
        rows = [*_over_own(mine)]
        csv = Table.of_records(rows).csv() if rows else table.csv()
        picture = _item_picture(item, place, draw(table, drawn, "one"), csv)
    known = tuple(row for row in table.rows if any(math.isfinite(cell.value) for cell in row.cells))
    return _ItemPart(place=place, table=replace(table, rows=known), picture=picture)


def _item_picture(item: Item, place: str, figure: Figure, csv: str) -> Picture:
    name = f"{item.name}-{place}".replace(",", "").replace(" ", "-")
    return Picture.of(name, f"{item.paper}: {item.title}, {place}", figure, csv)


def _with_runs(item: Item, place: str, evidence: Evidence) -> Flights | None:
    """Return an item's flights from the first campaign that kept all their run folders.

    Return None if no campaign kept them all.
    """
    where, nothing = Regime.of(place), Flights.pooled([])
    folders = (source for source in evidence.campaigns if source.may_have_runs)
    several = (Flights.pooled([source.flights], where.stack) for source in folders)
    if where.worlds:
        several = (flights.by_worlds.get(where.worlds, nothing) for flights in several)
    several = (flights.by_rules.get(where.rule, nothing) for flights in several)
    own = (of_kind(item, where.stack, flights) for flights in several)
    return next((mine for mine in own if len(mine) and all(map(_is_kept, mine["path"]))), None)


def _is_kept(run: str | None) -> bool:
    return run is not None and Path(run).is_dir()


def _over_own(flights: Flights) -> Iterator[dict[str, Any]]:
    """Yield a row for each faulty flight that succeeds, if its golden flight does so too.

    A row has the settings that differ between these flights, and the ratio of the flight times.
    """
    rows = flights.timed.rows(*_SETTING)
    varying = [name for name in _SETTING if len({row[name] for row in rows}) > 1]
    for row, ratio in zip(rows, flights.timed.ratios, strict=True):
        yield {**{name: row[name] for name in varying}, "over_golden": f"{ratio:.4f}"}
