"""The numbers of a comparison, from flights whose answers are known."""

import csv
import io
import math
import re
import shlex
from dataclasses import replace

import pytest
from made_flights import PLAN, SEEDS, comparison, on

from mavfi_cli.analysis.platforms import QUANTITIES, ChangedQuantity
from mavfi_cli.report.platforms import platform_csv, platform_lines
from mavfi_cli.stats.shares import Share, wilson
from mavfi_cli.studies.compare import ComparePlan


@pytest.fixture(scope="module")
def told(whole):
    return whole


def row(told, table, **wanted):
    (found,) = [
        r for r in getattr(told, table) if all(getattr(r, k) == v for k, v in wanted.items())
    ]
    return found


def test_a_row_a_platform_and_setting_with_medians_means_and_largest(told):
    assert len(told.settings) == 2 * 4
    golden = row(told, "settings", platform="tx2", setting="golden")
    found = golden.quantities["flight_time_s"]
    assert found.median.value == pytest.approx(1.5 * 25.5)
    assert found.mean.value == pytest.approx(1.5 * 25.5)
    assert found.largest == pytest.approx(45.0)
    assert found.median.low < found.median.value < found.median.high
    assert golden.quantities["response_median_s"].median.value == 1.6
    assert golden.quantities["response_p95_s"].median.value == 2.0


def test_success_is_counted_with_wilsons_interval():
    flights = [on("x86", s, 20.0, outcome="success" if s > 3 else "collision") for s in SEEDS]
    told = comparison(ComparePlan(platforms=("x86",), inject=()), flights)
    (golden,) = told.settings
    interval = wilson(7, 10)
    assert golden.success == Share(
        count=7, total=10, share=0.7, low=interval.low, high=interval.high
    )
    assert golden.outcomes == {"collision": 3, "success": 7}
    assert golden.quantities["flight_time_s"].median.count == 7
    assert golden.quantities["response_median_s"].median.count == 10  # failed ones too


def test_faults_that_did_nothing_are_in_no_number():
    flights = [on("x86", 1, 20.0, "none"), on("x86", 2, 90.0, "none", counted=False)]
    found = row(comparison(PLAN, flights), "settings", platform="x86", setting="none")
    assert (found.flown, found.counted) == (2, 1)
    assert found.quantities["flight_time_s"].largest == 20.0


def test_platforms_are_compared_mission_by_mission(told):
    golden = row(told, "ratios", platform="tx2", setting="golden")
    time = golden.quantities["flight_time_s"]
    assert (golden.reference, golden.pairs, time.count) == ("x86", 10, 10)
    assert time.value == pytest.approx(1.5)
    assert time.low == time.high == pytest.approx(1.5)  # the same in every mission
    assert golden.quantities["response_median_s"].value == pytest.approx(4.0)
    assert golden.quantities["distance_m"].value == pytest.approx(1.0)
    assert golden.quantities["replans"] == ChangedQuantity(
        kind="difference", unit="count", value=0.0, low=0.0, high=0.0, count=10
    )


def test_the_ratio_is_of_missions_that_both_platforms_fly_and_win():
    flights = [
        on("x86", 1, 20.0), on("x86", 2, 20.0), on("x86", 3, 20.0),
        on("tx2", 1, 40.0), on("tx2", 2, 99.0, outcome="collision"),
        on("tx2", 4, 99.0),
    ]  # fmt: skip
    golden = row(comparison(PLAN, flights), "ratios", platform="tx2", setting="golden")
    assert (golden.pairs, golden.both_succeed) == (2, 1)
    assert golden.quantities["flight_time_s"].count == 1
    assert golden.quantities["flight_time_s"].value == pytest.approx(2.0)
    assert golden.success.only_first == 1
    assert golden.success.difference == pytest.approx(-0.5)


def test_the_ratio_is_geometric_so_that_it_turns_round_with_the_platforms():
    times = {"x86": [10.0, 20.0, 40.0], "tx2": [20.0, 20.0, 90.0]}
    flights = [on(p, s, t) for p in times for s, t in enumerate(times[p])]

    def of(*platforms):
        told = comparison(ComparePlan(platforms=platforms, inject=()), flights)
        (found,) = told.ratios
        return found.quantities["flight_time_s"]

    there, back = of("x86", "tx2"), of("tx2", "x86")
    assert there.value == pytest.approx((2.0 * 1.0 * 2.25) ** (1.0 / 3.0))
    assert back.value == pytest.approx(1.0 / there.value)


def test_several_faults_of_one_mission_count_as_one():
    plan = ComparePlan(inject=("planning", "control"), missions=2)
    flights = [
        on(platform, seed, time_s, "none", target=target)
        for target in ("planning", "control")
        for platform, seed, time_s in (("x86", 1, 10.0), ("x86", 2, 10.0), ("tx2", 1, 20.0),
                                       ("tx2", 2, 40.0))
    ]  # fmt: skip
    found = row(comparison(plan, flights), "ratios", platform="tx2", setting="none")
    assert found.pairs == 4
    assert found.quantities["flight_time_s"].count == 2
    assert found.quantities["flight_time_s"].value == pytest.approx(math.sqrt(8.0))


