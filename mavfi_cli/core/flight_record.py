"""Defines the sections of a result.json, which a flight writes and all other parts read.

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
    """The quality of flight (QoF); unknown values are None."""

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
    """One event of a flight."""

    stamp_s: float = 0.0
    kind: str = ""  # phase, autopilot, plan, collision, outcome
    text: str = ""
    position_enu_m: Point | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedPlan:
    """The waypoints of a plan."""

    stamp_s: float = 0.0
    points_enu_m: Any = ()  # (n, 3) lists; None stands for infinity or NaN


@dataclass(frozen=True, slots=True, kw_only=True)
class ResponseTime:
    """Times from a depth frame to its setpoint, s; None if there was none."""

    median: float | None = None
    p95: float | None = None
    count: int = 0


# Nodes and programs -------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class KernelUse:
    """A kernel's invocations, its inputs that newer ones replaced, and the time it was busy."""

    invocations: int = 0
    dropped_inputs: int = 0
    busy_s: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeCrash:
    """The death of a node's process."""

    stamp_s: float = 0.0
    how: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeEnds:
    """Crashes, hangs and restarts of a node."""

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
    """Medians of a kernel's times on this host and in the flight, s."""

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
    """One value that a strike changed.

    Attributes:
        index: Index of the waypoint; 0 for messages without waypoints.
        before, after: None in a record stands for infinity or NaN, which JSON lacks; `before_hex`
            and `after_hex` have the bits.
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
    """One action of the fault on the mission."""

    stamp_s: float = 0.0
    tick: int = 0
    phase: str = ""
    invocation: int = 0  # number of the kernel's output
    changes: tuple[Change, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Reader:
    """The first receiver that used a corrupted value, and when."""

    name: str = ""
    stamp_s: float = 0.0
    state: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedTrigger:
    """The trigger of a fault, and the time that was drawn for it, s after the take-over."""

    when: str = ""
    number: float = 0.0
    phase: str | None = None
    drawn_time_s: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedActivation:
    """Whether a corrupted value was read, and its first reader."""

    activation: str = ""
    first_reader: Reader | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class StateFault:
    """The record of a fault in a state or in the detector, or of a killed process.

    Attributes:
        reason: Why it was not injected.
        request: The user's request, as a `FaultConfig`.
        states, units: Names of what the fault strikes, and their units.
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
    """An alarm of a detector.

    Attributes:
        message: Kind of the message that raised it: report, plan, ahead (active plan) or tick.
        recomputes: Recomputed stage if it differs from `stage`; else None, which is not written.
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
    """Number and total time of the phases in which a stage had no accepted message."""

    count: int = 0
    total_s: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Detection:
    """What a detector did in one flight.

    Attributes:
        checks: Number by kind of message.
        responses: Number by response.
        alarms: The first alarms, oldest first; `alarm_count` counts all.
        recoveries: By stage.
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
    """The flipped bits of a register, of an instruction or of memory."""

    site: str = ""
    role: str = ""
    register: str | None = None
    bits: Sequence[int] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class _Flip:
    """Whether the bits were flipped, and the value before and after as hexadecimal text."""

    applied: bool = False
    before: str = ""
    after: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReadingInstruction:
    """Whether the corrupted value was read, and the instruction that read it."""

    activation: str = ""
    instruction: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class MissionInstructionFault:
    """The record of a fault in an instruction of a node.

    Attributes:
        state: planned, applied, not_injected or null (nothing was to be flipped).
        reason: Why it was not injected.
        request: The user's request, as an `InstructionConfig`.
        stamp_s: Simulated time of the struck invocation, s.
        k: Number of the struck execution of the instruction.
        corruption: None without a flip.
        injection: None if the process was cut off before the result was known.
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
