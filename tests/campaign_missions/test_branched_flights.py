"""Missions that fly as one until a fault strikes leave the records of missions by themselves."""

import json
import os
import signal
import time
from dataclasses import replace

import pytest
from killing import processes, results_of

from mavfi_cli.campaign.keep import Keep
from mavfi_cli.campaign.missions import PlannedMission, changes_of
from mavfi_cli.campaign.progress import Spectator
from mavfi_cli.campaign.run import Options, run_campaign
from mavfi_cli.campaign.together import trunk_of
from mavfi_cli.core.processes import MISSION, VEHICLE, VEHICLES
from mavfi_cli.mission.config import MissionConfig
from mavfi_cli.mission.detector_config import DetectorConfig
from mavfi_cli.mission.fault_config import FaultConfig
from mavfi_cli.mission.instruction_config import InstructionConfig
from mavfi_cli.mission.record.run_folder import RunFolder

pytestmark = pytest.mark.slow
FILES = ("trace.parquet", "plans.parquet", "kernels.parquet", "flight.tlog", "fault.json")
DETECTOR = DetectorConfig(name="gad")
FAULTS = [
    *(FaultConfig(target=stage, seed=seed) for seed, stage in enumerate(
        ("perception", "planning", "control", "perception", "planning", "control")
    )),
    FaultConfig(target="waypoint_position", at="time=1", together=True, field="mantissa"),
    FaultConfig(target="command_vx", at="tick=1", field="exponent"),
    FaultConfig(target="waypoint_x", at="invocation=1", field="sign"),
    FaultConfig(target="time_to_collision", at="phase=flying", persistence="stuck-at"),
    FaultConfig(target="control", at="time=299"),  # never comes
]  # fmt: skip


class Notes(Spectator):
    def __init__(self):
        self.lines = []
        self.flying = []

    def on_progress(self, progress):
        self.flying.append((progress.running, progress.flights))

    def on_note(self, text):
        self.lines.append(text)


def fly(missions, folder, spectator=None, **options):
    planned = [PlannedMission(config=config) for config in missions]
    changed = Options(jobs=1, keep=Keep.ALL, **options)
    with run_campaign(planned, folder, changed, spectator or Notes()) as ledger:
        return list(ledger.results())


def record(path):
    folder = RunFolder(path)
    result = json.loads(folder.result.read_text())
    host = result.pop("host")
    files = {name: (path / name).read_bytes() for name in FILES if (path / name).exists()}
    return host, {**files, "result": result, "names": sorted(p.name for p in path.iterdir())}


@pytest.fixture(scope="module")
def missions(short_config):
    """One golden flight and its faults; two faults behind a detector, without its golden flight."""
    bare = [short_config, *(replace(short_config, fault=fault) for fault in FAULTS)]
    return [*bare, *(replace(each, detector=DETECTOR) for each in bare[1:3])]


@pytest.fixture(scope="module")
def both(missions, tmp_path_factory):
    """The same missions, branched and each from its start."""
    folder = tmp_path_factory.mktemp("both")
    notes = Notes()
    branched = fly(missions, folder / "branched", notes)
    assert notes.lines == []
    assert max(notes.flying) > (1, 1)  # one slot: however many missions fly, they are one flight
    assert {flights for running, flights in notes.flying if running} == {1}
    return branched, fly(missions, folder / "whole", branch=False)


def test_every_record_is_that_of_the_mission_flown_from_its_start(both):
    for one, other in zip(*both, strict=True):
        assert record(one.path)[1] == record(other.path)[1]
    assert [result.attempts for result in both[0]] == [1] * len(both[0])


def test_it_is_that_of_the_plain_command_too(both, missions, fly_short, short_config):
    for number in (0, 2, 3, len(missions) - 1):
        config = missions[number]
        alone = fly_short(fault=config.fault, detector=config.detector)
        assert record(both[0][number].path)[1] == record(alone.path)[1]
    assert short_config == missions[0]


def test_faulty_missions_really_branched_off(both, missions):
    hosts = [record(result.path)[0] for result in both[0]]
    assert hosts[0]["branched_s"] is None
    begun = [host["branched_s"] for host, config in zip(hosts, missions, strict=True)
             if config.fault is not None and config.detector is None]  # fmt: skip
    # MOST of them go with the golden flight, the rest with each other: the last of those, and of
    # the two behind a detector, is what the common flight has become.
    assert sum(at is not None for at in begun) == len(begun) - 1
    assert [host["branched_s"] is None for host in hosts[-2:]].count(True) == 1
    assert all(record(result.path)[0]["branched_s"] is None for result in both[1])


def test_faults_acted_and_one_never_did(both):
    fates = [result.result["fault"]["state"] for result in both[0] if result.result["fault"]]
    assert fates[len(FAULTS) - 1] == "not_injected"
    assert fates.count("applied") == len(fates) - 1


def test_nothing_but_run_folders_is_left(both):
    for results in both:
        campaign = results[0].path.parents[1]
        assert not (campaign / "work").exists()
        assert len(list((campaign / "runs").iterdir())) == len(results)


class _Killer(Spectator):
    """Kills a process of a kind as soon as two missions of one flight are there."""

    def __init__(self, mark, victim):
        self._mark, self._victim = mark, victim
        self.struck = False

    def on_progress(self, progress):
        found = processes(self._mark)
        if not self.struck and len(found.get(MISSION, [])) > 1 and self._victim in found:
            os.kill(max(found[self._victim]), signal.SIGKILL)
            self.struck = True


@pytest.mark.parametrize("victim", [MISSION, VEHICLE, VEHICLES])
def test_a_kill_after_a_branch_loses_and_changes_nothing(
    victim, both, missions, tmp_path, monkeypatch
):
    mark = str(tmp_path)
    monkeypatch.setenv("MAVFI_TEST_CAMPAIGN", mark)
    monkeypatch.setattr("mavfi_cli.campaign.run._LOOK_S", 0.01)
    killer = _Killer(mark, victim)
    few = missions[:4]
    results = fly(few, tmp_path / "campaign", killer)
    assert killer.struck
    assert [result.number for result in results] == list(range(len(few)))
    for one, other in zip(results, both[1], strict=False):
        assert record(one.path)[1] == record(other.path)[1]
    assert results_of(tmp_path / "campaign") == [
        (each.number, each.outcome, json.dumps(
            {k: v for k, v in each.result.items() if k != "host"}, sort_keys=True))
        for each in both[1][: len(few)]
    ]  # fmt: skip
    deadline = time.monotonic() + 30.0
    while {MISSION, VEHICLE, VEHICLES} & set(processes(mark)):
        assert time.monotonic() < deadline, "a process is left"
        time.sleep(0.05)


def test_what_can_share_a_flight():
    golden = MissionConfig(world="farm")
    trunks = [
        trunk_of(changes_of(config))
        for config in (
            golden,
            replace(golden, fault=FaultConfig(target="control", seed=1)),
            replace(golden, seed=4),
            replace(golden, detector=DETECTOR),
            replace(golden, instruction=InstructionConfig(target="control", seed=1)),
            replace(golden, detector=DETECTOR, fault=FaultConfig(target="detector", seed=1)),
            replace(golden, isolate=("planner",)),
            replace(golden, realtime=True),
        )
    ]
    assert trunks[0] == trunks[1] is not None
    assert None not in trunks[2:4]
    assert len(set(trunks[1:4])) == 3
    assert trunks[4:] == [None] * 4
