import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavfi_cli.link.codec import Codec, dialect
from sitl.autopilot.parameters import TYPE_INT32, TYPE_REAL32, Parameters


def bytewise(value, form="<i"):
    return struct.unpack("<f", struct.pack(form, value))[0]


def wire(message):
    """The message as a client decodes it."""
    return Codec(2, 2).decode(Codec(1, 1).encode(message))[0]


def test_names_fit_the_wire_and_are_in_index_order():
    store = Parameters(1)
    names = [wire(store.message(index)).param_id for index in range(len(store))]
    assert names == sorted(names)
    assert all(len(name) <= 16 for name in names)
    assert [store.index(name) for name in names] == list(range(len(store)))


@given(st.integers(-(2**31), 2**31 - 1))
def test_integers_travel_bytewise(value):
    packed = struct.pack("<i", value)
    if math.isfinite(struct.unpack("<f", packed)[0]):  # a NaN's bits may change in a float
        store = Parameters(1)
        store.write("COM_FLTMODE1", bytewise(value), TYPE_INT32)
        assert store.value("COM_FLTMODE1") == value
        message = wire(store.message(store.index("COM_FLTMODE1")))
        assert struct.pack("<f", message.param_value) == packed
        assert message.param_type == TYPE_INT32


@given(st.floats(width=32, allow_nan=False, allow_infinity=False))
def test_reals_come_back_as_stored(value):
    store = Parameters(1)
    store.write("MPC_XY_VEL_MAX", value, TYPE_REAL32)
    message = wire(store.message(store.index("MPC_XY_VEL_MAX")))
    assert message.param_value == value
    assert message.param_type == TYPE_REAL32
    assert 0.1 <= store.effective("MPC_XY_VEL_MAX") <= 20.0 + 1e-9


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_no_number_is_refused(value):
    store = Parameters(1)
    assert store.write("MPC_XY_VEL_MAX", value, TYPE_REAL32) is False
    assert store.value("MPC_XY_VEL_MAX") == 12.0


def test_unknown_name_and_wrong_type_are_ignored():
    store = Parameters(1)
    assert store.write("NO_SUCH", 1.0, TYPE_REAL32) is None
    assert store.write("MPC_XY_VEL_MAX", 5.0, TYPE_INT32) is None
    assert store.value("MPC_XY_VEL_MAX") == 12.0


def test_system_id_is_read_only():
    store = Parameters(7)
    assert store.write("MAV_SYS_ID", bytewise(9), TYPE_INT32) is False
    assert store.value("MAV_SYS_ID") == 7


def test_hash_follows_the_values():
    store = Parameters(1)
    before = struct.pack("<f", store.hash_message().param_value)
    assert struct.pack("<f", Parameters(1).hash_message().param_value) == before
    store.write("MPC_XY_VEL_MAX", 5.0, TYPE_REAL32)
    assert struct.pack("<f", store.hash_message().param_value) != before


def test_listing_sends_the_hash_then_every_index_once(bench):
    bench.send(dialect.MAVLink_param_request_list_message(1, 1))
    bench.run(1.0)
    listed = bench.take("PARAM_VALUE")
    count = len(bench.autopilot.parameters)
    assert (listed[0].param_id, listed[0].param_index, listed[0].param_type) == (
        "_HASH_CHECK",
        65535,
        5,
    )
    assert [message.param_index for message in listed[1:]] == list(range(count))
    assert {message.param_count for message in listed} == {count}


def test_good_cache_ends_the_listing(bench):
    bench.send(dialect.MAVLink_param_request_list_message(1, 1))
    bench.send(dialect.MAVLink_param_set_message(1, 1, b"_HASH_CHECK", 0.0, 5))
    bench.run(1.0)
    assert len(bench.take("PARAM_VALUE")) == 1


def test_read_by_name_and_index_and_silence_for_the_rest(bench):
    def answers(name, index):
        bench.send(dialect.MAVLink_param_request_read_message(1, 1, name, index))
        bench.tick()
        return [(m.param_id, m.param_index) for m in bench.take("PARAM_VALUE")]

    at = bench.autopilot.parameters.index("MIS_TAKEOFF_ALT")
    assert answers(b"MIS_TAKEOFF_ALT", -1) == [("MIS_TAKEOFF_ALT", at)]
    assert answers(b"", at) == [("MIS_TAKEOFF_ALT", at)]
    assert answers(b"_HASH_CHECK", -1) == [("_HASH_CHECK", 65535)]
    assert answers(b"NO_SUCH", -1) == []
    assert answers(b"", 32767) == []


def test_set_is_answered_twice_and_others_hear_it_once(bench):
    from sitl.autopilot.telemetry import Preset

    other = bench.autopilot.open_link(Preset.GCS)
    bench.send(dialect.MAVLink_param_set_message(1, 1, b"MPC_XY_CRUISE", 7.0, TYPE_REAL32))
    bench.tick()
    assert [m.param_value for m in bench.take("PARAM_VALUE")] == [7.0, 7.0]
    assert [m.param_value for m in other.take()] == [7.0]
    bench.send(dialect.MAVLink_param_set_message(1, 1, b"MPC_XY_CRUISE", math.nan, TYPE_REAL32))
    bench.tick()
    assert [m.param_value for m in bench.take("PARAM_VALUE")] == [7.0]
    bench.send(dialect.MAVLink_param_set_message(1, 1, b"MPC_XY_CRUISE", 1.0, TYPE_INT32))
    bench.tick()
    assert bench.take("PARAM_VALUE") == []
