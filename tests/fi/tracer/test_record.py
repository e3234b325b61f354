"""Fault records of somebody else's: a damaged one is refused before anything is struck."""

import copy
import json
from types import SimpleNamespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavfi_cli.core.errors import BuildMismatch, RecordError
from mavfi_cli.fi.tracer import record
from mavfi_cli.fi.tracer.counted import CountedStop, Detour
from mavfi_cli.fi.tracer.fault import InstructionCorruption, InstructionFault
from mavfi_cli.fi.tracer.image import Location
from mavfi_cli.fi.tracer.registers import width_of

SOUND = {
    "version": record.VERSION,
    "trigger": [
        {"object": "libm.so.6", "offset": 64, "count": 3, "detour": {"size": 5, "via": 0}},
        {"object": "libm.so.6", "offset": 80, "count": 1},
    ],
    "k": 12,
    "instruction": "add rax, rbx",
    "instruction_bytes": "4801d8",
    "corruption": {
        "site": "general", "role": "source", "register": "rbx", "operand": "rbx", "bits": [3, 60],
        "memory_operand": 0,
    },
    "build_ids": {"libm.so.6": "ab12"},
    "injection": {"applied": True},
}  # fmt: skip
LIBM = SimpleNamespace(build_id="ab12", text=(range(60, 100),))
LOADED = SimpleNamespace(find=lambda name: LIBM if name == "libm.so.6" else None)
MEMORY = SOUND["corruption"] | {"site": "memory", "register": ""}


def test_a_sound_record_is_its_fault():
    fault = record.fault_of(SOUND)
    first, second = fault.trigger
    assert first == CountedStop(Location("libm.so.6", 64), 3, Detour(5))
    assert second == CountedStop(Location("libm.so.6", 80), 1)
    assert (fault.execution, fault.instruction_bytes) == (12, bytes.fromhex("4801d8"))
    assert fault.corruption.to_json() == SOUND["corruption"]
    record.require_same_build(SOUND, LOADED)


@pytest.mark.parametrize(
    ("place", "value", "problem"),
    [
        (("build_ids",), None, "build_ids: must be a table"),
        (("build_ids",), ..., "it has no build_ids"),
        (("trigger",), ..., "it has no trigger"),
        (("trigger",), [], "trigger is empty"),
        (("trigger", 0, "offset"), "64", r"offset: must be a whole number"),
        (("trigger", 0, "offset"), -1, "offset must be between 0"),
        (("trigger", 0, "count"), 0, "count must be between 1"),
        (("trigger", 0, "object"), [], r"object: must be text"),
        (("trigger", 0, "detour", "size"), 10**9, "size must be between 1 and 127"),
        (("trigger", 0, "detour", "via"), 130, "via must be between -126 and 129"),
        (("instruction_bytes",), "no", "non-hexadecimal"),
        (("corruption", "site"), "soul", "site: 'soul'"),
        (("corruption", "register"), ..., "unknown register ''"),
        (("corruption", "register"), "rzx", "unknown register 'rzx'"),
        (("corruption", "bits"), "3", "bits: must be an array"),
        (("corruption", "bits", 0), 64, "bits must be between 0 and 63, got 64"),
        (("corruption", "memory_operand"), -1, "memory_operand must be between 0"),
        (("corruption",), MEMORY, "its instruction has no such memory operand"),
        (("injection",), [], "injection: must be a table"),
        (("input",), "1", "input: must be a whole number"),
        (("version",), 1, "not a fault record of version"),
    ],
)
def test_a_damaged_record_is_refused(place, value, problem):
    damaged = changed(place, value)
    with pytest.raises(RecordError, match=problem):
        record.fault_of(damaged)
    with pytest.raises(RecordError, match=problem):
        record.require_same_build(damaged, LOADED)


@pytest.mark.parametrize(
    ("place", "value", "problem"),
    [
        (("build_ids", "libm.so.6"), "cd34", "has build id ab12, not cd34 as recorded"),
        (("build_ids",), {}, "has build id ab12, not None as recorded"),
        (("build_ids", "libc.so.6"), "cd34", r"libc\.so\.6 is not loaded"),
        (("trigger", 1, "object"), "libc.so.6", r"libc\.so\.6 is not loaded"),
        (("trigger", 1, "offset"), 100, r"libm\.so\.6 has no code where the fault strikes"),
        (("trigger", 0, "offset"), 1 << 40, r"libm\.so\.6 has no code where the fault strikes"),
    ],
)
def test_a_record_of_other_code_is_refused(place, value, problem):
    with pytest.raises(BuildMismatch, match=problem):
        record.require_same_build(changed(place, value), LOADED)


def test_a_record_nested_too_deeply_is_refused(tmp_path):
    path = tmp_path / "fault.json"
    for depth, problem in ((900, "nested more than 64 deep"), (100_000, "damaged")):
        path.write_text(json.dumps(SOUND)[:-1] + f', "windows": {"[" * depth}{"]" * depth}}}')
        with pytest.raises(RecordError, match=problem):
            record.read(path)


def changed(place, value):
    """A copy of the sound record with another value at a place, or none (...)."""
    damaged = copy.deepcopy(SOUND)
    inner = damaged
    for key in place[:-1]:
        inner = inner[key]
    if value is ...:
        del inner[place[-1]]
    else:
        inner[place[-1]] = value
    return damaged


def places(value, place=()):
    """The places of all values in a JSON value."""
    items = value.items() if isinstance(value, dict) else enumerate(value)
    for key, inner in items:
        yield (*place, key)
        if isinstance(inner, dict | list):
            yield from places(inner, (*place, key))


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=2) | st.dictionaries(st.text(max_size=3), inner),
    max_leaves=4,
)


@settings(max_examples=300)
@given(st.sampled_from([*places(SOUND)]), values | st.just(...))
def test_any_changed_record_is_refused_or_is_a_fault_that_can_be_struck(place, value):
    damaged = changed(place, value)
    try:
        fault = record.fault_of(damaged)
        record.require_same_build(damaged, LOADED)
    except (RecordError, BuildMismatch):
        return
    assert isinstance(fault, InstructionFault)
    assert all(stop.count >= 1 and stop.location.offset >= 0 for stop in fault.trigger)
    if isinstance(fault.corruption, InstructionCorruption) and fault.corruption.register:
        assert all(0 <= bit < width_of(fault.corruption.register) for bit in fault.corruption.bits)
    json.dumps(fault.corruption and fault.corruption.to_json())
