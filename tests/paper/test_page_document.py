"""The report as plain values: its sentences, its tables, its commands."""

from pathlib import Path

import pytest
from made_flights import export_table, row

from mavfi_cli.analysis.flights import COSTS
from mavfi_cli.analysis.pairs import Fate, Flights
from mavfi_cli.paper.document import document
from mavfi_cli.paper.sources import CampaignSource, Evidence
from mavfi_cli.paper.verdicts import Verdict


def evidence(rows, name="mine", problems=()):
    path = Path(f"{name}.parquet")
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


def effect_of(judged, stack="mavbench"):
    """The effect of all faults; None without one."""
    by_fate = judged.judgements.get(stack, {})
    return by_fate[Fate.ALL].effect if by_fate else None


def test_five_sentences_say_what_was_counted(told):
    assert told["extent"] == "4 of 69 claims are judged by 30 missions."
    verdicts, cost, saved, saved_of_states, crashes = told["summary"]
    judged = {each.claim.name for each in told["claims"] if effect_of(each)}
    assert judged == {"table4-golden-dense", "table4-dense", "fig12-dense", "fig13-planning"}
    assert verdicts.startswith("Of 4 claims flown on mavbench, ")
    assert cost == (
        "On mavbench, a bit flip in an instruction loses 20 % (2 of 10; 95 % interval 6 to 51 %) "
        "of the missions whose golden flight succeeds."
    )
    assert saved == (
        "On mavbench, of the missions that a fault in an instruction loses, the autoencoder saves "
        "50 % (1 of 2; 95 % interval 9 to 91 %)."
    )
    assert saved_of_states == (
        "No mission that a fault in a state loses was flown again with a detector."
    )
    assert crashes.startswith("All 2 missions that a fault in an instruction loses follow a node")


def test_a_mission_that_is_lost_without_a_fault_is_not_lost_by_it():
    rows = [row(seed=1, outcome="collision")]
    rows.append(row("planning", seed=1, instruction=True, outcome="collision"))
    assert document(evidence(rows))["summary"][-1] == (
        "No fault in an instruction has lost a mission."
    )


def test_missions_unlike_the_papers_judge_no_claim():
    """A fault at a chosen moment tells nothing of an hour, but where a bit hurts."""
    where = {"struck_state": "waypoint_x", "struck_bits": [[62]]}
    first = {"seed": 1, "fault": {"at": "invocation=1"}, "outcome": "timeout", **where}
    rows = [row(seed=1), row("planning", seed=1), row("waypoint_x", **first)]
    told = document(evidence(rows))
    assert told["extent"] == "1 of 69 claims are judged by 2 missions."
    assert [each["where"] for each in told["hourly"]["mavbench"]] == ["state: planning, sparse"]
    assert [each["lost"] for each in told["map_rows"]] == [1]


def test_the_picture_of_faults_in_states_has_the_flights_of_its_data():
    rows = [row(seed=1), row("planning", seed=1)]
    rows += [row("planning", seed=1, detector=name) for name in ("aad", "range")]
    spread = document(evidence(rows))["spreads"]["mavbench"]
    assert {each["detector"] for each in spread["rows"]} == {"", "aad"}


def test_the_longest_flight_is_paired_and_unpaired():
    times = {1: (20.0, 30.0), 2: (10.0, 18.0)}  # golden, with a fault
    rows = [row(seed=seed, time_s=own) for seed, (own, _) in times.items()]
    rows += [row("planning", seed=seed, time_s=longer) for seed, (_, longer) in times.items()]
    (worst,) = document(evidence(rows))["worst"]
    assert worst["paired"] == pytest.approx(0.8)  # 18 over its own 10
    assert worst["unpaired"] == pytest.approx(1.0)  # 30 over the mean of 20 and 10
    assert worst["golden"] == pytest.approx(20 / 15 - 1)
    assert (worst["longer"], worst["flights"]) == (1.0, 2)


