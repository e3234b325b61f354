"""What a fault did, and whether it was seen."""

from types import SimpleNamespace

import pytest
from evaluation_flights import flown, pair, struck

from mavfi_cli.campaign.evaluation.pairs import Flights, Harm, flown_of, harm_of
from mavfi_cli.campaign.outcome import Injected

GOLDEN = {"kind": "error-free", "world": "farm", "seed": 7}
FAULT = {
    **GOLDEN, "kind": "fault", "level": "source", "stage": "planning", "target": "planning",
    "field": "sign",
}  # fmt: skip


@pytest.mark.parametrize(
    ("golden", "treated", "harm"),
    [
        (flown(), flown(time_s=104.9), Harm.NONE),
        (flown(), flown(time_s=105.1), Harm.LONGER),
        (flown(), flown(time_s=90.0), Harm.NONE),
        (flown(), flown("collision", 10.0), Harm.LOST),
        (flown(), flown("crash", None), Harm.LOST),
        (flown("collision"), flown("timeout", 300.0), Harm.OTHERWISE),
        (flown("collision"), flown("collision", 300.0), Harm.NONE),
        (flown("collision"), flown(), Harm.NONE),  # a fault that saved the mission
    ],
)
def test_harm_is_a_lost_mission_or_more_than_five_per_cent(golden, treated, harm):
    assert harm_of(golden, treated) is harm


def test_an_alarm_before_the_strike_detects_nothing():
    early = pair(struck(), struck(alarms_s=(19.98,)))
    assert early.alarm is None
    assert early.latency_s is None
    both = pair(struck(), struck(alarms_s=(19.98, 20.0, 20.5)))
    assert both.alarm.stamp_s == 20.0
    assert both.latency_s == 0.0


def test_a_protected_flight_that_was_never_struck_has_nothing_to_detect():
    parted = pair(struck(), flown(alarms_s=(25.0,), injected=Injected.NOT_INJECTED))
    assert not parted.struck
    assert parted.alarm is None


def test_what_the_detector_does_anyway_is_by_chance():
    assert pair(struck(), struck(alarms_s=(21.0,)), watched=flown(alarms_s=(50.0,))).by_chance
    assert not pair(struck(), struck(), watched=flown(alarms_s=(10.0,))).by_chance


@pytest.mark.parametrize(
    ("injected", "active"),
    [
        (Injected.ACTIVE, True),
        (Injected.UNREAD, True),
        (Injected.NOT_ACTIVATED, False),
        (Injected.NOT_INJECTED, False),
    ],
)
def test_activity_is_that_of_the_unprotected_flight(injected, active):
    withheld = struck(injected=Injected.NOT_ACTIVATED)  # the gate kept anybody from reading it
    assert pair(struck(injected=injected), withheld).active is active


def test_pairs_need_all_of_their_flights():
    flights = Flights()
    flights.add({**FAULT, "detector": "gad"}, struck())
    flights.add({**FAULT, "detector": "none"}, struck("collision"))
    flights.add({**GOLDEN, "detector": "none"}, flown())
    assert flights.faults(["gad"], lambda _: True) == []
    flights.add({**GOLDEN, "detector": "gad"}, flown(alarms_s=(3.0,)))
    (found,) = flights.faults(["gad"], lambda seed: seed != 7)
    assert (found.world, found.seed, found.stage, found.field) == ("farm", 7, "planning", "sign")
    assert found.faulty.outcome == "collision"
    assert found.watched.alarm_count == 1
    assert not found.complete
    (bare,) = flights.faults(["none"], lambda _: True)
    assert bare.protected is bare.faulty
    (free,) = flights.error_free(["gad"])
    assert free.watched.alarm_count == 1


def entry(fault, **result):
    return SimpleNamespace(
        outcome="success", injected=Injected.ACTIVE, path=None,
        result={"quality_of_flight": {"flight_time_s": 12.0}, "fault": fault, **result},
    )  # fmt: skip


def test_a_record_of_a_source_level_fault():
    strike = {"stamp_s": 11.5, "changes": [{"bits": [3]}]}
    fault = {"level": "source", "state": "applied", "states": ["command_vx"], "strikes": [strike]}
    alarm = {"stamp_s": 12.5, "stage": "control", "score": 3.0}
    detection = {
        "alarms": [alarm], "alarm_count": 4,
        "recoveries": {"control": {"count": 1}, "planning": {"count": 2}},
    }  # fmt: skip
    nodes = {"planner": {"crashes": [{"how": "killed"}]}, "control": {"crashes": []}}
    read = flown_of(entry(fault, detection=detection, nodes=nodes))
    assert (read.struck_s, read.states, read.bits) == (11.5, ("command_vx",), (3,))
    assert (read.alarm_count, read.episodes, read.crashed) == (4, 3, True)
    assert [each.stamp_s for each in read.alarms] == [12.5]


def test_a_record_of_an_instruction_level_fault():
    fault = {
        "level": "instruction", "state": "applied", "node": "planner", "stamp_s": 8.0,
        "corruption": {"bits": [5]},
    }  # fmt: skip
    read = flown_of(entry(fault))
    assert (read.struck_s, read.states, read.bits) == (8.0, ("planner",), (5,))
    missed = flown_of(entry({**fault, "state": "not_injected"}))
    assert missed.struck_s is None
