"""Arms: the same missions in several ways, and ratios over the pairs."""

import math

import numpy as np
import pytest

from mavfi_cli.campaign.arms import Arm, Flown, arm_missions, paired_ratio, paired_success
from mavfi_cli.mission.config import MissionConfig


def result(time_s, outcome="success"):
    return {"outcome": outcome, "time_s": time_s}


def time_s(each):
    return each["time_s"]


def flown(*results, errors=()):
    return Flown(results={("w", n): each for n, each in enumerate(results)}, errors=errors)


def test_the_list_grows_pair_by_pair():
    arms = [Arm(group="g", name=name, mission=MissionConfig(v_max_mps=v)) for name, v in
            (("slow", 1.0), ("fast", 2.0))]  # fmt: skip
    missions = arm_missions(arms, ("sparse", "dense"), 5, 2)
    assert [
        (m.config.seed, m.config.world, m.labels["arm"], m.config.v_max_mps) for m in missions
    ] == [
        (5, "sparse", "slow", 1.0), (5, "sparse", "fast", 2.0),
        (5, "dense", "slow", 1.0), (5, "dense", "fast", 2.0),
        (6, "sparse", "slow", 1.0), (6, "sparse", "fast", 2.0),
        (6, "dense", "slow", 1.0), (6, "dense", "fast", 2.0),
    ]  # fmt: skip
    pairs = [mission.pair for mission in missions]
    assert pairs[0] == pairs[1] == "sparse/5"
    assert len(set(pairs)) == 4


def test_a_ratio_is_over_pairs_that_both_succeeded():
    first = flown(result(10.0), result(20.0), result(1.0, "collision"), result(5.0))
    second = flown(result(20.0), result(80.0), result(1.0), result(7.0, "timeout"))
    found = paired_ratio(first, second, time_s)
    assert found.count == 2
    assert found.value == pytest.approx(math.sqrt(2.0 * 4.0))
    assert 2.0 - 1e-9 <= found.low <= found.value <= found.high <= 4.0 + 1e-9
    back = paired_ratio(second, first, time_s)
    assert back.value == pytest.approx(1.0 / found.value)


def test_each_side_may_be_measured_in_its_own_way():
    first, second = flown(result(10.0)), flown(result(10.0))
    found = paired_ratio(first, second, time_s, lambda each: 3.0 * each["time_s"])
    assert found.value == pytest.approx(3.0)


def test_nothing_to_compare_is_no_number():
    found = paired_ratio(flown(result(1.0, "crash")), flown(result(1.0)), time_s)
    assert found.count == 0
    assert math.isnan(found.value)


def test_the_interval_holds_the_ratio_that_was_put_in():
    rng = np.random.default_rng(3)
    first = flown(*(result(t) for t in rng.uniform(10.0, 30.0, 40)))
    second = flown(
        *(result(1.3 * each["time_s"] * math.exp(rng.normal(0.0, 0.05)))
          for each in first.results.values())
    )  # fmt: skip
    found = paired_ratio(first, second, time_s)
    assert found.low < 1.3 < found.high
    assert found.high - found.low < 0.1


def test_means_and_success_of_an_arm():
    arm = flown(result(10.0), result(None), result(99.0, "collision"), result(20.0))
    assert arm.mean(time_s).value == pytest.approx(15.0)
    assert (arm.success.count, arm.success.total) == (3, 4)
    assert arm.outcomes == {"success": 3, "collision": 1}
    test = paired_success(arm, flown(*[result(1.0, "timeout")] * 4))
    assert (test.only_first, test.neither) == (3, 1)
