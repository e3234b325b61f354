"""The effect that decides each claim, from a stack's flights or from isolated kernels."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from mavfi_cli.analysis.groups import RESAMPLES
from mavfi_cli.claims.effects import (
    NOTHING,
    Finding,
    Protected,
    compared,
    harm_difference,
    harmful,
    lost_share,
    struck,
    success_lost,
    worst_as_long,
)
from mavfi_cli.claims.flights import EVERY_STAGE, FlownMission, GoldenFlights, where
from mavfi_cli.core.types import Stage
from mavfi_cli.report.tables.paper_table import count_of
from mavfi_cli.stats.bootstrap import interval
from mavfi_cli.stats.effects import (
    as_interval,
    correlation,
    paired_difference,
    rate_difference,
)
from mavfi_cli.stats.shares import Share, wilson

Kernels = Mapping[str, Mapping[str, Any]]  # kernel -> its part of kernels.json
Flights = Sequence[FlownMission]
STAGES = tuple(stage.value for stage in Stage)
FEWEST = 4  # flights for a correlation with an interval

# Isolated kernels -----------------------------------------------------------------------------

_PLANNERS = ("rrt", "rrtconnect", "rrtstar")


def _outcome(kernels: Kernels, name: str, outcome: str) -> Share:
    told = kernels[name]["outcomes"][outcome]
    return wilson(told["count"], told["of"])


def octomap_most_silent(kernels: Kernels) -> Finding:
    """Silent corruption in OctoMap minus that in the worst other kernel."""
    return _beside(kernels, "octomap", "sdc", [each for each in kernels if each != "octomap"], max)


def rrtstar_least_silent(kernels: Kernels) -> Finding:
    """Silent corruption in RRT* minus that in the better other planner."""
    return _beside(kernels, "rrtstar", "sdc", [x for x in _PLANNERS if x != "rrtstar"], min)


def _beside(
    kernels: Kernels, name: str, outcome: str, others: Sequence[str], choose: Callable[..., str]
) -> Finding:
    """The share of an outcome in one kernel minus that in the most extreme of the others."""
    there = [each for each in others if each in kernels]
    if name not in kernels or not there:
        return NOTHING
    extreme = choose(there, key=lambda each: _outcome(kernels, each, outcome).share)
    shares = [_outcome(kernels, each, outcome) for each in (name, extreme)]
    titles = [kernels[each]["title"] for each in (name, extreme)]
    told = ", ".join(
        f"{title} {100 * each.share:.1f} %" for title, each in zip(titles, shares, strict=True)
    )
    return Finding(effect=rate_difference(*shares), told=told)


def least_benign(kernels: Kernels) -> Finding:
    """The least share of benign runs of the kernels other than OctoMap."""
    others = [each for each in kernels if each != "octomap"]
    if not others:
        return NOTHING
    least = min(others, key=lambda each: _outcome(kernels, each, "benign").share)
    share = _outcome(kernels, least, "benign")
    return Finding(
        effect=as_interval(share), told=f"least: {kernels[least]['title']}, {count_of(share)}"
    )


# Faults in kernels and states -----------------------------------------------------------------

_STAGE_OF = {
    "point_cloud": "perception", "octomap": "perception", "collision_check": "perception",
    "planner": "planning", "rrtstar": "planning", "rrt": "planning", "rrtconnect": "planning",
    "control": "control",
}  # fmt: skip


def instruction_faults(flights: Flights) -> list[FlownMission]:
    """Unprotected flights on the host's computer with a fault in an instruction."""
    return struck(where(flights, level="instruction", platform="x86"))


def _by_kernel(flights: Flights) -> dict[str, list[FlownMission]]:
    """Instruction-level faults in `sparse`, by the kernel that they struck."""
    found: dict[str, list[FlownMission]] = {}
    for each in where(instruction_faults(flights), world="sparse"):
        if each.struck_kernel:
            found.setdefault(each.struck_kernel, []).append(each)
    return found


def later_stages_worse(flights: Flights) -> Finding:
    """Harm by faults in planning and control minus harm by faults in perception."""
    kernels = _by_kernel(flights)
    later = [x for k, those in kernels.items() if _STAGE_OF[k] != "perception" for x in those]
    first = [x for k, those in kernels.items() if _STAGE_OF[k] == "perception" for x in those]
    return harm_difference(
        GoldenFlights(flights), later, first, ("planning and control", "perception")
    )


def check_critical(flights: Flights) -> Finding:
    """Harm by faults in the collision check minus harm by faults in the map."""
    kernels = _by_kernel(flights)
    others = kernels.get("point_cloud", []) + kernels.get("octomap", [])
    return harm_difference(
        GoldenFlights(flights), kernels.get("collision_check", []), others,
        ("collision check", "point cloud and OctoMap"),
    )  # fmt: skip


def map_harmless(flights: Flights) -> Finding:
    """Success lost by faults in point cloud and OctoMap."""
    kernels = _by_kernel(flights)
    those = kernels.get("point_cloud", []) + kernels.get("octomap", [])
    return success_lost(GoldenFlights(flights), those) if those else NOTHING


