"""The runner: what becomes of missions that end well, badly, or are ended from outside."""

import contextlib
import json
import math
import os
import signal
from dataclasses import replace
from pathlib import Path

import pytest
from plans import planned

from mavfi_cli.campaigns.ledger import Ledger
from mavfi_cli.campaigns.missions import Injected, PlannedMission, ResultState
from mavfi_cli.campaigns.progress import Spectator
from mavfi_cli.campaigns.run import ATTEMPTS, PROFILES
from mavfi_cli.campaigns.specification import Keep
from mavfi_cli.campaigns.workers import CampaignStopped
from mavfi_cli.core.errors import ConfigError, Interrupted
from mavfi_cli.mission.instruction import kept_in
from mavfi_cli.spec.fault import InstructionConfig
from mavfi_cli.spec.mission import MissionConfig


def only(ledger):
    with ledger:
        (result,) = ledger.results()
    return result


def alive(pid):
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, 0)
        return True
    return False


def test_results_come_in_the_order_of_the_list(campaign):
    missions = planned("sleep:0.3", *["fly"] * 30)
    with campaign.run(missions) as ledger:
        results = list(ledger.results())
    assert [result.number for result in results] == list(range(31))
    assert [result.mission.config for result in results] == [m.config for m in missions]
    assert [result.result["config"].get("seed", 3) for result in results] == list(range(31))
    assert {result.outcome for result in results} == {"success"}
    assert {result.injected for result in results} == {Injected.GOLDEN}
    assert campaign.notes.last.over == 31
    assert campaign.notes.last.outcomes == {"": {"success": 31}}


def test_outcomes_are_counted_by_setting_and_only_those_of_this_run(campaign):
    missions = [
        replace(mission, labels={"setting": "golden" if number < 3 else "FI", "n": number % 2})
        for number, mission in enumerate(planned(*["fly"] * 7))
    ]
    campaign.run(missions[:5]).close()
    assert campaign.notes.last.outcomes == {"golden": {"success": 3}, "FI": {"success": 2}}
    assert campaign.notes.last.success_rates == {"golden": 1.0, "FI": 1.0}
    campaign.run(missions, append=True).close()
    assert campaign.notes.last.outcomes == {"golden": {}, "FI": {"success": 2}}
    assert campaign.notes.last.success_rates == {"FI": 1.0}


def test_a_mission_that_is_listed_twice_is_flown_twice_and_not_again_by_a_second_run(campaign):
    missions = planned("fly") * 2
    with campaign.run(missions) as ledger:
        first = [(r.number, r.wall_s, r.attempts) for r in ledger.results()]
    assert [number for number, *_ in first] == [0, 1]
    with campaign.run(missions) as ledger:
        assert [(r.number, r.wall_s, r.attempts) for r in ledger.results()] == first


def test_a_mission_that_ends_badly_is_a_result(campaign):
    expected = {
        f"signal:{int(signal.SIGSEGV)}": ("crash", "killed by SIGSEGV"),
        f"signal:{int(signal.SIGABRT)}": ("crash", "killed by SIGABRT"),
        "exit:3": ("crash", "ended with code 3"),
        "end:collision": ("collision", ""),
    }
    with campaign.run(planned(*expected), keep=Keep.ALL) as ledger:
        results = list(ledger.results())
    for result, (outcome, reason) in zip(results, expected.values(), strict=True):
        assert (result.state, result.outcome) == (ResultState.FLOWN, outcome)
        assert result.reason.endswith(reason)
        assert result.attempts == 1
    path = results[0].path
    assert path.name == "000000-cut-off"  # it is kept with its last words
    assert "Segmentation fault" in (path / "stderr.txt").read_text()


def test_a_mission_without_an_end_hangs(campaign):
    result = only(campaign.run(planned("sleep:600"), limit_s=3.0))
    assert result.outcome == "hang"
    assert "within 3 s" in result.reason
    assert result.result["fault"] == {"schema": 1, "state": "applied", "seed": 0}


def test_nothing_of_a_mission_is_left_when_it_is_over(campaign):
    assert only(campaign.run(planned("orphan"))).outcome == "crash"
    assert not alive(int((campaign.folder / "orphan.pid").read_text()))
    assert not (campaign.folder / "work").exists()


def test_profiles_go_after_the_last_mission_with_their_golden_run(campaign):
    def faults(seed, number):
        attacks = (InstructionConfig(target="control", seed=fault) for fault in range(number))
        return [
            PlannedMission(config=MissionConfig(world="fly", seed=seed, instruction=attack))
            for attack in attacks
        ]

    kept = {seed: kept_in(campaign.folder / PROFILES, faults(seed, 1)[0].config.golden)
            for seed in (1, 2)}  # fmt: skip
    missions = faults(1, 3) + faults(2, 3)
    campaign.run(missions, only=frozenset({0, 1, 3, 4, 5})).close()
    assert kept[1].is_dir()  # a mission with this golden run is still missing
    assert not kept[2].exists()
    campaign.run(missions, only=frozenset({2})).close()
    assert not kept[1].exists()
    assert not (campaign.folder / PROFILES).exists()


