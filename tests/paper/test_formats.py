"""The formats of a table: text of one screen, Markdown, LaTeX and CSV, with the same numbers."""

import csv
import functools
import io
import itertools
import re

import pytest
from made_flights import flight, flights, struck

from mavfi_cli.paper.layouts import OF_FLIGHTS, of_flights
from mavfi_cli.report.paper import PaperCell, PaperColumn, PaperRow, PaperTable
from mavfi_cli.report.table import FORMATS

WORLDS = ("factory", "farm", "sparse", "dense")
STATES = ("time_to_collision", "future_collision_seq", "waypoint_position", "waypoint_yaw",
          "waypoint_velocity", "waypoint_acceleration", "command_velocity",
          "command_yaw")  # fmt: skip
COSTS = {"check_share": 2e-4, "recovery_share_perception": 0.01, "recovery_share_planning": 0.02,
         "recovery_share_control": 0.0}  # fmt: skip


def whole():
    """Flights of the four worlds with each detector, three a setting with other times."""
    for seed, world in itertools.product(("a", "b", "c"), WORLDS):
        time_s = 90.0 + ord(seed) % 7
        yield flight(time_s, pair=seed, world=world)
        yield struck(1.9 * time_s, pair=seed, world=world, fault_bits=1)
        for detector in ("gad", "aad"):
            yield struck(
                1.2 * time_s, pair=seed, world=world, detector=detector, fault_bits=1, **COSTS
            )


def places(column, values, **common):
    for seed, time_s in (("a", 90.0), ("b", 101.0), ("c", 97.0)):
        yield flight(time_s, pair=seed)
        for value in values:
            yield struck(1.31 * time_s, pair=seed, **{column: value}, **common)


FLIGHTS = {
    "fig8": flights(places("fault_target", STATES)),
    "table3": flights(places("fault_bits", (1, 3, 5))),
    **dict.fromkeys(("table4", "table5", "fig12", "fig14"), flights(whole())),
}


@functools.cache
def laid_out(name):
    return of_flights(name, flights(whole()))


@pytest.mark.parametrize("name", FLIGHTS)
def test_the_text_is_one_screen(name):
    lines = of_flights(name, FLIGHTS[name]).formatted("text").splitlines()
    assert len(lines) <= 24
    assert max(map(len, lines)) <= 100


@pytest.mark.parametrize("name", OF_FLIGHTS)
@pytest.mark.parametrize("form", FORMATS)
def test_every_layout_has_every_format(name, form):
    assert laid_out(name).formatted(form).endswith("\n")


def test_the_formats_have_the_same_numbers():
    found = of_flights("table4", FLIGHTS["table4"])
    ours = found.table.rows[2]
    assert ours[:4] == ["injection", "3", "100.0 (44 to 100)", "91.7"]
    markdown = found.formatted("markdown").splitlines()
    assert markdown[5].split(" | ")[1:4] == ours[1:4]
    latex = found.formatted("latex")
    assert "injection & 3 & 100.0 (44 to 100) & 91.7" in latex
    rows = list(csv.DictReader(io.StringIO(found.formatted("csv"))))
    assert len(rows) == 16
    (row,) = [r for r in rows if r["success, %"] == "injection" and r["quantity"] == "factory"]
    assert (float(row["value"]), row["n"], row["paper"]) == (100.0, "3", "91.7")
    assert float(row["low"]) == pytest.approx(43.85, abs=0.01)


@pytest.mark.parametrize("name", OF_FLIGHTS)
def test_latex_is_a_whole_tabular_of_plain_text(name):
    text = laid_out(name).formatted("latex")
    (form,) = re.findall(r"\\begin\{tabular\}\{([lr]+)\}", text)
    body = text[text.index(r"\begin{tabular}") : text.index(r"\end{tabular}")]
    rows = [line for line in body.splitlines() if line.endswith(r" \\")]
    assert rows
    assert all(len(re.findall(r"(?<!\\)&", row)) == len(form) - 1 for row in rows)
    assert not re.search(r"(?<!\\)[%#_$]", text)
    assert text.count(r"\begin{") == text.count(r"\end{")


@pytest.mark.parametrize(
    ("columns", "place", "size"),
    [(1, "table", "footnotesize"), (8, "table*", "footnotesize"), (14, "table*", "scriptsize")],
)
def test_a_latex_table_takes_the_place_that_it_needs(columns, place, size):
    text = PaperTable(
        name="t", title="T", labels=("state",),
        columns=(PaperColumn(title="time, s"),) * columns,
        rows=(PaperRow(labels=("a",), cells=(PaperCell(value=12.5),) * columns),),
    ).formatted("latex")  # fmt: skip
    assert text.startswith(rf"\begin{{{place}}}")
    assert rf"\centering\{size}" in text


def test_a_maximum_has_no_interval_and_nothing_is_a_dash():
    column = PaperColumn(title="worst, %", sign=True)
    assert column.formatted(3.04) == "+3.0"
    assert column.formatted(float("nan")) == "-"
    assert column.printed(PaperCell(paper=73.8).paper) == "+73.8"
    assert column.printed("< 0.1") == "< 0.1"
    assert column.printed(None) == ""
