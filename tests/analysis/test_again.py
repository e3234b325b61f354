"""`mavfi replay CAMPAIGN --mission`: a mission of a ledger and of an export, flown again."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from mavfi_cli import library
from mavfi_cli.analysis.flights import mission_of, read_export
from mavfi_cli.campaigns.begin import opened
from mavfi_cli.campaigns.ledger import METADATA
from mavfi_cli.campaigns.missions import PlannedMission
from mavfi_cli.campaigns.run import run_campaign
from mavfi_cli.core.errors import ConfigError, RecordError
from mavfi_cli.report.campaign import flights_file
from mavfi_cli.spec.fault import FaultConfig

FAULT = FaultConfig(target="waypoint_position", together=True, field="sign", at="time=0.5", seed=3)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, short_config):
    """A campaign of a golden and a faulty mission, each of a second."""
    made, golden = tmp_path_factory.mktemp("campaign"), replace(short_config, time_limit_s=1.0)
    missions = [
        PlannedMission(config=config, labels={"n": n})
        for n, config in enumerate((golden, replace(golden, fault=FAULT)))
    ]
    run_campaign(missions, made).close()
    return made


@pytest.fixture(scope="module")
def export(folder, tmp_path_factory):
    """Its export."""
    path = tmp_path_factory.mktemp("export") / "mine.parquet"
    pq.write_table(library.campaign(folder).table, path)
    return path


def mission(place, number):
    with opened(place) as ledger:
        return mission_of(ledger, number)


@pytest.mark.slow
def test_a_faulty_mission_repeats_from_both(folder, export, mavfi, tmp_path):
    for place in (folder, export):
        done = mavfi("replay", str(place), "--mission", "1", "--out", str(tmp_path), "--json")
        told = json.loads(done.stdout)
        assert (done.returncode, told["identical"], told["differing_measures"]) == (0, True, [])
        assert told["outcomes"][0] == told["outcomes"][1]


def test_without_the_fault_it_is_the_golden_one(folder, export):
    assert mission(folder, 1)[0].golden == mission(export, 0)[0]
    assert mission(export, 1)[0].fault == FAULT


def test_a_mission_that_another_build_flew_is_repeated_with_a_warning(export, mavfi, tmp_path):
    path, table = tmp_path / "old.parquet", pq.read_table(export)
    origin = json.loads(table.schema.metadata[METADATA])
    origin["versions"]["numpy"] = "0.1"
    pq.write_table(table.replace_schema_metadata({METADATA: json.dumps(origin)}), path)
    done = mavfi("replay", str(path), "--mission", "0", "--out", str(tmp_path))
    assert done.returncode == 0
    assert "numpy was 0.1" in done.stderr


def test_what_differs_is_named_and_ends_with_1(export, mavfi, tmp_path):
    rows = pq.read_table(export).to_pylist()
    rows[0]["distance_m"] += 1e-9
    rows[0]["outcome"] = "collision"
    pq.write_table(pa.Table.from_pylist(rows), tmp_path / "other.parquet")
    done = mavfi(
        "replay", str(tmp_path / "other.parquet"), "--mission", "0", "--out", str(tmp_path)
    )
    assert done.returncode == 1
    assert "DIFFERENT in outcome, distance_m" in done.stdout


def test_no_such_mission(folder, export, tmp_path):
    for place in (folder, export):
        with pytest.raises(ConfigError, match=r"7.* 0 to 1"):
            mission(place, 7)
    with pytest.raises(RecordError):
        mission(tmp_path, 0)
    pq.write_table(pa.table({"number": [0]}), tmp_path / "foreign.parquet")
    with pytest.raises(RecordError, match="not an export"):
        mission(tmp_path / "foreign.parquet", 0)


@pytest.mark.parametrize("text", ["{", "[1]", '{"wrold": 3}', '{"seed": -1}'])
def test_a_mission_of_strange_changes_is_refused(export, tmp_path, text):
    table, path = pq.read_table(export), tmp_path / "strange.parquet"
    place, texts = table.column_names.index("changes"), pa.array([text] * table.num_rows)
    pq.write_table(table.set_column(place, "changes", texts), path)
    with pytest.raises(RecordError, match="configuration of mission 0"):
        mission(path, 0)


def test_a_debugger_needs_a_run_folder(folder, mavfi):
    done = mavfi("replay", str(folder), "--mission", "0", "--gdb")
    assert done.returncode == 2
    assert "--gdb needs a run folder" in done.stderr


def test_columns_of_an_export_have_their_types_with_and_without_values(export):
    schema = pq.read_schema(export)
    assert schema.field("world_seed").type == pa.int64()  # no mission has one
    assert [field.name for field in schema if pa.types.is_null(field.type)] == []
    golden, struck = pq.read_table(export)["struck_bits"].to_pylist()
    assert golden is None
    assert struck == [[63], [63], [63]]  # the signs of x, y and z


def test_an_export_of_an_earlier_version_is_read_as_one_of_this(export, tmp_path):
    table = pq.read_table(export)
    place, old = table.schema.get_field_index("struck_bits"), tmp_path / "old.parquet"
    rows = [None, "1 15;19 24"]
    pq.write_table(table.slice(0, 2).set_column(place, "struck_bits", pa.array(rows)), old)
    assert read_export(old)["struck_bits"].to_pylist() == [None, [[1, 15], [19, 24]]]
    paths = table.schema.get_field_index("path")
    unread = table.set_column(paths, "path", pa.nulls(len(table), pa.string()))
    assert read_export(export).equals(unread)  # a path in a file may lead anywhere
    pq.write_table(table.slice(0, 1).set_column(place, "struck_bits", pa.array(["x"])), old)
    with pytest.raises(RecordError, match="cannot be read"):
        read_export(old)


def test_a_list_is_json_in_csv(export):
    text = flights_file(read_export(export), Path("t.csv")).decode()
    rows = list(csv.DictReader(text.splitlines()))
    struck = pq.read_table(export)["struck_bits"].to_pylist()
    assert [json.loads(row["struck_bits"] or "null") for row in rows] == struck