@pytest.mark.slow
def test_profiles_go_after_the_last_mission_that_is_planned(campaign):
    """`mavfi reproduce table4` flies some of the missions of its folder, in several parts."""
    attacks = [InstructionConfig(target="control", seed=seed) for seed in range(3)]
    missions = [PlannedMission(config=MissionConfig(world="fly", instruction=a)) for a in attacks]
    campaign.run(missions, only=frozenset({0}), planned=frozenset({0, 1})).close()
    assert kept_in(campaign.folder / PROFILES, missions[0].config.golden).is_dir()
    campaign.run(missions, only=frozenset({1}), planned=frozenset({0, 1})).close()
    assert not (campaign.folder / PROFILES).exists()


def test_profiles_that_several_campaigns_share_stay(campaign, tmp_path):
    attack = InstructionConfig(target="control", seed=1)
    config = MissionConfig(world="fly", instruction=attack)
    campaign.run([PlannedMission(config=config)], profiles=tmp_path / "shared").close()
    assert kept_in(tmp_path / "shared", config.golden).is_dir()


def test_a_mission_killed_from_outside_is_begun_again(campaign):
    result = only(campaign.run(planned(f"signal-once:{int(signal.SIGKILL)}")))
    assert (result.outcome, result.attempts) == ("success", 2)
    (note,) = campaign.notes.lines
    assert note.startswith("mission 0: killed by SIGKILL; ")


def test_missions_that_are_killed_each_time_or_lose_their_vehicle_stay_missing(campaign):
    killed = (f"signal:{int(signal.SIGKILL)}", "end:link_lost", "untrue", "vehicle")
    with pytest.raises(CampaignStopped, match=r"4 missions .* 3 times"):
        campaign.run(planned("fly", *killed))
    with Ledger(campaign.folder) as ledger:
        assert [number for number, *_ in ledger.missing()] == [1, 2, 3, 4]


def test_a_node_that_is_killed_each_time_is_believed_at_last(campaign):
    result = only(campaign.run(planned("node:killed by SIGKILL")))
    assert (result.state, result.attempts) == (ResultState.FLOWN, ATTEMPTS)


def test_a_mission_that_cannot_begin_or_meets_a_defect_has_no_outcome(campaign):
    expected = {
        "blocked": ("blocked", 1),
        "no-vehicle": ("ended with code 1", ATTEMPTS),
        "defect": ("ZeroDivisionError: a defect", 1),
    }
    with campaign.run(planned(*expected)) as ledger:
        results = list(ledger.results())
    for result, (reason, attempts) in zip(results, expected.values(), strict=True):
        assert (result.state, result.outcome) == (ResultState.ERROR, None)
        assert result.reason.endswith(reason)
        assert result.injected is None
        assert result.attempts == attempts


@pytest.mark.slow
def test_errors_are_flown_again_when_asked_for(campaign):
    missions = planned("blocked", "fly")
    campaign.run(missions).close()
    campaign.run(missions).close()
    assert len(campaign.notes.lines) == 1
    campaign.run(missions, errors=True).close()
    assert len(campaign.notes.lines) == 2
    last = campaign.notes.last
    assert (last.before, last.over, last.total) == (1, 2, 2)


@pytest.mark.parametrize("limit_s", [0.0, math.nan, math.inf])
def test_a_limit_that_ends_all_missions_or_none_is_refused(campaign, limit_s):
    with pytest.raises(ConfigError, match=r"^limit: "):
        campaign.run(planned("fly"), limit_s=limit_s)


def test_no_mission_at_all_ends_the_campaign(campaign):
    with pytest.raises(CampaignStopped, match=r"no mission could begin; .*blocked"):
        campaign.run(planned(*["blocked"] * 100))


def test_a_full_disk_stops_the_campaign_and_costs_nothing(campaign):
    missions = planned("fly", "fly", "full", "fly")
    with pytest.raises(CampaignStopped, match="No space left"):
        campaign.run(missions, jobs=1)
    with Ledger(campaign.folder) as ledger:
        assert [number for number, *_ in ledger.missing()] == [2, 3]


@pytest.mark.parametrize(
    ("keep", "kept"),
    [
        (Keep.NONE, []),
        (Keep.FEW, []),
        (Keep.FAILURES, ["000001-end-1"]),
        (Keep.SAMPLED, ["000000-fly-0", "000001-end-1"]),
        (Keep.ALL, ["000000-fly-0", "000001-end-1", "000002-fly-2"]),
    ],
)
def test_run_folders_are_kept_by_policy(campaign, keep, kept):
    with campaign.run(planned("fly", "end:collision", "fly"), keep=keep) as ledger:
        paths = [result.path for result in ledger.results() if result.path is not None]
    assert [path.name for path in paths] == kept
    for path in paths:
        assert json.loads((path / "result.json").read_text())["schema"] == 1
    runs = campaign.folder / "runs"
    assert (sorted(p.name for p in runs.iterdir()) if runs.is_dir() else []) == kept


