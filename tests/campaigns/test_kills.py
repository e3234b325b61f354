"""kill -9 at random: nothing is lost, nothing is doubled, the results are the same."""

import os
import signal
import time
from functools import partial

import pytest
from killing import (
    RUNNER,
    complete_with_kills,
    kill_one,
    processes,
    results_of,
    start_fake,
)
from live_processes import none_left
from plans import planned

from mavfi_cli.core.fork_server import GUARD, WORKER

pytestmark = pytest.mark.slow

MISSIONS, KILLS = 40, 8


def test_random_kills_lose_and_double_nothing(tmp_path):
    undisturbed, disturbed = tmp_path / "undisturbed", tmp_path / "disturbed"
    assert start_fake(undisturbed, MISSIONS).wait() == 0
    start = partial(start_fake, disturbed, MISSIONS)
    hits = complete_with_kills(start, str(disturbed), KILLS, seed=1, pause_s=0.2)
    assert hits.total() == KILLS
    assert results_of(disturbed) == results_of(undisturbed)
    assert [number for number, *_ in results_of(disturbed)] == list(range(MISSIONS))


def test_nothing_goes_on_when_the_runner_is_killed(tmp_path):
    mark = str(tmp_path / "campaign")
    runner = start_fake(tmp_path / "campaign", 1000)
    while WORKER not in processes(mark):
        time.sleep(0.05)
    assert kill_one(runner, mark, RUNNER)
    runner.wait()
    assert none_left(partial(processes, mark))


def test_a_killed_guard_costs_an_attempt_and_no_mission(campaign, monkeypatch):
    mark = str(campaign.folder)
    monkeypatch.setenv("MAVFI_TEST_CAMPAIGN", mark)
    struck = []

    def strike(progress):
        if not struck and progress.running == 2 and len(processes(mark).get(WORKER, [])) == 2:
            struck.append(processes(mark)[GUARD][0])
            os.kill(struck[0], signal.SIGKILL)

    campaign.notes.on_progress = strike
    with campaign.run(planned("sleep:3.0", "sleep:3.0", "fly")) as ledger:
        attempts = [result.attempts for result in ledger.results()]
    assert struck
    assert sorted(attempts) == [1, 1, 2]
    assert "its guard was killed" in campaign.notes.lines[0]
