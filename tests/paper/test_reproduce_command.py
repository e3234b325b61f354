"""`mavfi reproduce`, `campaign report` and `campaign status` as a user calls them."""

import csv
import io
import json
import re
import shutil

import pytest
from test_reproductions import TASK, flown, plan

from mavfi_cli.campaigns.ledger import Ledger
from mavfi_cli.campaigns.run import run_campaign
from mavfi_cli.campaigns.specification_file import load_spec
from mavfi_cli.paper.flying import Forecast

pytestmark = pytest.mark.usefixtures("no_vehicle")


@pytest.fixture(scope="module")
def folder(no_vehicle, tmp_path_factory):
    """The folder of a reproduction of fig9; do not change it."""
    asked = plan(tmp_path_factory.mktemp("reproduction"), "fig9")
    flown(asked)
    return asked.folder


@pytest.fixture(scope="module")
def table3(no_vehicle, tmp_path_factory):
    """The folder of a campaign of a preset; do not change it."""
    missions = load_spec("table3").scaled(0.02).missions()
    folder = tmp_path_factory.mktemp("home") / "campaigns/table3"
    run_campaign(missions, folder, TASK).close()
    with Ledger(folder, writing=True) as ledger:
        ledger.set_meta({"name": "table3"})  # as `begin` does
    return folder


def test_a_reproduction_ends_with_a_line_an_item(folder, mavfi):
    run = mavfi("reproduce", "fig9", "fig15", "--scale", "0.02", "--out", folder.parent)
    assert (run.returncode, run.stderr) == (0, "8 missions, 8 of them flown\n")
    title, result, *rest = run.stdout.splitlines()
    assert title.startswith("Fig. 9: ")
    assert "over its own golden one" in result
    assert rest[0].startswith("Fig. 15: ")
    assert re.search(r"airsim 1\.060 \(paper 1\.060\), .*spark 1\.910 \(paper 1\.910\)", rest[1])
    assert f"mavfi campaign report {folder} --item ITEM" in run.stdout
    assert f"mavfi report {folder.parent} -o report.html" in run.stdout


def test_claims_that_are_not_settled_in_time_have_bounds(folder, mavfi, tmp_path):
    shutil.copytree(folder.parent, tmp_path / "copy")
    line = ("--scale", "0.02", "--settle", "--hours", "1e-6", "--out", tmp_path / "copy")
    run = mavfi("reproduce", "fig9", *line)
    assert run.returncode == 0, run.stderr
    assert "1 claims are undecided:" in run.stderr
    end = run.stdout.partition("\nClaims at all looks together\n")[2]
    assert end.startswith("fig9-fields: cannot tell; ")
    page = tmp_path / "page.html"
    assert mavfi("report", tmp_path / "copy", "-o", page).returncode == 0
    assert "At all looks together, cannot tell" in page.read_text()


def test_one_item_is_shown_whole(tmp_path, mavfi):
    run = mavfi("reproduce", "fig15", "--out", tmp_path / "new")
    assert run.returncode == 0
    assert run.stderr.startswith("nothing to fly")
    assert "tmr" in run.stdout
    assert "campaign report" not in run.stdout
    assert not (tmp_path / "new").exists()  # the model flies nothing


def test_a_script_gets_the_tables(tmp_path, mavfi):
    run = mavfi("reproduce", "fig15", "--out", tmp_path / "new", "--json", "--quiet")
    told = json.loads(run.stdout)
    (item,) = told["items"]
    assert (told["stack"], told["scale"], item["name"]) == ("mavbench", 1.0, "fig15")
    (tmr,) = (row for row in item["rows"] if row["labels"] == ["tmr"])
    assert [round(cell["value"], 2) for cell in tmr["cells"]] == [1.06, 1.91]


@pytest.mark.parametrize("scale", ["nan", "0", "1.5"])
def test_a_scale_that_cannot_be_is_wrong_usage(tmp_path, mavfi, scale):
    run = mavfi("reproduce", "fig15", "--scale", scale, "--out", tmp_path)
    assert (run.returncode, run.stdout, len(run.stderr.splitlines())) == (2, "", 1)
    assert "'--scale'" in run.stderr


def numbers(forecast):
    return re.findall(r"\d[\d:]*", forecast.summary)


def test_the_forecast_is_one_line():
    forecast = Forecast(
        missions=100, over=10, seconds=3700, disk_bytes=2.5e6, measured=10, jobs=2, runs=7
    )
    # Missions, over, runs, time left, jobs, measured, MB.
    assert numbers(forecast) == ["100", "10", "7", "1:01:40", "2", "10", "2"]
    assert numbers(Forecast(missions=100, over=1, disk_bytes=2.5e6)) == ["100", "1", "2"]
    assert numbers(Forecast(missions=8, over=8)) == ["8", "8"]


