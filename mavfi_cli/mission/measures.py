"""The quality of a flight, and the sections and measures of its result.json.

Only this module interprets a result.json. Every measure is a column of a table of flights. A
mission that crashed or hung before it could write its record has few fields; measures of missing
fields are None. If a source-level fault struck several components, the measures join their values
by ";" in a common order, and `struck_bits` has a list of bits for every component. If a fault
strikes several times, the measures describe the first strike.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from math import isfinite

import numpy as np

from mavfi_cli.core.config import structure_record
from mavfi_cli.core.files import Json
from mavfi_cli.core.flight_record import (
    Detection,
    Event,
    KernelUse,
    MeasuredPlatform,
    MissionInstructionFault,
    NodeEnds,
    Point,
    ProgramEnds,
    QualityOfFlight,
    ReadingInstruction,
    RecordedActivation,
    RecordedCorruption,
    RecordedPlan,
    ResponseTime,
    StateFault,
    Strike,
)
from mavfi_cli.core.frames import norm
from mavfi_cli.core.types import KERNELS, FloatArray, Outcome, PilotCounters, Stage
from mavfi_cli.fi import bits

QUALITY = tuple(measure.name for measure in fields(QualityOfFlight))


def quality_of(
    log: Mapping[str, FloatArray], start_s: float, end_s: float, goal_enu_m: FloatArray
) -> QualityOfFlight:
    """Compute the quality of flight from a log: time, distance, energy and clearance.

    Flight time runs from the companion's take-over at take-off height to the end of the mission, as
    in the paper (section IV), where take-off precedes the measurement. Unknown values are None.

    Args:
        log: Columns by name with one row per control tick, as in `sitl.referee`. A foreign
            autopilot has no referee, so its log has only stamp, position and velocity.
        start_s, end_s: Stamps of the companion's take-over and of the end of the mission.
        goal_enu_m: Goal, of shape (3,), in metres.
    """
    inside = (log["stamp_s"] >= start_s - 1e-9) & (log["stamp_s"] <= end_s + 1e-9)
    flown = {name: column[inside] for name, column in log.items()}
    stamps, positions = flown["stamp_s"], flown["position_enu_m"]
    if len(stamps) < 2:
        return QualityOfFlight()
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
    # Without obstacles the clearance is infinite; values that the referee cannot measure are NaN.
    return QualityOfFlight(**{name: value for name, value in quality.items() if isfinite(value)})


# Sections -----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightRecord:
    """The sections of a result.json. A section that the file lacks is empty or None.

    A mission that crashed or hung before it could write its record lacks most sections.

    Attributes:
        pilot: None in a flight of a user's companion.
        plan_failures: Number of failed plans by reason.
        state_fault: The section `fault` if the fault is at source level.
        instruction_fault: The section `fault` if the fault is at instruction level.
        recorded_fault: The section `fault` as plain JSON values.
        in_lockstep: True for a flight of a user's companion in lockstep.
        mark: Digest of the user's companion that flew, as in `StackMark`; old records have none.
        referee: None if the vehicle provided no truth.
        seeds: Seeds of the mission (`root`) and of its fault.
        files: SHA-256 of the user's files.
    """

    outcome: str = ""
    reason: str = ""
    simulated_s: float | None = None
    goal_enu_m: Point | None = None
    config: Json = field(default_factory=dict)
    quality_of_flight: QualityOfFlight = field(default_factory=QualityOfFlight)
    pilot: PilotCounters | None = None
    events: Sequence[Event] = ()
    plans: Sequence[RecordedPlan] = ()
    plan_failures: Mapping[str, int] = field(default_factory=dict)
    state_fault: StateFault | None = None
    instruction_fault: MissionInstructionFault | None = None
    recorded_fault: Json | None = None
    detection: Detection | None = None
    nodes: Mapping[str, NodeEnds] = field(default_factory=dict)
    programs: Mapping[str, ProgramEnds] = field(default_factory=dict)
    in_lockstep: bool = False
    mark: str | None = None
    kernels: Mapping[str, KernelUse] = field(default_factory=dict)
    response_time_s: ResponseTime = field(default_factory=ResponseTime)
    measured_platform: MeasuredPlatform | None = None
    world: Json = field(default_factory=dict)
    referee: Json | None = field(default_factory=dict)
    seeds: Mapping[str, int | None] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    files: Mapping[str, str] = field(default_factory=dict)
    host: Json = field(default_factory=dict)

    @classmethod
    def of(cls, result: Json) -> FlightRecord:
        """Parse the sections of a result.json, given its content.

        Raises:
            RecordError: A section is damaged.
        """
        fault = result.get("fault") or None
        kind = "state_fault"
        if fault is not None and fault.get("level") == "instruction":
            kind = "instruction_fault"
        known = {
            name: value
            for name, value in {**result, kind: fault, "recorded_fault": fault}.items()
            if value not in (None, {}) or name == "referee"
        }
        return structure_record(known, cls)

    @property
    def fault(self) -> StateFault | MissionInstructionFault | None:
        """The fault, at source or instruction level, or None if the mission had no fault."""
        return self.state_fault or self.instruction_fault

    @property
    def strikes(self) -> Sequence[Strike]:
        """The recorded strikes of a source-level fault; empty if the mission had none."""
        return () if self.state_fault is None else self.state_fault.strikes

    @property
    def succeeded(self) -> bool:
        """True if the vehicle reached the goal."""
        return self.outcome == Outcome.SUCCESS.value

    @property
    def interrupted(self) -> bool:
        """True if the user interrupted the flight, so that its outcome is unknown."""
        return self.outcome == Outcome.INTERRUPTED.value

    @property
    def golden(self) -> bool:
        """True if the flight has neither a fault nor a detector."""
        return self.fault is None and self.detection is None


# Measures -----------------------------------------------------------------------------------------


def measures_of(flight: FlightRecord) -> dict[str, object]:
    """Return all measures of a mission, keyed by name.

    They are those of `fields_of`; `straight_m`, the distance from the take-off point to the
    edge of the goal's tolerance; `crashed`, whether a node died; `struck_s`, `struck_sites` and
    `first_bits`, the time and place of the fault; `alarms`, the listed alarms, oldest first;
    `episodes`, the number of runs of consecutive alarms; and STRUCK.
    """
    detection = flight.detection or Detection()
    hit = _of_instruction(flight) if flight.instruction_fault else _of_state(flight)
    return {
        **fields_of(flight),
        "straight_m": _straight_m(flight),
        "crashed": any(node.crashes for node in flight.nodes.values()),
        "alarms": [{"stamp_s": alarm.stamp_s, "stage": alarm.stage} for alarm in detection.alarms],
        "episodes": sum(recovery.count for recovery in detection.recoveries.values()),
        "struck_s": hit.get("struck_s"),
        "struck_sites": hit.get("struck_sites", []),
        "first_bits": hit.get("first_bits", []),
        **{name: hit.get(name) for name in STRUCK},
    }


def fields_of(flight: FlightRecord) -> dict[str, float | None]:
    """Return the measures that are copied directly from the record's fields, keyed by name."""
    detection, physics = flight.detection, (flight.referee or {}).get("physics") or {}
    return {
        **asdict(flight.quality_of_flight),
        "replans": None if flight.pilot is None else flight.pilot.replans,
        "simulated_s": flight.simulated_s,
        "response_median_s": flight.response_time_s.median,
        "response_p95_s": flight.response_time_s.p95,
        "alarm_count": None if detection is None else detection.alarm_count,
        "hover_shaft_w": physics.get("hover_shaft_w"),
    }


