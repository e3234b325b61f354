"""Every printed statistic once more from random flights, by SciPy and NumPy and another route."""

import math
from types import SimpleNamespace as Namespace

import numpy as np
import pytest
from made_flights import comparison, on
from scipy import stats

from mavfi_cli.studies.compare import ComparePlan

PLAN = ComparePlan(inject=("planning", "control"), missions=40)
SEEDS = range(1, 41)
SETTINGS = ("none", "gad", "aad")
ALIKE = 0.15  # of an interval's width: two bootstraps with other random numbers


def flights():
    """Missions of unlike length, most faults without a cost, some lost, some that did nothing."""
    rng = np.random.default_rng(20)
    length_s = dict(zip(SEEDS, rng.uniform(18.0, 24.0, len(SEEDS)), strict=True))
    found = []

    def fly(platform, slower, seed, setting, target, rate):
        cost = rng.exponential(1.5) if setting != "golden" and rng.random() < 0.3 else 0.0
        found.append(
            on(
                platform,
                seed,
                slower * length_s[seed] + cost,
                setting,
                target=target,
                outcome="collision" if rng.random() < rate else "success",
                counted=setting == "golden" or bool(rng.random() < 0.9),
                replans=float(rng.integers(0, 4)),
                response_median_s=float(rng.normal(0.4 * slower**10, 0.01)),
            )
        )

    for platform, factor, rate in (("x86", 1.0, 0.02), ("tx2", 1.05, 0.08)):
        for seed in SEEDS:
            slower = factor * rng.uniform(0.98, 1.02)
            fly(platform, slower, seed, "golden", "", rate)
            for setting in SETTINGS:
                for target in PLAN.inject:
                    fly(platform, slower, seed, setting, target, rate)
    return found


@pytest.fixture(scope="module")
def flown():
    return flights()


@pytest.fixture(scope="module")
def told(flown):
    return comparison(PLAN, flown)


def succeeded(each):
    return each["outcome"] == "success"


def counted(flown, platform, setting):
    return {
        (f["seed"], f["target"]): f
        for f in flown
        if (f["platform"], f["setting"]) == (platform, setting) and f["counted"]
    }


def costs(flown, platform, setting, protected=None):
    """Of each mission the costs of its faults: over the golden flight of the platform, x.

    With `protected`, only of the faults that count in the flights with this detector.
    """
    own = {seed: f for (seed, _), f in counted(flown, platform, "golden").items() if succeeded(f)}
    faults = counted(flown, platform, protected or setting)
    return {
        (seed, target): f["flight_time_s"] / own[seed]["flight_time_s"]
        for f in flown
        for seed, target in [(f["seed"], f["target"])]
        if (f["platform"], f["setting"]) == (platform, setting) and (seed, target) in faults
        if succeeded(f) and seed in own
    }


def rows(told, table):
    assert getattr(told, table)
    return getattr(told, table)


def by_mission(values):
    """Lists of values, one a mission."""
    seeds = sorted({seed for seed, _ in values})
    return [[v for (seed, _), v in values.items() if seed == s] for s in seeds]


def assert_interval(told, missions, statistic):
    """SciPy's BCa interval of whole missions, drawn with all that they hold."""

    def of(drawn):
        return statistic(np.concatenate([missions[int(n)] for n in drawn]))

    found = stats.bootstrap(
        (np.arange(len(missions)),), of, n_resamples=1999, vectorized=False, method="BCa", rng=3
    ).confidence_interval
    width = found.high - found.low
    assert told.low == pytest.approx(found.low, abs=ALIKE * width)
    assert told.high == pytest.approx(found.high, abs=ALIKE * width)


def test_settings(flown, told):
    for row in rows(told, "settings"):
        mine = counted(flown, row.platform, row.setting).values()
        won = [f["flight_time_s"] for f in mine if succeeded(f)]
        wilson = stats.binomtest(len(won), len(mine)).proportion_ci(method="wilson")
        assert (row.success.count, row.success.total) == (len(won), len(mine))
        assert row.success.low == pytest.approx(wilson.low)
        assert row.success.high == pytest.approx(wilson.high)
        time = row.quantities["flight_time_s"]
        assert time.median.value == pytest.approx(np.percentile(won, 50.0))
        assert_interval(time.mean, [[value] for value in won], np.mean)
        response = [f["response_median_s"] for f in mine]
        assert row.quantities["response_median_s"].mean.value == pytest.approx(np.mean(response))