def longest_kernel_flight(ratio: float, missions: int) -> Callable[[Flights], Finding]:
    """The probability of a flight as long as the paper's longest, with a fault in any kernel."""

    def find(flights: Flights) -> Finding:
        those = [each for kernel in _by_kernel(flights).values() for each in kernel]
        return worst_as_long(GoldenFlights(flights), those, ratio, missions)

    return find


def most_lost_kernel(flights: Flights) -> Finding:
    """Success lost by faults in the kernel that loses most."""
    kernels = {k: those for k, those in _by_kernel(flights).items() if those}
    if not kernels:
        return NOTHING
    most = max(kernels, key=lambda each: lost_share(kernels[each]).share)
    found = success_lost(GoldenFlights(flights), kernels[most])
    return Finding(effect=found.effect, told=f"most in {most}: {found.told}")


def _state_faults(flights: Flights, *states: str, **values: Any) -> list[FlownMission]:
    """Source-level faults in states in `sparse`, one bit in each component, of any field."""
    wanted: dict[str, Any] = {"world": "sparse", "fault_field": "any", "fault_bits": 1} | values
    found = struck(where(flights, level="source", platform="x86", fault_target=states, **wanted))
    return [each for each in found if each.together]


def collision_states(flights: Flights) -> Finding:
    """Harm by faults in a report's time minus harm by faults in its number."""
    return harm_difference(
        GoldenFlights(flights),
        _state_faults(flights, "time_to_collision"),
        _state_faults(flights, "future_collision_seq"),
        ("time_to_collision", "future_collision_seq"),
    )


def state_harm(*states: str) -> Callable[[Flights], Finding]:
    """The share of harmful faults in states."""
    return lambda flights: harmful(GoldenFlights(flights), _state_faults(flights, *states))


def fields_that_matter(flights: Flights) -> Finding:
    """Harm by sign and exponent of a position minus harm by its mantissa."""

    def of(*fields: str) -> list[FlownMission]:
        return _state_faults(flights, "waypoint_position", fault_field=fields)

    return harm_difference(
        GoldenFlights(flights),
        of("sign", "exponent"),
        of("mantissa"),
        ("sign and exponent", "mantissa"),
    )


def _bits(flights: Flights, *bits: int) -> list[FlownMission]:
    return _state_faults(flights, "waypoint_acceleration", fault_bits=bits)


def one_bit(flights: Flights) -> Finding:
    """Success lost by one flipped bit in each acceleration."""
    those = _bits(flights, 1)
    return success_lost(GoldenFlights(flights), those) if those else NOTHING


def five_bits(flights: Flights) -> Finding:
    """Lost missions with five flipped bits minus those with one."""
    shares = lost_share(_bits(flights, 5)), lost_share(_bits(flights, 1))
    if not all(each.total for each in shares):
        return NOTHING
    told = f"lost: {count_of(shares[0])} with 5 bits, {count_of(shares[1])} with 1"
    return Finding(effect=rate_difference(*shares), told=told)


# Detection and recovery -------------------------------------------------------------------------


def _stage_faults(flights: Flights) -> list[FlownMission]:
    """Flights of Table IV: golden, or a fault in an instruction of a stage."""
    return [
        each
        for each in where(flights, platform="x86")
        if each.golden or (each.level == "instruction" and each.fault_target in STAGES)
    ]


def success_lost_in(world: str) -> Callable[[Flights], Finding]:
    """Success lost by faults in instructions in a world."""

    def find(flights: Flights) -> Finding:
        those = struck(where(_stage_faults(flights), world=world))
        return success_lost(GoldenFlights(flights), those) if those else NOTHING

    return find


def worst_in(world: str, ratio: float, missions: int) -> Callable[[Flights], Finding]:
    """The probability of a flight as long as the paper's longest in a world."""

    def find(flights: Flights) -> Finding:
        those = struck(where(_stage_faults(flights), world=world))
        return worst_as_long(GoldenFlights(flights), those, ratio, missions)

    return find


def detour(stage: str, ratio: float) -> Callable[[Flights], Finding]:
    """The share of faults in a stage in `dense` whose flight is at least so long."""

    def find(flights: Flights) -> Finding:
        those = struck(where(_stage_faults(flights), world="dense", fault_target=stage))
        ratios = GoldenFlights(flights).ratios(those)
        if not ratios:
            return NOTHING
        share = wilson(sum(each >= ratio for each in ratios), len(ratios))
        return Finding(effect=as_interval(share), told=f"{count_of(share)} as long")

    return find


def recovered_by(detector: str) -> Callable[[Flights], Finding]:
    """The share of lost missions that a detector saves, in all worlds."""
    return lambda flights: Protected.of(_stage_faults(flights), detector).recovered()


def shortened_by(detector: str) -> Callable[[Flights], Finding]:
    """The share of longer flights that a detector brings back, in all worlds."""
    return lambda flights: Protected.of(_stage_faults(flights), detector).shortened()


