"""Defines the sections of result.json, the record that a flight writes and other parts read.

A record of a mission that was cut off, or from an earlier version, lacks some of the fields, so
every field has a default. docs/reference/records.md describes all of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from mavfi_cli.core.files import Json

SCHEMA = 1  # schema version of result.json and of its fault
Point = tuple[float, float, float]  # ENU, m


@dataclass(frozen=True, slots=True, kw_only=True)
class QualityOfFlight:
    """The quality of flight (QoF) of a mission. Unknown values are None."""

    flight_time_s: float | None = None
    distance_m: float | None = None
    mean_speed_mps: float | None = None
    max_speed_mps: float | None = None
    min_clearance_m: float | None = None
    goal_distance_m: float | None = None  # at the end of the mission
    energy_regression_j: float | None = None  # MAVBench's, see docs/reference/records.md
    energy_propeller_j: float | None = None  # from JSBSim's propeller shaft power, all rotors


@dataclass(frozen=True, slots=True, kw_only=True)
class Event:
    """One event of a flight, such as a new phase, a new plan or an alarm."""

    stamp_s: float = 0.0
    kind: str = ""  # such as phase, autopilot, plan, collision, outcome
    text: str = ""
    position_enu_m: Point | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedPlan:
    """The waypoints of a plan, and the time at which it was recorded."""

    stamp_s: float = 0.0
    points_enu_m: Any = ()  # nested lists of shape (n, 3); None stands for infinity or NaN


@dataclass(frozen=True, slots=True, kw_only=True)
class ResponseTime:
    """Statistics of the times from a depth frame to the first setpoint that depends on it.

    Attributes:
        median, p95: Median and 95th percentile in seconds; None if no setpoint depended on a frame.
        count: Number of times.
    """

    median: float | None = None
    p95: float | None = None
    count: int = 0


# Nodes and programs -------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class KernelUse:
    """How often a kernel ran, and how long.

    Attributes:
        invocations: Number of invocations.
        dropped_inputs: Number of inputs that newer inputs replaced before the kernel read them.
        busy_s: Total time of all invocations.
    """

    invocations: int = 0
    dropped_inputs: int = 0
    busy_s: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeCrash:
    """The death of a node's process: when it died, and how."""

    stamp_s: float = 0.0
    how: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeEnds:
    """The crashes of a node, and the number of its hangs and restarts."""

    crashes: Sequence[NodeCrash] = ()
    hangs: int = 0
    restarts: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class ProgramEnds:
    """How often a program of a user's companion was started, and its processes' exit codes."""

    starts: int = 0
    codes: Sequence[int] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredKernel:
    """The measured times of a kernel: median on the host, and median latency in the flight."""

    host_median_s: float = 0.0
    latency_median_s: float = 0.0
    invocations: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredPlatform:
    """A platform whose latencies are the host's times multiplied by a factor."""

    platform: str = ""
    factor: float = 0.0
    kernels: Mapping[str, MeasuredKernel] = field(default_factory=dict)


