"""The claims: each has its words, numbers and range, and decides what it says."""

import re
import tomllib
from pathlib import Path

import pytest
from flown import flights, row

from mavfi_cli.analysis.flights import COSTS
from mavfi_cli.analysis.pairs import WORLDS
from mavfi_cli.paper import claims, items
from mavfi_cli.paper.claims import CLAIMS
from mavfi_cli.paper.items import BY_NAME, printed
from mavfi_cli.stats.paired import ClaimVerdict
from mavfi_cli.stats.shares import wilson

BY_CLAIM = {claim.name: claim for claim in CLAIMS}


def verdict(name, those):
    claim = BY_CLAIM[name]
    return ClaimVerdict.of(claim.find(those).effect, claim.low, claim.high)


def test_names_are_unique_and_of_the_papers_items():
    assert len(BY_CLAIM) == len(CLAIMS) > 35
    assert {claim.item for claim in CLAIMS} < BY_NAME.keys()


@pytest.mark.parametrize("claim", CLAIMS, ids=lambda claim: claim.name)
def test_a_claim_is_a_sentence_with_a_range_inside_which_something_lies(claim):
    assert re.fullmatch(r"[A-Z].*\.", claim.words) or claim.words.startswith("future_")
    assert claim.effect
    assert claim.paper_tells
    assert claim.low < claim.high


@pytest.mark.parametrize("claim", CLAIMS, ids=lambda claim: claim.name)
def test_nothing_flown_is_no_verdict(claim):
    found = claim.find({} if claim.isolated else flights([]))
    assert ClaimVerdict.of(found.effect, claim.low, claim.high) is ClaimVerdict.NOT_FLOWN


def test_the_papers_numbers_stand_in_their_claims():
    assert BY_CLAIM["table4-dense"].paper == "85 % to 75.3 %: 9.7 points"
    assert "p = 0.0012" in BY_CLAIM["table4-factory"].paper_tells
    assert "p = 0.052" in BY_CLAIM["table4-dense"].paper_tells
    assert BY_CLAIM["table3-1"].paper_tells.endswith("Fisher's p = 0.0068")
    assert BY_CLAIM["table3-5"].paper_tells.endswith("Fisher's p = 0.63")
    assert BY_CLAIM["fig12-farm"].words.endswith("takes 74.2 % longer.")
    assert BY_CLAIM["table4-gad"].low > 0.4


NUMBERS = tomllib.loads((Path(items.__file__).parent / "paper.toml").read_text())


def flat(value):
    """All numbers inside."""
    inside = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    own = {float(value)} if isinstance(value, (int, float)) else set()
    return own.union(*map(flat, inside))


def test_the_numbers_in_the_words_of_a_claim_are_those_of_its_item():
    told = {claim: {float(x) for x in re.findall(r"\d+\.\d+", claim.words)} for claim in CLAIMS}
    assert sum(map(bool, told.values())) >= 10
    for claim, numbers in told.items():
        assert numbers - {89.6} <= flat(NUMBERS[claim.item]), claim.name  # Table IV's best world


LONGEST = [claim for claim in CLAIMS if "ratio" in claim.find.keywords]


@pytest.mark.parametrize("claim", LONGEST, ids=lambda claim: claim.name)
def test_a_longest_flight_is_as_long_as_its_words_say(claim):
    ratio = claim.find.keywords["ratio"]
    (said,) = re.findall(r"\d+\.\d+", claim.words)
    assert float(said) == pytest.approx(ratio if ratio >= 2.0 else 100.0 * (ratio - 1.0))


@pytest.mark.parametrize("world", WORLDS)
def test_the_counts_of_table_iv_are_its_printed_rates(world):
    told = tomllib.loads((Path(claims.__file__).parent / "claims.toml").read_text())["claim"]
    (counts,) = (each["paper_counts"] for each in told if each["name"] == f"table4-{world}")
    for kind, runs, found in zip(("golden", "none"), ("golden_runs", "runs"), counts, strict=True):
        missions = printed("table4", runs)
        assert found == [round(missions * printed("table4", "success_percent", kind, world) / 100),
                         missions]  # fmt: skip


