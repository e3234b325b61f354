"""Lost, harmful and recovered missions, counted by hand."""

import re

import pytest
from made_flights import flights, row

from mavfi_cli.paper.claims import MEASURES

PLANNING = {"target": "planning", "fault": {"field": "exponent"}}


def pairs(*outcomes):
    """A golden flight of 20 s for each seed, and a faulty one that lasts or ends like this."""
    rows = []
    for seed, end in enumerate(outcomes, start=1):
        rows.append(row(seed=seed))
        how = {"outcome": end, "time_s": 60.0} if isinstance(end, str) else {"time_s": end}
        rows.append(row(**PLANNING, seed=seed, **how))
    return rows


def test_a_fault_is_harmful_if_lost_or_more_than_10_percent_longer():
    those = flights(pairs(20.0, 22.0, 22.1, "timeout"))
    found = those.struck().share("harmed")
    assert (found.count, found.total) == (2, 4)
    assert those.struck()["added_s"] == [0.0, pytest.approx(2.0), pytest.approx(2.1), None]


def test_a_fault_without_a_successful_golden_flight_is_not_counted():
    rows = pairs("timeout", 40.0)
    rows[0] = {**rows[0], "outcome": "collision"}
    found = flights(rows).struck().share("harmed")
    assert (found.count, found.total) == (1, 1)


def test_success_lost_is_paired_and_counts_faults_that_nothing_read():
    rows = pairs("collision", *[20.0] * 8)
    rows[3] = {**rows[3], "injected": "not_activated"}
    rows.append(row(**PLANNING, seed=50, injected="not_injected"))
    found = MEASURES["success_lost"](flights(rows))
    assert found.effect.value == pytest.approx(1 / 9)
    assert found.effect.count == 9
    assert found.counts == "1 of 9 lost; golden 0 of 9"


def test_harm_counts_faults_that_nothing_read_and_says_how_many():
    rows = pairs("collision", *[20.0] * 3, "timeout")
    rows[3] = {**rows[3], "injected": "not_activated"}
    rows[8] = {**rows[8], "outcome": "collision"}  # a lost golden flight
    rows[9] = {**rows[9], "injected": "not_activated"}
    assert MEASURES["harmful"](flights(rows)).counts == "1 of 4 harmful, 1 of them never read"
    groups = {"planning": {"fault_target": "planning"}, "seed 1": {"seed": 1}}
    found = MEASURES["harm_difference"](flights(rows), groups)
    assert found.counts == "harmful: planning 1 of 4, 1 of them never read; seed 1 1 of 1"


def watched(rows, detector, *times):
    """The same faults with a detector."""
    found = []
    for seed, end in enumerate(times, start=1):
        how = {"outcome": end} if isinstance(end, str) else {"time_s": end}
        found.append(row(**PLANNING, seed=seed, detector=detector, **how))
    return rows + found


def test_what_a_detector_undoes_stands_beside_what_it_causes():
    rows = pairs("timeout", "collision", 40.0, 20.0)
    rows = watched(rows, "gad", 20.0, "collision", 20.5, 20.0)
    rows = watched(rows, "aad", 20.0, 20.0, 40.0, "crash")
    those = flights(rows)
    balances = {name: those.balance(name) for name in ("gad", "aad")}
    assert {name: (each.pairs, each.before) for name, each in balances.items()} == {
        "gad": (4, 3), "aad": (4, 3),
    }  # fmt: skip
    assert [(each.undone, each.caused) for each in balances.values()] == [(2, 0), (2, 1)]
    lost = those.balance("aad", column="lost")
    assert (lost.before, lost.undone, lost.caused) == (2, 2, 1)
    assert lost.p_value == pytest.approx(1.0)
    found = MEASURES["autoencoder_better"](those)
    assert re.findall(r"\d", found.counts) == ["1", "1", "4"]


@pytest.mark.parametrize("measure", ["recovered", "shortened"])
def test_too_few_ills_give_no_share(measure):
    found = MEASURES[measure](flights(watched(pairs(20.0), "gad", 20.0)), "gad")
    assert found.effect is None
    assert found.why.startswith("without the detector 0 of 1 are ")
    assert MEASURES[measure](flights(pairs(20.0)), "gad").why == "not flown"


def test_what_is_not_of_the_paper_is_marked():
    held = {"persistence": "stuck-at", "duration_s": 5.0}
    rows = [
        row("planning"),
        row("planning", fault=held),
        row("planning", config={"v_max_mps": 0.6}),
        row("planning", config={"time_limit_s": 99.0}),
        row("planning", fault={"at": "invocation=1"}),
        row("planning", fault={"exact_bits": (62,)}),
        row("planning", fault={"bits": 5, "field": "sign", "together": True}),
        row("planning", instruction=True),
        row("planning", instruction=True, fault={"roles": ("destination",)}),
        row("planning", instruction=True, config={"node_restart_s": 3600.0}),
        row("planning", config={"node_restart_s": 3600.0}),
        row("planning", instruction=True, fault={"compat": "rosfi-2021"}),
    ]
    told = flights(rows)["as_paper"]
    assert told == [True, False, False, True, True, False, True, True, False, True, False, True]
    assert flights(rows)["at"][3:6] == ["random", "invocation=1", "random"]


def test_flights_are_chosen_by_their_columns():
    those = flights([row(seed=1), row("planning", seed=2), row("control", seed=3)])
    found = those.chosen(fault_target=("planning", "control"))
    assert found["seed"] == [2, 3]
    assert those.chosen(fault_target=(None, "control"))["seed"] == [1, 3]
    assert those.chosen(seed=1, level=None)["seed"] == [1]
