"""Model and flight side by side: a flight that does what the model says differs by nothing."""

import json
import math
import re

import pyarrow as pa
import pytest

from mavfi_cli.analysis.beside_model import (
    FlightsReport,
    MeasuredOverhead,
    ModelAndFlights,
    side_by_side,
)
from mavfi_cli.analysis.overhead import ComputeOverhead
from mavfi_cli.mission.measures import FlightRecord, measures_of
from mavfi_cli.report.drawing import write_figure
from mavfi_cli.report.model import draw_flights, model_csv, model_json, model_lines
from mavfi_cli.spec.platform import load_platform
from mavfi_cli.studies.redundancy import FlightPlan
from mavfi_cli.vpm.model import SCHEMES, ModelVehicle
from mavfi_cli.vpm.report import Choices, report

HOVER_SHAFT_W = 20.0  # of the simulated vehicle, with one board
STRAIGHT_M = 40.0 - 1.0


def flight(row, plan, *, slower=1.0, longer=1.0, alarms=3, outcome="success"):
    """What a flight as the model has it records; or a slower one, or one of a longer path."""
    hover_w = HOVER_SHAFT_W * plan.rotors_w
    velocity = row.performance.velocity_mps / slower
    time_s = longer * STRAIGHT_M / velocity
    return {
        "outcome": outcome,
        "config": {"takeoff_height_m": 5.0, "goal_tolerance_m": 1.0},
        "world": {"start": [1.0, 2.0, 0.0]},
        "goal_enu_m": [41.0, 2.0, 5.0],
        "quality_of_flight": {
            "mean_speed_mps": velocity, "max_speed_mps": velocity, "flight_time_s": time_s,
            "distance_m": longer * STRAIGHT_M, "energy_propeller_j": hover_w * time_s,
        },
        "referee": {"physics": {"hover_shaft_w": hover_w}},
        "response_time_s": {"median": 1.0 / row.performance.throughput_hz},
        "pilot": {"replans": 2},
        "detection": {"alarm_count": alarms} if row.scheme in ("gad", "aad") else None,
    }  # fmt: skip


def flights_of(records):
    """Records of each arm as the columns of a ledger's table."""
    return pa.Table.from_pylist(
        [
            {
                "label_group": vehicle,
                "label_arm": scheme,
                "number": seed,
                "labels": "{}",
                "reason": "",
                "state": "flown",
                "world": "w",
                "seed": seed,
                "outcome": record["outcome"],
                "succeeded": record["outcome"] == "success",
                **measures_of(FlightRecord.of(record)),
            }
            for (vehicle, scheme), those in records.items()
            for seed, record in enumerate(those)
        ]
    )


@pytest.fixture
def spark(tmp_path):
    """The model's report, the plans, and a function that puts flights beside them."""
    vehicle, x86 = ModelVehicle.load("spark"), load_platform("x86")
    chain_s = sum(kernel.latency_s for kernel in x86.kernels.values())
    told = report([vehicle], Choices(), SCHEMES)
    setting = Choices().inputs(vehicle)
    rows = {row.scheme: row for row in told.vehicles[0].schemes}
    plans = {
        ("spark", name): FlightPlan.of(setting, scheme, x86, chain_s, tmp_path).setup
        for name, scheme in SCHEMES.items()
    }

    def beside(change=None, refused=(), count=3):
        flown = {
            key: [flight(rows[key[1]], plan, **(change or {}).get(key[1], {}))] * count
            for key, plan in plans.items()
            if key[1] not in refused
        }
        asked = {key: "too heavy to fly" if key[1] in refused else plans[key] for key in plans}
        overhead = ComputeOverhead(
            detector="aad", flights=3, detection_s=0.01, recompute_s=0.0, compute_s=10.0,
            host_compute_s=0.2, alarms=9, platforms=("x86",),
        )  # fmt: skip
        return told, FlightsReport(
            worlds=("w",), missions_each=count, first_seed=1, detectors="mine", stack="mavbench",
            overheads=(MeasuredOverhead.of(overhead),),
            vehicles=side_by_side(told, asked, flights_of(flown)),
        )  # fmt: skip

    return beside


def rows_of(told):
    return {row.scheme: row for row in told[1].vehicles[0].schemes}


def compared(group):
    """Each number of the model that stands beside one of the flights."""
    return [value for value in (getattr(group, name) for name in group.__slots__)
            if isinstance(value, ModelAndFlights)]  # fmt: skip


