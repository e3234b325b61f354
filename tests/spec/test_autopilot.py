"""Which autopilot flies the simulated vehicle: ours, or real firmware."""

import pytest

from mavfi_cli.core.errors import ConfigError, UnknownName
from mavfi_cli.spec.fault import InstructionConfig
from mavfi_cli.spec.mission import MissionConfig

PLANNER = InstructionConfig(target="planner")


def test_a_flight_of_our_own_has_the_record_that_it_had():
    assert not {"autopilot", "firmware"} & set(MissionConfig().to_dict())


def test_the_record_of_a_real_one_names_it():
    values = MissionConfig(autopilot="px4", firmware="/opt/px4/bin/px4").to_dict()
    assert (values["autopilot"], values["firmware"]) == ("px4", "/opt/px4/bin/px4")


def test_an_unknown_autopilot_is_refused():
    with pytest.raises(UnknownName, match="px4"):
        MissionConfig(autopilot="px5")


@pytest.mark.parametrize(
    "other",
    [
        {"autopilot": "px4", "link": "udpin:127.0.0.1:14540", "goal": (30.0, 40.0, 5.0)},
        {"autopilot": "px4", "instruction": PLANNER},
        {"autopilot": "ardupilot", "instruction": PLANNER, "realtime": True},
    ],
    ids=["link", "instruction", "wall clock"],
)
def test_what_a_real_autopilot_cannot_do_is_refused(other):
    with pytest.raises(ConfigError, match="autopilot"):
        MissionConfig(**other)


def test_an_autopilot_whose_flights_repeat_takes_instruction_level_faults():
    assert MissionConfig(autopilot="ardupilot", instruction=PLANNER).instruction is PLANNER


def test_the_binary_is_the_missions_or_the_environments(monkeypatch):
    monkeypatch.setenv("PX4_SITL", "/env/px4")
    assert MissionConfig(autopilot="px4").with_firmware().firmware == "/env/px4"
    named = MissionConfig(autopilot="px4", firmware="/own/px4")
    assert named.with_firmware().firmware == "/own/px4"
    assert MissionConfig().with_firmware() == MissionConfig()
    monkeypatch.delenv("PX4_SITL")
    with pytest.raises(ConfigError, match="--firmware PATH, or PX4_SITL"):
        MissionConfig(autopilot="px4").with_firmware()


def test_the_binary_is_a_file_that_the_mission_depends_on():
    assert MissionConfig(autopilot="px4", firmware="/own/px4").files == ("/own/px4",)
    assert MissionConfig().files == ()
