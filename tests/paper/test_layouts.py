"""Layouts on hand-made tables whose answers are known."""

import math
from pathlib import Path

import made_flights
import pytest
from made_flights import flight, flights, struck

from mavfi_cli.analysis.kernels import KernelSummary
from mavfi_cli.paper.items import ITEMS, Source, printed
from mavfi_cli.paper.layouts import OF_FLIGHTS, of_flights
from mavfi_cli.paper.status import of_kernels, of_model
from mavfi_cli.studies.compare import ComparePlan

KERNELS = Path(__file__).parents[2] / "docs/results/kernels.json"


def cell(found, label, title):
    """The cell of a row, by the start of its labels, and a column."""
    place = [column.title for column in found.columns].index(title)
    (row,) = [row for row in found.rows if " ".join(row.labels).startswith(label)]
    return row.cells[place]


def rows_of(found):
    """The cells of each row by its first label."""
    return {row.labels[0]: row.cells for row in found.rows}


def test_table_iv_counts_every_flown_mission_beside_the_papers_rate():
    flown = flights([
        flight(20.0), flight(20.0, pair="b", world="dense"),
        struck(25.0), struck(None), struck(21.0), struck(22.0),
        struck(20.0, detector="gad"), struck(None, detector="aad"),
        struck(None, detector="gad", protect="control"),
        {**struck(20.0), "state": "error"},
    ])  # fmt: skip
    found = of_flights("table4", flown)
    assert [column.title for column in found.columns] == ["sparse", "dense"]
    faults = cell(found, "injection", "sparse")
    assert (faults.value, faults.count, faults.paper) == (75.0, 4, 88.3)
    assert faults.low == pytest.approx(30.06, abs=0.01)  # Wilson
    assert faults.high == pytest.approx(95.44, abs=0.01)
    assert cell(found, "Gaussian", "sparse").count == 1  # not the one of another protection
    assert cell(found, "autoencoder", "sparse").value == 0.0
    assert math.isnan(cell(found, "injection", "dense").value)
    assert cell(found, "golden", "dense").paper == 85.0


def test_a_table_says_for_which_worlds_its_intervals_hold():
    fixed = flight(20.0, world_seed=16), flight(20.0, world="dense", world_seed=3)
    many = [flight(20.0), flight(21.0)]
    (note,) = [note for note in of_flights("table4", flights(fixed)).notes if "worlds:" in note]
    assert note == "worlds: fixed (dense 3, sparse 16); intervals hold for these worlds only"
    assert "another one for each seed" in flights(many).population
    assert "fixed (dense 3, sparse 16) in 2 flights, another" in flights([*fixed, *many]).population


def test_fig_12_compares_each_flight_with_its_own_golden_one():
    flown = flights([
        flight(20.0), flight(40.0, pair="b"), flight(None, pair="c"),
        struck(30.0), struck(44.0, pair="b"), struck(90.0, pair="c"),
        struck(None, fault_seed=2),
        struck(22.0, detector="gad"), struck(40.0, pair="b", detector="gad"),
        struck(90.0, pair="c", detector="gad"), struck(None, fault_seed=2, detector="gad"),
        struck(20.0, detector="aad"), struck(40.0, pair="b", detector="aad"),
        struck(90.0, pair="c", detector="aad"), struck(None, fault_seed=2, detector="aad"),
    ])  # fmt: skip
    found = of_flights("fig12", flown)
    worst = cell(found, "sparse", "worst, %")
    assert (worst.value, worst.count, worst.paper) == (pytest.approx(50.0), 2, 62.6)
    assert math.isnan(worst.low)  # a maximum
    assert cell(found, "sparse", "over mean, %").value == pytest.approx(200.0)  # 90 of 30 s
    assert cell(found, "sparse", "GAD, points").value == pytest.approx(40.0)
    assert cell(found, "sparse", "AAD, points").value == pytest.approx(50.0)
    assert "worst flight +50.0 % (paper +62.6 %) in sparse" in found.result