def _straight_m(flight: FlightRecord) -> float | None:
    start, goal = flight.world.get("start"), flight.goal_enu_m
    if not flight.config or start is None or goal is None:
        return None
    east, north, up = start
    takeoff = (east, north, up + flight.config["takeoff_height_m"])
    return math.dist(takeoff, goal) - float(flight.config["goal_tolerance_m"])


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
_FLOATS = {len("0x") + 16: "float64", len("0x") + 8: "float32"}  # by length of the hex pattern


def _of_state(flight: FlightRecord) -> dict[str, object]:
    fault = flight.state_fault or StateFault()
    drawn: dict[str, object] = {"strikes": fault.strike_count, "struck_sites": list(fault.states)}
    if not fault.strikes:
        return drawn
    first, activation = fault.strikes[0], fault.activation or RecordedActivation()
    changes, reader = first.changes, activation.first_reader  # no changes if a process was killed
    return {
        **drawn,
        "struck_s": first.stamp_s if fault.state == "applied" else None,
        "first_bits": list(changes[0].bits) if changes else [],
        "strike_s": first.stamp_s,
        "strike_phase": first.phase,
        "strike_tick": first.tick,
        "strike_invocation": first.invocation,
        "struck_state": _joined(change.state for change in changes),
        "struck_index": _joined(change.index for change in changes),
        "struck_before_hex": _joined(change.before_hex for change in changes),
        "struck_after_hex": _joined(change.after_hex for change in changes),
        "struck_before": _joined(_value(c.before, c.before_hex) for c in changes),
        "struck_after": _joined(_value(c.after, c.after_hex) for c in changes),
        "struck_bits": [list(change.bits) for change in changes],
        "activation": activation.activation or None,
        "first_reader": None if reader is None else reader.name,
        "first_read_state": None if reader is None else reader.state,
        "first_read_s": None if reader is None else reader.stamp_s,
    }


