"""The cost of detection and recovery in one flight: sums by hand, and a record that was flown."""

import json

import pytest
from made_flights import watched

from mavfi_cli.mission.measures import DetectionCost, FlightRecord

ALARMS = [
    ("perception", "recompute"), ("planning", "recompute"), ("planning", "hold"),
    ("planning", "accept"), ("control", "recompute"),
]  # fmt: skip
COUNTS = {"recompute": 6, "hold": 2, "accept": 1}
RECORD = {
    **watched("gad", 0.005, ALARMS, responses=COUNTS),
    "quality_of_flight": {"flight_time_s": 20.0},
    "simulated_s": 32.0,
}


def test_checks_take_host_time_and_recomputations_the_latency_of_their_kernels():
    """Four of eight recomputations are listed: one, two and one, so they are two, four and two."""
    cost = DetectionCost.of(FlightRecord.of(RECORD))
    assert (cost.detector, cost.checks) == ("gad", 1000)
    assert cost.check_host_s == pytest.approx(5e-6)
    assert cost.detection_share == pytest.approx(0.005 / 20.0)
    assert cost.recomputations == {"perception": 2.0, "planning": 4.0, "control": 2.0}
    assert cost.recovery_s == pytest.approx(
        {"perception": 2 * (0.01 + 0.3 + 0.05), "planning": 4 * 0.2, "control": 2 * 0.0005}
    )
    assert cost.recovered_s == pytest.approx(1.521)
    assert cost.recovery_share == pytest.approx(1.521 / 20.0)


def test_an_alarm_about_a_report_that_recomputes_control_costs_control_only():
    alarm = {"stage": "perception", "recomputes": "control", "response": "recompute"}
    detection = RECORD["detection"] | {"responses": {"recompute": 1}, "alarms": [alarm]}
    cost = DetectionCost.of(FlightRecord.of(RECORD | {"detection": detection}))
    assert cost.recomputations == {"perception": 0.0, "planning": 0.0, "control": 1.0}
    assert cost.recovered_s == pytest.approx(0.0005)


def test_without_a_flight_time_the_whole_mission_counts():
    cost = DetectionCost.of(
        FlightRecord.of(RECORD | {"quality_of_flight": {"flight_time_s": None}})
    )
    assert cost.detection_share == pytest.approx(0.005 / 32.0)


@pytest.mark.parametrize(
    "changes",
    [
        {"detection": None},
        {"host": {"stage_wall_s": {"octomap": 0.2}}},
        {"detection": RECORD["detection"] | {"checks": {"report": 0, "tick": 0}}},
        {"quality_of_flight": {}, "simulated_s": 0.0},
    ],
)
def test_a_flight_in_which_nothing_was_checked_has_no_cost(changes):
    assert DetectionCost.of(FlightRecord.of(RECORD | changes)) is None
    assert DetectionCost.of(FlightRecord.of({"outcome": "hang"})) is None


def test_a_real_record_has_what_it_takes(watched_flight):
    result = json.loads(watched_flight.result.read_text())
    cost = DetectionCost.of(FlightRecord.of(result))
    assert cost.checks_host_s == result["host"]["stage_wall_s"]["gate"] > 0.0
    assert cost.flight_s == result["quality_of_flight"]["flight_time_s"]
    assert 50.0 < cost.checks / cost.flight_s < 100.0  # a tick is 20 ms
    assert set(cost.recovery_s) == {"perception", "planning", "control"}
