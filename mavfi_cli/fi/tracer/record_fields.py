"""Types of the fault record's fields that mavfi reads; importing them does not load the tracer."""

from __future__ import annotations

from typing import NotRequired, TypedDict

from mavfi_cli.core.files import Json


class StageRecord(TypedDict):
    """One stage of a trigger."""

    object: str
    offset: int
    count: int
    detour: NotRequired[Json]


class FaultRecord(TypedDict, total=False):
    """A fault record, planned or completed. docs/reference/records.md lists all of its fields."""

    version: int
    state: str
    object: str
    offset: int
    symbol: str
    instruction: str
    instruction_bytes: str  # hexadecimal
    k: int
    trigger: list[StageRecord]  # empty if the fault is drawn when it strikes
    corruption: Json | None  # None: a null run
    build_ids: dict[str, str | None]
    injection: Json
    activation: Json
    not_injected_reason: str
    request: Json  # of a mission
    node: str
    kernel: str
    golden_sha256: str
    run: int
    input: int
    outcome: str
    run_s: float
    within_tolerance: bool
    signal: int | None
    exit_code: int
    error: str
    magnitude: Json
