"""What a fault did, and whether it was seen."""

import pytest
from made_flights import flight, labelled, pair, paired, struck

from mavfi_cli.analysis.detectors import WANTED
from mavfi_cli.mission.measures import FlightRecord, measures_of

GOLDEN = {"kind": "error-free", "world": "farm", "seed": 7}
FAULT = {
    **GOLDEN, "kind": "fault", "level": "source", "stage": "planning", "target": "planning",
    "field": "sign",
}  # fmt: skip


@pytest.mark.parametrize(
    ("golden", "treated", "harm"),
    [
        (flight(), struck(109.9), "none"),
        (flight(), struck(110.1), "longer"),
        (flight(), struck(90.0), "none"),
        (flight(), struck(10.0, outcome="collision"), "lost"),
        (flight(), struck(None, outcome="crash"), "lost"),
        (flight(None), struck(300.0, outcome="timeout"), ""),  # nothing can harm this mission
        (flight(None), struck(), ""),
    ],
)
def test_harm_is_a_lost_mission_or_more_than_ten_per_cent(golden, treated, harm):
    assert pair(treated, golden=golden)["harm"] == harm


def test_an_alarm_before_the_strike_detects_nothing():
    early = pair(struck(), struck(alarms_s=(19.98,)))
    assert not early["seen"]
    assert early["alarm_s"] is early["latency_s"] is None
    both = pair(struck(), struck(alarms_s=(19.98, 20.0, 20.5)))
    assert both["alarm_s"] == 20.0
    assert both["latency_s"] == 0.0


def test_a_protected_flight_that_was_never_struck_has_nothing_to_detect():
    parted = pair(struck(), flight(alarms_s=(25.0,), injected="not_injected"))
    assert not parted["struck"]
    assert not parted["seen"]


def test_what_the_detector_does_anyway_is_by_chance():
    assert pair(struck(), struck(alarms_s=(21.0,)), watched=flight(alarms_s=(50.0,)))["by_chance"]
    assert not pair(struck(), struck(), watched=flight(alarms_s=(10.0,)))["by_chance"]


@pytest.mark.parametrize(
    ("injected", "active"),
    [("active", True), ("unread", True), ("not_activated", False), ("not_injected", False)],
)
def test_activity_is_that_of_the_unprotected_flight(injected, active):
    withheld = struck(injected="not_activated")  # the gate kept anybody from reading it
    assert pair(struck(injected=injected), withheld)["active"] is active


def test_pairs_need_all_of_their_flights():
    rows = [
        labelled(struck(), **FAULT, detector="gad"),
        labelled(struck(None), **FAULT, detector="none"),
        labelled(flight(), **GOLDEN, detector="none"),
    ]
    assert paired(rows, "gad")[1] == []
    rows.append(labelled(flight(alarms_s=(3.0,)), **GOLDEN, detector="gad"))
    (free,), (found,) = paired(rows, "gad", complete=lambda seed: seed != 7)
    told = [found[name] for name in ("world", "seed", "stage", "field")]
    assert told == ["farm", 7, "planning", "sign"]
    assert (found["faulty_outcome"], found["outcome"]) == ("collision", "success")
    assert not found["complete"]
    assert free["alarms"] == 1
    _, (bare,) = paired(rows, "none")
    assert bare["outcome"] == bare["faulty_outcome"] == "collision"


def record(fault, **result):
    return measures_of(
        FlightRecord.of({"quality_of_flight": {"flight_time_s": 12.0}, "fault": fault, **result})
    )


def test_a_record_of_a_source_level_fault():
    strike = {
        "stamp_s": 11.5, "phase": "flying", "tick": 3, "invocation": 1,
        "changes": [{"bits": [3], "state": "command_vx", "index": 0, "before": 1.0, "after": 2.0,
                     "before_hex": "0x0", "after_hex": "0x0"}],
    }  # fmt: skip
    fault = {"level": "source", "state": "applied", "states": ["command_vx"], "strikes": [strike]}
    alarm = {"stamp_s": 12.5, "stage": "control", "score": 3.0}
    detection = {
        "alarms": [alarm], "alarm_count": 4,
        "recoveries": {"control": {"count": 1}, "planning": {"count": 2}},
    }  # fmt: skip
    nodes = {"planner": {"crashes": [{"how": "killed"}]}, "control": {"crashes": []}}
    read = record(fault, detection=detection, nodes=nodes)
    assert set(WANTED) - {"outcome", "succeeded", "injected", "path"} <= set(read)
    assert (read["struck_s"], read["struck_sites"]) == (11.5, ["command_vx"])
    assert (read["first_bits"], read["flight_time_s"]) == ([3], 12.0)
    assert (read["alarm_count"], read["episodes"], read["crashed"]) == (4, 3, True)
    assert read["alarms"] == [{"stamp_s": 12.5, "stage": "control"}]


def test_a_record_of_an_instruction_level_fault():
    fault = {
        "level": "instruction", "state": "applied", "node": "planner", "stamp_s": 8.0,
        "corruption": {"bits": [5]},
    }  # fmt: skip
    read = record(fault)
    assert (read["struck_s"], read["struck_sites"], read["first_bits"]) == (8.0, ["planner"], [5])
    assert record({**fault, "state": "not_injected"})["struck_s"] is None


def test_a_record_of_a_mission_that_was_cut_off_has_empty_columns():
    read = measures_of(FlightRecord.of({}))
    assert not any(value for value in read.values())
