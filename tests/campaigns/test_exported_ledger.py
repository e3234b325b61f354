"""An exported campaign, opened as the campaign itself."""

import json
from collections import Counter
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

import mavfi_cli
from mavfi_cli.analysis.flights import exported, read_export
from mavfi_cli.analysis.summary import groups
from mavfi_cli.campaigns.begin import opened
from mavfi_cli.campaigns.ledger import ExportedLedger, Ledger
from mavfi_cli.core.errors import MavfiError, RecordError

EXPORT = Path(__file__).parents[2] / "docs" / "results" / "numbers.parquet"


def test_it_has_the_missions_of_the_file():
    table = read_export(EXPORT)
    with opened(EXPORT) as ledger:
        assert isinstance(ledger, ExportedLedger)
        assert ledger.planned() == ledger.over() == table.num_rows
        outcomes = Counter(outcome for _, (outcome, _) in ledger.fates())
        assert outcomes == Counter(table["outcome"].to_pylist())
        assert exported(ledger).equals(table)
        for group in groups(ledger, ["site"]):
            site = group.labels.get("site")
            own = [row for row in table.to_pylist() if row["label_site"] == site]
            times = [row["flight_time_s"] for row in own]
            assert group.flights["flight_time_s"].to_pylist() == times


def test_the_library_reads_it():
    read = mavfi_cli.campaign(EXPORT)
    assert read.folder == EXPORT
    assert read.table.equals(read_export(EXPORT))


def test_its_commands_say_what_those_of_its_folder_say(mavfi, tmp_path):
    short = mavfi("campaign", "status", EXPORT)
    assert short.stdout.startswith("numbers: 640 missions"), short.stderr
    worlds = "worlds: fixed (dense 3) in 320 flights, another one for each seed in 320; "
    for status in (short, mavfi("campaign", "status", EXPORT, "--full")):
        assert status.stdout.splitlines()[1].startswith(worlds)
    full = json.loads(mavfi("campaign", "status", EXPORT, "--json", "--quality").stdout)
    assert full["missions"] == 640
    table = mavfi("campaign", "report", EXPORT, "--format", "csv").stdout
    assert len(table.splitlines()) == 1 + 6 * 5  # settings and their numbers
    copy = tmp_path / "copy.parquet"
    told = json.loads(mavfi("campaign", "export", EXPORT, copy, "--json").stdout)
    assert (told["file"], told["missions"]) == (str(copy), 640)
    assert pq.read_table(copy).equals(read_export(EXPORT))


@pytest.mark.parametrize(
    ("line", "code", "said"),
    [
        (("replay", EXPORT), 2, "--mission NUMBER (missions 0 to 639)"),
        (("replay", EXPORT, "--mission", "640"), 1, "mission 640 has not been flown"),
        (("campaign", "draw", EXPORT, "--output", "a.svg"), 1, "no pair "),
        (("campaign", "draw", EXPORT, "--pair", "3", "--output", "a.svg"), 1, "no run folder of"),
        (("campaign", "status", EXPORT, "--overhead"), 1, "use the campaign's folder"),
        (("campaign", "run", EXPORT), 1, "cannot fly missions from an export"),
        (("campaign", "status", "absent.parquet"), 1, "absent.parquet: no such file"),
    ],
)
def test_what_an_export_cannot_do_is_said(mavfi, tmp_path, line, code, said):
    run = mavfi(*line, cwd=tmp_path)
    assert (run.returncode, run.stdout) == (code, "")
    assert run.stderr.startswith("error: ")
    assert said in run.stderr


@pytest.mark.parametrize(
    "columns",
    [
        {"number": [0, 0]},  # twice the same
        {"number": ["first", "second"]},
        {"pair": [None, None]},
        {"changes": [[1], [2]]},
        {"label_setting": [b"\xff", b"a"]},
    ],
    ids=["twice", "texts", "empty", "lists", "bytes"],
)
def test_a_table_of_other_contents_is_refused_in_one_line(tmp_path, columns):
    whole = pq.read_table(EXPORT).slice(0, 2)
    for name, values in columns.items():
        whole = whole.set_column(whole.column_names.index(name), name, pa.array(values))
    path = tmp_path / "strange.parquet"
    pq.write_table(whole, path)
    with pytest.raises(RecordError, match="strange"), opened(path):
        pass


def test_exports_of_two_campaigns_in_one_file_are_refused(tmp_path):
    first = pq.read_table(EXPORT).slice(0, 2)
    second = first.append_column("label_later", pa.array(["a", "b"]))  # of a later version
    path = tmp_path / "both.parquet"
    pq.write_table(pa.concat_tables([first, second], promote_options="default"), path)
    with pytest.raises(RecordError, match="mission 0 twice"), opened(path):
        pass


def test_columns_that_an_earlier_version_lacked_are_not_needed(tmp_path):
    whole, path = pq.read_table(EXPORT), tmp_path / "earlier.parquet"
    pq.write_table(whole.drop_columns(["reason", "wall_s", "attempts", "replans"]), path)
    with opened(path) as ledger, opened(EXPORT) as today:
        (old,), (new,) = (groups(each, ["site"])[:1] for each in (ledger, today))
    assert old.flights["outcome"].equals(new.flights["outcome"])
    assert old.flights["replans"].null_count == old.flights.num_rows


@pytest.mark.parametrize("change", ["no golden flights", "other pairs"])
def test_an_export_without_pairs_is_reported_with_a_note(mavfi, tmp_path, change):
    table, path = pq.read_table(EXPORT), tmp_path / "alone.parquet"
    if change == "other pairs":
        pairs = pa.array([f"{number}" for number in range(table.num_rows)])
        table = table.set_column(table.column_names.index("pair"), "pair", pairs)
    else:
        table = table.filter(pc.is_valid(table["level"]))
    pq.write_table(table, path)
    run = mavfi("campaign", "status", path, "--full")
    assert run.returncode == 0, run.stderr
    assert "nothing to compare" in run.stdout
    assert json.loads(mavfi("campaign", "status", path, "--json").stdout)["faults"] == []
    assert "nothing to compare" not in mavfi("campaign", "status", EXPORT, "--full").stdout


@pytest.mark.parametrize("metadata", ["{", "[1]", "3"])
def test_damaged_metadata_are_refused(tmp_path, metadata):
    path = tmp_path / "strange.parquet"
    pq.write_table(pq.read_table(EXPORT).replace_schema_metadata({"mavfi": metadata}), path)
    with pytest.raises(RecordError, match="metadata is damaged"), opened(path):
        pass


def test_a_table_of_something_else_is_refused(tmp_path):
    path = tmp_path / "other.parquet"
    pq.write_table(pa.table({"number": [1]}), path)
    with pytest.raises(MavfiError, match="not an export"), opened(path):
        pass


def test_a_folder_is_a_folder_whatever_its_name(tmp_path):
    folder = tmp_path / "mine.parquet"
    Ledger(folder, writing=True).close()
    with opened(folder) as ledger:
        assert not isinstance(ledger, ExportedLedger)
