"""Tables of text: aligned, and no wider than a screen."""

import pytest

from mavfi_cli.report.table import Table

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
