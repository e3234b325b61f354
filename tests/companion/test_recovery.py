"""What an alarm does to the mission, with a gate that answers as it is told."""

import numpy as np
import pytest

from mavfi_cli.autonomy.pilot import Pilot, PilotMode, PilotParams
from mavfi_cli.companion.protection import PASSED, Decision, NoProtection, Recovery, Response
from mavfi_cli.core.types import CollisionReport, Command, Stage, Trajectory, VehicleState
from mavfi_cli.detect.gate import Alarm
from mavfi_cli.fi.injector import Follower

STATE = VehicleState(
    stamp_s=1.0, position_enu_m=np.array([1.4, 0.0, 0.0]), velocity_enu_mps=np.zeros(3),
    quaternion=np.array([1.0, 0.0, 0.0, 0.0]), yaw_rad=0.5,
)  # fmt: skip
REPORT = CollisionReport(
    stamp_s=1.0, collision=False, time_to_collision_s=np.inf, future_collision_seq=0
)
COMMAND = Command(stamp_s=1.0, velocity_enu_mps=np.ones(3), yaw_rad=0.25)


def a_plan():
    waypoints = np.zeros((6, 10))
    waypoints[:, 0] = np.arange(6.0)
    waypoints[:, 4] = 2.0
    return Trajectory(
        stamp_s=0.0, waypoints=waypoints, durations_s=np.full(6, 0.5), trajectory_seq=1,
        future_collision_seq=0,
    )  # fmt: skip


def decision(response, stage=Stage.CONTROL, waypoint=None):
    alarm = Alarm(
        stage=stage, detector="told", score=9.0, threshold=1.0, states=(), waypoint=waypoint
    )
    return Decision(response=response, alarm=alarm)


class Told(NoProtection):
    """Finds bad waypoints as a list says, then none."""

    def __init__(self, ahead=()):
        self.rest = list(ahead)
        self.looked = []

    def ahead(self, plan, first, only, stamp_s):
        self.looked.append((plan, only))
        if not self.rest:
            return PASSED
        return decision(Response.RECOMPUTE, waypoint=self.rest.pop(0))


class Flying:
    """A recovery and the pilot that it acts on."""

    def __init__(self, protection=None):
        self.pilot = Pilot(PilotParams(), np.array([40.0, 0.0, 5.0]))
        self.pilot.update(1.0, STATE)
        self.plan = a_plan()
        self.pilot.active.begin(self.plan, time_s=0.7, rate=1.0)
        self.pilot.mode = PilotMode.FLYING
        self.looks = 0
        self.recovery = Recovery(protection or Told(), self.pilot, Follower(), self.see_again)
        self.recovery.state = STATE

    def see_again(self):
        self.looks += 1


@pytest.mark.parametrize(("stage", "looks"), [(Stage.PERCEPTION, 1), (Stage.CONTROL, 0)])
def test_perception_looks_anew_only_where_the_alarm_is_its_own(stage, looks):
    flying = Flying()
    flying.recovery.recover(REPORT, decision(Response.RECOMPUTE, stage))
    assert flying.looks == looks
    assert flying.pilot.active.trajectory is flying.plan


def test_a_withheld_plan_is_rejected():
    flying = Flying()
    flying.recovery.recover(a_plan(), decision(Response.RECOMPUTE, Stage.PLANNING))
    assert flying.pilot.counters.plans_rejected == 1
    assert flying.pilot.active.trajectory is flying.plan


@pytest.mark.parametrize("message", [a_plan(), COMMAND], ids=["plan", "command"])
def test_to_hold_is_to_give_up_the_plan_and_hover(message):
    flying = Flying()
    flying.recovery.recover(message, decision(Response.HOLD))
    assert flying.pilot.active.trajectory is None
    assert flying.pilot.mode is PilotMode.WAITING


def test_a_dropped_waypoint_is_bridged_in_the_active_plan_and_needs_no_new_check():
    flying = Flying()
    flying.plan.waypoints[1, 1] = 1.0
    flying.pilot.active.checked = flying.plan
    bridged = flying.recovery.drop(flying.plan, 1)
    assert bridged is flying.pilot.active.trajectory is flying.pilot.active.checked
    assert bridged.waypoints[1, 0:3].tolist() == [1.0, 0.0, 0.0]  # as waypoint 2 comes from


def test_every_bad_waypoint_ahead_is_dropped():
    gate = Told(ahead=[2, 4])
    flying = Flying(gate)
    flying.recovery.judge_ahead(1.0)
    seen = [plan for plan, _ in gate.looked]
    assert len(seen) == len({id(plan) for plan in seen}) == 3
    assert seen[0] is flying.plan
    assert seen[2] is flying.pilot.active.trajectory


def test_between_waypoints_a_plan_that_was_seen_is_not_looked_through_again():
    gate = Told()
    flying = Flying(gate)
    flying.recovery.judge_changes(1.0, flying.plan)
    flying.recovery.judge_changes(1.02, flying.plan)
    assert gate.looked == [(flying.plan, None)]
    flying.pilot.active.trajectory = struck = a_plan()
    flying.recovery.judge_changes(1.04, flying.plan)
    assert gate.looked[1:] == [(struck, 1)]  # a strike: only the waypoint that is followed
    flying.pilot.active.time_s = 1.2
    flying.recovery.judge_changes(1.06, struck)
    assert gate.looked[2:] == [(struck, None)]
