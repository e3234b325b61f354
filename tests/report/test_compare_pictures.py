"""compare.svg and timeline.svg: parsed as XML, and measured on their axes."""

import math
import xml.etree.ElementTree as ET

import matplotlib as mpl
import pytest
from made_flights import PLAN, comparison
from matplotlib.patches import Rectangle

from mavfi_cli.report.compare_plot import PICTURES
from mavfi_cli.report.drawing import write_figure
from mavfi_cli.studies.compare import ComparePlan

SVG = "{http://www.w3.org/2000/svg}"
KERNELS = ("point cloud", "OctoMap", "collision check", "planner", "control")


def texts(path):
    root = ET.parse(path).getroot()
    assert root.tag == f"{SVG}svg"
    return ["".join(element.itertext()) for element in root.iter(f"{SVG}text")]


def bars(axes, colour=None):
    wanted = None if colour is None else mpl.colors.to_rgba(colour)
    found = [p for p in axes.patches if isinstance(p, Rectangle)]
    return [p for p in found if wanted is None or p.get_facecolor() == wanted]


@pytest.mark.slow
@pytest.mark.parametrize("draw", PICTURES.values())
def test_equal_comparisons_give_equal_bytes_whatever_the_settings(whole, tmp_path, draw):
    write_figure(draw(whole), tmp_path / "a.svg")
    with mpl.rc_context({"svg.hashsalt": "another", "svg.fonttype": "path"}):
        write_figure(draw(whole), tmp_path / "b.svg")
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()
    assert {p.name for p in tmp_path.iterdir()} == {"a.svg", "b.svg"}


@pytest.fixture(scope="module")
def drawn(whole):
    """The pictures of a comparison, drawn once."""
    return {name: draw(whole) for name, draw in PICTURES.items()}


def test_compare_names_platforms_settings_and_what_is_measured(drawn, tmp_path):
    write_figure(drawn["compare.svg"], tmp_path / "compare.svg")
    said = texts(tmp_path / "compare.svg")
    assert any(text.startswith("x86: Intel i9-9940X") for text in said)
    assert any(text.startswith("tx2: Jetson TX2") for text in said)
    for wanted in ("golden", "faults", "faults, gad", "faults, aad", "flight time, s",
                   "x86: 400 ms, 500 ms",
                   "tx2: 1600 ms, 2000 ms", "75 %", "100 %", "44.0 s"):  # fmt: skip
        assert wanted in said, wanted


def test_the_replans_stand_below_the_flights(whole, drawn):
    said = [text.get_text() for text in drawn["compare.svg"].axes[0].texts]
    means = [row.quantities["replans"].mean.value for row in whole.settings]
    assert [text for text in said if "replans" in text] == [f"{m:.1f} replans" for m in means]


def test_the_worst_case_bars_are_as_high_as_the_numbers(whole, drawn):
    worst = drawn["compare.svg"].axes[4]
    heights = [bar.get_height() for bar in bars(worst)]
    told = [row.over_own.largest for row in whole.costs]
    assert heights == pytest.approx([100.0 * (ratio - 1.0) for ratio in told])


def test_success_bars_are_shares_in_per_cent(drawn):
    success = drawn["compare.svg"].axes[1]
    assert [bar.get_height() for bar in bars(success)] == [100.0] * 8


def test_the_response_bar_is_the_kernels_and_the_waiting(whole, drawn):
    response = drawn["compare.svg"].axes[2]
    of_tx2 = [bar for bar in bars(response) if bar.get_y() > 0.5]
    assert sum(bar.get_width() for bar in of_tx2) == pytest.approx(1600.0)
    latency_s = whole.plan.platforms[1].kernel_latency_s
    assert of_tx2[1].get_width() == pytest.approx(1e3 * latency_s["octomap"])


@pytest.mark.parametrize(
    "plan",
    [PLAN, ComparePlan(platforms=("tx2",), inject=()), ComparePlan(platforms=("x86", "tx2-4c-0.81",
     "tx2"))],
)  # fmt: skip
def test_nothing_flown_and_other_numbers_of_platforms_are_drawn_all_the_same(plan, tmp_path):
    told = comparison(plan, [])
    write_figure(PICTURES["compare.svg"](told), tmp_path / "compare.svg")
    write_figure(PICTURES["timeline.svg"](told), tmp_path / "timeline.svg")
    assert "Success" in texts(tmp_path / "compare.svg")
    assert len(texts(tmp_path / "timeline.svg")) == 1


def test_the_timeline_has_both_platforms_all_kernels_and_the_response(drawn, tmp_path):
    write_figure(drawn["timeline.svg"], tmp_path / "timeline.svg")
    said = texts(tmp_path / "timeline.svg")
    for kernel in (*KERNELS, "setpoint"):
        assert said.count(kernel) == 2, kernel
    for begin in ("x86: ", "tx2: ", "360 ms ", "1320 ms "):
        assert any(text.startswith(begin) for text in said), begin
    assert said.count("stops before an obstacle") == 2


def test_bars_lie_where_the_kernels_ran_on_one_axis_for_all(whole, drawn):
    panels = drawn["timeline.svg"].axes
    for axes, row in zip(panels, whole.timeline.platforms, strict=True):
        assert axes.get_xlim() == (-0.05, 2.5)
        start, end = row.chain_s["octomap"]
        (octomap,) = bars(axes, "#1b4965")
        assert octomap.get_x() == pytest.approx(start)
        assert octomap.get_x() + octomap.get_width() == pytest.approx(end)
        assert math.floor(octomap.get_y() + 0.5) == 1  # the second lane
