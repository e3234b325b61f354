"""The quality of a flight, and the sections and measures of its result.json.

Only this module reads a result.json. Every measure is a column of a table of flights. A mission
that crashed or hung before it could write its record has few fields; measures of missing fields are
None. If a source-level fault struck several components, the measures join their values by ";" in a
common order, and `struck_bits` has a list of bits for every component. Of several strikes the
measures describe the first.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from mavfi_cli.core.frames import norm
from mavfi_cli.core.types import KERNELS, FloatArray, Outcome, Stage
from mavfi_cli.fi import bits

Record = Mapping[str, Any]  # a result.json, or a section of it
QUALITY = (
    "flight_time_s", "distance_m", "mean_speed_mps", "max_speed_mps", "min_clearance_m",
    "goal_distance_m",  # at the end of the mission
    "energy_regression_j",  # MAVBench's regression, see docs/reference/records.md
    "energy_propeller_j",  # from JSBSim's propeller shaft power, all rotors
)  # fmt: skip


def quality_of(
    log: Mapping[str, FloatArray], start_s: float, end_s: float, goal_enu_m: FloatArray
) -> dict[str, float | None]:
    """Compute QUALITY, the quality of flight (QoF): time, distance, energy and clearance.

    Flight time runs from the companion's take-over at take-off height to the end of the mission, as
    in the paper (section IV), where take-off precedes the measurement. Unknown values are None.

    Args:
        log: Columns with one row per control tick, as in `sitl.referee`. A foreign autopilot has
            no referee, so its log has only stamp, position and velocity.
        start_s, end_s: Stamps of the companion's take-over and of the end.
        goal_enu_m: Goal (3,), m.
    """
    inside = (log["stamp_s"] >= start_s - 1e-9) & (log["stamp_s"] <= end_s + 1e-9)
    flown = {name: column[inside] for name, column in log.items()}
    stamps, positions = flown["stamp_s"], flown["position_enu_m"]
    if len(stamps) < 2:
        return dict.fromkeys(QUALITY)
    distance_m = float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())
    flight_time_s = float(stamps[-1] - stamps[0])
    quality = {
        "flight_time_s": flight_time_s,
        "distance_m": distance_m,
        "mean_speed_mps": distance_m / flight_time_s,
        "max_speed_mps": float(np.linalg.norm(flown["velocity_enu_mps"], axis=1).max()),
        "goal_distance_m": norm(positions[-1] - goal_enu_m),
    }
    if "clearance_m" in flown:
        quality["min_clearance_m"] = float(flown["clearance_m"].min())
        for kind in ("regression", "propeller"):
            energy_j = np.trapezoid(flown[f"power_{kind}_w"], stamps)
            quality[f"energy_{kind}_j"] = float(energy_j)
    # Without obstacles the clearance is infinite; what the referee could not measure is NaN.
    return {
        name: quality[name] if np.isfinite(quality.get(name, np.nan)) else None for name in QUALITY
    }


# Sections -----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightRecord:
    """The sections of a result.json. A missing section is empty, and a missing value is None.

    A mission that crashed or hung before it could write its record lacks most of them.
    """

    outcome: str = ""
    reason: str = ""
    simulated_s: float | None = None
    goal_enu_m: Sequence[float] | None = None
    config: Record = field(default_factory=dict)
    quality_of_flight: Record = field(default_factory=dict)
    pilot: Record = field(default_factory=dict)
    events: Sequence[dict[str, Any]] = ()
    plans: Sequence[Record] = ()
    plan_failures: Mapping[str, int] = field(default_factory=dict)  # by reason; if any failed
    fault: Record = field(default_factory=dict)
    detection: Record = field(default_factory=dict)
    nodes: Record = field(default_factory=dict)
    programs: Record = field(default_factory=dict)  # of a user's companion
    kernels: Record = field(default_factory=dict)
    response_time_s: Record = field(default_factory=dict)
    measured_platform: Record = field(default_factory=dict)
    world: Record = field(default_factory=dict)
    referee: Record | None = field(default_factory=dict)  # None: the vehicle left no truth
    seeds: Mapping[str, int | None] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    files: Mapping[str, str] = field(default_factory=dict)  # SHA-256 of the user's files
    host: Record = field(default_factory=dict)

    @property
    def succeeded(self) -> bool:
        """True if the vehicle reached the goal."""
        return self.outcome == Outcome.SUCCESS.value

    @property
    def interrupted(self) -> bool:
        """True if the user interrupted the flight, so that the mission has no outcome."""
        return self.outcome == Outcome.INTERRUPTED.value

    @property
    def golden(self) -> bool:
        """True if the flight has neither a fault nor a detector."""
        return not (self.fault or self.detection)


_SECTIONS = frozenset(section.name for section in fields(FlightRecord))


def record_of(result: Record) -> FlightRecord:
    """Read the sections of a result.json."""
    known = {name: result[name] for name in _SECTIONS & result.keys()}
    return FlightRecord(
        **{name: value for name, value in known.items() if value is not None or name == "referee"}
    )


# Measures -----------------------------------------------------------------------------------------

_PLACES = {
    **{name: ("quality_of_flight", name) for name in QUALITY},
    "replans": ("pilot", "replans"),
    "simulated_s": ("simulated_s",),
    "response_median_s": ("response_time_s", "median"),
    "response_p95_s": ("response_time_s", "p95"),
    "alarm_count": ("detection", "alarm_count"),
    "hover_shaft_w": ("referee", "physics", "hover_shaft_w"),
}


def measures_of(record: Record) -> dict[str, Any]:
    """Return all measures of a mission.

    They are the fields of the record; `straight_m`, the distance from the take-off point to the
    edge of the goal's tolerance; `crashed`, whether a node died; `struck_s`, `struck_sites` and
    `first_bits`, the time and place of the fault; `alarms`, the listed alarms, oldest first;
    `episodes`, the number of runs of consecutive alarms; and STRUCK.
    """
    nodes, detection, fault = (record.get(name) or {} for name in ("nodes", "detection", "fault"))
    hit = _instruction(fault, nodes) if fault.get("level") == "instruction" else _source(fault)
    return {
        **fields_of(record),
        "straight_m": _straight_m(record),
        "crashed": any(node.get("crashes") for node in nodes.values()),
        "alarms": [
            {"stamp_s": alarm["stamp_s"], "stage": alarm["stage"]}
            for alarm in detection.get("alarms", ())
        ],
        "episodes": sum(recovery["count"] for recovery in detection.get("recoveries", {}).values()),
        "struck_s": hit.get("struck_s"),
        "struck_sites": hit["struck_sites"],
        "first_bits": hit.get("first_bits", []),
        **{name: hit.get(name) for name in STRUCK},
    }


def fields_of(record: Record) -> dict[str, Any]:
    """Return the measures that are fields of a record."""
    return {name: _at(record, *place) for name, place in _PLACES.items()}


def _at(record: Record, *place: str) -> Any:
    """Return a field of a field; None if either is missing."""
    value: Any = record
    for name in place:
        value = (value or {}).get(name)
    return value


def _straight_m(record: Record) -> float | None:
    config, start, goal = record.get("config"), _at(record, "world", "start"), "goal_enu_m"
    if not config or start is None or record.get(goal) is None:
        return None
    east, north, up = start
    takeoff = (east, north, up + config["takeoff_height_m"])
    return math.dist(takeoff, record[goal]) - float(config["goal_tolerance_m"])


# What a fault did -----------------------------------------------------------------------------

STRUCK = (
    "strikes", "strike_s", "strike_invocation", "struck_bits", "struck_before_hex",
    "struck_after_hex", "activation",
    # at source level
    "strike_phase", "strike_tick", "struck_state", "struck_index", "struck_before",
    "struck_after", "first_reader", "first_read_state", "first_read_s",
    # at instruction level
    "struck_node", "struck_kernel", "struck_function", "struck_address", "struck_instruction",
    "struck_execution", "struck_role", "struck_register", "reading_instruction", "node_ended",
)  # fmt: skip
_FLOATS = {len("0x") + 16: "float64", len("0x") + 8: "float32"}  # by the digits of their bits


def _source(fault: Record) -> dict[str, Any]:
    drawn = {"strikes": fault.get("strike_count"), "struck_sites": list(fault.get("states", ()))}
    strikes: Sequence[Record] = fault.get("strikes") or ()
    if not strikes:
        return drawn
    first = strikes[0]
    changes: Sequence[Record] = first["changes"]  # none where a process was killed
    reader: Record = _at(fault, "activation", "first_reader") or {}
    return {
        **drawn,
        "struck_s": first["stamp_s"] if fault.get("state") == "applied" else None,
        "first_bits": list(changes[0]["bits"]) if changes else [],
        "strike_s": first["stamp_s"],
        **{f"strike_{name}": first[name] for name in ("phase", "tick", "invocation")},
        **{
            f"struck_{name}": _joined(change[name] for change in changes)
            for name in ("state", "index", "before_hex", "after_hex")
        },
        **{
            f"struck_{when}": _joined(_value(change, when) for change in changes)
            for when in ("before", "after")
        },
        "struck_bits": [list(change["bits"]) for change in changes],
        "activation": _at(fault, "activation", "activation"),
        "first_reader": reader.get("name"),
        "first_read_state": reader.get("state"),
        "first_read_s": reader.get("stamp_s"),
    }


def _instruction(fault: Record, nodes: Record) -> dict[str, Any]:
    corruption: Record = fault.get("corruption") or {}
    injection: Record = fault.get("injection") or {}
    drawn = {
        "struck_s": fault.get("stamp_s") if fault.get("state") == "applied" else None,
        "struck_sites": [fault["node"]] if "node" in fault else [],
        "first_bits": list(corruption.get("bits", ())),
        "struck_node": fault.get("node"),
        "struck_kernel": fault.get("kernel"),
        "struck_function": fault.get("symbol"),
        "struck_address": f"{fault['object']}+{fault['offset']:#x}" if "object" in fault else None,
        "struck_instruction": fault.get("instruction"),
        "struck_execution": fault.get("k"),
        "struck_role": corruption.get("role"),
        "struck_register": corruption.get("register") or corruption.get("site"),
        "struck_bits": [list(corruption["bits"])] if corruption else None,
        "strike_invocation": fault.get("invocation"),
        "strikes": int(injection["applied"])
        if injection
        else None,  # unknown, because the record was cut off
    }
    if not injection.get("applied"):
        return drawn
    node: Record = nodes.get(fault.get("node", "")) or {}
    ends = [crash["how"] for crash in node.get("crashes", ())] + ["hang"] * node.get("hangs", 0)
    return {
        **drawn,
        "strike_s": fault.get("stamp_s"),
        "struck_before_hex": injection["before"],
        "struck_after_hex": injection["after"],
        "activation": _at(fault, "activation", "activation"),
        "reading_instruction": _at(fault, "activation", "instruction") or None,
        "node_ended": ";".join(ends) or None,
    }


def _joined(values: Iterable[Any]) -> str:
    return ";".join(map(str, values))


def _value(change: Record, when: str) -> Any:
    """Return a value, with infinities and NaN, which JSON lacks, restored from bits."""
    value, pattern = change[when], change[f"{when}_hex"]
    if value is not None:
        return value
    return bits.NUMPY_TYPES[_FLOATS[len(pattern)]].value(int(pattern, 16))


# Cost of detection and recovery -------------------------------------------------------------------

# Kernels that are recomputed after an alarm of a stage, from first to last.
RECOMPUTED = {
    Stage.PERCEPTION.value: ("point_cloud", "octomap", "collision_check"),
    Stage.PLANNING.value: ("planner",),
    Stage.CONTROL.value: ("control",),
}
# Note for every comparison of checks with simulated time, as no factor between hosts is known.
HOST_CHECKS = "checks take the time of the host that flew, not scaled to the platform"
_AGAIN = ("recompute", "hold")  # responses to an alarm that cause a recomputation


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectionCost:
    """Cost of a detector in one flight.

    The cost is "the total detection and recomputation time for each mission" (paper, Table V).
    Checks are measured in host time; recomputations in simulated time, by their latency on the
    flight's platform.

    Attributes:
        flight_s: Flight time, or simulated time of the whole mission if the former is unknown, s.
        recomputations: Number of recomputations per stage. The record lists the first alarms and
            only counts the others, which are distributed over the stages in the same ratio.
            Numbers may therefore be fractions.
        recovery_s: Simulated time of the recomputations per stage at the mean latency of the
            stage's kernels in this flight, s.
    """

    detector: str
    checks: int
    checks_host_s: float
    flight_s: float
    recomputations: Mapping[str, float]
    recovery_s: Mapping[str, float]
    compute_s: float
    host_compute_s: float
    platform: str
    faulty: bool

    @property
    def check_host_s(self) -> float:
        """Mean host time of a check, s."""
        return self.checks_host_s / self.checks

    @property
    def detection_share(self) -> float:
        """Ratio of the checks' host time to the flight time."""
        return self.checks_host_s / self.flight_s

    @property
    def recovered_s(self) -> float:
        """Simulated time of all recomputations, s."""
        return math.fsum(self.recovery_s.values())

    @property
    def recovery_share(self) -> float:
        """Ratio of the recomputations' simulated time to the flight time."""
        return self.recovered_s / self.flight_s

    @classmethod
    def of(cls, result: Record) -> DetectionCost | None:
        """Compute the cost of detection and recovery in a flight.

        Returns:
            Cost; None without a detector or without any check.
        """
        flight = record_of(result)
        detection, kernels = flight.detection, flight.kernels
        walls = flight.host.get("stage_wall_s") or {}
        checks_host_s = walls.get("gate")
        if not detection or not checks_host_s:
            return None
        checks = sum(detection["checks"].values())
        flight_s = flight.quality_of_flight.get("flight_time_s") or flight.simulated_s
        if not checks or not flight_s:
            return None
        # Alarms that are not listed are distributed over the stages like those that are.
        listed = [
            alarm.get("recomputes", alarm["stage"])
            for alarm in detection["alarms"]
            if alarm["response"] in _AGAIN
        ]
        total = sum(detection["responses"].get(response, 0) for response in _AGAIN)
        again = {stage: total * listed.count(stage) / max(len(listed), 1) for stage in RECOMPUTED}

        def mean_s(kernel: Record | None) -> float:
            """Return the mean latency of an invocation, s."""
            if not kernel or not kernel["invocations"]:
                return 0.0
            return float(kernel["busy_s"] / kernel["invocations"])

        return cls(
            detector=detection["detector"],
            checks=checks,
            checks_host_s=checks_host_s,
            flight_s=flight_s,
            recomputations=again,
            recovery_s={
                stage: math.fsum(again[stage] * mean_s(kernels.get(name)) for name in names)
                for stage, names in RECOMPUTED.items()
            },
            compute_s=math.fsum(kernels[name]["busy_s"] for name in KERNELS if name in kernels),
            host_compute_s=math.fsum(walls.get(name, 0.0) for name in KERNELS),
            platform=str(flight.config.get("platform", "an unknown platform")),
            faulty=bool(flight.fault),
        )
