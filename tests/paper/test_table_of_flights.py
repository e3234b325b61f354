"""The one table of flights: what stands beside each flight, and which flights are in it."""

import pyarrow as pa
import pytest
from made_flights import flight, flights, struck

from mavfi_cli.analysis.pairs import Fate, Flights


def columns(found, *names):
    return list(zip(*(found[name] for name in names), strict=True))


def test_each_flight_stands_beside_its_golden_one():
    found = flights([
        flight(20.0), flight(None, pair="b"),
        struck(23.0), struck(21.0), struck(None), struck(30.0, pair="b"),
        struck(30.0, pair="c"),
    ])  # fmt: skip
    assert columns(found, "own_lost", "over_own", "added_s", "harmed")[2:] == [
        (False, pytest.approx(1.15), pytest.approx(3.0), True),
        (False, pytest.approx(1.05), pytest.approx(1.0), False),  # 10 % longer is the limit
        (False, None, None, True),
        (True, None, None, None),  # the golden flight was lost
        (None, None, None, None),  # there is none
    ]


def test_the_fate_of_a_node_is_that_without_a_detector():
    dead = {"fault_seed": 1, "node_ended": "hang"}
    found = flights([
        flight(20.0), struck(20.0, **dead), struck(21.0, fault_seed=2),
        struck(22.0, fault_seed=1, detector="gad"),
        struck(23.0, fault_seed=2, detector="gad", node_ended="hang"),
        struck(24.0, fault_seed=3, detector="gad"),  # not flown without
    ])  # fmt: skip
    assert found.of_fate(Fate.ALL)["flight_time_s"] == found["flight_time_s"]
    assert found.of_fate(Fate.DEAD)["flight_time_s"] == [20.0, 20.0, 22.0]
    assert found.of_fate(Fate.SILENT)["flight_time_s"] == [20.0, 21.0, 23.0]


def test_a_protected_flight_stands_beside_the_same_fault_without_a_detector():
    found = flights([
        flight(20.0), struck(30.0, fault_seed=1), struck(None, fault_seed=2),
        *(struck(20.0, fault_seed=seed, detector="gad") for seed in (1, 2, 3)),
    ])  # fmt: skip
    names = ("bare_lost", "bare_over_own", "bare_harmed")
    assert columns(found, *names)[3:] == [
        (False, 1.5, True), (True, None, True), (None, None, None),
    ]  # fmt: skip


def test_a_shorter_export_has_empty_columns_and_errors_are_no_flights():
    short = {"state": ["flown", "error"], "outcome": ["success", None], "changes": ["{}", "{}"]}
    found = Flights.of(pa.table(short))
    assert columns(found, "lost", "struck", "world", "check_share") == [(False, False, None, None)]


def test_a_mission_of_several_campaigns_is_there_once():
    rows = {"state": ["flown"] * 2, "outcome": ["success"] * 2, "stack": ["ours", "theirs"],
            "changes": ["{}", '{"stack":"theirs"}']}  # fmt: skip
    tables = [Flights.of(pa.table(rows))] * 2
    assert len(Flights.pooled(tables)) == 2
    assert Flights.pooled(tables, "ours")["stack"] == ["ours"]
    assert len(Flights.pooled([])) == 0


def test_flights_are_counted_where_a_column_is_known():
    found = flights([flight(20.0), struck(23.0), struck(30.0, pair="b")])
    assert (found.share("harmed").count, found.share("harmed").total) == (1, 2)
    assert found.share(value=False).count == 3
    worlds = found.by("world", "level")
    assert {key: len(those) for key, those in worlds.items()} == {
        ("sparse", None): 1, ("sparse", "instruction"): 2,
    }  # fmt: skip


def test_flights_with_a_part_of_the_stages_are_not_comparable():
    parts = [struck(20.0, detector="gad", protect=each) for each in ("control", "planning")]
    found = flights([flight(20.0), struck(20.0, detector="aad"), *parts]).comparable
    assert found["detector"] == [None, "aad"]
