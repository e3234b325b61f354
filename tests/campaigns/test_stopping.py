"""Sequential stopping: by the first missions of the list, whatever order they end in."""

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st
from plans import planned

from mavfi_cli.campaigns.missions import Injected, MissingMission
from mavfi_cli.campaigns.run import MissionQueue
from mavfi_cli.campaigns.specification import Stop
from mavfi_cli.spec.mission import MissionConfig
from mavfi_cli.stats.shares import wilson

CONFIG = MissionConfig()
STOP = Stop(margin=0.12, batch=10)
wilson(1, 2)  # imports SciPy, for which an example of hypothesis has no time


def fly(outcomes, cells, slots, seed):
    """Which missions are flown where `slots` of them fly at a time and end in a random order."""
    queue = MissionQueue(
        (MissingMission(n, cell, CONFIG) for n, cell in enumerate(cells)), STOP, cells
    )
    rng = random.Random(seed)
    flying, flown = [], []
    while True:
        while len(flying) < slots and (entry := queue.next()) is not None:
            flying.append(entry[0])
        if not flying:
            return sorted(flown), queue
        number = flying.pop(rng.randrange(len(flying)))
        flown.append(number)
        queue.record(number, (outcomes[number], "golden"))


@given(
    st.lists(st.sampled_from(["success", "collision"]), min_size=120, max_size=120),
    st.integers(0, 9),
)
def test_slots_and_order_make_no_difference(outcomes, seed):
    cells = [number % 2 for number in range(120)]
    flown, gate = fly(outcomes, cells, 1, seed)
    again, same = fly(outcomes, cells, 7, seed + 1)
    assert flown == again
    assert gate.stopped == same.stopped
    for cell in (0, 1):
        mine = [outcomes[number] for number in flown if cells[number] == cell]
        share = wilson(mine.count("success"), len(mine))
        width = (share.high - share.low) / 2
        assert len(mine) % STOP.batch == 0
        assert len(mine) == 60 or width <= STOP.margin
        if len(mine) > STOP.batch:
            before = mine[: -STOP.batch]
            share = wilson(before.count("success"), len(before))
            assert (share.high - share.low) / 2 > STOP.margin


def test_faults_that_did_nothing_make_no_interval_narrow():
    gate = MissionQueue(iter(()), STOP, [0] * 100)
    for number in range(20):
        gate.record(number, ("success", Injected.NOT_ACTIVATED.value))
    assert not gate.stopped
    for number in range(20, 50):
        gate.record(number, ("success", Injected.ACTIVE.value))
    assert gate.stopped == {0}


def test_what_was_flown_before_counts():
    cells = [0] * 100
    outcomes = dict(zip(range(100), ["success"] * 100, strict=True))
    flown, _ = fly(outcomes, cells, 1, 0)
    left = (MissingMission(n, 0, CONFIG) for n in range(100) if n not in flown)
    over = [(n, ("success", "golden")) for n in flown]
    assert MissionQueue(left, STOP, cells, over).next() is None


def test_without_a_rule_everything_is_flown():
    queue = MissionQueue((MissingMission(n, 0, CONFIG) for n in range(3)), None)
    assert [queue.next() for _ in range(4)] == [*((n, 0, CONFIG) for n in range(3)), None]


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_campaign_stops_where_it_is_sure_enough(campaign, jobs):
    missions = planned(*["fly"] * 60)
    with campaign.run(missions, jobs=jobs, stop=STOP) as ledger:
        assert [result.number for result in ledger.results()] == list(range(20))


def test_a_mission_that_could_not_begin_counts_once_when_it_is_flown_again(campaign):
    (campaign.folder.parent / "blocked-0").touch()
    missions = planned(*["fly"] * 40)
    campaign.run(missions[:15]).close()
    (campaign.folder.parent / "blocked-0").unlink()
    with campaign.run(missions, append=True, stop=STOP, errors=True) as ledger:
        found = [(result.number, result.outcome) for result in ledger.results()]
    assert found == [(number, "success") for number in range(20)]
    assert (campaign.notes.last.before, campaign.notes.last.over) == (14, 20)
