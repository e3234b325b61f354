"""The page in a real browser: its claims, its labels, its console; and what is inside the file."""

import base64
import csv
import html
import io
import re

import pytest
from committed import PLACES

from mavfi_cli.paper.claims import CLAIMS
from mavfi_cli.report.page import FILTERS
from mavfi_cli.stats.shares import Interval, wilson

pytestmark = pytest.mark.slow  # the page of all committed flights takes its time

PHONE, DESKTOP = 390, 1280
MARKS = {"✓ reproduced", "✗ contradicted", "≈ undecided", "· not decidable"}


@pytest.mark.parametrize("width", [PHONE, DESKTOP])
def test_a_browser_shows_the_claims_and_no_label_covers_another(browser, page, width):
    found = browser.probe(page, width)
    assert found["console"] == []
    assert found["errors"] == []
    assert [each["name"] for each in found["claims"]] == [claim.name for claim in CLAIMS]
    assert {
        text.partition(",")[0] for each in found["claims"] for text in each["verdicts"]
    } <= MARKS
    by_name = {each["name"]: each for each in found["claims"]}
    assert by_name["table4-dense"]["verdicts"][:3] == [  # summary, all faults, silent
        "✓ reproduced", "✓ reproduced", "✗ contradicted",
    ]  # fmt: skip
    assert by_name["fig6-octomap"]["verdicts"] == ["✗ contradicted"] * 2
    shown = {each["name"] for each in found["claims"] if each["verdicts"][0] == "✗ contradicted"}
    assert set(found["filtered"]) == shown  # by the filter, without a script
    assert found["overlaps"] == []
    assert found["cut"] == []
    assert found["width"] == width
    assert found["wide"] <= width  # nothing makes the page itself scroll sideways


def test_it_prints(browser, page, tmp_path):
    browser.pdf(page, tmp_path / "page.pdf")
    assert (tmp_path / "page.pdf").read_bytes().startswith(b"%PDF")


def test_the_file_is_alone(page):
    text = page.read_text(encoding="utf-8")
    links = re.findall(r'(?:src|href)="([^"]*)"', text)
    assert all(each.startswith(("#", "data:")) for each in links)
    assert "@import" not in text
    assert "url(http" not in text
    assert "<script" not in text


def test_the_command_writes_one_page_and_equal_flights_give_equal_pages(
    told, page, mavfi, tmp_path
):
    written = tmp_path / "page.html"
    done = mavfi("report", *PLACES, "-o", written)
    assert done.returncode == 0
    shown = [line for line in done.stderr.splitlines() if not line.endswith(" ...")]  # no steps
    assert shown == [f"note: {problem}" for problem in told.problems]
    answer, last = done.stdout.splitlines()
    assert " of the " in answer
    assert re.match(rf"[\d,]+ missions in {written} \(", last)
    assert [each.name for each in tmp_path.iterdir()] == ["page.html"]
    text = written.read_text(encoding="utf-8")
    assert text.rstrip().endswith("</html>")
    assert text == page.read_text(encoding="utf-8")


def test_every_chart_has_its_data(page):
    text = page.read_text(encoding="utf-8")
    figures = re.findall(r"<figure .*?</figure>", text, re.DOTALL)
    assert len(figures) > 5
    for figure in figures:
        (code,) = re.findall(r'href="data:text/csv;charset=utf-8;base64,([^"]*)"', figure)
        rows = list(csv.DictReader(io.StringIO(base64.b64decode(code).decode())))
        assert rows
        assert all(each for each in rows)


def test_the_counts_of_the_documents_are_in_it(page):
    """docs/results/paper.md: 18 of 105 faults in planning in `dense` lose the mission."""
    text = html.unescape(page.read_text(encoding="utf-8"))
    assert "instruction: planning, dense" in text
    assert 'title="18 of 105 lost"' in text
    assert "22 of 315 lost; golden 0 of 315" in text


def test_every_lost_mission_has_its_command(told, page):
    text = page.read_text(encoding="utf-8")
    lost = [row for each in told.missions for row in each.lost]
    assert len(lost) > 100
    assert all(f"<code>{row.command}</code>" in text for row in lost)


def test_numbers_as_words():
    percent, rate, p_value, hourly, effect = (
        FILTERS[name] for name in ("percent", "rate", "p", "hourly", "effect")
    )
    share = wilson(3, 98)
    assert share.counts == "3 of 98"
    assert percent(share.share) == "3.1 %"
    assert percent(float("nan")) == rate(wilson(0, 0)) == "-"
    assert rate(share, 0) == "3 % (1 to 9)"
    assert p_value(0.0004) == "< 0.001"
    assert p_value(0.0123) == "0.012"
    assert hourly((0.17, 0.11, 0.2501)) == "0.17 (0.11 to 0.25)"
    found = Interval(value=-0.0, low=-0.05, high=0.05, count=9)
    assert effect(found, "points") == "+0.0 points (-5.0 to 5.0)"
    assert effect(Interval(value=0.9, low=0.85, high=0.93, count=9), "percent") == "90 % (85 to 93)"
    small = Interval(value=0.0002, low=0.0001, high=0.0003, count=9)
    assert effect(small, "percent") == "0.0200 % (0.0100 to 0.0300)"
    below_a_point = Interval(value=0.0, low=-0.0092, high=0.0092, count=300)
    assert effect(below_a_point, "points") == "+0.0 points (-0.9 to 0.9)"
