"""The claims: each has its words, numbers and range, and can come out either way."""

import math
import re
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from made_flights import flights, row

from mavfi_cli.analysis.flights import COSTS
from mavfi_cli.analysis.kernels import IsolatedKernel
from mavfi_cli.analysis.pairs import WORLDS, Fate, Flights
from mavfi_cli.paper import claims, items
from mavfi_cli.paper.claims import CLAIMS, ISOLATED, judged
from mavfi_cli.paper.items import BY_NAME, printed
from mavfi_cli.paper.verdicts import Finding, Verdict, judge
from mavfi_cli.stats.paired import paired_difference
from mavfi_cli.stats.shares import wilson

BY_CLAIM = {claim.name: claim for claim in CLAIMS}
TOLD = {
    each["name"]: each
    for each in tomllib.loads((Path(claims.__file__).parent / "claims.toml").read_text())["claim"]
}
NUMBERS = tomllib.loads((Path(items.__file__).parent / "paper.toml").read_text())
NOTHING = Flights.pooled([])


def alone(name, those, kernels=None):
    """The judgement of one claim that is its whole family."""
    claim = BY_CLAIM[name]
    (judgement,) = judge([claim.find(those, kernels or {})], [(claim.low, claim.high)])
    return judgement


def verdict(name, those, kernels=None):
    return alone(name, those, kernels).verdict


def test_names_are_unique_and_of_the_papers_parts():
    assert len(BY_CLAIM) == len(CLAIMS) > 60
    assert {claim.item for claim in CLAIMS} <= BY_NAME.keys() | {"section6"}


@pytest.mark.parametrize("claim", CLAIMS, ids=lambda claim: claim.name)
def test_a_claim_is_a_sentence_with_a_range_that_its_own_entry_gives(claim):
    assert re.fullmatch(r"[A-Z].*\.", claim.words) or claim.words.startswith("future_")
    assert claim.effect
    assert claim.paper_tells
    rules = {"size", "more", "less", "alike", "low", "high"} & TOLD[claim.name].keys()
    if claim.effect.startswith("none: "):
        assert not rules
        assert "why" in TOLD[claim.name]["given"]
    else:
        assert rules
        assert claim.low < claim.high
        assert math.isfinite(claim.low) or math.isfinite(claim.high)


@pytest.mark.parametrize("claim", CLAIMS, ids=lambda claim: claim.name)
def test_nothing_flown_is_no_verdict_and_says_so(claim):
    found = claim.find(NOTHING, {})
    assert found.effect is None
    assert found.why
    assert "0 of 0" not in found.why + found.counts


def test_a_premise_is_of_the_same_part():
    assert all(BY_CLAIM[c.premise].item == c.item for c in CLAIMS if c.premise)


def test_the_papers_numbers_stand_in_their_claims():
    assert BY_CLAIM["table4-dense"].paper == "85 % to 75.3 %: 9.7 points"
    assert "p = 0.0012" in BY_CLAIM["table4-factory"].paper_tells
    assert "p = 0.052" in BY_CLAIM["table4-dense"].paper_tells
    assert BY_CLAIM["table3-1"].paper_tells.endswith("Fisher's p = 0.0068")
    assert BY_CLAIM["table3-5"].paper_tells.endswith("Fisher's p = 0.63")


def flat(value):
    """All numbers inside."""
    inside = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    own = {float(value)} if isinstance(value, (int, float)) else set()
    return own.union(*map(flat, inside))


def differences(of):
    """The printed numbers, and what Tables III and IV have between two of their rows."""
    numbers = flat(NUMBERS.get(of, {}))
    if of == "table4":
        rates = NUMBERS["table4"]["success_percent"]
        numbers |= {round(rates["golden"][w] - rates["none"][w], 1) for w in WORLDS}
    if of == "table3":
        table = NUMBERS["table3"]
        numbers |= {round(100 * (table[n]["1"] / table[n]["0"] - 1), 1)
                    for n in ("flight_time_s", "energy_kj")}  # fmt: skip
        numbers.add(round(table["replans"]["1"] - table["replans"]["0"], 2))
    return numbers


ELSEWHERE = {89.6, 1.91}  # Table IV's best world; the abstract
ROUNDED = {2.0, 1.06, 0.94, 0.0001}  # Table V: the mean of its columns


def test_the_numbers_in_the_words_of_a_claim_are_those_of_its_item():
    numbers = {claim: {float(x) for x in re.findall(r"\d+\.\d+", claim.words)} for claim in CLAIMS}
    assert sum(map(bool, numbers.values())) >= 20
    for claim, mine in numbers.items():
        assert mine - ELSEWHERE - ROUNDED <= differences(claim.item), claim.name


@pytest.mark.parametrize("world", WORLDS)
def test_the_counts_of_table_iv_are_its_printed_rates(world):
    counts = TOLD[f"table4-{world}"]["paper_counts"]
    for kind, runs, found in zip(("golden", "none"), ("golden_runs", "runs"), counts, strict=True):
        missions = printed("table4", runs)
        assert found == [round(missions * printed("table4", "success_percent", kind, world) / 100),
                         missions]  # fmt: skip