def autoencoder_better(flights: Flights) -> Finding:
    """Success with the autoencoder minus success with the Gaussian detector."""
    those = _stage_faults(flights)
    test = compared(Protected.of(those, "gad"), Protected.of(those, "aad"))
    if not test.pairs:
        return NOTHING
    told = f"{test.only_second} missions by AAD only, {test.only_first} by GAD only"
    return Finding(effect=paired_difference(test), told=f"{told}, of {test.pairs:,}")


def dense_worse(flights: Flights) -> Finding:
    """Lost missions in `dense` minus those in `farm`."""
    golden = GoldenFlights(flights)
    shares = [
        lost_share(golden.paired(struck(where(_stage_faults(flights), world=world))))
        for world in ("dense", "farm")
    ]
    if not all(each.total for each in shares):
        return NOTHING
    told = f"lost: dense {count_of(shares[0])}, farm {count_of(shares[1])}"
    return Finding(effect=rate_difference(*shares), told=told)


def _undone(flights: Flights, detector: str, *protect: str) -> Share:
    return Protected.of(_stage_faults(flights), detector, "+".join(protect)).undone()


def control_recovers_most(detector: str) -> Callable[[Flights], Finding]:
    """Harm undone by watching control minus that by the better single other stage."""

    def find(flights: Flights) -> Finding:
        shares = {each: _undone(flights, detector, each) for each in STAGES}
        if not all(each.total for each in shares.values()):
            return NOTHING
        other = max(STAGES[:2], key=lambda each: shares[each].share)
        told = ", ".join(f"{name} {count_of(each)}" for name, each in shares.items())
        effect = rate_difference(shares["control"], shares[other])
        return Finding(effect=effect, told=f"harm undone: {told}")

    return find


def all_stages_best(detector: str) -> Callable[[Flights], Finding]:
    """Harm undone by watching all stages minus that by watching control."""

    def find(flights: Flights) -> Finding:
        whole = _undone(flights, detector, *STAGES)
        single = _undone(flights, detector, "control")
        if not (whole.total and single.total):
            return NOTHING
        told = f"harm undone: all stages {count_of(whole)}, control {count_of(single)}"
        return Finding(effect=rate_difference(whole, single), told=told)

    return find


def _platform_faults(flights: Flights, platform: str) -> list[FlownMission]:
    """Flights of Fig. 16: golden, or one bit of any state of a stage."""
    return [
        each
        for each in where(flights, platform=platform, world="sparse")
        if each.golden
        or (each.level == "source" and each.fault_target in STAGES and each.fault_field == "any")
    ]


def worst_on(platform: str, ratio: float, missions: int) -> Callable[[Flights], Finding]:
    """The probability of a flight as long as the paper's longest on a computer."""

    def find(flights: Flights) -> Finding:
        those = _platform_faults(flights, platform)
        return worst_as_long(GoldenFlights(those), struck(those), ratio, missions)

    return find


def shortened_on(platform: str, detector: str) -> Callable[[Flights], Finding]:
    """The share of longer flights that a detector brings back on a computer."""
    return lambda flights: Protected.of(_platform_faults(flights, platform), detector).shortened()


# Costs --------------------------------------------------------------------------------------------


_NO_COSTS = Finding(
    effect=None, told="flown, but this export does not hold these times; a new one does"
)


def overhead_of(detector: str) -> Callable[[Flights], Finding]:
    """The mean share of the flight time that detection and recovery take."""

    def find(flights: Flights) -> Finding:
        shares = [each.overhead for each in _watched(flights, detector)]
        known = [each for each in shares if each is not None]
        if not known:
            return _NO_COSTS if shares else NOTHING
        found = interval(known, resamples=RESAMPLES)
        return Finding(effect=found, told="time of the computer that flew, and simulated recovery")

    return find


def gaussian_dearer(flights: Flights) -> Finding:
    """Overhead of the Gaussian detector minus that of the autoencoder, on the same faults."""
    costs = [
        {(x.pair, x.fault): x.overhead for x in _watched(flights, name) if x.overhead is not None}
        for name in ("gad", "aad")
    ]
    both = sorted(costs[0].keys() & costs[1].keys())
    if not both:
        return _NO_COSTS if _watched(flights, "gad") else NOTHING
    found = interval([costs[0][key] - costs[1][key] for key in both], resamples=RESAMPLES)
    return Finding(effect=found, told="the same faults with either detector")


def _watched(flights: Flights, detector: str) -> list[FlownMission]:
    return struck(where(_stage_faults(flights), protect=EVERY_STAGE), detector=detector)


def energy_follows_time(flights: Flights) -> Finding:
    """Correlation of energy with flight time over successful golden flights in `sparse`."""
    golden = [
        x
        for x in GoldenFlights(where(flights, world="sparse", platform="x86")).flights
        if not x.lost
    ]
    pairs = [
        (each.flight_time_s, each.energy_regression_j)
        for each in golden
        if each.flight_time_s and each.energy_regression_j
    ]
    if len(pairs) < FEWEST:
        return NOTHING
    return Finding(effect=correlation(pairs), told=f"{len(pairs):,} golden flights")


def calibrated(_: Flights) -> Finding:
    """No finding: the model takes this number from the paper."""
    return Finding(
        effect=None, told="our model is calibrated with this number, so it tells nothing"
    )