def test_flights_as_the_model_has_them_do_not_differ(spark):
    for row in rows_of(spark()).values():
        pairs = [*compared(row.flown), *compared(row.over_none), *compared(row.over_aad)]
        assert len(pairs) == 12
        for pair in pairs:
            assert pair.difference_percent == pytest.approx(0.0, abs=1e-9)
        assert row.flown.success.share == 1.0


def test_tmr_takes_as_much_longer_as_the_paper_says(spark):
    ratio = rows_of(spark())["tmr"].over_aad.flight_time_ratio
    assert ratio.flights.value == pytest.approx(1.91, rel=1e-3)
    assert ratio.model == pytest.approx(1.91, rel=1e-3)


def test_by_how_much_a_flight_differs(spark):
    told = rows_of(spark({"tmr": {"slower": 1.25, "longer": 1.1}}))
    tmr, ratios = told["tmr"].flown, told["tmr"].over_none
    assert tmr.velocity_mps.difference_percent == pytest.approx(-20.0)
    assert tmr.path_ratio.difference_percent == pytest.approx(10.0)
    assert tmr.flight_time_s.difference_percent == pytest.approx(37.5)
    assert tmr.energy_j.difference_percent == pytest.approx(37.5)
    assert told["none"].flown.flight_time_s.difference_percent == pytest.approx(0.0, abs=1e-9)
    time, velocity = ratios.flight_time_ratio, ratios.velocity_ratio
    assert time.flights.value / time.model == pytest.approx(1.375)
    assert time.difference_percent == pytest.approx(37.5)
    assert velocity.flights.value / velocity.model == pytest.approx(0.8)


def test_only_successes_count(spark):
    row = rows_of(spark({"dmr": {"outcome": "collision"}}))["dmr"]
    assert row.flown.success.share == 0.0
    assert row.flown.outcomes == {"collision": 3}
    assert math.isnan(row.flown.velocity_mps.flights.value)
    assert row.over_none.pairs == 0


def test_a_scheme_that_is_not_flown_says_why(spark):
    told = spark(refused=("tmr",))
    assert rows_of(told)["tmr"].problem == "too heavy to fly"
    lines = model_lines(*told)
    assert [line for line in lines if "tmr" in line and "too heavy to fly" in line]
    rows = model_csv(told[1]).splitlines()
    assert len(rows) == 6
    assert "too heavy to fly" in rows[3]


def test_the_table_tells_overheads_side_by_side(spark):
    text = "\n".join(model_lines(*spark()))
    assert "aad       0.1 %     0.1 %         0.0062 %  9 in 3 flights  5 %" in text
    assert re.search(r"none: .* 8 m/s² .* 9\.171 m/s²", text)
    assert "no detector" in text
    assert "3.0 a flight" in text
    assert "683" not in text


def test_what_has_no_number_has_none_in_the_table(spark):
    lines = model_lines(*spark({"dmr": {"outcome": "collision"}}, count=1))
    lines = lines[next(n for n, line in enumerate(lines) if line.startswith("Flights in")) :]
    text = "\n".join(lines)
    assert "nan" not in text
    assert max(map(len, lines)) <= 100
    assert re.search(r"^dmr +6.50 m/s +- +-$", text, re.MULTILINE)  # no success
    assert re.search(r"^tmr +x 0.5236 +x [\d.]+ +\(1 pairs\) ", text, re.MULTILINE)  # no interval


def test_a_detector_that_does_not_know_these_flights(spark):
    text = "\n".join(model_lines(*spark({"aad": {"alarms": 683}})))
    assert "aad: 683 alarms" in text


def test_the_picture(spark, tmp_path):
    told, whole = spark({"dmr": {"outcome": "collision"}}, refused=("tmr",), count=1), spark()
    first, second = (draw_flights(told[1]) for _ in range(2))
    write_figure(first, tmp_path / "a.svg")
    write_figure(second, tmp_path / "b.svg")
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()
    left, right = draw_flights(whole[1]).axes
    diamonds = [y for line in left.lines if line.get_marker() == "D" for y in line.get_ydata()]
    drawn = [row.flown.velocity_mps.model for row in rows_of(whole).values()]
    assert diamonds == pytest.approx(drawn)
    highest = rows_of(whole)["tmr"].over_none.energy_ratio
    heights = [bar.get_height() for bar in right.patches]
    assert len(heights) == 15
    assert max(heights) == pytest.approx(highest.flights.value)
    words = [text.get_text() for text in first.axes[0].texts]
    assert "not flown" in words
    assert "0 % of 1 succeed" in words


def test_it_is_json(spark):
    assert json.dumps(model_json(*spark({"dmr": {"outcome": "collision"}})))