def test_what_a_detector_undoes_and_causes_stands_by_level_and_by_fate(told):
    rows = {row.fate: row for row in told["balances"]}
    assert {(row.level, row.computer, row.detector) for row in rows.values()} == {
        ("instruction", "x86", "aad")
    }
    assert {fate: (row.lost.before, row.lost.undone) for fate, row in rows.items()} == {
        Fate.ALL: (2, 1), Fate.SILENT: (0, 0), Fate.DEAD: (2, 1),
    }  # fmt: skip
    assert [row.lost.caused for row in rows.values()] == [0, 0, 0]


def test_what_detectors_save_of_states_has_a_sentence_of_its_own():
    rows = [row(seed=1), row("planning", seed=1, outcome="timeout")]
    rows += [row("planning", seed=1, detector="gad")]
    assert document(evidence(rows))["summary"][3] == (
        "On mavbench, of the missions that a fault in a state loses, the Gaussian detector saves "
        "100 % (1 of 1; 95 % interval 21 to 100 %)."
    )


def test_nothing_flown_is_said_in_sentences_too():
    found = document(evidence([row(config={"world": "nowhere"})]))
    assert found["summary"] == [
        "None of the claims has been flown yet.",
        "No flight with a fault has a golden flight beside it, so the cost is not known.",
        "No mission that a fault in an instruction loses was flown again with a detector.",
        "No mission that a fault in a state loses was flown again with a detector.",
        "No fault in an instruction has lost a mission.",
    ]


def test_every_claim_is_judged_on_each_stack(told):
    assert told["problems"] == ["something is missing."]
    for each in told["claims"]:
        stacks = {"isolated kernels"} if each.claim.isolated else {"mavbench", "hardened"}
        assert each.judgements.keys() == stacks
    by_name = {each.claim.name: each for each in told["claims"]}
    assert by_name["table4-dense"].judgements["hardened"][Fate.ALL].why == "not flown"
    assert by_name["fig15-tmr"].verdict("mavbench") is Verdict.NOT_DECIDABLE


def test_an_effect_without_an_interval_is_no_number():
    """The mean cost of one flight."""
    costs = dict.fromkeys(COSTS, 0.01)
    told = document(evidence([row("planning", instruction=True, detector="gad", **costs)]))
    (gad,) = (each for each in told["claims"] if each.claim.name == "table5-gad")
    assert effect_of(gad) is None
    assert gad.verdict("mavbench") is Verdict.NOT_DECIDABLE


def test_failures_an_hour_are_at_the_rate(told):
    (hourly,) = told["hourly"]["mavbench"]
    assert hourly["per_hour"][""][0] == pytest.approx(0.4)


def test_lost_and_longest_missions_have_their_command(told):
    (mine,) = told["missions"]
    assert [each["number"] for each in mine["lost"]] == [1, 4, 5]
    assert mine["lost"][0]["command"] == "mavfi replay mine.parquet --mission 1"
    assert mine["longest"][0]["number"] == 28  # seed 10: 21 s
    assert mine["longest"][0]["ratio"] == pytest.approx(1.05)


def test_a_command_can_be_pasted_whatever_the_name_of_the_folder():
    (mine,) = document(evidence([row(outcome="crash")], name="my flights"))["missions"]
    assert mine["lost"][0]["command"] == "mavfi replay 'my flights.parquet' --mission 0"


def test_a_kept_run_is_replayed_from_its_folder_as_long_as_it_is_there(tmp_path):
    rows = [row(), row("planning", outcome="crash", path=str(tmp_path))]
    rows.append(row("control", outcome="crash", path=str(tmp_path / "removed")))
    (mine,) = document(evidence(rows))["missions"]
    assert [each["command"] for each in mine["lost"]] == [
        f"mavfi replay {tmp_path}",
        "mavfi replay mine.parquet --mission 2",
    ]
