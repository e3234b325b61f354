"""The report as plain values: its sentences, its tables, its commands."""

import re
from pathlib import Path

import pytest
from made_flights import export_table, flights, row

from mavfi_cli.analysis.flights import COSTS
from mavfi_cli.analysis.pairs import Fate, Flights
from mavfi_cli.paper.answers import (
    REASONS,
    Delays,
    delay_sentence,
    disagreements,
    protections,
    reason_of,
)
from mavfi_cli.paper.beyond import Arm
from mavfi_cli.paper.claims import CLAIMS, judged
from mavfi_cli.paper.document import document
from mavfi_cli.paper.sources import CampaignSource, Evidence
from mavfi_cli.paper.verdicts import ISOLATED, JudgedClaim, Judgement, Verdict
from mavfi_cli.stats.shares import Interval

pytestmark = pytest.mark.slow  # each page draws its pictures

LOST = {"outcome": "timeout"}


def evidence(rows, name="mine", problems=(), folder=None):
    path = folder or Path(f"{name}.parquet")
    flights = Flights.of(export_table(rows))
    source = CampaignSource(path=path, name=name, spec=None, planned=None, flights=flights)
    return Evidence(campaigns=[source], kernels=[], problems=problems)


@pytest.fixture(scope="module")
def told():
    """Ten missions in `dense`: two lost by a node's crash, one saved by the autoencoder."""
    rows = []
    for seed in range(1, 11):
        where = {"config": {"world": "dense"}, "seed": seed, "instruction": True}
        lost = {"outcome": "timeout", "node_ended": "killed by SIGSEGV"} if seed < 3 else {}
        rows.append(row(config={"world": "dense"}, seed=seed))
        rows.append(row("planning", **where, **lost, time_s=20.0 + seed / 10))
        saved = {} if seed != 2 else {"outcome": "collision"}
        rows.append(row("planning", **where, detector="aad", **saved))
    return document(evidence(rows, problems=["something is missing."]), 2.0)


def effect_of(claim, stack="mavbench"):
    """The effect of all faults; None without one."""
    by_fate = claim.judgements.get(stack, {})
    return by_fate[Fate.ALL].effect if by_fate else None


def test_the_answer_counts_what_is_judged(told):
    assert re.findall(r"\d+", told.extent) == ["30", "4", "69"]
    names = {each.claim.name for each in told.claims if effect_of(each)}
    assert names == {"table4-golden-dense", "table4-dense", "fig12-dense", "fig13-planning"}
    assert "4 claims" in told.answer
    assert told.answer.startswith("Not known yet: ")  # 4 of 69 are too few for an answer
    assert sum(map(int, re.findall(r"(\d+) (?:is|are)", told.answer))) == 4
    counts = told.verdicts()["mavbench"]
    assert sum(counts.values()) - counts["not decidable"] == 4


def test_lost_missions_are_told_to_follow_dead_nodes(told):
    assert "2 of 2 missions" in told.crashes


def test_a_mission_that_is_lost_without_a_fault_is_not_lost_by_it():
    rows = [row(seed=1, outcome="collision")]
    rows.append(row("planning", seed=1, instruction=True, outcome="collision"))
    assert document(evidence(rows)).crashes == ""


def test_missions_unlike_the_papers_judge_no_claim():
    """A fault at a chosen moment tells nothing of an hour, but where a bit hurts."""
    where = {"struck_state": "waypoint_x", "struck_bits": [[62]]}
    first = {"seed": 1, "fault": {"at": "invocation=1"}, "outcome": "timeout", **where}
    rows = [row(seed=1), row("planning", seed=1), row("waypoint_x", **first)]
    told = document(evidence(rows))
    assert re.findall(r"\d+", told.extent) == ["2", "1", "69"]
    assert [each.where for each in told.hourly["mavbench"]] == ["state: planning, sparse"]
    assert told.map_csv.splitlines()[1].endswith(",1,1,1")


