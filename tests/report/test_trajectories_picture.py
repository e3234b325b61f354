"""The picture of a pair: parsed as XML, and measured on the axes that it is drawn on."""

import re
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.colors import to_hex, to_rgba
from matplotlib.patches import Rectangle

from mavfi_cli.mission.run_folder import load_run
from mavfi_cli.report.drawing import DETECTORS, write_figure
from mavfi_cli.report.top_view import Trajectories

SVG = "{http://www.w3.org/2000/svg}"
FAULT = {"kind": "fault", "stamp_s": 9.0, "text": "", "position_enu_m": [3.0, 1.0, 5.0]}
ALARM = {"kind": "alarm", "stamp_s": 9.1, "text": "", "position_enu_m": [3.5, 1.0, 5.0]}


@pytest.fixture(scope="module")
def golden(troubled_flight):
    return load_run(troubled_flight.path)


def faulty(golden, events=(FAULT,), *, shift_m=2.0, time_s=30.0, **changes):
    """The golden flight, so much further north, with a fault that took its time."""
    trace = golden.trace
    column = trace.column_names.index("truth_y_m")
    moved = trace.set_column(column, "truth_y_m", [trace["truth_y_m"].to_numpy() + shift_m])
    quality = {**golden.result["quality_of_flight"], "flight_time_s": time_s}
    result = {**golden.result, "quality_of_flight": quality, "fault": {"state": "applied"},
              "events": [*golden.result["events"], *events], **changes}  # fmt: skip
    return replace(golden, result=result, trace=moved)


@pytest.fixture(scope="module")
def panels(golden):
    lost = faulty(golden, outcome="collision", shift_m=1.0)
    saved = faulty(golden, (FAULT, ALARM), shift_m=0.5, time_s=21.0, detection={"alarms": []})
    return [
        ("a bit of x", [("golden", golden), ("FI", faulty(golden))]),
        ("a bit of y", [("golden", golden), ("FI", lost), ("D&R", saved)]),
    ]


@pytest.fixture(scope="module")
def figure(panels):
    return Trajectories(panels).draw()


def test_the_svg_has_every_flight_and_says_what_became_of_it(panels, golden, figure, tmp_path):
    path, again = tmp_path / "pair.svg", tmp_path / "again.svg"
    write_figure(figure, path)
    write_figure(Trajectories(panels).draw(), again)
    assert path.read_bytes() == again.read_bytes()
    root = ET.parse(path).getroot()
    groups = {e.get("id"): e for e in root.iter(f"{SVG}g") if "flight-" in (e.get("id") or "")}
    assert set(groups) == {"flight-0-0", "flight-0-1", "flight-1-0", "flight-1-1", "flight-1-2"}
    drawn = {name: group.find(f"{SVG}path") for name, group in groups.items()}
    assert all(len(re.findall("[ML]", each.get("d"))) > 10 for each in drawn.values())
    colour = {name: re.search("stroke: (#[0-9a-f]{6})", each.get("style"))[1]
              for name, each in drawn.items()}  # fmt: skip
    assert colour["flight-0-0"] == colour["flight-1-0"]
    assert colour["flight-0-1"] == colour["flight-1-1"]
    assert len(set(colour.values())) == 3
    said = ["".join(element.itertext()) for element in root.iter(f"{SVG}text")]
    golden_s = golden.result["quality_of_flight"]["flight_time_s"]
    longer, shorter = (f"{100 * (time_s / golden_s - 1):+.1f} %" for time_s in (30.0, 21.0))
    assert said.count(f"golden: success, {golden_s:.1f} s") == 2
    assert {
        "posts, seed 2", "fault: a bit of x", "fault: a bit of y", "east, m", "goal",
        f"FI: success, 30.0 s ({longer})", "FI: collision, 30.0 s", "fault", "alarm", "start",
        f"D&R: success, 21.0 s ({shorter})", "collision",
    } <= set(said)  # fmt: skip
    assert said.count("fault") == 1  # one legend of the marks for all panels