# Faults in states, and detectors ------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Change:
    """One value that a fault changed when it struck.

    Attributes:
        index: Index of the waypoint; 0 for messages without waypoints.
        before, after: The value before and after the change. None in a record stands for infinity
            or NaN, which JSON lacks.
        before_hex, after_hex: The bits of these values in hexadecimal.
    """

    state: str = ""
    index: int = 0
    bits: tuple[int, ...] = ()
    before: float | int | bool | None = None
    after: float | int | bool | None = None
    before_hex: str = ""
    after_hex: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Strike:
    """One action of a fault: when it struck, and which values it changed."""

    stamp_s: float = 0.0
    tick: int = 0
    phase: str = ""
    invocation: int = 0  # number of the kernel's output
    changes: tuple[Change, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Reader:
    """The first receiver that read a corrupted value, and the time at which it did."""

    name: str = ""
    stamp_s: float = 0.0
    state: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedTrigger:
    """The trigger of a fault, and the time that was drawn for it, if any.

    Attributes:
        when: Kind of the trigger, such as `time` or `tick`.
        number: Number that belongs to the kind, such as that of the tick.
        drawn_time_s: The time that was drawn at random, in seconds after the companion took
            control; None if no time was drawn.
    """

    when: str = ""
    number: float = 0.0
    phase: str | None = None
    drawn_time_s: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedActivation:
    """What happened to a corrupted value, and the first receiver that read it, if any did."""

    activation: str = ""
    first_reader: Reader | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class StateFault:
    """The record of a source-level fault: in a state, in the detector, or a killed process.

    Attributes:
        reason: Why the fault was not injected; empty if it was.
        request: The fault that the user asked for, as the fields of a `FaultConfig`.
        states, units: Names of the values that the fault strikes, and their units.
        strikes: The first strikes; `strike_count` counts all.
    """

    schema: int = SCHEMA
    level: str = "source"
    state: str = ""  # planned, applied or not_injected
    reason: str = ""
    request: Json = field(default_factory=dict)
    stage: str = ""
    states: Sequence[str] = ()
    units: Sequence[str] = ()
    trigger: RecordedTrigger | None = None
    strikes: Sequence[Strike] = ()
    strike_count: int | None = None
    activation: RecordedActivation | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedAlarm:
    """An alarm of a detector in a flight.

    Attributes:
        message: Kind of the message that raised the alarm: report, plan, ahead (active plan) or
            tick.
        recomputes: The recomputed stage if it differs from `stage`, otherwise None. None is not
            written to the record.
    """

    stamp_s: float = 0.0
    stage: str = ""
    message: str = ""
    score: float | None = None
    states: tuple[str, ...] = ()
    response: str = ""
    recomputes: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedRecovery:
    """The number and total time of the periods in which the gate accepted no message of a stage."""

    count: int = 0
    total_s: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Detection:
    """What a detector did in one flight: its checks, alarms, responses and recoveries.

    Attributes:
        protect: Stages that the detector watched.
        checks: Number of checks by kind of message.
        responses: Number of alarms by the response to them.
        alarms: The first alarms, oldest first; `alarm_count` counts all.
        recoveries: Recoveries by stage.
    """

    detector: str = ""
    protect: Sequence[str] = ()
    threshold: float | None = None
    checks: Mapping[str, int] = field(default_factory=dict)
    alarm_count: int | None = None
    responses: Mapping[str, int] = field(default_factory=dict)
    alarms: Sequence[RecordedAlarm] = ()
    recoveries: Mapping[str, RecordedRecovery] = field(default_factory=dict)


# Faults in instructions ---------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedCorruption:
    """The bits that a fault flips, and the register, instruction or memory that contains them."""

    site: str = ""
    role: str = ""
    register: str | None = None
    bits: Sequence[int] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class _Flip:
    """The result of a bit flip: whether it was applied, and the value before and after it.

    The values are hexadecimal strings.
    """

    applied: bool = False
    before: str = ""
    after: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReadingInstruction:
    """What happened to a corrupted operand, and the instruction that read it, if any did."""

    activation: str = ""
    instruction: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class MissionInstructionFault:
    """The record of an instruction-level fault in a node.

    Attributes:
        state: planned, applied, not_injected or null (nothing was to be flipped).
        reason: Why the fault was not injected; empty if it was.
        request: The fault that the user asked for, as the fields of an `InstructionConfig`.
        stamp_s: Simulated time of the struck invocation, in seconds.
        k: Number of the struck execution of the instruction.
        corruption: The bits to flip; None if nothing was to be flipped.
        injection: Result of the flip; None if the process was cut off before it was known.
    """

    state: str = ""
    reason: str = ""
    request: Json = field(default_factory=dict)
    node: str = ""
    kernel: str = ""
    invocation: int | None = None
    invocations: int | None = None
    stamp_s: float | None = None
    sampling: str = ""
    windows: str = ""
    k: int | None = None
    object: str = ""
    offset: int = 0
    symbol: str = ""
    instruction: str = ""
    corruption: RecordedCorruption | None = None
    injection: _Flip | None = None
    activation: ReadingInstruction | None = None