def test_the_picture_of_faults_in_states_has_the_flights_of_its_data():
    rows = [row(seed=1), row("planning", seed=1)]
    rows += [row("planning", seed=1, detector=name) for name in ("aad", "range")]
    (spread,) = document(evidence(rows)).spreads
    assert {line.split(",")[1] for line in spread.csv.splitlines()[1:]} == {"", "aad"}


def test_what_a_detector_undoes_and_causes_stands_by_level_and_by_fate(told):
    rows = {row.fate: row for row in told.balances}
    assert {(row.level, row.computer, row.detector) for row in rows.values()} == {
        ("instruction", "x86", "aad")
    }
    assert {fate: (row.lost.before, row.lost.undone) for fate, row in rows.items()} == {
        Fate.ALL: (2, 1), Fate.SILENT: (0, 0), Fate.DEAD: (2, 1),
    }  # fmt: skip
    assert [row.lost.caused for row in rows.values()] == [0, 0, 0]


def test_added_time_is_that_of_the_same_faults():
    rows = [row(seed=seed) for seed in (1, 2, 3)]
    for seed, time_s in ((1, 20.0), (2, 23.0), (3, 20.5)):
        lost = {"outcome": "timeout"} if seed == 3 else {}
        rows.append(row("planning", seed=seed, time_s=time_s, **lost))
    rows += [row("planning", seed=seed, detector="gad", time_s=22.0) for seed in (1, 2)]
    (delay,) = Delays.of("mavbench", flights(rows))
    assert [*delay.added_s[None]] == [0.0, pytest.approx(3.0)]  # seed 3 has no flight with GAD
    assert [*delay.added_s["gad"]] == [pytest.approx(2.0)] * 2
    assert delay.golden_s == pytest.approx(20.0)
    # Faults; the limit; lost or late without a detector, and with GAD.
    assert re.findall(r"\d", delay_sentence([delay])) == ["2", "1", "1", "2"]


def test_a_lost_mission_is_longer_than_any():
    (delay,) = Delays.of("mavbench", flights([row(seed=1), row("planning", seed=1, **LOST)]))
    assert [*delay.added_s[None]] == [float("inf")]


@pytest.mark.parametrize(
    ("lost", "saved", "effect"),
    [(8, True, "helps"), (3, True, "no proven effect"), (8, False, "harms"),
     (0, True, "nothing to undo")],
)  # fmt: skip
def test_a_protection_helps_or_harms_beyond_chance(lost, saved, effect):
    rows = [row(seed=seed) for seed in range(1, 11)]
    for seed in range(1, 11):
        end = LOST if seed <= lost else {}
        rows.append(row("planning", seed=seed, **(end if saved else {})))
        rows.append(row("planning", seed=seed, detector="gad", **({} if saved else end)))
    (gad,) = protections({"mavbench": flights(rows)})
    cell = gad.against["a wrong value in a state"]
    undone, caused = (lost, 0) if saved else (0, lost)
    before = lost if saved else 0
    assert cell.effect == effect
    if lost:
        counts = f"{undone} of {before} undone, {caused} caused"
        assert cell.counts.startswith(f"harmed: {counts}; lost: {counts}; 10 pairs, p ")
    else:
        assert cell.counts == "no harm in 10 pairs"
    assert gad.against["a fault in an instruction, silent"] is None


def test_another_stack_is_compared_in_the_same_scenes():
    one, two = [], []
    for seed in range(1, 21):
        for stack, rows in (("mavbench", one), ("hardened", two)):
            if stack == "mavbench" or seed > 10:
                config = {"stack": stack}
                end = LOST if stack == "mavbench" else {}
                rows += [row(seed=seed, config=config),
                         row("planning", seed=seed, config=config, **end)]  # fmt: skip
    (other,) = protections({"mavbench": flights(one), "hardened": flights(two)})
    cell = other.against["a wrong value in a state"]
    assert (cell.effect, cell.counts) == ("helps", "harmful 0 of 10 instead of 10 of 10")


