"""Recovery after an alarm: recomputes the stage of a withheld message, or holds the vehicle.

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

from mavfi_cli.autonomy.pilot import Pilot
from mavfi_cli.autonomy.trajectory import without_waypoint
from mavfi_cli.companion.protection import Decision, NoProtection, Response
from mavfi_cli.core.states import Message
from mavfi_cli.core.types import CollisionReport, Stage, Trajectory, VehicleState
from mavfi_cli.fi.source.injector import Follower


class Recovery:
    """Acts on the pilot and its active plan after alarms.

    Attributes:
        state: Newest vehicle state, from which a holding vehicle plans anew.
    """

    def __init__(
        self,
        protection: NoProtection,
        pilot: Pilot,
        follower: Follower,
        recompute_perception: Callable[[], None],
    ) -> None:
        self._protection = protection
        self._pilot = pilot
        self._follower = follower
        self._recompute_perception = recompute_perception
        self._looked: tuple[Trajectory | None, int] = (None, -1)
        self.state: VehicleState | None = None

    def recover(self, withheld: Message, decision: Decision) -> None:
        """Request what a withheld message needs; a command is recomputed by its sender."""
        self._follower.withheld(withheld)
        if isinstance(withheld, Trajectory):
            self._pilot.reject_plan()
        elif isinstance(withheld, CollisionReport):
            if decision.blames(Stage.PERCEPTION):
                self._recompute_perception()
        elif decision.response is Response.RECOMPUTE and decision.blames(Stage.PLANNING):
            self._pilot.want_plan()
        if decision.response is Response.HOLD:
            self._hold()

    def look_round(self, stamp_s: float, unharmed: Trajectory) -> None:
        """Judge changes of the active plan since the last tick, before the mission logic uses it.

        A new plan or a new waypoint triggers a check of the whole plan ahead. In between, each tick
        checks the present waypoint only, because 50 checks of the whole plan per second would cost
        an order of magnitude more.

        Args:
            unharmed: Plan before this tick's strike, which the gate has already judged.
        """
        active, (seen, seen_at) = self._pilot.active, self._looked
        if active.trajectory is None:
            return
        at = active.waypoint
        if active.trajectory is not seen or at != seen_at:
            known = unharmed is seen and at == seen_at
            self.look_ahead(stamp_s, at if known else None)
        self._looked = (active.trajectory, at)

    def look_ahead(self, stamp_s: float, only: int | None = None) -> None:
        """Drop anomalous waypoints of the plan ahead before other nodes use them."""
        active = self._pilot.active
        while (flown := active.trajectory) is not None:
            decision = self._protection.ahead(flown, active.waypoint, only, stamp_s)
            alarm = decision.alarm
            if decision.response is Response.HOLD:
                self._hold()
            elif decision.response is Response.RECOMPUTE and alarm is not None:
                if alarm.mended is not None:
                    self._replace(flown, alarm.mended)
                else:
                    assert alarm.waypoint is not None
                    self.drop(flown, alarm.waypoint)
                if alarm.stage is Stage.PLANNING:
                    self._pilot.want_plan()
                if active.trajectory is not flown:
                    continue
            return

    def drop(self, flown: Trajectory, waypoint: int) -> Trajectory:
        """Drop a waypoint from a plan, also where it is the active one. Return the new plan."""
        bridged = without_waypoint(flown, waypoint)
        self._replace(flown, bridged)
        return bridged

    def _replace(self, flown: Trajectory, mended: Trajectory) -> None:
        self._follower.withheld(flown)
        self._pilot.active.exchange(flown, mended)

    def _hold(self) -> None:
        if self.state is not None:
            self._pilot.abandon(self.state)
