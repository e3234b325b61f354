"""Tables: aligned and no wider than a screen, and the same cells in every format."""

import csv
from xml.etree import ElementTree

import pytest

from mavfi_cli.report.table import Table, rate, spread
from mavfi_cli.stats.shares import Interval, Share

ROWS = [["name", "count", "share"], ["a", "1", "0.5 %"], ["long name", "100"]]


def test_labels_stand_to_the_left_and_numbers_to_the_right():
    assert Table(ROWS, labels=1).lines() == [
        "name       count  share",
        "a              1  0.5 %",
        "long name    100",
    ]
    assert Table(ROWS).lines() == [
        "name       count  share",
        "a          1      0.5 %",
        "long name  100",
    ]


@pytest.mark.parametrize(("width", "tables"), [(23, 1), (22, 2), (16, 2), (1, 2)])
def test_a_wide_table_is_cut_into_several_with_the_same_labels(width, tables):
    told = Table(ROWS, labels=1).lines(width)
    assert told.count("") == tables - 1
    if tables == 1:
        assert told == Table(ROWS, labels=1).lines()
    else:
        assert told == [
            "name       count", "a              1", "long name    100", "",
            "name       share", "a          0.5 %", "long name",
        ]  # fmt: skip


def test_as_many_columns_as_fit_stand_in_a_table():
    rows = [[f"{column:05d}" for column in range(40)]]
    told = [line for line in Table(rows, labels=2).lines(100) if line]
    assert all(line.startswith("00000  00001  ") for line in told)
    assert [len(line) for line in told] == [96, 96, 96, 26]
    values = [int(cell) for line in told for cell in line.split()[2:]]
    assert values == list(range(2, 40))


def test_prose_goes_on_below_itself():
    rows = [["key", "source"], ["mass", "the data sheet of the maker and a scale"], ["x", ""]]
    assert Table(rows, prose=True).lines(30) == [
        "key   source",
        "mass  the data sheet of the",
        "      maker and a scale",
        "x",
    ]


WIDE = Table(
    [["state", "n", "ours", "paper"], ["a|b & <c>", "3", "1.5 %", "2"]],
    labels=1, kept=1, parts=(2,), name="t", title="A & B", notes=("a note",),
)  # fmt: skip


def test_columns_of_one_part_stay_on_one_page_and_kept_ones_are_repeated():
    rows = [["x", "n", *"abcd"], ["1", "2", *"3456"]]
    table = Table(rows, labels=1, kept=1, parts=(2, 2))
    assert table.lines(13) == ["x  n  a  b", "1  2  3  4", "", "x  n  c  d", "1  2  5  6"]
    assert table.lines(16) == ["x  n  a  b  c  d", "1  2  3  4  5  6"]


def test_markdown_latex_and_html_escape_their_own_marks():
    markdown = WIDE.markdown().splitlines()
    assert markdown[:2] == ["**A & B**", ""]
    assert markdown[3:5] == ["| --- | ---: | ---: | ---: |", r"| a\|b & <c> | 3 | 1.5 % | 2 |"]
    assert r"a|b \& \textless{}c\textgreater{} & 3 & 1.5 \% & 2 \\" in WIDE.latex()
    root = ElementTree.fromstring(f"<div>{WIDE.html()}</div>")
    cells = [(cell.text, cell.get("class")) for cell in root.iter("td")]
    assert cells == [("a|b & <c>", None), ("3", "n"), ("1.5 %", "n"), ("2", "n")]
    assert (root.findtext(".//caption"), root.findtext("p")) == ("A & B", "a note")
    assert ElementTree.fromstring(WIDE.html(bare=True)).find("caption") is None


def test_csv_has_unrounded_numbers_and_no_word_for_nothing():
    records = [{"name": "a,b", "x": 0.1 + 0.2}, {"x": None, "y": True}]
    rows = list(csv.reader(Table.of_records(records).csv().splitlines()))
    assert rows == [["name", "x", "y"], ["a,b", "0.30000000000000004", ""], ["", "", "True"]]
    assert Table.of_records(records, ["y"]).csv() == 'y\n""\nTrue\n'


def test_one_formatter_serves_shares_and_other_estimates():
    share = Share(count=97, total=100, share=0.97, low=0.915, high=0.9905)
    assert rate(share) == "97.0 % (92 to 99)"
    assert rate(share, 0, ends=1) == "97 % (91.5 to 99.1)"
    value = Interval(value=-0.001, low=-1.0, high=1.0, count=4)
    assert spread(value, 2, sign="+", chance=1e-4) == "-0.00 (-1.00 to +1.00, p<.001)"
    assert spread(value, 1) == "0.0 (-1.0 to 1.0)"


def test_a_newline_in_a_cell_begins_no_row():
    table = Table([["name"], ["a\nb"]], title="t\nu", notes=["n\no"])
    assert table.text().splitlines() == ["t\ufffdu", "name", "a\ufffdb", "n\ufffdo"]
    assert "| a\ufffdb |" in table.markdown().splitlines()
