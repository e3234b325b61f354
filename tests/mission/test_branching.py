"""The faults of missions that fly together: each acts in its own flight only, as it would alone."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mavfi_cli.core.types import Command
from mavfi_cli.fi.source.schedule import Moment
from mavfi_cli.mission.branching import Branching, Member, Trunk, can_branch
from mavfi_cli.mission.config import MissionConfig
from mavfi_cli.mission.fault_config import FaultConfig
from mavfi_cli.mission.injection import SourceInjection

FAULTS = [
    FaultConfig(target="command_vx", at="tick=3", seed=1),
    FaultConfig(target="command_vy", at="tick=3", seed=2),
    FaultConfig(target="command_yaw", at="tick=5", seed=3),
    FaultConfig(target="command_vz", at="time=299", seed=4),
]


class Together(Branching):
    """One process that plays both sides of a fork: it becomes the mission that is `wanted`."""

    def __init__(self, *faults, wanted=None):
        configs = [MissionConfig(), *(MissionConfig(fault=fault) for fault in faults)]
        super().__init__([Member(config=config, out=Path()) for config in configs])
        self.forked = []
        self._wanted = wanted
        self.trunk = Trunk(self, self._branch)
        self.trunk.prepare(20.0)

    def _branch(self, number):
        self.forked.append(number)
        if number != self._wanted:
            return False
        self.trunk.become(number)
        return True

    def become(self, member):
        raise AssertionError

    def fork(self, member):
        raise AssertionError

    def await_fork(self):
        raise AssertionError

    def scratch(self, member):
        raise AssertionError


def command(tick):
    return Command(
        stamp_s=0.02 * tick, velocity_enu_mps=np.array([1.0, tick, -0.5]), yaw_rad=0.1 * tick
    )


def moment(tick):
    return Moment(stamp_s=0.02 * tick, flight_s=0.02 * tick, tick=tick, phase="flying")


def values(sent):
    return (*sent.velocity_enu_mps.tolist(), sent.yaw_rad)


def test_the_common_flight_never_sees_a_struck_message():
    together = Together(*FAULTS)
    for tick in range(1, 10):
        message = command(tick)
        assert together.trunk.pass_on(message, moment(tick)) is message
    assert together.forked == [1, 2, 3]
    assert together.trunk.left == [4]
    assert together.trunk.finish() is None


@pytest.mark.parametrize("wanted", [1, 2, 3])
def test_a_mission_that_branches_off_sees_what_it_would_see_alone(wanted):
    together = Together(*FAULTS, wanted=wanted)
    alone = SourceInjection(FAULTS[wanted - 1], 20.0)
    for tick in range(1, 10):
        sent = together.trunk.pass_on(command(tick), moment(tick))
        assert values(sent) == values(alone.pass_on(command(tick), moment(tick)))
    assert together.forked[-1] == wanted
    assert together.trunk.left == []
    assert together.trunk.news() == alone.news() != []
    assert together.trunk.finish() == alone.finish()
    assert together.trunk.finish()["state"] == "applied"


def test_a_fault_that_never_acts_has_the_record_of_one_that_waited_alone():
    together = Together(*FAULTS)
    alone = SourceInjection(FAULTS[3], 20.0)
    for tick in range(1, 10):
        together.trunk.pass_on(command(tick), moment(tick))
        alone.pass_on(command(tick), moment(tick))
    together.trunk.become(4)
    assert together.trunk.finish() == alone.finish()
    assert together.trunk.finish()["state"] == "not_injected"


def test_every_trigger_sees_a_phase_that_is_over_before_the_next_message():
    together = Together(FaultConfig(target="command_vx", at="phase=evading"))
    together.trunk.watch(replace(moment(1), phase="evading"))
    message = command(2)
    assert together.trunk.pass_on(message, moment(2)) is message
    assert together.forked == [1]


def test_an_error_in_one_mission_is_not_the_others(monkeypatch):
    def fails(self, message, moment, index=0):
        raise ZeroDivisionError

    monkeypatch.setattr(SourceInjection, "pass_on", fails)
    message = command(1)
    assert Together(FAULTS[0]).trunk.pass_on(message, moment(1)) is message
    with pytest.raises(ZeroDivisionError):
        Together(FAULTS[0], wanted=1).trunk.pass_on(message, moment(1))


def test_the_mission_without_a_fault_is_the_common_flight():
    assert Together(*FAULTS).me == 0


@pytest.mark.parametrize(
    "config",
    [
        MissionConfig(link="udpin:127.0.0.1:14540"),
        MissionConfig(isolate=("planner",)),
        MissionConfig(realtime=True),
    ],
)
def test_what_cannot_be_forked_flies_alone(config):
    assert can_branch(MissionConfig())
    assert not can_branch(config)
