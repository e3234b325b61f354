"""Every claim of the paper: its words, the number that decides it, and what the paper's n can tell.

A claim is decided by one number, its effect, and by the range that the claim gives for it. The
range is the direction that the words state. If the words state a size of a rate, it is cut to the
95 % interval that this size has at the paper's number of missions. `stats.effects.judge` does the
rest. The paper's numbers are those of `reproduction/paper.toml`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

from mavfi_cli.claims import effects as measure
from mavfi_cli.claims.effects import Finding, Where
from mavfi_cli.reproduction.flights import EVERY_STAGE, STAGES
from mavfi_cli.reproduction.layouts import WORLDS
from mavfi_cli.reproduction.paper import printed
from mavfi_cli.stats.bootstrap import Interval
from mavfi_cli.stats.effects import (
    Count,
    effect_difference,
    fisher,
    rate_difference,
    recovered_share,
)
from mavfi_cli.stats.shares import wilson

POINTS, PERCENT, NUMBER = "points", "percent", "number"  # units of an effect
_LIKELY = 0.05  # probability from which a longest flight is no surprise
_HARDLY = 0.02  # a loss of success that counts as none
_DETECTORS = {"gad": "Gaussian", "aad": "autoencoder"}
# Which flights a claim is about.
_KERNELS = {"level": "instruction", "platform": "x86", "world": "sparse"}
_MAP, _CHECK = ("point_cloud", "octomap"), "collision_check"
_LATER = ("planner", "rrtstar", "rrt", "rrtconnect", "control")  # kernels after perception
_STATES = {"level": "source", "platform": "x86", "world": "sparse", "fault_bits": 1,
           "fault_field": "any", "together": True}  # fmt: skip
_IN_STAGES = {"level": "instruction", "platform": "x86", "fault_target": STAGES}
_TX2 = {"level": "source", "platform": "tx2", "world": "sparse", "fault_field": "any",
        "fault_target": STAGES}  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Claim:
    """A claim of the paper.

    Attributes:
        name: unique, such as `table4-dense`.
        item: table or figure, by its name in `mavfi reproduce`.
        words: the claim as a sentence.
        paper: its numbers; empty if the paper prints none.
        effect: the number that decides, in words.
        find: the effect of a stack's flights, or of the isolated kernels.
        low, high: the claimed range of the effect.
        unit: POINTS of a rate, PERCENT of a whole, or NUMBER.
        paper_tells: what the paper's own number of missions can tell.
        isolated: whether it is about isolated kernels.
    """

    name: str
    item: str
    words: str
    effect: str
    find: Callable[[Any], Finding]
    paper: str = "no number printed"
    low: float = -math.inf
    high: float = math.inf
    unit: str = POINTS
    paper_tells: str = "drawn only, without counts"
    isolated: bool = False


def _number(item: str, *keys: object) -> float:
    found = printed(item, *keys)
    assert isinstance(found, float), (item, keys)
    return found


def _wins(percent: float, missions: float) -> Count:
    return round(missions * percent / 100.0), round(missions)


def _difference(first: Count, second: Count) -> Interval:
    return rate_difference(wilson(*first), wilson(*second))


def _tells(spread: Interval, unit: str, *counts: Count) -> str:
    low, high = (f"{100 * end:z.0f}" for end in (spread.low, spread.high))
    chance = fisher(counts[0], counts[1])
    told = "p < 0.001" if chance < 0.001 else f"p = {chance:.2g}"
    return f"{low} to {high} {unit}; Fisher's {told}"


# Isolated kernels, and faults in kernels and states ------------------------------------------


def _kernels() -> Iterator[Claim]:
    runs = f"{_number('fig6', 'runs'):,.0f} runs a kernel tell differences from 2 points on"
    yield Claim(
        name="fig6-octomap", item="fig6", isolated=True, low=0.0, paper_tells=runs,
        words="Of all isolated kernels, OctoMap most often returns a wrong result silently.",
        effect="share of silent corruption in OctoMap minus the largest of the other kernels",
        find=partial(measure.outcome_beside, name="octomap", outcome="sdc", choose=max),
    )  # fmt: skip
    yield Claim(
        name="fig6-benign", item="fig6", isolated=True, low=0.25, unit=PERCENT, paper_tells=runs,
        words="Every kernel but OctoMap survives more than a quarter of all faults unchanged.",
        paper="benign in more than 25 %, PID in about 25 %",
        effect="least share of benign runs among the other kernels",
        find=partial(measure.least_benign, but="octomap"),
    )  # fmt: skip
    yield Claim(
        name="fig6-rrtstar", item="fig6", isolated=True, high=0.0, paper_tells=runs,
        words="Of the three planners, RRT* has the least silent corruption.",
        effect="share of silent corruption in RRT* minus the smaller of the other planners",
        find=partial(measure.outcome_beside, name="rrtstar", outcome="sdc", choose=min,
                     others=("rrt", "rrtconnect")),
    )  # fmt: skip


def _kernels_in_flight() -> Iterator[Claim]:
    runs = _number("fig7", "runs")
    worst = _number("fig7", "worst_increase_percent")
    points = _number("fig7", "success_lost_points")
    counts = _wins(100.0, runs), _wins(100.0 - points, runs)
    loss = _difference(*counts)
    yield Claim(
        name="fig7-stages", item="fig7", low=0.0,
        words="In flight, faults in planning and control do more harm than faults in perception.",
        effect="share of harmful faults in planning and control minus that in perception",
        find=partial(measure.harm_difference, groups={
            "planning and control": {**_KERNELS, "struck_kernel": _LATER},
            "perception": {**_KERNELS, "struck_kernel": (*_MAP, _CHECK)},
        }),
    )  # fmt: skip
    yield Claim(
        name="fig7-map", item="fig7", high=_HARDLY,
        words="Faults in point cloud and OctoMap hardly affect the mission.",
        paper="little to negligible",
        effect="success lost by these faults; below 2 points counts as hardly",
        find=partial(measure.success_lost, **_KERNELS, struck_kernel=_MAP),
        paper_tells="if none of 200 is lost, the loss is below 2 points",
    )  # fmt: skip
    yield Claim(
        name="fig7-check", item="fig7", low=0.0,
        words="Within perception, the collision check is the critical kernel.",
        effect="share of harmful faults in the check minus that in point cloud and OctoMap",
        find=partial(measure.harm_difference, groups={
            "collision check": {**_KERNELS, "struck_kernel": _CHECK},
            "point cloud and OctoMap": {**_KERNELS, "struck_kernel": _MAP},
        }),
    )  # fmt: skip
    yield _longest(
        "fig7-time", "fig7", f"A fault in a kernel lengthens the flight by up to {worst:g} %.",
        _KERNELS, 1.0 + worst / 100.0, 7 * runs,
    )  # fmt: skip
    yield Claim(
        name="fig7-success", item="fig7", low=0.0, high=loss.high,
        words=f"Faults in the most critical kernel cost up to {points:g} points of success.",
        paper=f"{points:g} points",
        effect="success lost by faults in the kernel that loses most",
        find=partial(measure.most_lost_kernel, **_KERNELS),
        paper_tells=_tells(loss, "points if no golden flight is lost", *counts),
    )  # fmt: skip
    yield Claim(
        name="fig7-energy", item="fig7", low=0.0, unit=NUMBER,
        words="Flight energy grows with flight time.",
        effect="correlation of the two over golden flights",
        find=partial(measure.energy_follows_time, world="sparse", platform="x86"),
    )  # fmt: skip


def _longest(
    name: str,
    item: str,
    words: str,
    where: Where,
    ratio: float,
    missions: float,
) -> Claim:
    """A claim about the longest flight of so many."""
    told = f"× {ratio:.2f}" if ratio >= 2.0 else f"+{100 * (ratio - 1):.1f} %"  # noqa: RUF001
    return Claim(
        name=name, item=item, words=words, low=_LIKELY, unit=PERCENT,
        paper=f"{told}, the longest of {missions:.0f}",
        effect=f"probability that the longest of {missions:.0f} flights is at least as long, each "
        "over its own golden flight",
        find=partial(measure.worst_as_long, ratio=ratio, missions=round(missions), **where),
        paper_tells="one flight; over which golden flight is not said",
    )  # fmt: skip


def _states() -> Iterator[Claim]:
    yield Claim(
        name="fig8-seq", item="fig8", low=0.0,
        words="future_collision_seq is much more robust than time_to_collision.",
        effect="share of harmful faults in time_to_collision minus that in future_collision_seq",
        find=partial(measure.harm_difference, groups={
            state: {**_STATES, "fault_target": state}
            for state in ("time_to_collision", "future_collision_seq")
        }),
    )  # fmt: skip
    for state, words in (
        ("position", "A corrupted position of a waypoint leads astray or into an obstacle."),
        ("yaw", "A corrupted yaw of a waypoint leads astray or into an obstacle."),
        ("velocity", "A corrupted velocity of a waypoint makes the vehicle lose its trajectory."),
    ):
        yield Claim(
            name=f"fig8-{state}", item="fig8", low=0.0, unit=PERCENT, words=words,
            effect=f"share of harmful faults in the {state}; one is enough",
            find=partial(measure.harmful, **_STATES, fault_target=f"waypoint_{state}"),
        )  # fmt: skip
    position = {**_STATES, "fault_target": "waypoint_position"}
    yield Claim(
        name="fig9-fields", item="fig9", low=0.0,
        words="Flips in sign and exponent do more harm than flips in the mantissa.",
        effect="share of harmful faults in sign and exponent minus that in the mantissa",
        find=partial(measure.harm_difference, groups={
            "sign and exponent": {**position, "fault_field": ("sign", "exponent")},
            "mantissa": {**position, "fault_field": "mantissa"},
        }),
    )  # fmt: skip
    runs = _number("table3", "runs")
    names = {0: "golden", 1: "1 bit", 5: "5 bits"}
    acceleration = {**_STATES, "fault_target": "waypoint_acceleration"}
    for other, bits, words, finder in (
        (
            0,
            1,
            "One flipped bit in each acceleration lowers the success rate.",
            partial(measure.success_lost, **acceleration),
        ),
        (
            1,
            5,
            "Five flipped bits cost only slightly more than one.",
            partial(
                measure.loss_difference,
                first={**acceleration, "fault_bits": 5},
                second=acceleration,
                told="{} with 5 bits, {} with 1",
            ),
        ),
    ):
        success = [_number("table3", "success_percent", each) for each in (other, bits)]
        counts = _wins(success[0], runs), _wins(success[1], runs)
        loss = _difference(*counts)
        yield Claim(
            name=f"table3-{bits}", item="table3", words=words, find=finder,
            low=0.0 if other == 0 else loss.low, high=loss.high,
            paper=f"{names[other]} {success[0]:g} %, {names[bits]} {success[1]:g} %",
            effect=f"success with {names[bits]} below that {'of' if not other else 'with'} "
            f"{names[other]}{' flights' if not other else ''}",
            paper_tells=_tells(loss, "points", *counts),
        )  # fmt: skip


# Detection and recovery ---------------------------------------------------------------------------


def _table4_counts(kind: str, world: str = "") -> Count:
    """Successes and missions of a row of Table IV; of all worlds without one."""
    missions = _number("table4", "golden_runs" if kind == "golden" else "runs")
    worlds = (world,) if world else WORLDS
    each = [_wins(_number("table4", "success_percent", kind, w), missions) for w in worlds]
    return sum(wins for wins, _ in each), sum(of for _, of in each)


def _worlds() -> Iterator[Claim]:
    for world in WORLDS:
        golden, faulty = _table4_counts("golden", world), _table4_counts("none", world)
        loss = _difference(golden, faulty)
        success = [_number("table4", "success_percent", kind, world) for kind in ("golden", "none")]
        yield Claim(
            name=f"table4-{world}", item="table4", low=0.0, high=loss.high,
            words=f"In {world.capitalize()}, faults in instructions lower the success rate.",
            paper=f"{success[0]:g} % to {success[1]:g} %: {success[0] - success[1]:.1f} points",
            effect="success of golden flights minus that of the same missions with a fault",
            find=partial(measure.success_lost, **_IN_STAGES, world=world),
            paper_tells=_tells(loss, "points", golden, faulty),
        )  # fmt: skip
    losses = [
        _difference(_table4_counts("golden", world), _table4_counts("none", world))
        for world in ("dense", "farm")
    ]
    more = effect_difference(*losses)
    yield Claim(
        name="table4-dense-over-farm", item="table4", low=0.0,
        words="Faults cost more missions where obstacles are dense than where there are none.",
        paper=f"{100 * losses[0].value:.1f} points in Dense, {100 * losses[1].value:.1f} in Farm",
        effect="share of lost missions in Dense minus that in Farm, where golden flights succeed",
        find=partial(
            measure.loss_difference, first={"world": "dense"}, second={"world": "farm"},
            told="dense {}, farm {}", **_IN_STAGES, own_lost=False,
        ),
        paper_tells=f"{100 * more.low:z.0f} to {100 * more.high:z.0f} points more",
    )  # fmt: skip


def _recovery() -> Iterator[Claim]:
    golden, faulty = _table4_counts("golden"), _table4_counts("none")
    for detector, best in (("gad", "89.6 %"), ("aad", "100 %")):
        own = recovered_share(golden, faulty, _table4_counts(detector))
        ends = f"{100 * own.low:.0f} to {100 * own.high:.0f} %"
        yield Claim(
            name=f"table4-{detector}", item="table4", low=max(0.0, own.low), unit=PERCENT,
            words=f"The {_DETECTORS[detector]} detector recovers up to {best} of the missions "
            "that faults lose.",
            paper=f"{best} at best, {100 * own.value:.0f} % over all worlds",
            effect="share of lost missions that the detector saves",
            find=partial(measure.recovered, detector=detector, **_IN_STAGES),
            paper_tells=f"{ends} over all worlds; a ratio of differences",
        )  # fmt: skip
    counts = _table4_counts("aad"), _table4_counts("gad")
    gain = _difference(*counts)
    yield Claim(
        name="table4-aad-over-gad", item="table4", low=0.0,
        words="The autoencoder consistently does better than the Gaussian detector.",
        paper=f"{100 * gain.value:.1f} points more success over all worlds",
        effect="success with the autoencoder minus success with the Gaussian, on the same faults",
        find=partial(measure.autoencoder_better, **_IN_STAGES),
        paper_tells=_tells(gain, "points", *counts),
    )  # fmt: skip


def _long_flights() -> Iterator[Claim]:
    runs = _number("fig12", "runs")
    for world in WORLDS:
        worst = _number("fig12", "worst_increase_percent", world)
        yield _longest(
            f"fig12-{world}", "fig12",
            f"In {world.capitalize()}, the longest flight with a fault takes {worst:g} % longer.",
            {**_IN_STAGES, "world": world},
            1.0 + worst / 100.0, runs,
        )  # fmt: skip
    for detector, name in _DETECTORS.items():
        points = [_number("fig12", "recovered_points", detector, world) for world in WORLDS]
        yield Claim(
            name=f"fig12-{detector}", item="fig12", low=0.5, unit=PERCENT,
            words=f"The {name} detector recovers most of the long flights.",
            paper=f"{min(points):.1f} to {max(points):.1f} points of the longest",
            effect="share of flights over 5 % longer than golden that it brings back within 5 %",
            find=partial(measure.shortened, detector=detector, **_IN_STAGES),
            paper_tells="differences of single longest flights",
        )  # fmt: skip
    for stage in ("perception", "planning"):
        longer = _number("fig13", "increase_percent", stage)
        yield Claim(
            name=f"fig13-{stage}", item="fig13", low=0.0, unit=PERCENT,
            words=f"In Dense, a fault in {stage} can cause a detour of {longer:g} % more time.",
            paper=f"+{longer:g} %, one flight",
            effect=f"share of faults in {stage} whose flight is at least as long; one is enough",
            find=partial(measure.as_long, ratio=1.0 + longer / 100.0,
                         **{**_IN_STAGES, "fault_target": stage, "world": "dense"}),
            paper_tells="one chosen flight",
        )  # fmt: skip


def _stages() -> Iterator[Claim]:
    for detector, name in _DETECTORS.items():
        told = {
            stages: _number("fig14", "recovered_percent", detector, "factory", stages)
            for stages in (*STAGES, EVERY_STAGE)
        }
        single = ", ".join(f"{told[stage]:g}" for stage in STAGES)
        yield Claim(
            name=f"fig14-control-{detector}", item="fig14", low=0.0,
            words=f"Of single stages, watching control recovers most ({name}).",
            paper=f"Factory: {single} % of the longest",
            effect="share of harm undone by watching control minus the better of the others",
            find=partial(measure.control_recovers_most, detector=detector, **_IN_STAGES),
            paper_tells="differences of single longest flights",
        )  # fmt: skip
        yield Claim(
            name=f"fig14-all-{detector}", item="fig14", low=0.0,
            words=f"Watching all stages recovers more than watching control alone ({name}).",
            paper=f"Factory: {told[EVERY_STAGE]:g} % against {told['control']:g} %",
            effect="share of harm undone by watching all stages minus that by watching control",
            find=partial(measure.all_stages_best, detector=detector, **_IN_STAGES),
            paper_tells="differences of single longest flights",
        )  # fmt: skip


def _costs() -> Iterator[Claim]:
    for detector, name in _DETECTORS.items():
        sums = [_number("table5", "sum", detector, world) for world in WORLDS]
        yield Claim(
            name=f"table5-{detector}", item="table5", high=max(sums) / 100.0, unit=PERCENT,
            words=f"Detection and recovery with the {name} detector take at most {max(sums):g} % "
            "of the flight time.",
            paper=f"{min(sums):g} to {max(sums):g} %",
            effect="mean share of the flight time, all worlds",
            find=partial(measure.overhead_of, detector=detector, **_IN_STAGES),
            paper_tells="printed without spread",
        )  # fmt: skip
    yield Claim(
        name="table5-gad-over-aad", item="table5", low=0.0, unit=PERCENT,
        words="The Gaussian detector costs far more than the autoencoder, because it recomputes "
        "perception and planning.",
        paper="2 % against 0.005 %",
        effect="cost of the Gaussian detector minus that of the autoencoder, on the same faults",
        find=partial(measure.gaussian_dearer, **_IN_STAGES),
        paper_tells="printed without spread",
    )  # fmt: skip
    ratios = [_number("fig15", "time_ratio", "tmr", vehicle) for vehicle in ("airsim", "spark")]
    yield Claim(
        name="fig15-tmr", item="fig15", low=0.0, unit=PERCENT,
        words=f"Triple redundancy makes the flight {ratios[0]:g} times as long on the AirSim UAV, "
        f"and {ratios[1]:g} times on the DJI Spark.",
        paper=f"{ratios[0]:g} and {ratios[1]:g} times",
        effect="nothing here (mavfi vpm --fly flies it)",
        find=measure.calibrated,
        paper_tells="a model, not flown",
    )  # fmt: skip
    worst = _number("fig16", "worst_ratio", "tx2")
    yield _longest(
        "fig16-worst", "fig16",
        f"On the TX2, the longest flight with a fault takes {worst:g} times as long.",
        _TX2, worst, 300,
    )  # fmt: skip
    for detector, name in _DETECTORS.items():
        share = _number("fig16", "recovered_percent", detector, "tx2")
        yield Claim(
            name=f"fig16-{detector}", item="fig16", low=0.5, unit=PERCENT,
            words=f"On the TX2, too, the {name} detector recovers most of the long flights.",
            paper=f"{share:g} % of the longest",
            effect="share of flights over 5 % longer than golden that it brings back within 5 %",
            find=partial(measure.shortened, detector=detector, **_TX2),
            paper_tells="differences of single longest flights",
        )  # fmt: skip


CLAIMS: tuple[Claim, ...] = (
    *_kernels(), *_kernels_in_flight(), *_states(), *_worlds(), *_recovery(), *_long_flights(),
    *_stages(), *_costs(),
)  # fmt: skip
