"""What follows an alarm: a message is withheld, computed again, or the vehicle holds.

`Protection` judges a message and counts; this is what its answer does to the mission.

    answer      report             plan               plan that is flown   command
    RECOMPUTE   look anew          ask for another    drop the waypoint    compute it again
    HOLD        look anew, hold    hold               hold                 hold

Perception looks anew where the alarm is its own. That of a detector over all stages recomputes
control (section V-D), which it does in the next tick, without the report.

Where a number of the flown plan has changed, and not a waypoint, the plan gets back the number that
was accepted, and another one is asked for. The mission logic and the collision check never see it.

To hold is to give the plan up, hover, and plan anew from there. PASS and ACCEPT let the message
take effect. Where computing a command again did not help, or its waypoint is to blame, control
drops that waypoint, takes the next, and begins afresh (paper, section V-E).
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

ATTEMPTS = 2  # a command is computed again in one tick
WITHHELD = (Response.RECOMPUTE, Response.HOLD)


@dataclass(frozen=True, slots=True, kw_only=True)
class Setpoint:
    """A command on its way, and what it was computed from."""

    due_s: float  # when control has computed it
    command: Command
    directive: Directive
    waypoint: int  # of the directive's trajectory
    attempt: int = 0  # how often it was computed again
    frame_s: float | None = None  # of a depth frame whose verdict no earlier command knew


@dataclass(frozen=True, slots=True, kw_only=True)
class Retry:
    """How control computes a withheld command again."""

    directive: Directive
    fresh: TrackingState | None  # the controller begins from this; None: from its own state
    attempt: int


class Recovery:
    """Lets messages pass or has them computed again.

    Args:
        protection: judges; the null object lets everything pass.
        pilot: whose plan is dropped, changed or asked for.
        follower: is told which message was withheld; None where no fault is followed.
        exchange: puts a changed version of a plan in the place of the one that is flown.
        look_anew: has perception compute again, from the newest frame.

    Attributes:
        state: the vehicle's newest state, from which a vehicle that holds plans anew.
    """

    def __init__(
        self,
        protection: NoProtection,
        pilot: Pilot,
        follower: Follower | None,
        exchange: Callable[[Trajectory, Trajectory], None],
        look_anew: Callable[[], None],
    ) -> None:
        self._protection = protection
        self._pilot = pilot
        self._follower = follower
        self._exchange = exchange
        self._look_anew = look_anew
        self._looked: tuple[Trajectory | None, int] = (None, -1)
        self.state: VehicleState | None = None

    def admit_report(self, report: CollisionReport, stamp_s: float) -> bool:
        """Whether perception's message takes effect."""
        response, stage = self._protection.report(report, stamp_s)
        if response not in WITHHELD:
            return True
        self._withhold(report)
        if stage is Stage.PERCEPTION:
            self._look_anew()
        if response is Response.HOLD:
            self._hold()
        return False

    def admit_plan(self, plan: Trajectory, stamp_s: float) -> bool:
        """Whether an awaited plan takes effect; else another one has been asked for."""
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
        """Whether a command goes out, and if not, how control tries again in this tick.

        What raises an alarm ATTEMPTS times leaves the last command in force until the next tick.

        Args:
            command: as it would go out.
            setpoint: what control computed it from.
            last: the command that is in force.
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
        """Compute again as before; or without the waypoint, from the last command on."""
        directive = setpoint.directive
        if drop and directive.trajectory is not None:
            bridged = self._drop(directive.trajectory, setpoint.waypoint)
            directive = replace(directive, trajectory=bridged)
        fresh = None if last is None else TrackingState(yaw_rad=last.yaw_rad, stamp_s=last.stamp_s)
        return Retry(directive=directive, fresh=fresh, attempt=setpoint.attempt + 1)

    def look_round(self, stamp_s: float, unharmed: Trajectory) -> None:
        """Before the mission logic works with the flown plan: what has changed since the last tick?

        With a new plan, or a waypoint that is begun, the whole way ahead is looked through. In
        between only the waypoint that is followed is watched, in every tick: looking through the
        whole plan 50 times a second would be another order of cost.

        Args:
            unharmed: the plan before this tick's strike; the gate has seen that one already.
        """
        if self._pilot.flown.trajectory is None:
            return
        at, (seen, seen_at) = self._pilot.flown.waypoint, self._looked
        if self._pilot.flown.trajectory is not seen or at != seen_at:
            known = unharmed is seen and at == seen_at
            self.look_ahead(stamp_s, at if known else None)
        self._looked = (self._pilot.flown.trajectory, at)

    def look_ahead(self, stamp_s: float, only: int | None = None) -> None:
        """Drop what the gate finds wrong on the way ahead, before others take it for true.

        Args:
            only: nothing but this waypoint is dropped.
        """
        pilot = self._pilot
        while pilot.flown.trajectory is not None:
            flown = pilot.flown.trajectory
            response, alarm = self._protection.ahead(flown, pilot.flown.waypoint, only, stamp_s)
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
                if pilot.flown.trajectory is not flown:
                    continue
            return

    def _drop(self, flown: Trajectory, waypoint: int) -> Trajectory:
        """The plan without a waypoint, which is flown from now on."""
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
