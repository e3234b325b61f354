"""Lost, harmful and recovered missions, counted by hand."""

import pytest
from flown import flights, row

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


def test_a_fault_is_harmful_if_lost_or_more_than_5_percent_longer():
    those = flights(pairs(20.0, 21.0, 21.1, "timeout"))
    found = those.struck().share("harmed")
    assert (found.count, found.total) == (2, 4)


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
    assert found.told == "1 of 9 lost; golden 0 of 9"


def test_a_longest_flight_is_as_probable_as_flights_are_as_long():
    those = flights(pairs(30.0, 20.0, 20.0, 20.0))
    found = MEASURES["worst_as_long"](those, 1.5, 10)
    assert found.effect.value == pytest.approx(1.0 - 0.75**10)
    assert found.told == "1 of 4 as long; longest +50.0 %"


def watched(rows, detector, *times):
    """The same faults with a detector."""
    found = []
    for seed, end in enumerate(times, start=1):
        how = {"outcome": end} if isinstance(end, str) else {"time_s": end}
        found.append(row(**PLANNING, seed=seed, detector=detector, **how))
    return rows + found


def test_a_detector_saves_lost_missions_and_brings_long_ones_back():
    rows = pairs("timeout", "collision", 40.0, 20.0)
    rows = watched(rows, "gad", 20.0, "collision", 20.5, 20.0)
    rows = watched(rows, "aad", 20.0, 20.0, 40.0, "crash")
    those = flights(rows)
    assert MEASURES["recovered"](those, "gad").told == "1 of 2 lost missions saved"
    assert MEASURES["recovered"](those, "aad").effect.value == 1.0
    assert MEASURES["shortened"](those, "gad").told == "1 of 1 longer flights brought back"
    for name in ("gad", "aad"):
        undone = those.protected(name).chosen(bare_harmed=True).share("harmed", value=False)
        assert (undone.count, undone.total) == (2, 3)
    told = MEASURES["autoencoder_better"](those).told
    assert told == "1 missions by AAD only, 1 by GAD only, of 4"


def test_nothing_to_recover_says_so():
    found = MEASURES["recovered"](flights(watched(pairs(20.0), "gad", 20.0)), "gad")
    assert found.effect is None
    assert found.told == "without it 0 of 1 lost"
    assert MEASURES["recovered"](flights(pairs(20.0)), "gad").told == ""


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
    ]
    told = flights(rows)["as_paper"]
    assert told == [True, False, False, True, True, False, True, True, False]
    assert flights(rows)["at"][-6:-3] == ["random", "invocation=1", "random"]


def test_flights_are_chosen_by_their_columns():
    those = flights([row(seed=1), row("planning", seed=2), row("control", seed=3)])
    found = those.chosen(fault_target=("planning", "control"))
    assert found["seed"] == [2, 3]
    assert those.chosen(fault_target=(None, "control"))["seed"] == [1, 3]
    assert those.chosen(seed=1, level=None)["seed"] == [1]