@pytest.mark.parametrize("settings", [1, 7, 20, 40, 136, 137])
@pytest.mark.parametrize(("keep", "outcome"), [(Keep.SAMPLED, "success"), (Keep.FEW, "timeout")])
def test_the_sample_has_some_of_every_setting(settings, keep, outcome):
    repetitions = 200  # the settings take turns in the list
    kept = [keep.wants(n, outcome) for n in range(settings * repetitions)]
    for setting in range(settings):
        assert 1 <= sum(kept[setting::settings]) <= 25
    assert sum(kept) / len(kept) == pytest.approx(1 / 20, rel=0.1 if settings > 1 else 0.5)


def test_another_list_is_refused_and_its_first_difference_shown(campaign):
    campaign.run(planned("fly")).close()
    counted = r'"seed":1.*1 missions there, 2 here, .*1 are new'
    with pytest.raises(ConfigError, match=counted):
        campaign.run(planned("fly", "fly"))
    both = r'new one.*"seed":0,.*gone one.*"fly".*1 are gone'
    with pytest.raises(ConfigError, match=both) as told:
        campaign.run(planned("exit:1"))
    assert "--append" not in str(told.value)  # not every command that flies a list can add to it


@pytest.mark.slow
def test_append_adds_what_is_new(campaign):
    campaign.run(planned("fly")).close()
    with campaign.run(planned("fly", "end:crash"), append=True) as ledger:
        assert [(r.number, r.outcome) for r in ledger.results()] == [(0, "success"), (1, "crash")]
    with campaign.run(planned("fly"), append=True) as ledger:
        assert ledger.planned() == 2


@pytest.mark.slow
def test_a_file_that_missions_name_must_not_change_between_them(campaign, tmp_path):
    mine, other = tmp_path / "mine.toml", tmp_path / "other.toml"
    mine.write_text("scale = 1.2")
    other.write_text("")
    missions = planned("fly", platform=str(mine))
    campaign.run(missions).close()
    campaign.run([*missions, *planned("fly", vehicle=str(other))], append=True).close()
    mine.write_text("scale = 2.5")
    more = [*missions, *planned("fly", "fly", platform=str(mine))[1:]]
    with pytest.raises(ConfigError, match=r"mine\.toml: changed after"):
        campaign.run(more, append=True)
    mine.write_text("scale = 1.2")
    campaign.run(more, append=True).close()
    other.unlink()
    with pytest.raises(ConfigError, match=r"/other\.toml: changed after"):
        campaign.run(more, append=True)


def test_the_file_of_a_varied_stack_must_not_change_either(campaign, tmp_path):
    mine = tmp_path / "mine.toml"
    mine.write_text("")
    missions = planned("fly", stack=f"{mine}:guards_tracking=true")
    campaign.run(missions).close()
    mine.write_text("guards_tracking = false")
    with pytest.raises(ConfigError, match=r"mine\.toml: changed after"):
        campaign.run(missions)


def test_only_one_process_runs_a_campaign(campaign):
    with (
        Ledger(campaign.folder, writing=True),
        pytest.raises(ConfigError, match="another process"),
    ):
        campaign.run(planned("fly"))


class Interrupting(Spectator):
    """Presses Ctrl-C so often, each time that it hears of two missions that fly."""

    def __init__(self, times):
        self.lines = []
        self._left = times

    def on_progress(self, progress):
        if self._left and progress.running == 2:
            self._left -= 1
            signal.raise_signal(signal.SIGINT)

    def on_note(self, text):
        self.lines.append(text)


@pytest.mark.slow
def test_ctrl_c_once_lets_missions_finish(campaign):
    campaign.notes = notes = Interrupting(1)
    missions = planned("sleep:1.5", "sleep:1.5", "fly")
    with pytest.raises(Interrupted, match="run again to continue"):
        campaign.run(missions)
    (note,) = notes.lines
    assert "Ctrl-C once more" in note
    with Ledger(campaign.folder) as ledger:
        assert [result.number for result in ledger.results()] == [0, 1]
    with campaign.run(missions) as ledger:
        assert [result.number for result in ledger.results()] == [0, 1, 2]


def test_ctrl_c_twice_kills_them(campaign):
    campaign.notes = Interrupting(2)
    with pytest.raises(Interrupted):
        campaign.run(planned("sleep:600", "sleep:600"))
    with Ledger(campaign.folder) as ledger:
        assert ledger.over() == 0
    assert not Path(campaign.folder / "work").exists()