def test_a_fault_that_no_detector_saw_does_not_stand_beside_those_that_one_saw():
    flown = flights([
        flight(20.0), struck(22.0, fault_seed=1), struck(40.0, fault_seed=2),
        struck(22.0, fault_seed=1, detector="gad"),
    ])  # fmt: skip
    found = of_flights("fig12", flown)
    worst = cell(found, "sparse", "worst, %")
    assert (worst.value, worst.count) == (pytest.approx(10.0), 1)
    assert cell(found, "sparse", "GAD, points").value == pytest.approx(0.0)
    alone = of_flights("fig12", flown.chosen(detector=None))
    assert cell(alone, "sparse", "worst, %").value == pytest.approx(100.0)


def test_fig_14_gives_the_recovered_share_by_protected_stages():
    flown = flights([
        flight(20.0, world="factory"), struck(30.0, world="factory"),
        struck(25.0, world="factory", detector="gad", protect="control"),
        struck(20.0, world="factory", detector="aad"),
    ])  # fmt: skip
    found = of_flights("fig14", flown)
    control = cell(found, "Gaussian control", "factory")
    assert (control.value, control.paper, control.count) == (pytest.approx(50.0), 34.7, 1)
    assert cell(found, "autoencoder perception+planning+control", "factory").value == 100.0
    assert math.isnan(cell(found, "Gaussian planning+control", "factory").value)


def test_table_iii_has_a_row_for_each_number_of_bits():
    flown = flights([
        flight(20.0), flight(22.0, pair="b", replans=2),
        struck(30.0, level="source", fault_bits=1), struck(None, pair="b", fault_bits=1),
        struck(40.0, level="source", fault_bits=5, energy_regression_j=20_000.0),
    ])  # fmt: skip
    found = of_flights("table3", flown)
    assert [row.labels for row in found.rows] == [("0 (golden)",), ("1",), ("5",)]
    golden = cell(found, "0", "flight time, s")
    assert (golden.value, golden.count, golden.paper) == (21.0, 2, 94.6)
    assert cell(found, "0", "replans").value == 1.5
    assert cell(found, "5", "energy, kJ").value == 20.0
    assert (cell(found, "1", "success, %").value, cell(found, "1", "success, %").paper) == (50, 92)


def test_table_v_says_that_an_export_has_no_times():
    found = of_flights("table5", flights([struck(20.0, detector="gad")]))
    assert any(note.startswith("no numbers: this export") for note in found.notes)


def test_table_v_adds_detection_and_recovery():
    costs = {"check_share": 0.001, "recovery_share_perception": 0.02,
             "recovery_share_planning": 0.03, "recovery_share_control": 0.0}  # fmt: skip
    alone = {**costs, "recovery_share_perception": 0.0, "recovery_share_planning": 0.0}
    flown = flights([struck(20.0, detector="gad", **costs), struck(20.0, detector="aad", **alone)])
    found = of_flights("table5", flown)
    assert cell(found, "GAD planning", "sparse").value == pytest.approx(3.0)
    assert cell(found, "GAD sum", "sparse").value == pytest.approx(5.1)
    assert cell(found, "GAD sum", "sparse").paper == 1.9218
    assert cell(found, "AAD sum", "sparse").value == pytest.approx(0.1)
    assert cell(found, "AAD recovery", "sparse").paper == "< 0.0001"


def test_figs_7_to_9_have_a_row_for_each_place():
    flown = flights([
        flight(20.0), flight(30.0, pair="b", planner="rrt"),
        struck(24.0, fault_target="planner"),
        struck(33.0, pair="b", fault_target="planner", planner="rrt"),
        struck(None, fault_target="control"),
    ])  # fmt: skip
    found = of_flights("fig7", flown)
    assert rows_of(found)["RRT*"][2].value == pytest.approx(20.0)
    rows = rows_of(found)
    assert list(rows) == ["golden, RRT*", "golden, RRT", "RRT", "RRT*", "PID"]
    assert rows["RRT"][2].value == pytest.approx(10.0)
    assert rows["PID"][0].value == 0.0
    fields = of_flights("fig9", flights([
        flight(20.0), struck(21.0, fault_field="sign"),
        struck(20.0, fault_field="mantissa"),
    ]))  # fmt: skip
    labels = [row.labels for row in fields.rows]
    assert labels == [("golden", ""), ("sign", "yes"), ("mantissa", "no")]
    states = of_flights("fig8", flights([
        flight(20.0), struck(30.0, fault_target="time_to_collision")
    ]))  # fmt: skip
    assert "+50.0 % over its own golden one (time_to_collision)" in states.result