# Either way ---------------------------------------------------------------------------------------


def possible(claim):
    """The verdicts that a hundred numbers of hits give at the paper's n.

    The others of the claim's item come out alike, so Holm's factor is that of the whole family.
    """
    told = TOLD[claim.name]
    n = told.get("more") or told.get("less") or told.get("alike")
    if n is None:
        n = told["paper_counts"][-1][1] if "paper_counts" in told else 300
    found = []
    for hits in range(0, n + 1, -(-n // 100)):
        share = wilson(hits, n).effect
        found += [Finding(effect=share), Finding(effect=wilson(0, n).minus(wilson(hits, n)))]
        if claim.unit == "points":
            lost = [True] * hits + [False] * (n - hits)
            found.append(Finding(effect=paired_difference([False] * n, lost, range(n))))
    family = sum(other.item == claim.item and other.rule != "none" for other in CLAIMS)
    ends = [(claim.low, claim.high)] * family
    return {judge([each] * family, ends)[0].verdict for each in found}


SHARES = [
    claim
    for claim in CLAIMS
    if claim.unit in ("points", "percent")
    and claim.rule != "none"
    and not claim.name.startswith(("fig11", "table5"))
]


@pytest.mark.parametrize("claim", SHARES, ids=lambda claim: claim.name)
def test_a_rule_can_come_out_either_way_at_the_papers_n(claim):
    assert {Verdict.REPRODUCED, Verdict.CONTRADICTED} <= possible(claim)


# On flights ---------------------------------------------------------------------------------------


def stage(name, seed, **how):
    return row(name, instruction=True, seed=seed, config={"world": "dense"}, **how)


def dense(lost, own_lost=0, node_ended=None):
    """A golden flight and a fault in planning for 300 seeds; so many faults lose the mission."""
    rows = []
    for seed in range(1, 301):
        own = "collision" if seed <= own_lost else "success"
        rows.append(row(seed=seed, config={"world": "dense"}, outcome=own))
        hit = seed <= lost
        ended = {"node_ended": node_ended} if hit else {"node_ended": None}
        rows.append(stage("planning", seed, outcome="timeout" if hit else "success", **ended))
    return flights(rows)


@pytest.mark.parametrize(
    ("lost", "own_lost", "expected"),
    [
        (29, 0, Verdict.REPRODUCED),
        (150, 0, Verdict.CONTRADICTED),  # far more than the paper
        (0, 0, Verdict.CONTRADICTED),
        (0, 60, Verdict.CONTRADICTED),
        (9, 0, Verdict.UNDECIDED),
    ],
)
def test_success_in_dense(lost, own_lost, expected):
    assert verdict("table4-dense", dense(lost, own_lost)) is expected
    assert verdict("table4-farm", dense(lost)) is Verdict.NOT_DECIDABLE


def test_silent_faults_and_dead_nodes_are_judged_apart():
    by_name = {
        each.claim.name: each
        for each in judged({"mavbench": dense(40, node_ended="killed by SIGSEGV")}, {})
    }
    cells = by_name["table4-dense"].judgements["mavbench"]
    assert cells[Fate.ALL].counts == "40 of 300 lost; golden 0 of 300"
    assert cells[Fate.SILENT].counts == "0 of 260 lost; golden 0 of 260"
    assert cells[Fate.DEAD].counts == "40 of 40 lost; golden 0 of 40"
    assert cells[Fate.SILENT].verdict is Verdict.CONTRADICTED
    farm = by_name["table4-farm"].judgements["mavbench"]
    assert {each.why for each in farm.values()} == {"not flown"}
    assert set(by_name["table4-golden-dense"].judgements["mavbench"]) == {Fate.ALL}
    calm = {each.claim.name: each for each in judged({"mavbench": dense(0)}, {})}
    dead = calm["table4-dense"].judgements["mavbench"][Fate.DEAD]
    assert "none of the faults" in dead.why


def kernels(**shares):
    """Outcomes of 5,000 runs of each kernel: silent, benign."""
    return {
        name: IsolatedKernel(
            name=name,
            title=name,
            runs=5000,
            outcomes={"sdc": wilson(silent, 5000), "benign": wilson(benign, 5000)},
        )
        for name, (silent, benign) in shares.items()
    }


def test_isolated_kernels():
    told = kernels(octomap=(2000, 500), rrtstar=(20, 2000), rrt=(100, 2000), control=(900, 1300))
    found = {each.claim.name: each.verdict(ISOLATED) for each in judged({}, told)}
    assert found["fig6-octomap"] is Verdict.REPRODUCED
    assert found["fig6-octomap-benign"] is Verdict.REPRODUCED
    assert found["fig6-rrtstar"] is Verdict.REPRODUCED
    assert found["fig6-benign"] is Verdict.UNDECIDED  # 26 % of 5,000
    assert found["fig6-pid"] is Verdict.REPRODUCED
    assert found["fig6-rrtconnect"] is Verdict.NOT_DECIDABLE  # not run
    assert found["table4-dense"] is None
    octomap = told["octomap"].outcomes
    octomap["sdc"] = replace(octomap["sdc"], low=0.1, high=0.7)  # few inputs tell less
    assert verdict("fig6-octomap", NOTHING, told) is Verdict.UNDECIDED


def test_a_ranking_needs_kernels_and_flights():
    ranked = kernels(**{name: (100 * k, 2000) for k, name in enumerate("abcde", 1)})

    def flown(order):
        rows = []
        for seed in range(1, 61):
            rows.append(row(seed=seed))
            for place, name in enumerate(order):
                lost = seed <= 10 * place
                rows.append(row("planning", instruction=True, seed=seed, struck_kernel=name,
                                outcome="timeout" if lost else "success"))  # fmt: skip
        return flights(rows)

    same, opposite = (alone("fig7-ranking", flown(x), ranked) for x in ("abcde", "edcba"))
    assert same.effect.value == pytest.approx(1.0)
    assert same.verdict is Verdict.CONTRADICTED
    assert opposite.effect.value == pytest.approx(-1.0)
    assert opposite.verdict is Verdict.REPRODUCED
    assert "same harm" in alone("fig7-ranking", flown("abcde").chosen(lost=False), ranked).why


def test_the_range_of_deltas_is_read_from_run_folders(tmp_path):
    rows = []
    for seed in range(1, 31):
        folder = tmp_path / str(seed)
        folder.mkdir()
        x = np.append(np.linspace(0.0, 50.0, 500), 50.0 + 0.01 * seed)
        pq.write_table(pa.table({"waypoint_x": x}), folder / "trace.parquet")
        rows.append(row(seed=seed, path=str(folder)))
    found = alone("fig11-x", flights(rows))
    assert found.effect.value == pytest.approx(1.0 - 0.1 / 50.0, abs=2e-3)
    assert found.verdict is Verdict.REPRODUCED
    gone = flights([row(seed=1, path=str(tmp_path / "gone"))])
    assert "run folders" in alone("fig11-x", gone).why


def test_states_and_fields():
    rows = []
    for seed in range(1, 101):
        rows.append(row(seed=seed))
        for field, time_s in (("sign", 30.0), ("exponent", 20.0), ("mantissa", 20.0)):
            fault = {"field": field, "together": True}
            rows.append(row("waypoint_position", seed=seed, fault=fault, time_s=time_s))
    assert verdict("fig9-fields", flights(rows)) is Verdict.REPRODUCED
    assert verdict("fig8-position", flights(rows)) is Verdict.NOT_DECIDABLE  # any field, not these


def test_five_bits_beside_one_that_costs_nothing_tell_nothing():
    rows = []
    for seed in range(1, 301):
        rows.append(row(seed=seed))
        for bits in (1, 5):
            fault = {"bits": bits, "together": True, "field": "any"}
            rows.append(row("waypoint_acceleration", seed=seed, fault=fault))
    found = {each.claim.name: each for each in judged({"mavbench": flights(rows)}, {})}
    assert found["table3-1"].verdict("mavbench") is Verdict.CONTRADICTED
    judgement = found["table3-5"].judgements["mavbench"][Fate.ALL]
    assert judgement.verdict is Verdict.NOT_DECIDABLE
    assert judgement.why.endswith("table3-1 is contradicted")


def test_what_a_detector_causes_stands_against_what_it_saves():
    rows = []
    for seed in range(1, 401):
        rows.append(row(seed=seed, config={"world": "dense"}))
        rows.append(stage("planning", seed, outcome="timeout" if seed <= 80 else "success"))
        lost = 10 < seed <= 90  # saves ten, loses ten others
        rows.append(stage("planning", seed, detector="gad",
                          outcome="timeout" if lost else "success"))  # fmt: skip
    found = alone("table4-gad", flights(rows))
    assert found.counts == "of 80 lost, 10 undone; 10 newly caused"
    assert found.effect.value == 0.0
    assert found.verdict is Verdict.CONTRADICTED
    balance = flights(rows).balance("gad")
    assert (balance.pairs, balance.before, balance.undone, balance.caused) == (400, 80, 10, 10)
    assert balance.p_value == 1.0


def test_the_cost_of_detectors():
    rows = []
    for seed in range(1, 31):
        for name, share in (("gad", 0.02), ("aad", 0.0001)):
            costs = dict.fromkeys(COSTS, 0.0) | {"recovery_share_planning": share + 1e-5 * seed}
            rows.append(stage("planning", seed, detector=name, **costs))
    those = flights(rows)
    assert verdict("table5-gad", those) is Verdict.REPRODUCED
    assert verdict("table5-perception", those) is Verdict.CONTRADICTED
    assert verdict("table5-planning", those) is Verdict.REPRODUCED
    assert verdict("table5-aad-recovery", those) is Verdict.CONTRADICTED
    assert verdict("table5-gad-over-aad", those) is Verdict.REPRODUCED
    without = flights([stage("planning", 1, detector="gad")])
    assert "does not hold these times" in alone("table5-gad", without).why


def test_the_costs_of_one_detector_compare_nothing():
    shares = dict.fromkeys(COSTS, 0.01)
    those = flights([stage("planning", 1, detector="gad", **shares)])
    assert alone("table5-gad-over-aad", those).effect is None
