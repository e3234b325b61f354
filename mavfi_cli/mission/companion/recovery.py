"""Recovery after an alarm: withholds or recomputes a message, or holds the vehicle.

`Protection` judges and counts messages. This module applies its response to the mission.

    response    report                       plan              active plan          command
    RECOMPUTE   recompute perception         request another   drop the waypoint    recompute it
    HOLD        recompute perception, hold   hold              hold                 hold

Perception recomputes only if the alarm names it. A detector over all stages recomputes control
(paper, section V-D), which happens in the next tick without the report.

If a sequence number of the active plan has changed, but no waypoint, the plan gets its accepted
number back, and a new plan is requested. Mission logic and collision check never see the change.

A vehicle that holds drops the plan, hovers, and plans anew from there. PASS and ACCEPT let the
message take effect. If recomputing a command did not help, or its waypoint is at fault, control
drops that waypoint, takes the next, and resets its state (paper, section V-E).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from mavfi_cli.autonomy.orders import Directive
from mavfi_cli.autonomy.pilot import Pilot
from mavfi_cli.autonomy.tracking import TrackingState
from mavfi_cli.autonomy.trajectory import without_waypoint
from mavfi_cli.core.states import Message
from mavfi_cli.core.types import CollisionReport, Command, Stage, Trajectory, VehicleState
from mavfi_cli.fi.source.activation import Follower
from mavfi_cli.mission.companion.protection import NoProtection, Response

ATTEMPTS = 2  # maximum recomputations of a command in one tick
WITHHELD = (Response.RECOMPUTE, Response.HOLD)


@dataclass(frozen=True, slots=True, kw_only=True)
class Setpoint:
    """A pending command and its inputs."""

    due_s: float  # end of control's computation
    command: Command
    directive: Directive
    waypoint: int  # index in the directive's trajectory
    attempt: int = 0  # number of recomputations
    frame_s: float | None = None  # stamp of a depth frame that no earlier command has used


@dataclass(frozen=True, slots=True, kw_only=True)
class Retry:
    """Inputs for recomputing a withheld command."""

    directive: Directive
    fresh: TrackingState | None  # initial state of the controller; None for its own
    attempt: int


class Recovery:
    """Accepts messages or has them recomputed.

    Args:
        protection: Judges messages; the null object accepts all.
        pilot: Pilot whose plan is dropped, changed or requested.
        follower: Gets withheld messages; None without a fault.
        exchange: Replaces the active plan by a changed version.
        recompute_perception: Has perception recompute from the newest frame.

    Attributes:
        state: Newest vehicle state, from which a holding vehicle plans anew.
    """

    def __init__(
        self,
        protection: NoProtection,
        pilot: Pilot,
        follower: Follower | None,
        exchange: Callable[[Trajectory, Trajectory], None],
        recompute_perception: Callable[[], None],
    ) -> None:
        self._protection = protection
        self._pilot = pilot
        self._follower = follower
        self._exchange = exchange
        self._recompute_perception = recompute_perception
        self._looked: tuple[Trajectory | None, int] = (None, -1)
        self.state: VehicleState | None = None

    def admit_report(self, report: CollisionReport, stamp_s: float) -> bool:
        """Return True if a collision report takes effect."""
        response, stage = self._protection.report(report, stamp_s)
        if response not in WITHHELD:
            return True
        self._withhold(report)
        if stage is Stage.PERCEPTION:
            self._recompute_perception()
        if response is Response.HOLD:
            self._hold()
        return False

    def admit_plan(self, plan: Trajectory, stamp_s: float) -> bool:
        """Return True if a requested plan takes effect. Otherwise request another."""
        response = self._protection.plan(plan, stamp_s)
        if response not in WITHHELD:
            return True
        self._withhold(plan)
        self._pilot.reject_plan()
        if response is Response.HOLD:
            self._hold()
        return False

    def admit_command(
        self, command: Command, setpoint: Setpoint, last: Command | None, stamp_s: float
    ) -> tuple[bool, Retry | None]:
        """Return True if a command is sent, and otherwise the inputs to recompute it in this tick.

        After ATTEMPTS alarms the last command holds until the next tick.

        Args:
            command: Command to send.
            setpoint: Inputs of the command.
            last: Command in force.
        """
        flown = setpoint.directive.trajectory
        response, stage = self._protection.tick(flown, setpoint.waypoint, command, stamp_s)
        if response not in WITHHELD:
            return True, None
        self._withhold(command)
        if response is Response.HOLD:
            self._hold()
            return False, None
        if stage is Stage.PLANNING:
            self._pilot.want_plan()
        if setpoint.attempt >= ATTEMPTS:
            return False, None
        drop = stage is Stage.PLANNING or setpoint.attempt > 0
        return False, self._retry(setpoint, last if drop else None, drop=drop)

    def _retry(self, setpoint: Setpoint, last: Command | None, *, drop: bool) -> Retry:
        """Return the inputs to recompute, unchanged or without the waypoint."""
        directive = setpoint.directive
        if drop and directive.trajectory is not None:
            bridged = self._drop(directive.trajectory, setpoint.waypoint)
            directive = replace(directive, trajectory=bridged)
        fresh = None if last is None else TrackingState(yaw_rad=last.yaw_rad, stamp_s=last.stamp_s)
        return Retry(directive=directive, fresh=fresh, attempt=setpoint.attempt + 1)

    def look_round(self, stamp_s: float, unharmed: Trajectory) -> None:
        """Judge changes of the active plan since the last tick, before the mission logic uses it.

        A new plan or a new waypoint triggers a check of the whole plan ahead. In between, each tick
        checks the present waypoint only, because 50 checks of the whole plan per second would cost
        an order of magnitude more.

        Args:
            stamp_s: Present stamp, s.
            unharmed: Plan before this tick's strike, which the gate has already judged.
        """
        if self._pilot.active.trajectory is None:
            return
        at, (seen, seen_at) = self._pilot.active.waypoint, self._looked
        if self._pilot.active.trajectory is not seen or at != seen_at:
            known = unharmed is seen and at == seen_at
            self.look_ahead(stamp_s, at if known else None)
        self._looked = (self._pilot.active.trajectory, at)

    def look_ahead(self, stamp_s: float, only: int | None = None) -> None:
        """Drop anomalous waypoints of the plan ahead before other nodes use them.

        Args:
            stamp_s: Present stamp, s.
            only: Drop this waypoint only.
        """
        pilot = self._pilot
        while pilot.active.trajectory is not None:
            flown = pilot.active.trajectory
            response, alarm = self._protection.ahead(flown, pilot.active.waypoint, only, stamp_s)
            if response is Response.HOLD:
                self._hold()
            elif response is Response.RECOMPUTE and alarm is not None:
                if alarm.mended is not None:
                    self._replace(flown, alarm.mended)
                else:
                    assert alarm.waypoint is not None
                    self._drop(flown, alarm.waypoint)
                if alarm.stage is Stage.PLANNING:
                    pilot.want_plan()
                if pilot.active.trajectory is not flown:
                    continue
            return

    def _drop(self, flown: Trajectory, waypoint: int) -> Trajectory:
        """Drop a waypoint from the active plan and return the new plan."""
        bridged = without_waypoint(flown, waypoint)
        self._replace(flown, bridged)
        return bridged

    def _replace(self, flown: Trajectory, mended: Trajectory) -> None:
        self._withhold(flown)
        self._exchange(flown, mended)

    def _hold(self) -> None:
        if self.state is not None:
            self._pilot.abandon(self.state)

    def _withhold(self, message: Message) -> None:
        if self._follower is not None:
            self._follower.withheld(message)
