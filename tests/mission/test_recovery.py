"""What an alarm does to the mission, with a gate that answers as it is told."""

import numpy as np
import pytest

from mavfi_cli.autonomy.orders import PilotMode
from mavfi_cli.autonomy.pilot import Pilot, PilotParams
from mavfi_cli.core.types import CollisionReport, Command, Stage, Trajectory, VehicleState
from mavfi_cli.detect.gate import Alarm
from mavfi_cli.fi.source.activation import Follower
from mavfi_cli.mission.companion.protection import NoProtection, Response
from mavfi_cli.mission.companion.recovery import ATTEMPTS, Recovery, Setpoint

STATE = VehicleState(
    stamp_s=1.0, position_enu_m=np.array([1.4, 0.0, 0.0]), velocity_enu_mps=np.zeros(3),
    quaternion=np.array([1.0, 0.0, 0.0, 0.0]), yaw_rad=0.5,
)  # fmt: skip
REPORT = CollisionReport(
    stamp_s=1.0, collision=False, time_to_collision_s=np.inf, future_collision_seq=0
)
COMMAND = Command(stamp_s=1.0, velocity_enu_mps=np.ones(3), yaw_rad=0.25)
LAST = Command(stamp_s=0.98, velocity_enu_mps=np.zeros(3), yaw_rad=0.125)


def a_plan():
    waypoints = np.zeros((6, 10))
    waypoints[:, 0] = np.arange(6.0)
    waypoints[:, 4] = 2.0
    return Trajectory(
        stamp_s=0.0, waypoints=waypoints, durations_s=np.full(6, 0.5), trajectory_seq=1,
        future_collision_seq=0,
    )  # fmt: skip


class Told(NoProtection):
    """Gives one answer to everything, and to looks ahead those of a list, then PASS."""

    def __init__(self, answer, stage=Stage.CONTROL, ahead=()):
        self.answer, self.stage, self.rest = answer, stage, list(ahead)
        self.looked = []

    def report(self, report, stamp_s):
        return self.answer, self.stage

    def tick(self, trajectory, index, command, stamp_s):
        return self.answer, self.stage

    def ahead(self, plan, first, only, stamp_s):
        self.looked.append((plan, only))
        if not self.rest:
            return Response.PASS, None
        alarm = Alarm(
            stage=self.stage, detector="told", score=9.0, threshold=1.0, states=(),
            waypoint=self.rest.pop(0),
        )  # fmt: skip
        return Response.RECOMPUTE, alarm


class Desk:
    """A recovery, the pilot that it acts on, and what it exchanged."""

    def __init__(self, protection):
        self.pilot = Pilot(PilotParams(), np.array([40.0, 0.0, 5.0]))
        self.pilot.update(1.0, STATE)
        self.plan = a_plan()
        self.pilot.active.begin(self.plan, time_s=0.7, rate=1.0)
        self.pilot.mode = PilotMode.FLYING
        self.exchanged = []
        self.follower = Follower()
        self.looks = 0
        self.recovery = Recovery(
            protection, self.pilot, self.follower, self.exchange, self.recompute_perception
        )
        self.recovery.state = STATE

    def recompute_perception(self):
        self.looks += 1

    def exchange(self, flown, changed):
        self.exchanged.append((flown, changed))
        if self.pilot.active.trajectory is flown:
            self.pilot.active.trajectory = changed

    def command(self, attempt=0):
        directive = self.pilot.update(1.0, STATE)
        setpoint = Setpoint(
            due_s=1.0, command=COMMAND, directive=directive, waypoint=1, attempt=attempt
        )
        return self.recovery.admit_command(COMMAND, setpoint, LAST, 1.0)


@pytest.mark.parametrize("answer", [Response.PASS, Response.ACCEPT])
def test_what_passes_changes_nothing(answer):
    desk = Desk(Told(answer))
    assert desk.recovery.admit_report(REPORT, 1.0)
    assert desk.command() == (True, None)
    assert desk.pilot.active.trajectory is desk.plan
    assert desk.exchanged == []


@pytest.mark.parametrize(("stage", "looks"), [(Stage.PERCEPTION, 1), (Stage.CONTROL, 0)])
def test_perception_looks_anew_only_where_the_alarm_is_its_own(stage, looks):
    desk = Desk(Told(Response.RECOMPUTE, stage))
    assert not desk.recovery.admit_report(REPORT, 1.0)
    assert desk.looks == looks
    assert desk.pilot.active.trajectory is desk.plan


def test_to_hold_is_to_give_up_the_plan_and_hover():
    desk = Desk(Told(Response.HOLD))
    assert not desk.recovery.admit_report(REPORT, 1.0)
    assert desk.pilot.active.trajectory is None
    assert desk.pilot.mode is PilotMode.WAITING


def test_a_command_is_first_computed_again_as_before():
    desk = Desk(Told(Response.RECOMPUTE))
    passes, retry = desk.command()
    assert not passes
    assert (retry.directive.trajectory, retry.fresh, retry.attempt) == (desk.plan, None, 1)
    assert desk.exchanged == []


@pytest.mark.parametrize(("stage", "attempt"), [(Stage.CONTROL, 1), (Stage.PLANNING, 0)])
def test_then_without_its_waypoint_and_from_the_last_command_on(stage, attempt):
    desk = Desk(Told(Response.RECOMPUTE, stage))
    desk.plan.waypoints[1, 1] = 1.0
    passes, retry = desk.command(attempt)
    assert not passes
    ((flown, bridged),) = desk.exchanged
    assert flown is desk.plan
    assert retry.directive.trajectory is bridged is desk.pilot.active.trajectory
    assert bridged.waypoints[1, 0:3].tolist() == [1.0, 0.0, 0.0]  # as waypoint 2 comes from
    assert (retry.fresh.yaw_rad, retry.fresh.stamp_s) == (LAST.yaw_rad, LAST.stamp_s)
    assert retry.attempt == attempt + 1


def test_after_so_many_attempts_the_last_command_stays_in_force():
    desk = Desk(Told(Response.RECOMPUTE))
    assert desk.command(ATTEMPTS) == (False, None)


def test_every_bad_waypoint_ahead_is_dropped():
    desk = Desk(Told(Response.PASS, ahead=[2, 4]))
    desk.recovery.look_ahead(1.0)
    assert len(desk.exchanged) == 2
    assert desk.exchanged[0][1] is desk.exchanged[1][0]
    assert desk.pilot.active.trajectory is desk.exchanged[1][1]


def test_between_waypoints_a_plan_that_was_seen_is_not_looked_through_again():
    gate = Told(Response.PASS)
    desk = Desk(gate)
    desk.recovery.look_round(1.0, desk.plan)
    desk.recovery.look_round(1.02, desk.plan)
    assert gate.looked == [(desk.plan, None)]
    desk.pilot.active.trajectory = struck = a_plan()
    desk.recovery.look_round(1.04, desk.plan)
    assert gate.looked[1:] == [(struck, 1)]  # a strike: only the waypoint that is followed
    desk.pilot.active.time_s = 1.2
    desk.recovery.look_round(1.06, struck)
    assert gate.looked[2:] == [(struck, None)]
