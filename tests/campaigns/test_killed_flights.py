"""Real flights of workers that are killed: nothing is lost, and nothing is left."""

import os
import signal
from dataclasses import replace
from functools import partial

import pytest
from killing import VEHICLE, processes, results_of
from live_processes import none_left

from mavfi_cli.campaigns.missions import PlannedMission
from mavfi_cli.campaigns.progress import Spectator
from mavfi_cli.campaigns.run import Options, run_campaign
from mavfi_cli.campaigns.specification import Keep
from mavfi_cli.core.fork_server import GUARD, WORKER

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def missions(short_config):
    return [PlannedMission(config=replace(short_config, seed=seed)) for seed in range(1, 4)]


@pytest.fixture(scope="module")
def undisturbed(missions, tmp_path_factory):
    folder = tmp_path_factory.mktemp("undisturbed") / "campaign"
    run_campaign(missions, folder, Options(jobs=1, keep=Keep.NONE)).close()
    return results_of(folder)


class _Killer(Spectator):
    """Kills one process of a kind as soon as a mission flies."""

    def __init__(self, mark, victim):
        self._mark, self._victim = mark, victim
        self.struck = False
        self.notes = []

    def on_progress(self, progress):
        found = processes(self._mark)
        if not self.struck and WORKER in found and self._victim in found:
            os.kill(found[self._victim][0], signal.SIGKILL)
            self.struck = True

    def on_note(self, text):
        self.notes.append(text)


@pytest.mark.parametrize("victim", [WORKER, GUARD])
def test_a_kill_costs_an_attempt_and_no_mission(
    victim, missions, undisturbed, tmp_path, monkeypatch
):
    mark = str(tmp_path)
    monkeypatch.setenv("MAVFI_TEST_CAMPAIGN", mark)
    monkeypatch.setattr("mavfi_cli.campaigns.run._LOOK_S", 0.02)
    killer = _Killer(mark, victim)
    with run_campaign(missions, tmp_path / "campaign", Options(jobs=1), killer) as ledger:
        attempts = sorted(result.attempts for result in ledger.results())
    assert killer.struck
    assert len(killer.notes) == 1
    assert killer.notes[0].endswith("begun again")
    assert attempts == [1, 1, 2]
    assert results_of(tmp_path / "campaign") == undisturbed
    assert none_left(partial(processes, mark))


def test_a_mission_whose_time_runs_out_leaves_no_vehicle(short_config, tmp_path, monkeypatch):
    mark = str(tmp_path)
    monkeypatch.setenv("MAVFI_TEST_CAMPAIGN", mark)
    # 80 m by the wall clock take longer than the limit on any machine, the short way does not.
    slow = PlannedMission(config=replace(short_config, realtime=True, goal=(58.0, 58.0, 5.0)))
    usual = PlannedMission(config=short_config)
    seen = []

    class Watch(Spectator):
        def on_progress(self, _progress):
            seen.append(set(processes(mark)))

    options = Options(jobs=1, limit_s=25.0, keep=Keep.NONE)
    with run_campaign([slow, usual], tmp_path / "campaign", options, Watch()) as ledger:
        assert [result.outcome for result in ledger.results()] == ["hang", "success"]
    assert any(VEHICLE in kinds for kinds in seen)  # by the wall clock it is a process of its own
    assert VEHICLE not in processes(mark)
