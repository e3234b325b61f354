"""Whatever arrives, the autopilot goes on, and everything it says can be encoded."""

import math
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavfi_cli.link.codec import Codec, dialect
from sitl.autopilot.services import handle
from sitl.autopilot.telemetry import Preset

_INTEGERS = {
    "uint8_t": (0, 255), "int8_t": (-128, 127), "uint16_t": (0, 65535),
    "int16_t": (-32768, 32767), "uint32_t": (0, 2**32 - 1), "int32_t": (-(2**31), 2**31 - 1),
    "uint64_t": (0, 2**64 - 1), "int64_t": (-(2**63), 2**63 - 1),
}  # fmt: skip


def scalar(kind):
    if kind in _INTEGERS:
        low, high = _INTEGERS[kind]
        few = [value for value in (0, 1, 6, 176, 400, 100, 245) if low <= value <= high]
        return st.sampled_from(few) | st.integers(low, high)
    return st.sampled_from([0.0, 1.0, -1.0, 6.0, math.nan, math.inf]) | st.floats(
        width=32 if kind == "float" else 64
    )


def field(name, kind, length):
    if name in ("target_system", "target_component", "target"):
        return st.sampled_from([0, 1, 2, 100])
    if name == "command" and not length:
        return st.sampled_from(COMMANDS) | st.integers(0, 65535)
    if name == "param_id":
        return st.sampled_from([b"MPC_XY_VEL_MAX", b"COM_OF_LOSS_T", b"_HASH_CHECK", b"\xff\0"])
    if kind == "char":
        return st.binary(max_size=length)
    return scalar(kind) if length == 0 else st.lists(scalar(kind), min_size=length, max_size=length)


COMMANDS = [16, 20, 21, 22, 176, 178, 179, 185, 192, 300, 400, 401, 410, 510, 511, 512, 520, 2000]
HEARD = [
    "COMMAND_LONG", "COMMAND_INT", "SET_POSITION_TARGET_LOCAL_NED", "SET_MODE", "PARAM_SET",
    "SET_POSITION_TARGET_GLOBAL_INT", "MANUAL_CONTROL", "FILE_TRANSFER_PROTOCOL", "PING",
    "TIMESYNC", "PARAM_REQUEST_READ",
]  # fmt: skip
CLASSES = list(dialect.mavlink_map.values())
LIKELY = [cls for cls in CLASSES if cls.msgname in HEARD]


@st.composite
def messages(draw):
    cls = draw(st.sampled_from(LIKELY) | st.sampled_from(CLASSES))
    lengths = {
        name: cls.array_lengths[cls.ordered_fieldnames.index(name)] for name in cls.fieldnames
    }
    return cls(
        *(
            draw(field(name, kind, lengths[name]))
            for name, kind in zip(cls.fieldnames, cls.fieldtypes, strict=True)
        )
    )


def check_sane(bench):
    assert not np.isinf(bench.autopilot.snapshot.setpoint).any()
    assert np.isfinite(bench.vehicle.position_ned_m).all()


@pytest.mark.slow
@settings(max_examples=150, deadline=None)
@given(data=st.lists(messages(), min_size=1, max_size=8), airborne=st.booleans())
def test_valid_frames_of_any_message_with_any_fields(make_bench, data, airborne):
    bench = make_bench(Preset.ONBOARD)
    if airborne:
        bench.fly()
    for message in data:
        bench.send(message)
        bench.run(0.1)
        check_sane(bench)
    bench.run(0.5)
    check_sane(bench)


@settings(max_examples=200, deadline=None)
@given(st.lists(st.binary(max_size=300), max_size=5))
def test_raw_bytes(make_bench, chunks):
    bench = make_bench()
    codec = Codec(1, 1)
    for chunk in chunks:
        for message in codec.decode(chunk):
            handle(bench.autopilot, message, bench.link)
    bench.run(0.1)
    check_sane(bench)


@settings(max_examples=100, deadline=None)
@given(message=messages(), flips=st.lists(st.integers(0, 10_000), max_size=4))
def test_damaged_frames(make_bench, message, flips):
    bench = make_bench()
    frame = bytearray(Codec(245, 190).encode(message))
    for flip in flips:
        frame[flip // 8 % len(frame)] ^= 1 << flip % 8
    for received in Codec(1, 1).decode(bytes(frame)):
        handle(bench.autopilot, received, bench.link)
    bench.run(0.1)


@pytest.mark.slow
@settings(max_examples=100, deadline=None)
@given(index=st.integers(0, 60), bits=st.integers(0, 2**32 - 1))
def test_flight_with_any_parameter_value(make_bench, index, bits):
    bench = make_bench()
    table = bench.autopilot.parameters
    row = table.message(index % len(table))
    value = struct.unpack("<f", struct.pack("<I", bits))[0]
    bench.send(dialect.MAVLink_param_set_message(1, 1, row._param_id_raw, value, row.param_type))
    bench.run(4.5)
    bench.command(400, 1)
    bench.command(22)
    bench.run(3.0)
    bench.command(20)
    bench.run(2.0)
    bench.command(21)
    bench.run(2.0)
    check_sane(bench)