def test_fig_13_follows_one_flight_into_its_recovery():
    flown = flights([
        flight(20.0), flight(20.0, pair="b"),
        struck(22.0), struck(30.0, pair="b"),
        struck(26.0, detector="aad"), struck(21.0, pair="b", detector="aad"),
    ])  # fmt: skip
    found = of_flights("fig13", flown)
    assert cell(found, "planning", "worst, %").value == pytest.approx(50.0)
    assert cell(found, "planning", "worst, %").paper == 24.5
    assert cell(found, "planning", "the same with AAD, %").value == pytest.approx(5.0)
    milder = struck(28.0, pair="b", detector="aad", fault_seed=2)  # of the same mission
    found = of_flights(
        "fig13", flights([flight(20.0, pair="b"), struck(30.0, pair="b", fault_seed=1), milder])
    )
    assert math.isnan(cell(found, "planning", "the same with AAD, %").value)


def test_fig_16_compares_platforms():
    flown = flights([
        flight(20.0), flight(25.0, pair="c", platform="tx2"),
        struck(22.0), struck(50.0, pair="c", platform="tx2"),
        struck(30.0, pair="c", platform="tx2", detector="gad"),
    ])  # fmt: skip
    found = of_flights("fig16", flown)
    worst = cell(found, "tx2", "worst, x own golden")
    assert (worst.value, worst.paper) == (pytest.approx(2.0), 2.8)
    assert cell(found, "tx2", "GAD recovers, %").value == pytest.approx(80.0)
    assert cell(found, "x86", "worst, x own golden").paper is None


def test_fig_16_and_a_comparison_take_the_same_flights():
    """The worst fault was not flown with the detector, so no detector recovers any of it."""
    times_s = [("golden", 1, 20.0), ("golden", 2, 20.0), ("none", 1, 24.0), ("none", 2, 40.0),
               ("gad", 1, 21.0)]  # fmt: skip
    flights = [made_flights.on("tx2", seed, time_s, setting, world="sparse")
               for setting, seed, time_s in times_s]  # fmt: skip
    plan = ComparePlan(platforms=("tx2",), inject=("planning",), detectors=("gad",))
    bare, protected = made_flights.comparison(plan, flights).costs
    figure = of_flights("fig16", made_flights.compared(flights))
    worst = cell(figure, "tx2", "worst, x own golden").value
    recovered = cell(figure, "tx2", "GAD recovers, %").value
    assert worst == bare.over_own.largest == pytest.approx(2.0)
    assert recovered == 100.0 * protected.over_own.recovered_share == pytest.approx(75.0)


@pytest.mark.parametrize("name", OF_FLIGHTS)
def test_a_layout_takes_a_table_without_flights(name):
    found = of_flights(name, flights([]))
    assert found.name == name
    assert all(math.isnan(each.value) for row in found.rows for each in row.cells)
    assert found.result


def test_fig_6_reads_the_runs_of_kernels():
    found = of_kernels(KernelSummary.read(KERNELS).kernels)
    benign = cell(found, "OctoMap", "benign, %")
    assert (benign.count, benign.paper) == (5000, "< 25")
    assert benign.low < benign.value < benign.high
    for row in found.rows:
        assert math.fsum(each.value for each in row.cells) == pytest.approx(100.0)


def test_fig_15_is_the_model_calibrated_to_the_paper():
    found = of_model()
    for vehicle, ratio in (("airsim", 1.06), ("spark", 1.91)):
        assert cell(found, "tmr", vehicle).paper == ratio
        assert cell(found, "tmr", vehicle).value == pytest.approx(ratio, abs=0.005)


def test_every_item_has_a_layout_and_a_source():
    assert {item.name for item in ITEMS if item.source is Source.FLIGHTS} == set(OF_FLIGHTS)


def test_the_paper_stands_once():
    assert printed("table3", "replans", 5) == 4.28
    assert printed("fig14", "recovered_percent", "gad", "factory", "planning+control") == 65.1
    assert printed("fig14", "recovered_percent", "gad", "dense", "control") is None
    assert printed("fig8", "critical", "command_yaw") is None
