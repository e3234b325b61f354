"""The fault record: a JSON file that first states what will be struck, and later what was struck.

It is flushed to disk *before* the target runs to the trigger, so that it survives any effect
of the fault. It is completed afterwards. Each write leaves the old file or the new one, never a
partial one.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, cast

from mavfi_cli.core.config import structure_record
from mavfi_cli.core.errors import BuildMismatch, RecordError
from mavfi_cli.core.files import Json, read_json, write_text
from mavfi_cli.core.flight_record import SCHEMA
from mavfi_cli.fi.tracer.counted import CountedStop, Detour
from mavfi_cli.fi.tracer.decode import decode
from mavfi_cli.fi.tracer.fault import (
    InstructionCorruption,
    InstructionFault,
    Site,
)
from mavfi_cli.fi.tracer.image import Image, Location
from mavfi_cli.fi.tracer.inject import Followed, Injection
from mavfi_cli.fi.tracer.record_fields import FaultRecord, StageRecord
from mavfi_cli.fi.tracer.registers import width_of

VERSION = 2  # version 1 had whole registers as operands
_LARGEST = 1 << 24  # bytes of a record
_LARGEST_OFFSET, _LARGEST_COUNT = 1 << 40, 1 << 48
_LONGEST_DETOUR = 127  # bytes
_SHORT_JUMP = -126, 129  # reach of a two-byte jump from its own address
_WIDEST_OPERAND, _MOST_OPERANDS = 8192, 8  # bits of an opcode or in memory; memory operands


def planned(
    fault: InstructionFault, image: Image, *, names_symbol: bool = True, **context: Any
) -> FaultRecord:
    """Return the record of a fault that has not struck yet.

    Args:
        image: image of the process, for symbols and build ids.
        names_symbol: include the symbol; reading the symbols of a large object takes seconds.
        context: further entries, such as seed, sampling rule, scope, kernel, program and run.
    """
    target = fault.target
    record = {
        "version": VERSION,
        "state": "planned",
        "level": "instruction",
        "object": target.object,
        "offset": target.offset,
        "symbol": image.symbol(target) if names_symbol else "",
        "instruction": fault.instruction,
        "instruction_bytes": fault.instruction_bytes.hex(),
        "k": fault.execution,
        "trigger": [_stage_to_json(stage) for stage in fault.trigger],
        "corruption": fault.corruption and fault.corruption.to_json(),
        "build_ids": {
            name: image.named(name).build_id
            for name in sorted({stage.location.object for stage in fault.trigger})
        },
        **context,
    }
    return cast(FaultRecord, record)


def undrawn(**context: Any) -> FaultRecord:
    """Return the record of a fault that will be drawn only when it strikes.

    `context` holds further entries, as for `planned`.
    """
    record = {
        "version": VERSION,
        "state": "planned",
        "level": "instruction",
        "trigger": [],
        "corruption": None,
        **context,
    }
    return cast(FaultRecord, record)


def _stage_to_json(stage: CountedStop) -> StageRecord:
    location = stage.location
    entry = StageRecord(object=location.object, offset=location.offset, count=stage.count)
    if stage.detour is not None:
        entry["detour"] = asdict(stage.detour)
    return entry


def completed(
    record: FaultRecord, injection: Injection | None, followed: Followed, **result: Any
) -> FaultRecord:
    """Return the record of a fault after its run, with the entries of `result` added.

    `injection` is None for a null run, or if the trigger was not reached.
    """
    what: Json = {"applied": False}
    if injection is not None:
        values = {"before": hex(injection.before), "after": hex(injection.after)}
        what = asdict(injection) | values
    activation = asdict(followed) | {"activation": followed.activation.value}
    written = {"state": "completed", "injection": what, "activation": activation, **result}
    return cast(FaultRecord, {**record, **written})


def repeatable(written: FaultRecord) -> dict[str, Any]:
    """Return a completed record in the form that every repetition of the run reproduces.

    It has a final state (`applied`, `not_injected` or `null`), but not the duration of the stop.
    """
    injection = {k: v for k, v in written["injection"].items() if k != "stop_s"}
    reason = written.get("not_injected_reason", "")
    state = "applied" if injection["applied"] else "not_injected"
    if written["corruption"] is None and not reason:
        state = "null"
    ending = {"schema": SCHEMA, "state": state, "reason": reason, "injection": injection}
    return {**written, **ending}


def describe(written: FaultRecord) -> str:
    """Describe a completed fault in one line."""
    if not written["trigger"]:
        return f"fault in {written['kernel']}: not injected ({written['not_injected_reason']})"
    place = written["symbol"] or f"{written['object']}+{written['offset']:#x}"
    where = f"{written['kernel']}, {written['instruction']} at {place}"
    corruption = written["corruption"]
    if corruption is None:
        return f"null fault in {where}: nothing is flipped"
    if not written["injection"]["applied"]:
        return f"fault in {where}: not injected ({written.get('not_injected_reason', '')})"
    bits = ", ".join(map(str, corruption["bits"]))
    what = corruption["register"] or corruption["site"]
    activation = written["activation"]["activation"].replace("_", " ")
    return f"fault in {where}: bit {bits} of {corruption['role']} {what}, {activation}"


@dataclass(frozen=True, slots=True, kw_only=True)
class _Stage:
    """One stage of a recorded trigger."""

    object: str
    offset: int
    count: int
    detour: Detour | None = None

    def stop(self) -> CountedStop:
        """Return the recorded stage as a counted stop.

        Raises:
            ValueError: a number is out of range.
        """
        _require_range("offset", self.offset, 0, _LARGEST_OFFSET)
        _require_range("count", self.count, 1, _LARGEST_COUNT)
        if self.detour is not None:
            _require_range("detour.size", self.detour.size, 1, _LONGEST_DETOUR)
            _require_range("detour.via", self.detour.via, *_SHORT_JUMP)
        return CountedStop(Location(self.object, self.offset), self.count, self.detour)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Repeatable:
    """The entries of a record from which its fault is repeated and compared."""

    trigger: tuple[_Stage, ...]
    k: int
    instruction: str
    instruction_bytes: str
    corruption: InstructionCorruption | None
    build_ids: dict[str, str | None]
    injection: dict[str, Any] = field(default_factory=dict)
    run: int = 0
    input: int = 0

    @classmethod
    def of(cls, record: FaultRecord) -> _Repeatable:
        """Read the entries of a record.

        Raises:
            RecordError: the record is damaged or has another version.
        """
        if record.get("version") != VERSION:
            raise RecordError(f"not a fault record of version {VERSION}")
        try:
            read = structure_record(record, cls)
            if read.corruption is not None:
                _require_bits(read.corruption)
            if not read.trigger:
                raise ValueError("its trigger is empty")
        except ValueError as error:
            raise RecordError(f"the fault record is damaged: {error}") from None
        return read

    def fault(self) -> InstructionFault:
        """Return the fault. Raises RecordError if an entry is out of its range."""
        try:
            code = bytes.fromhex(self.instruction_bytes)
            if self.corruption is not None and self.corruption.site is Site.MEMORY:
                instruction = decode(code, 0)
                if instruction is None or self.corruption.memory_operand >= len(instruction.memory):
                    raise ValueError("its instruction has no such memory operand")
            return InstructionFault(
                trigger=tuple(stage.stop() for stage in self.trigger),
                execution=self.k,
                instruction=self.instruction,
                instruction_bytes=code,
                corruption=self.corruption,
            )
        except ValueError as error:
            raise RecordError(f"the fault record is damaged: {error}") from None


def _require_range(name: str, value: int, low: int, high: int) -> None:
    if not low <= value <= high:
        raise ValueError(f"{name} must be between {low} and {high}, got {value}")


def _require_bits(corruption: InstructionCorruption) -> None:
    """Raise ValueError if a register does not exist, or a bit or an operand is out of range."""
    width = _WIDEST_OPERAND
    if corruption.site not in (Site.MEMORY, Site.OPCODE):
        try:
            width = width_of(corruption.register)
        except KeyError:
            raise ValueError(f"unknown register {corruption.register!r}") from None
    for bit in corruption.bits:
        _require_range("corruption.bits", bit, 0, width - 1)
    _require_range("corruption.memory_operand", corruption.memory_operand, 0, _MOST_OPERANDS - 1)


def fault_of(record: FaultRecord) -> InstructionFault:
    """Return the fault that a record describes, so that it can be repeated.

    Raises:
        RecordError: the record is damaged or has another version.
    """
    return _Repeatable.of(record).fault()


def require_same_build(record: FaultRecord, image: Image) -> None:
    """Raise an error if an object that a record names is not loaded or is from another build.

    Raises:
        BuildMismatch: an object is missing or of another build, or has no code at a stop of the
            trigger; the message names all such objects.
        RecordError: the record is damaged or has another version.
    """
    read, differences = _Repeatable.of(record), []
    stops = [stop.location for stop in read.fault().trigger]
    for name in {location.object: None for location in stops} | read.build_ids:
        loaded, build_id = image.find(name), read.build_ids.get(name)
        if loaded is None:
            differences.append(f"{name} is not loaded")
        elif loaded.build_id != build_id:
            differences.append(f"{name} has build id {loaded.build_id}, not {build_id} as recorded")
        elif not all(
            any(location.offset in span for span in loaded.text)
            for location in stops
            if location.object == name
        ):
            differences.append(f"{name} has no code where the fault strikes")
    if differences:
        raise BuildMismatch(differences)


def write(path: Path, record: FaultRecord) -> None:
    """Write a record and flush it to disk before returning.

    Raises:
        RecordError: the file cannot be written.
    """
    write_text(path, json.dumps(record, indent=1) + "\n")


def read(path: Path) -> FaultRecord:
    """Read a fault record from a file.

    Raises:
        RecordError: the file does not exist or is not a fault record.
    """
    record = read_json(path, _LARGEST)
    if "trigger" not in record:
        raise RecordError(f"{path}: not a fault record")
    if record.get("version") != VERSION:
        raise RecordError(f"{path}: not a fault record of version {VERSION}")
    return cast(FaultRecord, record)
