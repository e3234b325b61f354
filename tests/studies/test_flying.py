"""What all studies do: fly a list into a folder that may hold more."""

import os
from dataclasses import replace
from pathlib import Path

import pytest

from mavfi_cli.campaigns.begin import begin, chosen, stored_spec
from mavfi_cli.campaigns.ledger import Ledger
from mavfi_cli.campaigns.missions import PlannedMission
from mavfi_cli.campaigns.progress import Spectator
from mavfi_cli.campaigns.run import Options, fly_missing, run_campaign
from mavfi_cli.campaigns.specification import Keep
from mavfi_cli.core.errors import ConfigError
from mavfi_cli.spec.mission import MissionConfig
from mavfi_cli.studies import fly

OPTIONS = Options(jobs=1, keep=Keep.NONE, task="fake_task")


@pytest.fixture(autouse=True)
def _fake_task_is_importable(monkeypatch):
    paths = [str(Path(__file__).parents[1] / "campaigns"), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, paths)))


@pytest.mark.slow
def test_a_smaller_plan_flies_no_mission_that_a_larger_one_has_left(tmp_path):
    missions = [
        PlannedMission(config=MissionConfig(world=world, seed=seed), labels={"n": seed})
        for seed, world in enumerate(["fly", "end:collision", "fly", "fly", "fly"])
    ]
    run_campaign(missions, tmp_path, replace(OPTIONS, only=frozenset({2}))).close()
    told = []

    class Told(Spectator):
        def on_progress(self, progress):
            told.append((progress.before, progress.over, progress.total))

    table = fly(missions[:3], tmp_path, Keep.NONE, OPTIONS, Told())
    assert table["number"].to_pylist() == [0, 1, 2]
    assert table["outcome"].to_pylist() == ["success", "collision", "success"]
    assert told[-1] == (1, 3, 3)
    with Ledger(tmp_path) as ledger:
        assert (ledger.planned(), ledger.over()) == (5, 3)
    more = fly(missions, tmp_path, Keep.NONE, OPTIONS, Spectator())
    assert more["number"].to_pylist() == [0, 1, 2, 3, 4]


@pytest.mark.slow
def test_a_campaign_continues_the_list_of_a_study(tmp_path):
    missions = [
        PlannedMission(config=MissionConfig(world="fly", seed=seed), labels={"n": seed}, pair="p")
        for seed in range(4)
    ]
    fly(missions[:3], tmp_path, Keep.ALL, replace(OPTIONS, only=frozenset({1})), Spectator())
    with Ledger(tmp_path, writing=True) as ledger:
        ledger.plan(missions[3:])
    spec, folder = chosen(str(tmp_path), None, None)
    assert (folder, spec.keep, spec.missions()) == (tmp_path, Keep.ALL, missions[3:])
    with begin(spec, folder) as ledger:
        fly_missing(ledger, OPTIONS, Spectator())
        assert (ledger.over(), stored_spec(ledger)) == (4, None)
    spec, _ = chosen(str(tmp_path), None, None)
    assert spec.missions() == []
    run_campaign(missions, tmp_path / "other", OPTIONS).close()
    with pytest.raises(ConfigError, match="other: has no specification"):
        chosen(str(tmp_path / "other"), None, None)