def _of_instruction(flight: FlightRecord) -> dict[str, object]:
    fault = flight.instruction_fault
    assert fault is not None
    flip, injection = fault.corruption or RecordedCorruption(), fault.injection
    address = f"{fault.object}+{fault.offset:#x}" if fault.object else None
    drawn: dict[str, object] = {
        "struck_s": fault.stamp_s if fault.state == "applied" else None,
        "struck_sites": [fault.node] if fault.node else [],
        "first_bits": list(flip.bits),
        "struck_node": fault.node or None,
        "struck_kernel": fault.kernel or None,
        "struck_function": fault.symbol,
        "struck_address": address,
        "struck_instruction": fault.instruction or None,
        "struck_execution": fault.k,
        "struck_role": flip.role or None,
        "struck_register": flip.register or flip.site or None,
        "struck_bits": None if fault.corruption is None else [list(flip.bits)],
        "strike_invocation": fault.invocation,
        "strikes": None if injection is None else int(injection.applied),
    }
    if injection is None or not injection.applied:
        return drawn
    reading = fault.activation or ReadingInstruction()
    node = flight.nodes.get(fault.node) or NodeEnds()
    ends = [crash.how for crash in node.crashes] + ["hang"] * node.hangs
    return {
        **drawn,
        "strike_s": fault.stamp_s,
        "struck_before_hex": injection.before,
        "struck_after_hex": injection.after,
        "activation": reading.activation or None,
        "reading_instruction": reading.instruction or None,
        "node_ended": ";".join(ends) or None,
    }


def _joined(values: Iterable[object]) -> str:
    return ";".join(map(str, values))


def _value(value: float | int | bool | None, pattern: str) -> object:
    """Return `value`, or if it is None, the float whose bits `pattern` gives as hexadecimal text.

    A record has None instead of an infinity or NaN, which JSON lacks.
    """
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
# Printed where checks are compared with simulated time, because no factor between hosts is known.
HOST_CHECKS = "checks take the time of the host that flew, not scaled to the platform"
_AGAIN = ("recompute", "hold")  # responses to an alarm that cause a recomputation


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectionCost:
    """The time that a detector cost in one flight, for its checks and for recomputations.

    The cost is "the total detection and recomputation time for each mission" (paper, Table V).
    Checks are measured in host time; recomputations in simulated time, by their latency on the
    flight's platform.

    Attributes:
        flight_s: Flight time in seconds, or the simulated time of the whole mission if the flight
            time is unknown.
        recomputations: Number of recomputations per stage. The record lists only the first alarms
            and counts the others. The others are distributed over the stages in the same ratio as
            the listed alarms, so the numbers may be fractions.
        recovery_s: Simulated time in seconds of the recomputations per stage, at the mean latency
            of the stage's kernels in this flight.
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
        """Mean host time of a check, in seconds."""
        return self.checks_host_s / self.checks

    @property
    def detection_share(self) -> float:
        """Ratio of the checks' host time to the flight time."""
        return self.checks_host_s / self.flight_s

    @property
    def recovered_s(self) -> float:
        """Simulated time of all recomputations, in seconds."""
        return math.fsum(self.recovery_s.values())

    @property
    def recovery_share(self) -> float:
        """Ratio of the recomputations' simulated time to the flight time."""
        return self.recovered_s / self.flight_s

    @classmethod
    def of(cls, flight: FlightRecord) -> DetectionCost | None:
        """Compute the cost of detection and recovery in a flight, if its record contains it.

        Returns:
            The cost, or None if the flight had no detector, or if its record has no checks, no host
            time of the checks, or no flight time.
        """
        detection, kernels = flight.detection, flight.kernels
        walls = flight.host.get("stage_wall_s") or {}
        checks_host_s = walls.get("gate")
        if detection is None or not checks_host_s:
            return None
        checks = sum(detection.checks.values())
        flight_s = flight.quality_of_flight.flight_time_s or flight.simulated_s
        if not checks or not flight_s:
            return None
        # Alarms that are not listed are distributed over the stages like those that are.
        listed = [
            alarm.recomputes or alarm.stage
            for alarm in detection.alarms
            if alarm.response in _AGAIN
        ]
        total = sum(detection.responses.get(response, 0) for response in _AGAIN)
        again = {stage: total * listed.count(stage) / max(len(listed), 1) for stage in RECOMPUTED}

        def mean_s(kernel: KernelUse | None) -> float:
            """Return the mean latency of a kernel's invocation in seconds, or 0 if it never ran."""
            if kernel is None or not kernel.invocations:
                return 0.0
            return kernel.busy_s / kernel.invocations

        return cls(
            detector=detection.detector,
            checks=checks,
            checks_host_s=checks_host_s,
            flight_s=flight_s,
            recomputations=again,
            recovery_s={
                stage: math.fsum(again[stage] * mean_s(kernels.get(name)) for name in names)
                for stage, names in RECOMPUTED.items()
            },
            compute_s=math.fsum(kernels[name].busy_s for name in KERNELS if name in kernels),
            host_compute_s=math.fsum(walls.get(name, 0.0) for name in KERNELS),
            platform=str(flight.config.get("platform", "an unknown platform")),
            faulty=flight.fault is not None,
        )
