"""The ledger: whole rows or none, one writer, and no other version's."""

import contextlib
import sqlite3
from dataclasses import replace

import pytest
from plans import planned

from mavfi_cli.campaigns.ledger import LEDGER, Ledger
from mavfi_cli.campaigns.missions import (
    Injected,
    PlannedMission,
    ResultState,
    changes_of,
)
from mavfi_cli.core.config import structure
from mavfi_cli.core.errors import ConfigError, RecordError
from mavfi_cli.mission.measures import FlightRecord
from mavfi_cli.spec.fault import FaultConfig, InstructionConfig
from mavfi_cli.spec.mission import MissionConfig

ROW = {
    "state": ResultState.FLOWN,
    "result": {"outcome": "success", "quality_of_flight": {"flight_time_s": 20.0}},
    "reason": "",
    "injected": Injected.GOLDEN,
    "wall_s": 1.0,
    "attempts": 1,
    "path": "runs/000000-farm",
}
CONFIGS = [
    MissionConfig(),
    MissionConfig(seed=9, start=(1.0, 2.0, 0.0), isolate=("octomap",)),
    MissionConfig(fault=FaultConfig(target="waypoint_x", exact_bits=(1, 62), duration_s=2.0)),
    MissionConfig(instruction=InstructionConfig(target="planner", sites=("general", "flags"))),
]


@contextlib.contextmanager
def written(folder, count=3):
    with Ledger(folder, writing=True) as ledger:
        ledger.plan(planned(*["fly"] * count))
        yield ledger


@pytest.mark.parametrize("config", CONFIGS)
def test_a_mission_comes_back_as_it_was(tmp_path, config):
    mission = PlannedMission(config=config, labels={"bits": 3, "stage": None})
    assert structure(changes_of(config), MissionConfig) == config
    with Ledger(tmp_path, writing=True) as ledger:
        ledger.plan([mission])
        ledger.add(0, **ROW)
        (result,) = ledger.results()
    assert result.mission == mission
    assert result.result == ROW["result"]
    assert result.path == tmp_path / "runs/000000-farm"


@pytest.mark.parametrize("config", CONFIGS[2:])
def test_a_pair_is_named_by_its_golden_flight(config):
    flown, restarted, golden, bare, other = (
        PlannedMission(config=each).pair
        for each in (
            *(config, replace(config, node_restart_s=9.0), config.golden, MissionConfig()),
            MissionConfig(seed=4),
        )
    )
    assert flown == restarted == golden == bare
    assert other != flown


def test_what_has_no_row_is_missing(tmp_path):
    with written(tmp_path, 2500) as ledger:
        for number in (0, 3, 2400):
            ledger.add(number, **ROW)
        ledger.add(5, **{**ROW, "state": ResultState.ERROR, "result": {}, "injected": None})
        missing = [number for number, *_ in ledger.missing()]
        assert missing == [n for n in range(2500) if n not in (0, 3, 5, 2400)]
        assert [n for n, *_ in ledger.missing(errors=True)][2:5] == [4, 5, 6]
        assert ledger.over() == 4
        assert list(ledger.columns(("number", "outcome"))) == [[(0, 3, 2400), ("success",) * 3]]
        assert ledger.errors_by_cell() == {0: 1}


def test_rows_added_while_the_missing_are_read_change_nothing(tmp_path):
    with written(tmp_path, 10) as ledger:
        seen = []
        for number, *_ in ledger.missing():
            ledger.add(number, **ROW)
            seen.append(number)
    assert seen == list(range(10))


def test_it_is_read_while_it_is_written(tmp_path):
    with written(tmp_path) as ledger, Ledger(tmp_path) as reader:
        assert reader.over() == 0
        ledger.add(1, **ROW)
        assert reader.over() == 1


def test_a_reader_changes_nothing(tmp_path):
    with written(tmp_path):
        pass
    with Ledger(tmp_path) as reader, pytest.raises(RecordError, match="readonly"):
        reader.add(0, **ROW)


def test_a_ledger_that_cannot_be_written_is_read(tmp_path, monkeypatch):
    with written(tmp_path) as ledger:
        planned_missions = ledger.planned()
        with monkeypatch.context() as patch:
            patch.setattr("mavfi_cli.campaigns.ledger.os.access", lambda *_: False)
            with pytest.raises(ConfigError, match="is read-only, and its run has not ended"):
                Ledger(tmp_path)
    before = sorted(tmp_path.iterdir())
    monkeypatch.setattr("mavfi_cli.campaigns.ledger.os.access", lambda *_: False)
    with Ledger(tmp_path) as ledger:
        assert ledger.planned() == planned_missions > 0
        assert sorted(tmp_path.iterdir()) == before  # no index of a log