def test_a_stack_in_both_kinds_of_worlds_is_judged_for_each_kind():
    rows = []
    for seed in range(1, 21):
        for config, lost in ({"world_seed": 3}, LOST), ({}, {}):
            rows.append(row(seed=seed, config=config))
            rows.append(row("planning", seed=seed, config=config, instruction=True, **lost))
        config = {"stack": "hardened"}
        rows += [row(seed=seed, config=config),
                 row("planning", seed=seed, config=config, instruction=True)]  # fmt: skip
    told = document(evidence(rows))
    fixed, many, hardened = told.places
    assert told.place == "mavbench, fixed worlds"
    assert (fixed, many) == (told.place, "mavbench, another world for each seed")
    claim = next(each for each in told.claims if each.claim.name == "table4-sparse")
    found = {place: effect_of(claim, place).value for place in (fixed, many, hardened)}
    assert found == {fixed: 1.0, many: 0.0, hardened: 0.0}
    assert {*told.verdicts()} == {fixed, many, hardened, ISOLATED}
    assert told.populations[fixed].startswith("worlds: fixed (sparse 3)")
    item = next(each for each in told.items if each.item.name == "fig7")
    assert item.missing[fixed] == "mavfi reproduce fig7 --stack mavbench"
    assert item.missing[many] == "mavfi reproduce fig7 --stack mavbench --worlds many"
    # Of both kinds, only the flights in the same worlds are compared with those of another stack.
    (other,) = (each for each in told.protections if "instead of" in each.name)
    assert other.name == f"hardened instead of {many}"
    cell = other.against["a fault in an instruction, silent"]
    assert (cell.effect, cell.counts) == (
        "nothing to undo",
        "harmful 0 of 20 instead of 0 of 20",
    )


@pytest.mark.parametrize(
    ("lost", "advice"),
    [(8, "wrong value in a state.*Gaussian detector helps"),
     (2, "wrong value in a state.* nothing "), (0, "^$")],
)  # fmt: skip
def test_the_advice_names_what_helps(lost, advice):
    rows = [row(seed=seed) for seed in range(1, 11)]
    for seed in range(1, 11):
        rows.append(row("planning", seed=seed, **(LOST if seed <= lost else {})))
        rows.append(row("planning", seed=seed, detector="gad"))
    assert re.search(advice, document(evidence(rows)).advice)


DEAD = {"instruction": True, "node_ended": "killed by SIGSEGV"}


def test_arms_help_by_the_same_faults_on_any_stack():
    """Of these the detectors see none, and the golden flights are those without a protection."""
    base, rows = {"stack": "mavbench-replica"}, []
    for seed in range(1, 11):
        lost = LOST if seed < 9 else {}
        rows += [
            row(seed=seed, config=base),
            row("planning", seed=seed, config=base, **DEAD, **lost),
        ]
        rows += [row("process.planner", seed=seed, config=base, **lost)]
        for settings in ("restores_counters=true", 'standby=["planner"]'):
            mine = {"seed": seed, "config": {"stack": f"mavbench-replica:{settings}"}}
            rows += [row("planning", **mine, **DEAD)]
            rows += [row("process.planner", **mine, **lost)]
    told = document(evidence(rows))
    assert told.advice == (
        "Against a fault in an instruction that ends its node, hot standby and supervisor help "
        "(mavbench-replica). Against a killed process, nothing flown here is proven to help."
    )
    assert [guard.name for guard in told.protections] == ["hot standby", "supervisor"]
    dead, killed = (told.protections[0].against[kind] for kind in told.kinds)
    assert (dead.effect, killed.effect) == ("helps", "no proven effect")
    assert dead.counts == "harmed: 8 of 8 undone, 0 caused; lost: 8 of 8 undone, 0 caused; " + (
        "10 pairs, p = 0.0078"
    )
    assert {*told.arms} == {"mine on mavbench-replica"}


