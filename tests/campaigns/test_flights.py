"""Real flights: a campaign's records are those of `mavfi fly`, faults of both levels included."""

import json
from dataclasses import replace

import pytest

from mavfi_cli.analysis.flights import untreated
from mavfi_cli.campaigns.missions import Injected, PlannedMission
from mavfi_cli.campaigns.run import Options, run_campaign
from mavfi_cli.campaigns.specification import Keep
from mavfi_cli.mission.run_folder import RunFolder
from mavfi_cli.spec.detector import DetectorConfig
from mavfi_cli.spec.fault import FaultConfig, InstructionConfig

FAULT = FaultConfig(target="waypoint_position", at="time=1", together=True, field="mantissa")
DETECTOR = DetectorConfig(name="gad", protect=("planning", "control"))
INSTRUCTION = InstructionConfig(target="control", seed=4)


@pytest.fixture(autouse=True)
def _fake_task_is_importable():
    """These flights are real, and the memory of an attacked node depends on PYTHONPATH."""


def record(folder):
    result = json.loads(folder.result.read_text())
    del result["host"]
    return folder.trace.read_bytes(), folder.tlog.read_bytes(), result


@pytest.fixture(scope="module")
def flown(short_config, tmp_path_factory):
    configs = [
        short_config,
        replace(short_config, fault=FAULT),
        replace(short_config, instruction=INSTRUCTION),
        replace(short_config, seed=6),
        replace(short_config, fault=FAULT, detector=DETECTOR),
    ]
    folder = tmp_path_factory.mktemp("flown") / "campaign"
    missions = [PlannedMission(config=config) for config in configs]
    with run_campaign(missions, folder, Options(jobs=2, keep=Keep.ALL)) as ledger:
        return list(ledger.results())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "changes"),
    [
        (0, {}),
        (1, {"fault": FAULT}),
        (2, {"instruction": INSTRUCTION}),
        (3, {"seed": 6}),
        (4, {"fault": FAULT, "detector": DETECTOR}),
    ],
)
def test_records_are_identical_to_those_of_a_mission_by_itself(flown, fly_short, number, changes):
    kept = RunFolder(flown[number].path)
    assert record(kept) == record(fly_short(**changes))
    assert flown[number].result == json.loads(kept.result.read_text())


def test_a_pair_shares_everything_but_its_treatment(flown):
    golden, source, instruction, other, protected = (result.mission.pair for result in flown)
    assert golden == source == instruction == protected != other


def test_what_became_of_the_faults(flown):
    assert [result.injected for result in flown[:2]] == [Injected.GOLDEN, Injected.ACTIVE]
    activation = flown[2].result["fault"]["activation"]["activation"]
    expected = {"read": Injected.ACTIVE, "not_read_in_window": Injected.UNREAD}
    assert flown[2].injected is expected.get(activation, Injected.NOT_ACTIVATED)


def test_nothing_is_left_of_the_flights(flown):
    campaign = flown[0].path.parents[1]
    assert not (campaign / "work").exists()
    assert not list(campaign.glob("runs/*/.*"))


def test_a_model_and_a_threshold_are_part_of_the_treatment():
    bare = {"setting": "FI", "site": "fly/mavsdk_server"}
    guarded = {**bare, "setting": "D&R(G)", "detector": "gad", "model": "m.json", "threshold": 9.0}
    assert untreated(guarded) == untreated(bare) != untreated({**bare, "site": "fly"})
