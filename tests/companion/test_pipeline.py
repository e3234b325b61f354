"""The companion without a vehicle: what a withheld message leads to, and who reads what."""

import math
from dataclasses import dataclass

import numpy as np
import pytest

from mavfi_cli.autonomy.pilot import PilotMode
from mavfi_cli.companion.injection import NoInjection
from mavfi_cli.companion.pipeline import ATTEMPTS, Companion, CompanionParts
from mavfi_cli.companion.protection import PASSED, Decision, NoProtection, Response
from mavfi_cli.core.types import Briefing, DepthFrame, Stage, Trajectory, VehicleState
from mavfi_cli.core.wall import WallClock
from mavfi_cli.detect.gate import Alarm
from mavfi_cli.spec.mission import MissionConfig

LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


def vehicle(stamp_s, east_m=0.0):
    return VehicleState(
        stamp_s=stamp_s, position_enu_m=np.array([east_m, 0.0, 5.0]),
        velocity_enu_mps=np.zeros(3), quaternion=LEVEL, yaw_rad=0.0,
    )  # fmt: skip


def frame(stamp_s):
    return DepthFrame(
        stamp_s=stamp_s, depth_m=np.full((24, 32), math.inf), hfov_rad=math.pi / 2.0,
        position_enu_m=np.array([0.0, 0.0, 5.0]), quaternion=LEVEL,
    )  # fmt: skip


class Told(NoProtection):
    """Answers about reports, plans and commands as lists say, then lets everything pass."""

    def __init__(self):
        self.reports, self.plans, self.ticks = [], [], []
        self.judged = []

    def _answer(self, message, answers):
        self.judged.append(message)
        return answers.pop(0) if answers else PASSED

    def report(self, report, stamp_s):
        return self._answer(report, self.reports)

    def plan(self, plan, stamp_s):
        return self._answer(plan, self.plans)

    def tick(self, trajectory, index, command, stamp_s):
        return self._answer(command, self.ticks)


def alarm(response, stage):
    found = Alarm(stage=stage, detector="told", score=9.0, threshold=1.0, states=())
    return Decision(response=response, alarm=found)


@dataclass
class Flown:
    """A companion over open ground that has seen one frame, and its gate."""

    companion: Companion
    gate: Told
    inputs: list  # of control, in the order of its invocations
    now_s: float = 1.0

    def advance(self, seconds):
        self.now_s = round(self.now_s + seconds, 6)
        self.companion.executor.advance(self.now_s)

    def tick(self):
        self.advance(0.02)
        command = self.companion.tick(vehicle(self.now_s))
        self.companion.executor.compute()
        return command

    def follow(self):
        """Follow a plan of 20 m to the east, and send a first command."""
        waypoints = np.zeros((20, 10))
        waypoints[:, 0], waypoints[:, 2], waypoints[:, 4] = np.arange(20.0), 5.0, 2.0
        plan = Trajectory(
            stamp_s=self.now_s, waypoints=waypoints, durations_s=np.full(20, 0.5),
            trajectory_seq=1, future_collision_seq=0,
        )  # fmt: skip
        self.companion.pilot.active.begin(plan, time_s=0.0, rate=1.0)
        self.companion.pilot.mode = PilotMode.FLYING
        return plan, self.tick()


@pytest.fixture
def flown():
    config, gate = MissionConfig(stack="hardened", planner="rrtconnect"), Told()
    briefing = Briefing(
        start_enu_m=np.zeros(3), goal_enu_m=np.array([40.0, 0.0, 5.0]),
        bounds_enu_m=np.array([-5.0, -10.0, 1.0, 45.0, 10.0, 10.0]),
        camera_offset_flu_m=np.zeros(3),
    )  # fmt: skip
    companion = Companion(
        config, CompanionParts.of(config), briefing, WallClock(), NoInjection(), gate,
    )  # fmt: skip
    made = Flown(companion, gate, [])
    companion.executor.nodes["control"].on_start = lambda job, _start_s: made.inputs.append(job)
    made.advance(0.0)
    companion.take_frame(frame(made.now_s))
    made.advance(1.0)
    made.tick()
    assert made.inputs
    return made


def test_a_command_is_first_computed_again_as_before(flown):
    plan, _ = flown.follow()
    flown.gate.ticks = [alarm(Response.RECOMPUTE, Stage.CONTROL)]
    before = len(flown.inputs)
    sent = flown.tick()
    first, again = flown.inputs[before:]
    assert (again.inputs.trajectory, again.fresh) == (first.inputs.trajectory, None)
    assert flown.companion.pilot.active.trajectory is plan
    assert sent is flown.gate.judged[-1]


@pytest.mark.parametrize(
    "stages", [(Stage.PLANNING,), (Stage.CONTROL, Stage.CONTROL)], ids=["waypoint", "second alarm"]
)
def test_then_without_its_waypoint_and_from_the_last_command_on(flown, stages):
    plan, last = flown.follow()
    flown.gate.ticks = [alarm(Response.RECOMPUTE, stage) for stage in stages]
    before = len(flown.inputs)
    flown.tick()
    assert len(flown.inputs) - before == 1 + len(stages)
    again = flown.inputs[-1]
    assert again.inputs.trajectory is flown.companion.pilot.active.trajectory is not plan
    assert (again.fresh.yaw_rad, again.fresh.stamp_s) == (last.yaw_rad, last.stamp_s)


def test_after_so_many_attempts_the_last_command_stays_in_force(flown):
    _, last = flown.follow()
    flown.gate.ticks = [alarm(Response.RECOMPUTE, Stage.CONTROL)] * (1 + ATTEMPTS)
    before = len(flown.inputs)
    assert flown.tick() is last
    assert len(flown.inputs) - before == 1 + ATTEMPTS
    assert flown.tick() is not last


def test_a_command_that_makes_the_vehicle_hold_is_not_recomputed(flown):
    _, last = flown.follow()
    flown.gate.ticks = [alarm(Response.HOLD, Stage.CONTROL)]
    before = len(flown.inputs)
    assert flown.tick() is last
    assert len(flown.inputs) - before == 1
    assert flown.companion.pilot.active.trajectory is None


def test_a_withheld_report_never_reaches_the_pilot_and_perception_looks_anew(flown):
    flown.follow()
    flown.advance(1.0)
    clouds = flown.companion.executor.nodes["point_cloud"]
    known, before = flown.companion.report, clouds.invocations
    flown.gate.reports = [alarm(Response.RECOMPUTE, Stage.PERCEPTION)]
    flown.companion.take_frame(frame(flown.now_s))
    flown.advance(1.0)
    assert clouds.invocations == before + 2
    assert flown.gate.judged.count(flown.companion.report) == 1
    assert flown.companion.report is not known


def test_a_withheld_plan_is_requested_anew(flown):
    counters = flown.companion.pilot.counters
    assert (counters.plans_requested, flown.companion.plans) == (1, [])
    flown.gate.plans = [alarm(Response.RECOMPUTE, Stage.PLANNING)]
    flown.advance(0.5)
    flown.tick()
    assert (counters.plans_requested, counters.plans_rejected) == (2, 1)
    flown.advance(0.5)
    (plan,) = flown.companion.plans
    assert plan is flown.gate.judged[-1]