def test_every_way_is_the_truth_of_its_flight(panels, figure):
    for axes, (_, flights) in zip(figure.axes, panels, strict=True):
        assert len(axes.lines) == len(flights)
        for line, (_, run) in zip(axes.lines, flights, strict=True):
            x, y = (run.trace[f"truth_{axis}_m"].to_numpy() for axis in "xy")
            np.testing.assert_array_equal(line.get_xydata(), np.column_stack([x, y]))
        widths = [line.get_linewidth() for line in axes.lines]
        assert widths == sorted(widths, reverse=True)  # those of one way are seen over each other
        boxes = [patch for patch in axes.patches if isinstance(patch, Rectangle)]
        assert len(boxes) == len(flights[0][1].result["world"]["boxes"])


def test_a_protected_flight_has_the_colour_of_its_detector(golden):
    """Whatever its place; a second name with the same detector takes its turn."""
    guarded = {name: faulty(golden, detection={"detector": name, "alarms": []})
               for name in ("gad", "aad")}  # fmt: skip
    flights = [("golden", golden), ("FI", faulty(golden)), ("D&R(G)", guarded["gad"]),
               ("D&R(A)", guarded["aad"]), ("D&R(A), 2", guarded["aad"])]  # fmt: skip
    axes = Trajectories([("", flights)]).draw().axes[0]
    colours = [line.get_color() for line in axes.lines]
    assert colours[2:4] == [DETECTORS["gad"], DETECTORS["aad"]]
    assert len(set(colours)) == 5


def test_faults_and_alarms_have_the_colour_of_their_flight(figure):
    """In the second panel two faults at one place stand side by side, and there is one alarm."""
    axes = figure.axes[1]
    _, lost, saved = (line.get_color() for line in axes.lines)
    marks = {
        label: [each for each in axes.collections if each.get_label() == label]
        for label in ("fault", "alarm", "collision")
    }
    assert [to_hex(each.get_facecolor()[0]) for each in marks["fault"]] == [lost, saved]
    assert [to_hex(each.get_facecolor()[0]) for each in marks["alarm"]] == [saved]
    assert [to_hex(each.get_facecolor()[0]) for each in marks["collision"]] == [lost]
    np.testing.assert_array_equal(marks["fault"][0].get_offsets(), [FAULT["position_enu_m"][:2]])
    np.testing.assert_array_equal(marks["alarm"][0].get_offsets(), [ALARM["position_enu_m"][:2]])
    figure.canvas.draw()
    at = [each.get_offset_transform().transform(each.get_offsets())[0] for each in marks["fault"]]
    assert np.linalg.norm(at[0] - at[1]) > 8.0
    assert [tuple(text.xy) for text in axes.texts] == [(3.0, 1.0), (3.0, 1.0), (3.5, 1.0)]
    (legend,) = figure.legends
    named = dict(zip([t.get_text() for t in legend.texts], legend.legend_handles, strict=True))
    assert tuple(named["fault"].get_facecolor()[0]) == to_rgba("white")


def test_it_is_told_in_words_too(panels, golden):
    told = Trajectories(panels).lines()
    assert told[:2] == ["posts, seed 2", "fault: a bit of x"]
    assert told[2].endswith(f" s  {golden.folder.path}")
    assert told[6].startswith("  FI: collision, 30.0 s  ")
    assert len(told) == 1 + 3 + 4


def test_flights_without_a_trace_or_a_fault_are_drawn_all_the_same(golden, tmp_path):
    cut = faulty(golden, outcome="crash", world=None)
    cut.result["quality_of_flight"] = dict.fromkeys(golden.result["quality_of_flight"])
    panels = [
        ("", [("golden", golden)]),
        ("x", [("fault", replace(cut, trace=None))]),
        *[("y", [("golden", golden)])] * 2,
    ]
    figure = Trajectories(panels).draw()
    write_figure(figure, tmp_path / "odd.svg")
    assert "fault: crash<" in (tmp_path / "odd.svg").read_text()
    assert [axes.get_visible() and axes.axison for axes in figure.axes] == [
        *[True] * 4, False, False,
    ]  # fmt: skip