def test_the_longest_flights_over_the_mean_golden_one(told):
    golden = row(told, "worst", platform="x86", setting="golden")
    faulty = row(told, "worst", platform="x86", setting="none")
    aad = row(told, "worst", platform="x86", setting="aad")
    assert golden.worst_s == 30.0
    assert faulty.worst_s == 44.0
    assert faulty.over_mean_ratio == pytest.approx(44.0 / 25.5)
    # Against the mean, what remains is the longest mission, not the fault.
    assert aad.over_mean_recovered_share == pytest.approx((44.0 - 30.0) / (44.0 - 25.5))


def test_faults_no_longer_than_the_longest_golden_flight_leave_nothing_to_recover():
    flights = [on("x86", s, 20.0 + s, setting) for s in SEEDS for setting in PLAN.settings]
    told = comparison(PLAN, flights)
    for setting in ("gad", "aad"):
        assert math.isnan(
            row(told, "worst", platform="x86", setting=setting).over_mean_recovered_share
        )
        assert math.isnan(
            row(told, "costs", platform="x86", setting=setting).over_own.recovered_share
        )


def test_a_fault_that_cost_nothing_is_not_recommended():
    flights = [on(p, s, 20.0, setting) for p in PLAN.platforms for s in SEEDS
               for setting in PLAN.settings]  # fmt: skip
    text = "\n".join(platform_lines(comparison(PLAN, flights)))
    assert re.search("no fault.* tx2", text)
    assert "mavfi fly" not in text


def test_the_command_that_repeats_the_worst_flight_can_be_pasted():
    plan = replace(PLAN, world="my worlds/a b.toml")
    flights = [on(p, s, 21.0 if setting == "none" else 20.0, setting) for p in PLAN.platforms
               for s in SEEDS for setting in PLAN.settings]  # fmt: skip
    lines = platform_lines(comparison(plan, flights))
    again = next(line for line in lines if "mavfi fly" in line)
    words = ["mavfi", "fly", "--world", "my worlds/a b.toml", "--seed"]
    assert shlex.split(again)[:5] == words


def test_nothing_flown_gives_no_number_and_no_error():
    told = comparison(PLAN, [])
    assert all(r.success.total == 0 for r in told.settings)
    assert all(math.isnan(r.worst_s) for r in told.worst)
    assert all(r.pairs == 0 and r.worst_flight is None for r in told.costs)
    assert all(math.isnan(r.extra_s.value) for r in told.cost_differences)
    assert all(math.isnan(r.quantities["flight_time_s"].value) for r in told.ratios)


def test_no_line_of_the_text_is_longer_than_100_columns_but_commands():
    plan = ComparePlan(inject=("perception", "planning", "control"), field="exponent", missions=200)
    flights = [
        on(platform, seed, 20.0 + seed % 7, setting,
               outcome="collision" if platform == "tx2" and seed % 4 == 0 else "success")
        for platform in plan.platforms for seed in range(200) for setting in plan.settings
    ]  # fmt: skip
    told = comparison(plan, flights, errors=["mission 3: no"])
    text = platform_lines(told)
    assert "-25.0 (p<.001)" in "\n".join(text)
    assert [line for line in text if len(line) > 100 and not line.startswith("  mavfi fly")] == []


@pytest.mark.parametrize(("missions", "said"), [(1, False), (2, True), (9, True), (10, False)])
def test_intervals_of_too_few_flights_are_said_to_be_too_narrow(missions, said):
    plan = ComparePlan(inject=(), missions=missions)
    flights = [
        on(platform, seed, 20.0 + seed) for platform in plan.platforms
        for seed in range(1, missions + 1)
    ]  # fmt: skip
    told = comparison(plan, flights)
    assert ("fewer than 10 flights" in "\n".join(platform_lines(told))) is said


def test_text_and_csv_say_every_number_with_its_unit(whole):
    text = platform_lines(whole)
    assert all(len(line) <= 100 for line in text if not line.startswith("  mavfi fly"))
    (line,) = [line for line in text if "--seed 2 --platform tx2" in line]
    assert (
        line
        == "  mavfi fly --world sparse --seed 2 --platform tx2 --inject planning --fault-seed 14"
    )
    hardened = replace(whole, plan=replace(whole.plan, stack="hardened"))
    (line,) = [line for line in platform_lines(hardened) if "--seed 2 --platform tx2" in line]
    assert line.endswith("--platform tx2 --stack hardened --inject planning --fault-seed 14")
    rows = list(csv.DictReader(io.StringIO(platform_csv(whole))))
    assert all(r["unit"] in ("s", "m", "J", "count", "1") for r in rows)
    settings = [r for r in rows if r["table"] == "settings"]
    assert len(settings) == 2 * 4 * (1 + 2 * len(QUANTITIES))
    (ratio,) = [
        r for r in rows
        if (r["table"], r["setting"], r["quantity"]) == ("ratios", "golden", "flight time")
    ]  # fmt: skip
    assert (ratio["platform"], ratio["reference"], ratio["statistic"]) == ("tx2", "x86", "ratio")
    assert float(ratio["value"]) == pytest.approx(1.5)
    largest = {r["setting"]: float(r["value"]) for r in rows if r["statistic"] == "ratio of the "
               "largest"}  # fmt: skip
    assert largest == {r.setting: r.largest_ratio for r in whole.cost_differences}
    assert len(largest) == 3
