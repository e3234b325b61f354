"""The picture of a flight: parsed as XML, and measured on the axes that it is drawn on."""

import re
import xml.etree.ElementTree as ET
from dataclasses import replace

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.patches import Circle, Rectangle

from mavfi_cli.core.types import Outcome
from mavfi_cli.mission.run_folder import load_run
from mavfi_cli.report.drawing import write_figure
from mavfi_cli.report.top_view import draw_top_view

SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture(scope="module")
def run(troubled_flight):
    return load_run(troubled_flight.path)


@pytest.fixture(scope="module")
def figure(run):
    return draw_top_view(run)


@pytest.fixture(scope="module")
def axes(figure):
    return figure.axes[0]


def texts(path):
    root = ET.parse(path).getroot()
    assert root.tag == f"{SVG}svg"
    return ["".join(element.itertext()) for element in root.iter(f"{SVG}text")]


def changed(run, **changes):
    return replace(run, result={**run.result, **changes})


def test_equal_runs_give_equal_bytes_whatever_the_settings(run, figure, tmp_path):
    write_figure(figure, tmp_path / "a.svg")
    with mpl.rc_context({"svg.hashsalt": "another", "svg.fonttype": "path"}):
        write_figure(draw_top_view(run), tmp_path / "b.svg")
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()
    assert {p.name for p in tmp_path.iterdir()} == {"a.svg", "b.svg"}


def test_it_says_what_one_needs_to_know(run, figure, tmp_path):
    write_figure(figure, tmp_path / "flight.svg")
    said = texts(tmp_path / "flight.svg")
    quality = run.result["quality_of_flight"]
    title = f"posts, seed 2: success, {quality['flight_time_s']:.1f} s, "
    assert any(text.startswith(title) for text in said)
    assert {"east, m", "north, m", "speed, m/s", "goal", "start", "planned", "new plan"} <= set(
        said
    )
    assert {"simulated time, s", "height, m"} <= set(said)
    assert not any(text.startswith(("fault: ", "detector: ")) for text in said)
    assert not re.search(rb"\d{4}-\d\d-\d\dT", (tmp_path / "flight.svg").read_bytes())


def test_obstacles_are_where_the_world_has_them(run, axes):
    drawn = {
        (*p.get_xy(), p.get_width(), p.get_height())
        for p in axes.patches
        if isinstance(p, Rectangle)
    }
    boxes = run.result["world"]["boxes"]
    assert drawn == {(b[0], b[1], b[3] - b[0], b[4] - b[1]) for b in boxes}


def test_the_path_is_the_truth_coloured_by_speed(run, axes):
    (path,) = [c for c in axes.collections if isinstance(c, LineCollection)]
    points = np.array([segment[0] for segment in path.get_segments()])
    trace = run.trace
    true = np.column_stack([trace["truth_x_m"].to_numpy(), trace["truth_y_m"].to_numpy()])
    np.testing.assert_array_equal(points, true[:-1])
    speeds = np.linalg.norm(
        np.column_stack([trace[f"truth_v{axis}_mps"].to_numpy() for axis in "xyz"]), axis=1
    )
    np.testing.assert_allclose(path.get_array(), speeds[1:])
    assert path.get_clim() == (0.0, run.result["config"]["v_max_mps"])


def test_every_plan_and_every_mark_is_drawn(run, axes):
    assert len(axes.lines) == len(run.result["plans"]) <= 6
    places = {
        label: collection.get_offsets()
        for collection in axes.collections
        if isinstance(collection, PathCollection)
        for label in [collection.get_label()]
    }
    for kind, label in (("replan", "new plan"), ("slow", "slows down"), ("stop", "stops")):
        told = [e["position_enu_m"][:2] for e in run.result["events"] if e["kind"] == kind]
        if told:
            np.testing.assert_array_equal(places[label], told)
        else:
            assert label not in places
    (goal,) = [p for p in axes.patches if isinstance(p, Circle)]
    assert goal.get_center() == tuple(run.result["goal_enu_m"][:2])
    assert goal.get_radius() == run.result["config"]["goal_tolerance_m"]


def test_a_fault_at_the_start_does_not_hide_where_the_flight_began(run):
    places = run.trace.slice(0, 1).to_pylist()[0]
    there = [places[f"truth_{axis}_m"] for axis in "xyz"]
    event = {"kind": "fault", "stamp_s": 0.0, "text": "", "position_enu_m": there}
    axes = draw_top_view(changed(run, events=[event])).axes[0]
    marks = {each.get_label(): each for each in axes.collections}
    np.testing.assert_array_equal(marks["start"].get_offsets(), marks["fault"].get_offsets())
    assert marks["start"].get_zorder() > marks["fault"].get_zorder()
    assert marks["start"].get_sizes()[0] < marks["fault"].get_sizes()[0]  # and both are seen


