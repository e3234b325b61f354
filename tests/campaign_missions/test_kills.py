"""kill -9 at random: nothing is lost, nothing is doubled, the results are the same."""

import os
import signal
import time
from functools import partial

from conftest import planned
from killing import complete_with_kills, descendants, kill_one, results_of, start_fake

MISSIONS = 40


def test_random_kills_lose_and_double_nothing(tmp_path):
    undisturbed, disturbed = tmp_path / "undisturbed", tmp_path / "disturbed"
    assert start_fake(undisturbed, MISSIONS).wait() == 0
    hits = complete_with_kills(partial(start_fake, disturbed, MISSIONS), 12, seed=1, pause_s=0.6)
    assert hits.total() >= 12
    assert len(hits) >= 3
    assert results_of(disturbed) == results_of(undisturbed)
    assert [number for number, *_ in results_of(disturbed)] == list(range(MISSIONS))


def test_nothing_goes_on_when_the_runner_is_killed(tmp_path):
    runner = start_fake(tmp_path / "campaign", 1000)
    while 3 not in descendants(runner.pid).values():  # template, slot, mission
        time.sleep(0.05)
    left = descendants(runner.pid)
    assert kill_one(runner, "runner")
    runner.wait()
    deadline = time.monotonic() + 30.0
    while any(alive(pid) for pid in left):
        assert time.monotonic() < deadline, "processes are left of a killed runner"
        time.sleep(0.05)


def alive(pid):
    try:
        with open(f"/proc/{pid}/stat") as stat:
            return stat.read().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_a_killed_slot_costs_an_attempt_and_no_mission(campaign):
    missions = planned("sleep:1.0", "sleep:1.0", "fly")
    struck = []

    def strike(progress):
        if not struck and progress.running == 2:
            slots = [pid for pid, g in descendants(os.getpid()).items() if g == 2]
            if len(slots) == 2:
                os.kill(slots[0], signal.SIGKILL)
                struck.append(slots[0])

    campaign.notes.on_progress = strike
    with campaign.run(missions) as ledger:
        attempts = [result.attempts for result in ledger.results()]
    assert struck
    assert sorted(attempts) == [1, 1, 2]
    assert campaign.notes.lines[0].endswith("its slot was killed; begun again")
