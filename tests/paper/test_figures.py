"""Figures for print: size, text, formats, and colours that survive grey."""

import itertools
import math
from dataclasses import replace

import matplotlib.colors
import pytest
from made_flights import flight, flights, struck
from matplotlib.text import Text

from mavfi_cli.core.errors import RecordError
from mavfi_cli.paper.figures import DRAWN, draw
from mavfi_cli.paper.layouts import OF_FLIGHTS, of_flights
from mavfi_cli.report.drawing import write_figure
from mavfi_cli.report.paper import (
    MARKERS,
    PALETTE,
    SMALLEST,
    WIDTHS_IN,
    PaperCell,
    PaperColumn,
    PaperRow,
    PaperTable,
    draw_dots,
    draw_stack,
)

FLIGHTS = flights(
    each
    for seed in "abcd"
    for world in ("factory", "sparse")
    for each in (
        flight(20.0, pair=seed, world=world),
        struck(20.0 + ord(seed) % 7, pair=seed, world=world, fault_field="sign"),
        struck(21.0, pair=seed, world=world, fault_field="sign", detector="gad"),
        struck(20.5, pair=seed, world=world, fault_field="sign", detector="aad"),
    )
)  # fmt: skip
FROM_TABLES = sorted(set(DRAWN) - {"fig13"})  # fig13 draws run folders


def lightness(colour):
    """CIE L* of a colour, which is what is left of it in grey print."""
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4
              for c in matplotlib.colors.to_rgb(colour)]  # fmt: skip
    luminance = 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]
    return 116.0 * math.cbrt(luminance) - 16.0


def test_the_palette_survives_grey_print():
    assert all(abs(lightness(a) - lightness(b)) >= 14.0
               for a, b in itertools.combinations(PALETTE, 2))  # fmt: skip
    assert all(lightness(colour) <= 85.0 for colour in PALETTE)  # seen on white
    assert len(set(MARKERS)) == len(PALETTE)  # and told apart without any colour


def shown_texts(figure):
    return [text for text in figure.findobj(Text) if text.get_text().strip() and text.get_visible()]


@pytest.mark.parametrize("columns", WIDTHS_IN)
@pytest.mark.parametrize("name", FROM_TABLES)
def test_a_figure_fits_its_columns_with_text_of_seven_points(name, columns):
    figure = DRAWN[name](FLIGHTS, columns)
    assert figure.get_figwidth() == WIDTHS_IN[columns]
    assert min(text.get_fontsize() for text in shown_texts(figure)) >= SMALLEST
    figure.draw_without_rendering()


def small_table():
    cells = (PaperCell(value=3.0, low=2.0, high=4.0, count=9, paper=5.0),
             PaperCell(value=97.0, low=90.0, high=99.0, count=9))  # fmt: skip
    row = PaperRow(labels=("one",), cells=cells)
    columns = (PaperColumn(title="time, s"), PaperColumn(title="success, %"))
    return PaperTable(name="t", title="T", labels=("what",), columns=columns, rows=(row, row))


@pytest.mark.parametrize("draw", [draw_dots, draw_stack])
def test_tables_are_drawn_in_the_same_sizes(draw):
    figure = draw(small_table(), "one")
    assert figure.get_figwidth() == WIDTHS_IN["one"]
    assert min(text.get_fontsize() for text in shown_texts(figure)) >= SMALLEST


def test_long_names_of_settings_leave_room_for_the_dots():
    told = small_table()
    name = "FI, sparse, queue.waypoint_position, mavbench:owns_sequence_numbers=false"
    figure = draw_dots(replace(told, rows=[replace(told.rows[0], labels=(name,))] * 9), "one")
    figure.draw_without_rendering()  # warns if an axes has no room
    assert min(axes.get_window_extent().width for axes in figure.axes) > 0.5 * figure.dpi
    labels = figure.axes[0].get_yticklabels()
    boxes = [label.get_window_extent() for label in labels]
    assert all(a.y0 > b.y1 for a, b in itertools.pairwise(boxes))  # from top to bottom


def test_a_table_without_rows_is_not_drawn():
    with pytest.raises(RecordError, match="none of its missions has flown yet"):
        draw(replace(small_table(), rows=()), None, "one")


def test_dots_show_ours_and_the_papers():
    axes = draw_dots(small_table(), "two").axes[0]
    values = {tuple(line.get_xdata()) for line in axes.lines}
    assert {(3.0,), (5.0,)} <= values
    ends = [each.get_paths()[0].vertices[:, 0].tolist() for each in axes.collections]
    assert ends == [[2.0, 4.0]] * 2  # an interval a row


@pytest.mark.parametrize("suffix", [".svg", ".pdf", ".png"])
def test_a_figure_is_written_the_same_each_time(tmp_path, suffix):
    paths = [tmp_path / f"{place}{suffix}" for place in "ab"]
    for path in paths:
        write_figure(draw_dots(small_table()), path)
    first, second = (path.read_bytes() for path in paths)
    assert first == second
    assert first[:4] in (b"<?xm", b"%PDF", b"\x89PNG")


def test_what_is_drawn_is_what_the_table_says():
    axes = DRAWN["fig12"](FLIGHTS, "two").axes[0]  # factory
    worst = of_flights("fig12", FLIGHTS).rows[0].cells[1].value
    drawn = [max(line.get_xdata()) for line in axes.lines if line.get_marker() == "s"]
    assert drawn == [pytest.approx(worst)]


@pytest.mark.parametrize("name", OF_FLIGHTS)
def test_before_a_mission_has_flown_there_is_nothing_to_draw(name):
    nothing = flights([])
    with pytest.raises(RecordError, match="none of its missions"):
        draw(of_flights(name, nothing), nothing, "one")


@pytest.mark.parametrize("name", ["fig8", "fig9"])
def test_faults_by_place_need_a_fault(name):
    golden = flights([flight(20.0)])
    with pytest.raises(RecordError, match="none of its missions"):
        draw(of_flights(name, golden), golden, "one")


def test_trajectories_need_a_kept_run():
    with pytest.raises(RecordError, match="run folders, but none were kept"):
        DRAWN["fig13"](FLIGHTS, "one")