def test_ratios(flown, told):
    for row in rows(told, "ratios"):
        first, second = (counted(flown, p, row.setting) for p in ("x86", "tx2"))
        pairs = [(first[key], second[key]) for key in first.keys() & second.keys()]
        assert row.pairs == len(pairs)
        differ = [(succeeded(a), succeeded(b)) for a, b in pairs if succeeded(a) != succeeded(b)]
        only_second = sum(b for _, b in differ)
        assert row.success.difference == pytest.approx((2 * only_second - len(differ)) / len(pairs))
        chance = stats.binomtest(only_second, len(differ)).pvalue if differ else 1.0
        assert row.success.p_value == pytest.approx(chance)
        both = {
            (a["seed"], a["target"]): math.log(b["flight_time_s"] / a["flight_time_s"])
            for a, b in pairs
            if succeeded(a) and succeeded(b)
        }
        means = [np.mean(values) for values in by_mission(both)]
        time = row.quantities["flight_time_s"]
        assert time.value == pytest.approx(stats.gmean(np.exp(means)))
        logs = Namespace(low=math.log(time.low), high=math.log(time.high))
        assert_interval(logs, [[value] for value in means], np.mean)


def test_costs(flown, told):
    for row in rows(told, "costs"):
        mine = costs(flown, row.platform, row.setting)
        over = list(mine.values())
        assert (row.pairs, row.cost_s.mean.count) == (
            len(over), len({seed for seed, _ in mine})
        )  # fmt: skip
        assert row.over_own.largest == pytest.approx(max(over))
        assert row.over_own.p95.value == pytest.approx(np.percentile(over, 95.0))
        assert_interval(row.over_own.p95, by_mission(mine), lambda v: np.percentile(v, 95.0))
        bare = max(costs(flown, row.platform, "none", row.setting).values())
        if row.setting != "none":
            assert row.over_own.recovered_share == pytest.approx(
                1.0 - (max(over) - 1.0) / (bare - 1.0)
            )


def test_faults_on_two_platforms(flown, told):
    for row in rows(told, "cost_differences"):
        here, there = (costs(flown, platform, row.setting) for platform in ("x86", "tx2"))
        shared = here.keys() & there.keys()
        assert row.pairs == len(shared)
        own = {
            (f["platform"], f["seed"]): f["flight_time_s"]
            for f in flown
            if f["setting"] == "golden"
        }
        extra = {
            key: (there[key] - 1.0) * own["tx2", key[0]] - (here[key] - 1.0) * own["x86", key[0]]
            for key in shared
        }
        assert row.extra_s.value == pytest.approx(np.mean(list(extra.values())))
        assert_interval(row.extra_s, by_mission(extra), np.mean)
        sums = np.array([np.sum(values) for values in by_mission(extra)])
        flips = np.abs(np.random.default_rng(4).choice([-1.0, 1.0], (20_000, len(sums))) @ sums)
        chance = np.mean(flips >= abs(sums.sum()) * (1.0 - 1e-9))
        assert row.p_value == pytest.approx(chance, abs=0.02)
        late = [np.percentile([of[key] for key in shared], 95.0) for of in (here, there)]
        assert row.p95_ratio.value == pytest.approx(late[1] / late[0])
        assert row.largest_ratio == pytest.approx(max(there.values()) / max(here.values()))


def test_the_longest_flights(flown, told):
    for row in rows(told, "worst"):
        golden, mine = (
            [f["flight_time_s"] for f in counted(flown, row.platform, setting).values()
             if succeeded(f)]
            for setting in ("golden", row.setting)
        )  # fmt: skip
        assert row.worst_s == max(mine)
        assert row.over_mean_ratio == pytest.approx(max(mine) / np.mean(golden))