def stage(name, seed, **how):
    return row(name, instruction=True, seed=seed, config={"world": "dense"}, **how)


def dense(lost, own_lost=0):
    """A golden flight and a fault in planning for 100 seeds; so many faults lose the mission."""
    rows = []
    for seed in range(1, 101):
        own = "collision" if seed <= own_lost else "success"
        rows.append(row(seed=seed, config={"world": "dense"}, outcome=own))
        rows.append(stage("planning", seed, outcome="timeout" if seed <= lost else "success"))
    return flights(rows)


@pytest.mark.parametrize(
    ("lost", "own_lost", "told"),
    [
        (10, 0, ClaimVerdict.REPRODUCED),
        (60, 0, ClaimVerdict.REPRODUCED),  # the words state a direction and no size
        (0, 0, ClaimVerdict.OPEN),
        (0, 20, ClaimVerdict.NOT_REPRODUCED),
    ],
)
def test_success_in_dense(lost, own_lost, told):
    assert verdict("table4-dense", dense(lost, own_lost)) is told
    assert verdict("table4-farm", dense(lost)) is ClaimVerdict.NOT_FLOWN


def outcome(count):
    found = wilson(count, 5000)
    return {"count": count, "of": 5000, "share": found.share, "wilson95": [found.low, found.high]}


def kernels(**shares):
    """Outcomes of 5,000 runs of each kernel: silent, benign."""
    return {
        name: {"title": name, "outcomes": {"sdc": outcome(silent), "benign": outcome(benign)}}
        for name, (silent, benign) in shares.items()
    }


def test_the_interval_of_a_kernel_is_that_of_its_summary():
    told = kernels(octomap=(2000, 500), rrt=(1900, 2000))
    assert verdict("fig6-octomap", told) is ClaimVerdict.REPRODUCED
    told["octomap"]["outcomes"]["sdc"]["wilson95"] = [0.3, 0.5]  # few inputs tell less
    assert verdict("fig6-octomap", told) is ClaimVerdict.OPEN


def test_isolated_kernels():
    told = kernels(octomap=(2000, 500), rrtstar=(20, 2000), rrt=(100, 2000), control=(900, 1300))
    assert verdict("fig6-octomap", told) is ClaimVerdict.REPRODUCED
    assert verdict("fig6-rrtstar", told) is ClaimVerdict.REPRODUCED
    assert verdict("fig6-benign", told) is ClaimVerdict.OPEN  # 26 % of 5,000
    other = kernels(octomap=(200, 500), point_cloud=(900, 3000))
    assert verdict("fig6-octomap", other) is ClaimVerdict.NOT_REPRODUCED


def test_states_and_fields():
    rows = []
    for seed in range(1, 41):
        rows.append(row(seed=seed))
        for field, time_s in (("sign", 30.0), ("exponent", 20.0), ("mantissa", 20.0)):
            fault = {"field": field, "together": True}
            rows.append(row("waypoint_position", seed=seed, fault=fault, time_s=time_s))
    assert verdict("fig9-fields", flights(rows)) is ClaimVerdict.REPRODUCED
    assert verdict("fig8-position", flights(rows)) is ClaimVerdict.NOT_FLOWN  # any field, not these


def test_the_cost_of_detectors():
    rows = []
    for seed in range(1, 31):
        for name, share in (("gad", 0.02), ("aad", 0.0001)):
            costs = dict.fromkeys(COSTS, 0.0) | {"check_share": share}
            rows.append(stage("planning", seed, detector=name, **costs))
    those = flights(rows)
    assert verdict("table5-gad", those) is ClaimVerdict.REPRODUCED  # 2 %, at most 2.2 %
    assert verdict("table5-aad", those) is ClaimVerdict.NOT_REPRODUCED  # 0.01 %, at most 0.0062 %
    assert verdict("table5-gad-over-aad", those) is ClaimVerdict.REPRODUCED


def test_the_costs_of_one_detector_compare_nothing():
    shares = dict.fromkeys(COSTS, 0.01)
    found = BY_CLAIM["table5-gad-over-aad"].find(
        flights([stage("planning", 1, detector="gad", **shares)])
    )
    assert (found.effect, found.told) == (None, "")