def test_a_full_disk_leaves_the_old_rows_and_half_of_none(tmp_path):
    with written(tmp_path) as ledger:
        ledger.add(0, **ROW)
        pages = ledger._db.execute("PRAGMA page_count").fetchone()[0]
        ledger._db.execute(f"PRAGMA max_page_count = {pages}")  # SQLite's own "disk is full"
        noise = "".join(chr(33 + (i * i * 7919) % 90) for i in range(200_000))
        with pytest.raises(RecordError, match="full"):
            ledger.add(1, **{**ROW, "result": {"outcome": noise}})
        ledger._db.execute("PRAGMA max_page_count = 1000000")
        assert [result.number for result in ledger.results()] == [0]
        ledger.add(1, **ROW)
        assert [result.number for result in ledger.results()] == [0, 1]


def test_another_version_is_refused(tmp_path):
    with written(tmp_path) as ledger:
        ledger.set_meta({"schema": "99"})
    for writing in (False, True):
        with pytest.raises(ConfigError, match=r"version 99; .* version 1"):
            Ledger(tmp_path, writing=writing)


@pytest.mark.parametrize(
    ("content", "error", "problem"),
    [
        (b"not a database" * 100, RecordError, "not a database"),
        (None, RecordError, "holds no campaign"),
    ],
)
def test_what_is_no_ledger_is_refused(tmp_path, content, error, problem):
    if content is not None:
        (tmp_path / LEDGER).write_bytes(content)
    with pytest.raises(error, match=problem):
        Ledger(tmp_path)


def test_a_damaged_ledger_is_one_line(tmp_path):
    with written(tmp_path) as ledger:
        ledger.add(0, **ROW)
    path = tmp_path / LEDGER
    data = bytearray(path.read_bytes())
    for page in range(8192, len(data), 512):
        data[page : page + 64] = bytes([255] * 64)
    path.write_bytes(data)
    for read in (Ledger.planned, Ledger.cells, Ledger.results, Ledger.missing, Ledger.fates):
        with Ledger(tmp_path) as damaged, pytest.raises(RecordError, match="malformed"):
            list(read(damaged))


def test_a_database_of_somebody_else_is_refused(tmp_path):
    with contextlib.closing(sqlite3.connect(tmp_path / LEDGER)) as other:
        other.execute("CREATE TABLE songs (name TEXT)")
        other.commit()
    with pytest.raises(ConfigError, match="of no version"):
        Ledger(tmp_path, writing=True)


@pytest.mark.parametrize(
    ("fault", "injected"),
    [
        (None, Injected.NOT_INJECTED),
        ({"state": "planned"}, Injected.NOT_INJECTED),
        ({"state": "not_injected", "activation": {"activation": "read"}}, Injected.NOT_INJECTED),
        ({"state": "null"}, Injected.NULL),
        ({"state": "applied"}, Injected.ACTIVE),
        ({"state": "applied", "activation": {"activation": "not_read"}}, Injected.NOT_ACTIVATED),
        ({"state": "applied", "activation": {"activation": "unchanged"}}, Injected.NOT_ACTIVATED),
        ({"state": "applied", "activation": {"activation": "read"}}, Injected.ACTIVE),
        ({"state": "applied", "activation": {"activation": "overwritten"}}, Injected.NOT_ACTIVATED),
        ({"state": "applied", "activation": {"activation": "not_read_in_window"}}, Injected.UNREAD),
    ],
)
def test_what_became_of_a_fault(fault, injected):
    assert Injected.of(FlightRecord.of({"fault": fault}), faulty=True) is injected
    assert Injected.of(FlightRecord.of({"fault": fault}), faulty=False) is Injected.GOLDEN


@pytest.mark.parametrize(
    ("alarm", "injected"),
    [
        ({}, Injected.CAUGHT),
        ({"states": ["waypoint_x"]}, Injected.CAUGHT),  # at that very stamp
        ({"stamp_s": 11.5}, Injected.CAUGHT),
        ({"stamp_s": 11.5, "states": ["waypoint_x"]}, Injected.NOT_ACTIVATED),
        ({"stamp_s": 10.0}, Injected.NOT_ACTIVATED),  # before the fault
        ({"response": "accept"}, Injected.NOT_ACTIVATED),
    ],
)
def test_a_fault_that_a_detector_withheld_was_no_idle_one(alarm, injected):
    told = {"stamp_s": 11.0, "states": ["command_yaw"], "response": "recompute", **alarm}
    fault = {
        "state": "applied",
        "activation": {"activation": "overwritten"},
        "strikes": [{"stamp_s": 11.0, "changes": [{"state": "command_yaw"}]}],
    }
    result = {"fault": fault, "detection": {"alarms": [told]}}
    assert Injected.of(FlightRecord.of(result), faulty=True) is injected
    assert (
        Injected.of(FlightRecord.of({**result, "detection": None}), faulty=True)
        is Injected.NOT_ACTIVATED
    )