def test_scales_are_equal_and_everything_of_the_flight_is_inside(run, axes):
    assert axes.get_aspect() == 1.0
    (low_x, high_x), (low_y, high_y) = axes.get_xlim(), axes.get_ylim()
    x, y = run.trace["truth_x_m"].to_numpy(), run.trace["truth_y_m"].to_numpy()
    assert low_x < x.min() < x.max() < high_x
    assert low_y < y.min() < y.max() < high_y


@pytest.mark.parametrize("outcome", [o for o in Outcome if o is not Outcome.SUCCESS])
def test_a_flight_that_failed_shows_where(run, outcome):
    axes = draw_top_view(changed(run, outcome=outcome.value)).axes[0]
    (mark,) = [c for c in axes.collections if c.get_label().replace(" ", "_") == outcome.value]
    end = [run.trace["truth_x_m"][-1].as_py(), run.trace["truth_y_m"][-1].as_py()]
    np.testing.assert_array_equal(mark.get_offsets(), [end])


@pytest.mark.slow
def test_without_referee_world_or_trace_there_is_a_picture_all_the_same(run, tmp_path):
    heard = run.trace.drop_columns([c for c in run.trace.column_names if c.startswith("truth_")])
    foreign = replace(changed(run, world=None, referee=None), trace=heard)
    empty = replace(changed(run, world=None, plans=[], events=[]), trace=run.trace.slice(0, 0))
    lost = replace(changed(run, world=None, goal_enu_m=None), trace=None)
    unknown = changed(run, quality_of_flight=dict.fromkeys(run.result["quality_of_flight"]))
    for number, odd in enumerate((foreign, empty, lost, unknown)):
        write_figure(draw_top_view(odd), tmp_path / f"{number}.svg")
        assert "east, m" in texts(tmp_path / f"{number}.svg")


def test_no_more_plans_than_one_can_tell_apart_older_ones_paler(run):
    plans = [{"stamp_s": k, "points_enu_m": [[0, k, 5], [9, k, 5]]} for k in range(23)]
    lines = draw_top_view(changed(run, plans=plans)).axes[0].lines
    assert [line.get_ydata()[0] for line in lines] == [17, 18, 19, 20, 21, 22]
    alphas = [line.get_alpha() for line in lines]
    assert alphas == sorted(alphas)
    assert len(set(alphas)) == 6
    labels = [line.get_label() for line in lines if not line.get_label().startswith("_")]
    assert labels == ["planned (newest 6 of 23)"]


def test_height_over_time_is_the_truth_with_the_same_marks(run, figure):
    above, beside = figure.axes[:2]
    (path,) = [c for c in beside.collections if isinstance(c, LineCollection)]
    points = np.array([segment[0] for segment in path.get_segments()])
    np.testing.assert_array_equal(points[:, 0], run.trace["stamp_s"].to_numpy()[:-1])
    np.testing.assert_array_equal(points[:, 1], run.trace["truth_z_m"].to_numpy()[:-1])
    (goal,) = beside.lines
    assert set(goal.get_ydata()) == {run.result["goal_enu_m"][2]}
    low, high = beside.get_ylim()
    assert low == 0.0
    assert high > points[:, 1].max()
    marks = [
        [len(c.get_offsets()) for c in axes.collections if isinstance(c, PathCollection)]
        for axes in (above, beside)
    ]
    assert sum(marks[0]) == sum(marks[1]) + 1  # the goal


SOURCE = {
    "level": "source", "stage": "planning", "states": ["waypoint_z"], "state": "applied",
    "request": {"target": "planning"},
}  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"fault": SOURCE}, "fault: .*waypoint z"),
        (
            {
                "fault": SOURCE | {"states": ["waypoint_x", "waypoint_y", "waypoint_z"],
                                   "request": {"target": "waypoint_position", "together": True,
                                               "field": "exponent"}},
                "detection": {"detector": "aad", "alarm_count": 1},
            },
            "fault: .*exponent .*waypoint position; detector: aad, 1 alarm",
        ),
        (
            {"fault": SOURCE | {"state": "not_injected"},
             "detection": {"detector": "gad", "alarm_count": 0}},
            r"fault: .*waypoint z \(not injected\); detector: gad, no alarms",
        ),
        (
            {"fault": SOURCE | {"stage": "process", "states": ["octomap"],
                                "request": {"target": "process.octomap"}}},
            "fault: .*octomap.* killed",
        ),
        (
            {"fault": {"level": "instruction", "node": "octomap", "state": "applied",
                       "request": {"target": "perception", "sites": [], "roles": []}}},
            "fault: .*instruction .*octomap",
        ),
        ({"detection": {"detector": "l2", "alarm_count": 12}}, "detector: l2, 12 alarms"),
    ],
)  # fmt: skip
def test_the_title_names_fault_and_detector(run, changes, told):
    title = draw_top_view(changed(run, **changes)).axes[0].get_title("left")
    assert re.fullmatch(told, " ".join(title.splitlines()[1:]))