def test_the_page_agrees_with_the_rule_of_the_protections():
    """docs/results/paper.md: 17 of 92 faults lose the mission, and each protection saves all 17."""
    results = Path(__file__).parents[2] / "docs" / "results"
    names = ("table4-part1", "table4-part2", "protected-part1")
    found = Evidence.gather([results / f"replica-{name}.parquet" for name in names])
    mine = Arm.by_base(found.flights())["mavbench-replica"]
    arms = {*mine["detector"]} - {None, "GAD", "AAD", "a process for each node"}
    assert len(arms) == 4
    for arm in arms:
        lost = mine.balance(arm, column="lost", bare_harmed=(True, False))
        assert (lost.pairs, lost.before, lost.undone, lost.caused) == (92, 17, 17, 0)
    assert {*mine.protected("supervisor")["seed"]} == {*range(1, 32)}
    assert {*mine.protected("supervisor")["world"]} == {"factory", "sparse", "dense"}


def test_a_campaign_with_several_rules_has_arms_under_each():
    """The rules of a factorial are not pooled."""
    rows = [row(seed=1)]
    for stack in ("mavbench", "mavbench:guards_tracking=true", "mavbench:smoother=release"):
        rows += [row("planning", seed=1, config={"stack": stack, **rule}, fault=fault, **DEAD)
                 for rule in ({}, {"node_restart_s": 3600.0})
                 for fault in ({}, {"compat": "rosfi-2021"})]  # fmt: skip
    found = document(evidence(rows)).arms
    assert len(found) == 4
    assert {tuple((arm.name, arm.lost.total) for arm in mine) for mine in found.values()} == {
        (("unprotected", 1), ("tracking guard", 1))
    }
    assert "mine, rosfi-2021, dead nodes never back" in found


def test_nothing_judged_is_said():
    found = document(evidence([row(config={"world": "nowhere"})]))
    assert found.answer.startswith("Nothing ")
    assert (found.crashes, found.forest, found.delays, found.protections) == ("", None, None, [])


def test_every_claim_is_judged_on_each_stack(told):
    assert told.problems == ["something is missing."]
    for each in told.claims:
        stacks = {"isolated kernels"} if each.claim.isolated else {"mavbench", "hardened"}
        assert each.judgements.keys() == stacks
    by_name = {each.claim.name: each for each in told.claims}
    assert by_name["table4-dense"].judgements["hardened"][Fate.ALL].why == "not flown"
    assert by_name["fig15-tmr"].verdict("mavbench") is Verdict.NOT_DECIDABLE


def test_an_effect_without_an_interval_is_no_number():
    """The mean cost of one flight."""
    costs = dict.fromkeys(COSTS, 0.01)
    told = document(evidence([row("planning", instruction=True, detector="gad", **costs)]))
    (gad,) = (each for each in told.claims if each.claim.name == "table5-gad")
    assert effect_of(gad) is None
    assert gad.verdict("mavbench") is Verdict.NOT_DECIDABLE


def test_failures_an_hour_are_at_the_rate(told):
    (hourly,) = told.hourly["mavbench"]
    assert hourly.per_hour[""][0] == pytest.approx(0.4)


def test_lost_and_longest_missions_have_their_command(told):
    (mine,) = told.missions
    assert [each.number for each in mine.lost] == [1, 4, 5]
    assert mine.lost[0].command == "mavfi replay mine.parquet --mission 1"
    assert mine.longest[0].number == 28  # seed 10: 21 s
    assert mine.longest[0].ratio == pytest.approx(1.05)


def test_a_command_can_be_pasted_whatever_the_name_of_the_folder():
    (mine,) = document(evidence([row(outcome="crash")], name="my flights")).missions
    assert mine.lost[0].command == "mavfi replay 'my flights.parquet' --mission 0"


@pytest.mark.parametrize(
    ("name", "place"), [("results/own", "results/own.parquet"), ("/results/own", "own.parquet")]
)
def test_a_command_names_the_relative_path_of_an_export(name, place):
    """A published page does not show an absolute path of the machine that wrote it."""
    (mine,) = document(evidence([row(outcome="crash")], name=name)).missions
    assert mine.lost[0].command == f"mavfi replay {place} --mission 0"


