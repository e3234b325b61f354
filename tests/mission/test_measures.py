"""What a fault did, as the columns of an export."""

import pytest

from mavfi_cli.mission.measures import STRUCK, FlightRecord, measures_of

STRIKE = {
    "changes": [
        {
            "state": "waypoint_x", "index": 33, "bits": [57], "before": 25.5, "after": 1.5e11,
            "before_hex": "0x4039800000000000", "after_hex": "0x4239800000000000",
        }
    ],
    "invocation": 1, "phase": "flying", "stamp_s": 11.96, "tick": 79,
}  # fmt: skip
SOURCE = {
    "level": "source", "state": "applied", "strike_count": 1, "strikes": [STRIKE],
    "activation": {
        "activation": "read",
        "first_reader": {"name": "collision_check", "stamp_s": 12.17, "state": "waypoint_x"},
    },
}  # fmt: skip
INSTRUCTION = {
    "level": "instruction", "state": "applied", "node": "octomap", "kernel": "octomap",
    "symbol": "search+0x205", "object": "liboctomap.so", "offset": 0x28765, "invocation": 15,
    "instruction": "and ebx, 1", "k": 3, "stamp_s": 13.39,
    "corruption": {"bits": [0, 4], "register": "rbx", "role": "destination", "site": "general"},
    "injection": {"applied": True, "before": "0x0", "after": "0x11", "reason": ""},
    "activation": {"activation": "read", "after_instructions": 3, "instruction": "add ebx, r8d"},
}  # fmt: skip


def told(**result):
    """The columns that are not empty."""
    found = {
        name: value
        for name, value in measures_of(FlightRecord.of(result)).items()
        if name in STRUCK
    }
    assert tuple(found) == STRUCK
    return {name: value for name, value in found.items() if value is not None}


def test_a_fault_in_a_state():
    assert told(fault=SOURCE) == {
        "strikes": 1, "strike_s": 11.96, "strike_phase": "flying", "strike_tick": 79,
        "strike_invocation": 1, "struck_state": "waypoint_x", "struck_index": "33",
        "struck_bits": [[57]], "struck_before": "25.5", "struck_after": "150000000000.0",
        "struck_before_hex": "0x4039800000000000", "struck_after_hex": "0x4239800000000000",
        "activation": "read", "first_reader": "collision_check",
        "first_read_state": "waypoint_x", "first_read_s": 12.17,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("pattern", "value"),
    [
        ("0x7ff0000000000000", "inf"),
        ("0xfff0000000000000", "-inf"),
        ("0x7ff8000000000000", "nan"),
        ("0xff800000", "-inf"),
    ],
)
def test_several_components_keep_their_order_and_what_json_cannot_hold_its_value(pattern, value):
    infinite = {**STRIKE["changes"][0], "state": "waypoint_y", "bits": [1, 2], "after": None,
                "after_hex": pattern}  # fmt: skip
    strike = {**STRIKE, "changes": [STRIKE["changes"][0], infinite]}
    found = told(fault={**SOURCE, "strikes": [strike, STRIKE], "strike_count": 2})
    assert found["strikes"] == 2
    assert found["struck_state"] == "waypoint_x;waypoint_y"
    assert found["struck_bits"] == [[57], [1, 2]]
    assert found["struck_after"] == f"150000000000.0;{value}"


def test_a_fault_in_an_instruction():
    nodes = {"octomap": {"crashes": [{"how": "killed by SIGSEGV"}], "hangs": 1}}
    assert told(fault=INSTRUCTION, nodes=nodes) == {
        "strikes": 1, "strike_s": 13.39, "strike_invocation": 15, "struck_bits": [[0, 4]],
        "struck_before_hex": "0x0", "struck_after_hex": "0x11", "activation": "read",
        "struck_node": "octomap", "struck_kernel": "octomap", "struck_function": "search+0x205",
        "struck_address": "liboctomap.so+0x28765", "struck_instruction": "and ebx, 1",
        "struck_execution": 3, "struck_role": "destination", "struck_register": "rbx",
        "reading_instruction": "add ebx, r8d", "node_ended": "killed by SIGSEGV;hang",
    }  # fmt: skip


def test_a_killed_process_changes_no_bit():
    strike = {"changes": [], "invocation": 3, "phase": "flying", "stamp_s": 9.0, "tick": 5}
    killed = {**SOURCE, "states": ["process.planner"], "strikes": [strike]}
    found = measures_of(FlightRecord.of({"fault": killed}))
    assert (found["struck_s"], found["first_bits"]) == (9.0, [])
    assert (found["strikes"], found["struck_bits"]) == (1, [])


def test_a_fault_that_did_not_act_has_no_strike():
    missed = {**INSTRUCTION, "injection": {"applied": False}}
    assert told(fault=missed)["strikes"] == 0
    assert "strike_s" not in told(fault=missed)
    unknown = {name: value for name, value in INSTRUCTION.items() if name != "injection"}
    assert "strikes" not in told(fault=unknown)  # its process was cut off
    assert told(fault={**SOURCE, "strikes": [], "strike_count": 0}) == {"strikes": 0}


@pytest.mark.parametrize("result", [{}, {"fault": None}, {"fault": {"state": "planned"}}])
def test_what_no_record_tells_is_empty(result):
    """Golden flights, and such as were cut off before they struck."""
    assert told(**result) == {}
