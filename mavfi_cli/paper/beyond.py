"""What the paper does not ask of its flights.

From the kernel to the mission, where a bit hurts, failures an hour, and what each mechanism saves.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from mavfi_cli.analysis.pairs import Flights
from mavfi_cli.campaigns.missions import canonical
from mavfi_cli.core.config import read_toml
from mavfi_cli.core.types import BY_NAME, DType
from mavfi_cli.stats.paired import McNemar, holm
from mavfi_cli.stats.shares import Share, cross_layer, wilson

Row = Mapping[str, Any]  # one flight

# What a struck kernel did, as far as the flight shows it. After `same flight`, the fault was read,
# and every measure of the flight is that of the golden one.
FATES = ("never read", "same flight", "changed flight", "crashed", "hung")
_UNREAD, _SAME, _CHANGED, _CRASH, _HANG = FATES
_MEASURES = (
    "outcome", "flight_time_s", "distance_m", "min_clearance_m", "goal_distance_m",
    "energy_regression_j", "energy_propeller_j", "replans",
)  # fmt: skip


def kernel_flows(flights: Flights, alone: Mapping[str, tuple[int, int]]) -> list[dict[str, Any]]:
    """The flow from kernel to mission, a row for each kernel that instruction-level faults struck.

    A row has the kernel, the lost missions among those of each fate, the lost and the harmed of
    all, the share of silent corruption of the isolated kernel, and the probability that a mission
    is lost given such corruption, with the ends of its interval. The last two are None where they
    are not known.

    Args:
        alone: silent corruptions and faults of each isolated kernel.
    """
    own = {row["pair"]: row for row in flights.golden.rows("pair", *_MEASURES)}
    hit = flights.struck(level="instruction", own_lost=False).by("struck_kernel")
    kernels = {name: those for (name,), those in hit.items() if name}
    return [
        _flow(name, kernels[name], own, alone.get(name))
        for name in sorted(kernels, key=lambda each: (_ORDER.get(each, 9), each))
    ]


_ORDER = {"point_cloud": 0, "octomap": 1, "collision_check": 2, "rrtstar": 3, "control": 8}


def _flow(
    name: str, flights: Flights, own: Mapping[str, Row], alone: tuple[int, int] | None
) -> dict[str, Any]:
    of_fate = flights.grouped(_fate_of(each, own[each["pair"]]) for each in flights.rows())
    fates = {fate: of_fate[fate].share() if fate in of_fate else wilson(0, 0) for fate in FATES}
    lived = fates[_SAME].count + fates[_CHANGED].count
    layers = None if alone is None else cross_layer(*alone, lived, len(flights))
    return {
        "kernel": name,
        "fates": fates,
        "lost": flights.share(),
        "harmed": flights.share("harmed"),
        "silent": layers and layers.corruption,
        "given_silent": layers and layers.failure_given_corruption,
    }


def _fate_of(flight: Row, own: Row) -> str:
    """What a kernel did after an instruction-level fault struck it.

    Missions repeat to the byte, so a flight that differs from its golden one does so by the fault.
    """
    ended = set((flight["node_ended"] or "").split(";")) - {""}
    if ended:
        return _HANG if ended == {"hang"} else _CRASH
    if any(own[name] != flight[name] for name in _MEASURES):
        return _CHANGED
    return _SAME if flight["activation"] == "read" else _UNREAD


# State by bit by phase of flight ------------------------------------------------------------------

_BITS = {  # lowest bit of each class, highest class first
    DType.FLOAT64: (("bit 63, sign", 63), ("exponent 62 to 57", 57), ("exponent 56 to 52", 52),
                    ("mantissa 51 to 26", 26), ("mantissa 25 to 0", 0)),
    DType.INT32: (("bit 31, sign", 31), ("bits 30 to 16", 16), ("bits 15 to 8", 8),
                  ("bits 7 to 0", 0)),
    DType.BOOL: (("flag", 0),),
}  # fmt: skip
BIT_CLASSES = tuple(tuple(name for name, _ in kinds) for kinds in _BITS.values())


def state_map(flights: Flights) -> dict[tuple[str, str, str], dict[str, Share]]:
    """The harmed and the lost missions by state, class of bits and phase.

    It counts source-level faults without a detector whose golden flights succeed.

    A fault in several components is told by its group, and by the highest bit that it flips.
    """
    hit = flights.struck(level="source", own_lost=False)
    hit = hit.where([bool(x["struck_state"] and any(x["struck_bits"] or ())) for x in hit.rows()])
    places = ((_state(x), _class(x), x["strike_phase"] or "") for x in hit.rows())
    return {
        place: {"harmed": those.share("harmed"), "lost": those.share()}
        for place, those in sorted(hit.grouped(places).items())
    }


def _state(flight: Row) -> str:
    states = str(flight["struck_state"]).split(";")
    return states[0] if len(states) == 1 else str(flight["fault_target"])


def _class(flight: Row) -> str:
    name = str(flight["struck_state"]).split(";")[0]
    highest = max(bit for bits in flight["struck_bits"] for bit in bits)
    kinds = _BITS[BY_NAME[name].dtype if name in BY_NAME else DType.FLOAT64]
    return next(each for each, lowest in kinds if highest >= lowest)


# Failures a flight hour ---------------------------------------------------------------------------


def hourly_failures(flights: Flights, upsets_per_hour: float) -> Iterator[dict[str, Any]]:
    """Failures of missions a flight hour, a row for each kind of fault in one world.

    A row says where a fault strikes, and for each detector the share of faults that lose a mission
    whose golden flight succeeds, and the rate: point, low and high. The empty name is no detector.

    Args:
        upsets_per_hour: bit flips that reach the injection sites in an hour of flight.
    """
    hit = flights.comparable.chosen(struck=True, own_lost=False)
    for place, those in sorted(hit.grouped(map(_kind, hit.rows())).items()):
        lost = dict(
            sorted((name or "", each.share()) for (name,), each in those.by("detector").items())
        )
        hourly = {name: each.per_hour(upsets_per_hour) for name, each in lost.items()}
        yield {"where": place, "lost": lost, "per_hour": hourly}


_COMPONENTS = Counter(state.group for state in BY_NAME.values())


def _kind(flight: Row) -> str:
    """What is struck, how unless it is one bit of any field, and where it flies."""
    level = "instruction" if flight["level"] == "instruction" else "state"
    components = _COMPONENTS[str(flight["fault_target"]).rpartition(".")[2]]
    how = [
        None if flight["fault_field"] == "any" else flight["fault_field"],
        None if flight["fault_bits"] == 1 else f"{flight['fault_bits']} bits",
        "all components" if flight["together"] and components > 1 else None,
    ]
    computer = None if flight["platform"] == "x86" else flight["platform"]
    parts = (flight["fault_target"], *how, flight["world"], computer)
    return f"{level}: {', '.join(part for part in parts if part)}"


# What each mechanism saves ------------------------------------------------------------------------

# An arm is a stack with or without a detector. Its faults are those that the arm without protection
# has read, so all arms are counted on the same faults in the same scenes.
_BASE = "mavbench"
_WORDS, _ = read_toml(Path(__file__).parent / "arms.toml")
PLAIN = _WORDS["stacks"][""]


def arms(flights: Flights) -> list[dict[str, Any]]:
    """The arms of a campaign, the unprotected one first; none unless it flew several stacks.

    A row has the arm's name, its lost golden flights, its lost missions of each injection site and
    of all, and the p-value of McNemar's exact test against the unprotected arm, None of that arm
    itself, also as corrected by Holm over all arms.
    """
    if len(set(flights["stack"])) < 2:
        return []
    golden: dict[str, list[Row]] = {}
    trials: dict[str, dict[str, Row]] = {}
    for flight in flights.rows(*_READ):
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
    tests = {name: McNemar.of(won[PLAIN], won[name]).p_value for name in order if name != PLAIN}
    corrected = dict(zip(tests, holm([*tests.values()]), strict=True))
    return [
        {
            "name": name,
            "golden": _lost(golden.get(name, [])),
            "by_site": _by_site(those),
            "lost": _lost(those),
            "p_value": tests.get(name),
            "corrected_p": corrected.get(name),
        }
        for name, those in kept.items()
    ]


_READ = ("stack", "detector", "level", "fault", "fault_target", "activation", "lost", "changes")


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