def test_a_kept_run_is_replayed_from_its_folder_as_long_as_it_is_there(tmp_path):
    rows = [row(), row("planning", outcome="crash", path=str(tmp_path))]
    rows.append(row("control", outcome="crash", path=str(tmp_path / "removed")))
    (mine,) = document(evidence(rows, folder=tmp_path)).missions
    assert [each.command for each in mine.lost] == [
        f"mavfi replay {tmp_path}",
        f"mavfi replay {tmp_path} --mission 2",
    ]
    (exported,) = document(evidence(rows)).missions  # its path is one of another machine
    assert exported.lost[0].command == "mavfi replay mine.parquet --mission 1"


def test_a_kept_flight_has_its_picture_and_a_link_to_a_file_is_none(tmp_path):
    secret = tmp_path / "secret.svg"
    secret.write_text("<svg>secret</svg>")
    rows = [row()]
    for place, name in enumerate(("kept", "link", "none")):
        run = tmp_path / name
        run.mkdir()
        if name == "kept":
            (run / "flight.svg").write_text("<svg></svg>")
        elif name == "link":
            (run / "flight.svg").symlink_to(secret)
        rows.append(row("planning", seed=place + 1, outcome="crash", path=str(run)))
    (mine,) = document(evidence(rows, folder=tmp_path)).missions
    assert [bool(each.picture) for each in mine.lost] == [True, False, False]
    assert mine.lost[0].picture.startswith("data:image/svg+xml;base64,")


def test_reasons_are_of_claims_and_grouped(told):
    assert {name for _, _, name in REASONS} <= {claim.name for claim in CLAIMS}
    groups = disagreements(told.claims, "mavbench")
    assert all(each.claims for each in groups)
    known = [bool(each.reason) for each in groups]
    assert known == sorted(known, reverse=True)  # the others are one group, the last
    assert known.count(False) <= 1
    names = [name for each in groups for name in each.names]
    assert names == [
        each.claim.name for each in told.claims
        if each.verdict("mavbench") is Verdict.CONTRADICTED
    ]  # fmt: skip


NEVER = "mavbench-replica, dead nodes never back"


@pytest.mark.parametrize(
    ("name", "stack", "verdict", "effect", "explained"),
    [
        ("table4-gad", "mavbench", Verdict.CONTRADICTED, -0.1, True),
        ("table4-gad", "mavbench", Verdict.CONTRADICTED, -0.5, False),
        ("table4-gad", "mavbench", Verdict.UNDECIDED, -0.1, False),
        ("table4-gad", "hardened", Verdict.CONTRADICTED, -0.1, False),
        ("table4-gad", "mavbench-replica", Verdict.CONTRADICTED, 0.0, True),
        ("table4-dense", "mavbench-replica", Verdict.CONTRADICTED, 0.39, False),
        ("table4-dense", NEVER, Verdict.CONTRADICTED, 0.39, True),
        ("fig6-octomap", "hardened", Verdict.CONTRADICTED, -0.147, True),
        ("fig6-octomap", "hardened", Verdict.CONTRADICTED, -0.4, False),
    ],
)
def test_a_reason_stands_only_beside_the_effect_that_it_explains(
    name, stack, verdict, effect, explained
):
    claim = next(each for each in CLAIMS if each.name == name)
    interval = Interval(value=effect, low=effect, high=effect, count=9)
    place = ISOLATED if claim.isolated else stack
    judgement = Judgement(verdict=verdict, effect=interval)
    contradicted = JudgedClaim(claim=claim, judgements={place: {Fate.ALL: judgement}})
    assert bool(reason_of(contradicted, stack)) is explained


def test_every_contradiction_of_the_published_missions_has_its_reason():
    results = Path(__file__).parents[2] / "docs" / "results"
    found = Evidence.gather([results / "paper-mavbench.parquet", results / "kernels.json"])
    flown = found.flights("mavbench").chosen(as_paper=True, at=(None, "random"))
    claims = judged({"mavbench": flown}, found.isolated)
    contradicted = disagreements(claims, "mavbench")
    assert sum(len(each.claims) for each in contradicted) == 20
    assert all(each.reason for each in contradicted)