def test_unknown_items_are_usage_errors(mavfi, tmp_path):
    run = mavfi("reproduce", "tabel4")
    assert (run.returncode, run.stdout) == (2, "")
    assert "'table4'" in run.stderr
    run = mavfi("reproduce", "table1")
    assert (run.returncode, len(run.stderr.splitlines())) == (1, 1)
    assert "is not an experiment" in run.stderr
    assert mavfi("reproduce", "fig9", "--scale", "0").returncode == 2
    run = mavfi("reproduce", "fig9", "--stack", "mavbnch", "--out", tmp_path)
    assert "'mavbench'" in run.stderr


@pytest.mark.slow
def test_report_prints_a_table_and_draws_its_figure(folder, mavfi, tmp_path):
    text = mavfi("campaign", "report", folder, "--item", "fig9").stdout
    assert text.startswith("Fig. 9: ")
    told = mavfi("campaign", "report", folder, "--item", "fig9", "--format", "csv").stdout
    rows = list(csv.DictReader(io.StringIO(told)))
    assert [row["field"] for row in rows[::3]] == ["golden", "sign", "exponent", "mantissa"]
    for name in ("a.svg", "b.pdf", "c.png"):
        run = mavfi("campaign", "report", folder, "--item", "fig9", "--output", tmp_path / name,
                    "--columns", "two")  # fmt: skip
        assert (run.stdout, run.stderr) == (text, f"figure: {tmp_path / name}\n")
        assert (tmp_path / name).stat().st_size > 1000


def test_report_and_status_of_a_preset_show_the_papers_table(table3, mavfi):
    home = table3.parent.parent
    text = mavfi("campaign", "report", "table3", cwd=home).stdout
    assert text.startswith("Table III: ")
    assert mavfi("campaign", "report", "table3", "--item", "table3", cwd=home).stdout == text
    status = mavfi("campaign", "status", "table3", cwd=home).stdout
    assert status == f"table3: 8 of 8 missions\n\n{text}"
    assert mavfi("campaign", "report", table3, "--item", "fig9").returncode == 2


def test_a_reproduction_tells_its_items(folder, mavfi):
    text = mavfi("campaign", "status", folder).stdout
    lines = text.splitlines()
    assert lines[0] == "mavbench: 8 of 356 missions"
    assert lines[1].startswith("348 missing: about ")
    assert len(lines) <= 24
    (row,) = [line for line in lines if line.startswith("fig9")]
    assert row.split()[-3:] == ["8", "8", "100"]
    (row,) = [line for line in lines if line.startswith("table3")]
    assert row.split()[-3:] == ["8", "2", "25"]


def test_full_status_is_still_there(folder, mavfi):
    whole = mavfi("campaign", "status", folder, "--full").stdout
    assert "mean replans" in whole
    quality = mavfi("campaign", "status", folder, "--quality").stdout
    assert quality.startswith(whole)


def test_bad_reports_are_one_line(folder, mavfi, tmp_path):
    for arguments, told in (
        (("--item", "fig99"), "unknown item 'fig99'"),
        (("--item", "fig2"), "is not an experiment"),
        (("--item", "fig9", "--output", "x.jpg"), ".svg, .pdf or .png"),
        (("--item", "fig9", "--output", tmp_path / "no/x.png"), "its folder does not exist"),
        (("--item", "fig6"), "no kernel runs"),
    ):
        run = mavfi("campaign", "report", folder, *arguments)
        assert (run.returncode > 0, run.stdout) == (True, "")
        assert len(run.stderr.splitlines()) == 1
        assert told in run.stderr


def test_status_of_a_campaign_of_ones_own_is_one_table(table3, mavfi, tmp_path):
    """What all settings share is said once, below the table."""
    mine = shutil.copytree(table3, tmp_path / "mine")
    with Ledger(mine, writing=True) as ledger:
        ledger.set_meta({"name": "mine"})
    lines = mavfi("campaign", "status", mine).stdout.splitlines()
    (shared,) = [line for line in lines if "site=waypoint_acceleration" in line]
    assert shared.startswith("in all settings")
    assert any(line.startswith("mavfi campaign report ") for line in lines)
    heads = [line for line in lines if line.startswith("setting")]
    assert [head.split()[:3] for head in heads] == [["setting", "bits", "n"]]
    whole = mavfi("campaign", "report", mine).stdout
    assert whole.count("site=waypoint_acceleration") == 1
    assert "energy, kJ" in whole
