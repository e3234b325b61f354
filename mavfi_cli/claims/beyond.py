"""What the paper does not ask: from kernel to mission, where a bit hurts, failures an hour."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum

from mavfi_cli.claims.effects import harm_share, lost_share, struck
from mavfi_cli.claims.flights import FlownMission, GoldenFlights, comparable, where
from mavfi_cli.core.states import BY_NAME, DType
from mavfi_cli.stats.shares import Share, cross_layer, failures_per_hour


class Fate(Enum):
    """What a struck kernel did, as far as the flight shows it."""

    UNREAD = "never read"
    SAME = "same flight"  # it was read, and every measure of the flight is that of the golden one
    CHANGED = "changed flight"
    CRASH = "crashed"
    HANG = "hung"


_MEASURES = (
    "outcome", "flight_time_s", "distance_m", "min_clearance_m", "goal_distance_m",
    "energy_regression_j", "energy_propeller_j", "replans",
)  # fmt: skip


def _fate_of(golden: GoldenFlights, flight: FlownMission) -> Fate:
    """What a kernel did after an instruction-level fault struck it.

    Missions repeat to the byte, so a flight that differs from its golden one does so by the fault.
    """
    ended = set((flight.node_ended or "").split(";")) - {""}
    if ended:
        return Fate.HANG if ended == {"hang"} else Fate.CRASH
    own = golden.of(flight)
    changed = own is not None and any(
        getattr(own, name) != getattr(flight, name) for name in _MEASURES
    )
    if changed:
        return Fate.CHANGED
    return Fate.SAME if flight.activation == "read" else Fate.UNREAD


@dataclass(frozen=True, slots=True, kw_only=True)
class _KernelFlow:
    """Faults in one kernel: what it did, and what became of the missions.

    Attributes:
        fates: lost missions among those of each fate.
        lost, harmed: of all.
        silent: share of silent corruption of the isolated kernel; None without its runs.
        given_silent: probability that a mission is lost given silent corruption of the kernel, with
            the ends of its interval; None where it cannot be told.
    """

    kernel: str
    fates: Mapping[Fate, Share]
    lost: Share
    harmed: Share
    silent: Share | None = None
    given_silent: tuple[float, float, float] | None = None


def kernel_flows(
    flights: Sequence[FlownMission], alone: Mapping[str, tuple[int, int]]
) -> list[_KernelFlow]:
    """The flow from kernel to mission, for each kernel that instruction-level faults struck.

    Args:
        alone: silent corruptions and faults of each isolated kernel.
    """
    golden = GoldenFlights(flights)
    kernels: dict[str, list[FlownMission]] = {}
    for each in golden.paired(struck(flights)):
        if each.level == "instruction" and each.struck_kernel:
            kernels.setdefault(each.struck_kernel, []).append(each)
    return [
        _flow(name, kernels[name], golden, alone.get(name))
        for name in sorted(kernels, key=lambda each: (_ORDER.get(each, 9), each))
    ]


_ORDER = {"point_cloud": 0, "octomap": 1, "collision_check": 2, "rrtstar": 3, "control": 8}


def _flow(
    name: str, flights: Sequence[FlownMission], golden: GoldenFlights, alone: tuple[int, int] | None
) -> _KernelFlow:
    by_fate: dict[Fate, list[FlownMission]] = {fate: [] for fate in Fate}
    for each in flights:
        by_fate[_fate_of(golden, each)].append(each)
    lived = sum(each.lost for fate in (Fate.SAME, Fate.CHANGED) for each in by_fate[fate])
    layers = None if alone is None else cross_layer(*alone, lived, len(flights))
    return _KernelFlow(
        kernel=name,
        fates={fate: lost_share(those) for fate, those in by_fate.items()},
        lost=lost_share(flights),
        harmed=harm_share(golden, flights),
        silent=None if layers is None else Share(**layers["corruption"]),
        given_silent=None if layers is None else layers["failure_given_corruption"],
    )


# State by bit by phase of flight ------------------------------------------------------------------

_BITS = {  # lowest bit of each class, highest class first
    DType.FLOAT64: (("bit 63, sign", 63), ("exponent 62 to 57", 57), ("exponent 56 to 52", 52),
                    ("mantissa 51 to 26", 26), ("mantissa 25 to 0", 0)),
    DType.INT32: (("bit 31, sign", 31), ("bits 30 to 16", 16), ("bits 15 to 8", 8),
                  ("bits 7 to 0", 0)),
    DType.BOOL: (("flag", 0),),
}  # fmt: skip
BIT_CLASSES = tuple(tuple(name for name, _ in kinds) for kinds in _BITS.values())


@dataclass(frozen=True, slots=True, kw_only=True)
class StateCell:
    """Harmful faults in one class of bits of a state, in one phase of flight."""

    state: str
    bits: str
    phase: str
    harmed: Share
    lost: Share


def state_map(flights: Sequence[FlownMission]) -> list[StateCell]:
    """The map, for source-level faults without a detector whose golden flights succeed.

    A fault in several components is told by its group, and by the highest bit that it flips.
    """
    golden = GoldenFlights(flights)
    cells: dict[tuple[str, str, str], list[FlownMission]] = {}
    for each in golden.paired(struck(flights)):
        if each.level == "source" and each.struck_state and each.struck_bits:
            place = (_state(each), _class(each), each.strike_phase or "")
            cells.setdefault(place, []).append(each)
    return [
        StateCell(
            state=state, bits=bits, phase=phase, harmed=harm_share(golden, those),
            lost=lost_share(those),
        )
        for (state, bits, phase), those in sorted(cells.items())
    ]  # fmt: skip


def _state(flight: FlownMission) -> str:
    states = str(flight.struck_state).split(";")
    return states[0] if len(states) == 1 else str(flight.fault_target)


def _class(flight: FlownMission) -> str:
    name = str(flight.struck_state).split(";")[0]
    bits = max(map(int, str(flight.struck_bits).replace(";", " ").split()))
    kinds = _BITS[BY_NAME[name].dtype if name in BY_NAME else DType.FLOAT64]
    return next(each for each, lowest in kinds if bits >= lowest)


# Failures a flight hour ---------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class _HourlyFailures:
    """Failures of missions a flight hour, for one kind of fault in one world.

    Attributes:
        where: what is struck, how, and in which world.
        lost: share of faults that lose a mission whose golden flight succeeds, by detector; the
            empty name is no detector.
        per_hour: point, low and high, by detector.
    """

    where: str
    lost: Mapping[str, Share]
    per_hour: Mapping[str, tuple[float, float, float]]


def hourly_failures(
    flights: Sequence[FlownMission], upsets_per_hour: float
) -> list[_HourlyFailures]:
    """Failures an hour of every kind of fault, by world and detector.

    Args:
        upsets_per_hour: bit flips that reach the injection sites in an hour of flight.
    """
    golden = GoldenFlights(flights)
    kinds: dict[str, dict[str, list[FlownMission]]] = {}
    for each in golden.paired(where(comparable(flights), struck=True)):
        kinds.setdefault(_kind(each), {}).setdefault(each.detector or "", []).append(each)
    found = []
    for place, by_detector in sorted(kinds.items()):
        lost = {name: lost_share(those) for name, those in sorted(by_detector.items())}
        hourly = {name: failures_per_hour(upsets_per_hour, each) for name, each in lost.items()}
        found.append(_HourlyFailures(where=place, lost=lost, per_hour=hourly))
    return found


_COMPONENTS = Counter(state.group for state in BY_NAME.values())


def _kind(flight: FlownMission) -> str:
    """What is struck, how unless it is one bit of any field, and where it flies."""
    level = "instruction" if flight.level == "instruction" else "state"
    components = _COMPONENTS[str(flight.fault_target).rpartition(".")[2]]
    how = [
        None if flight.fault_field == "any" else flight.fault_field,
        None if flight.fault_bits == 1 else f"{flight.fault_bits} bits",
        "all components" if flight.together and components > 1 else None,
    ]
    computer = None if flight.platform == "x86" else flight.platform
    parts = (flight.fault_target, *how, flight.world, computer)
    return f"{level}: {', '.join(part for part in parts if part)}"
