"""The mission's state machine, driven by hand, one tick of 20 ms after the other."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavfi_cli.autonomy.pilot import Pilot, PilotMode, PilotParams, PlanFailure
from mavfi_cli.core.types import CollisionReport, Trajectory, VehicleState

TICK_S = 0.02
GOAL = np.array([40.0, 0.0, 5.0])
P = PilotParams()


def state(x=0.0, y=0.0, z=5.0, yaw=0.0):
    return VehicleState(
        stamp_s=0.0, position_enu_m=np.array([x, y, z]), velocity_enu_mps=np.zeros(3),
        quaternion=np.array([1.0, 0.0, 0.0, 0.0]), yaw_rad=yaw,
    )  # fmt: skip


def straight(request, speed=2.0, count=40, **changes):
    """A plan as asked for: east at one speed, waypoints every 0.5 s."""
    waypoints = np.zeros((count, 10))
    waypoints[:, 0:3] = request.position_enu_m
    waypoints[:, 0] += 0.5 * speed * np.arange(count)
    waypoints[:, 4] = speed
    plan = Trajectory(
        stamp_s=request.stamp_s, waypoints=waypoints, durations_s=np.full(count, 0.5),
        trajectory_seq=request.trajectory_seq + 1,
        future_collision_seq=request.future_collision_seq,
    )  # fmt: skip
    return replace(plan, **changes)


class Driver:
    """A pilot, a clock, and a vehicle that is where the trajectory says."""

    def __init__(self, **params):
        self.pilot = Pilot(PilotParams(**params), GOAL)
        self.now_s = 1.0
        self.last = None
        self.requests = []

    def tick(self, count=1, at=None):
        for _ in range(count):
            self.now_s = round(self.now_s + TICK_S, 6)
            tracked, request = self.pilot.update(self.now_s, self.vehicle() if at is None else at)
            self.last = SimpleNamespace(mode=self.pilot.mode, tracking=tracked, plan=request)
            if self.last.plan is not None:
                self.requests.append(self.last.plan)
        return self.last

    def until(self, condition, ticks=3000):
        for _ in range(ticks):
            if condition(self.tick()):
                return self.last
        raise AssertionError(f"never came, mode {self.pilot.mode}")

    def vehicle(self):
        if self.last is None:
            return state()
        if self.last.tracking.trajectory is None:
            return state(*self.last.tracking.hold_enu_m)
        waypoints = self.last.tracking.trajectory.waypoints
        done_m = self.last.tracking.time_s * waypoints[0, 4]
        return state(waypoints[0, 0] + done_m, waypoints[0, 1], waypoints[0, 2])

    def fly(self, speed=2.0, ticks=50, **changes):
        """Take off on a first plan and come up to speed; the plan."""
        self.tick()
        plan = straight(self.requests[-1], speed, **changes)
        self.pilot.on_plan(plan)
        self.tick(ticks)
        assert self.pilot.mode is PilotMode.FLYING
        return plan

    def foresee(self, time_s, seq=1, age_s=0.0):
        self.pilot.on_report(
            CollisionReport(
                stamp_s=self.now_s - age_s, collision=True, time_to_collision_s=time_s,
                future_collision_seq=seq,
            )
        )  # fmt: skip
        return self.pilot.mode


@pytest.fixture
def driver():
    return Driver()


# Planning from a hover -----------------------------------------------------------------------


def test_it_hovers_where_it_is_and_asks_for_a_plan_once(driver):
    directive = driver.tick(10, at=state(3.0, 4.0, 5.0))
    assert directive.mode is PilotMode.WAITING
    assert directive.tracking.trajectory is None
    np.testing.assert_array_equal(directive.tracking.hold_enu_m, [3.0, 4.0, 5.0])
    (request,) = driver.requests
    assert request.stamp_s == 1.02
    np.testing.assert_array_equal(request.position_enu_m, [3.0, 4.0, 5.0])
    np.testing.assert_array_equal(request.velocity_enu_mps, np.zeros(3))
    np.testing.assert_array_equal(request.goal_enu_m, GOAL)
    assert (request.attempt, request.trajectory_seq, request.future_collision_seq) == (1, 0, 0)


def test_a_plan_from_a_hover_may_be_late_and_begins_at_its_beginning(driver):
    driver.tick()
    plan = straight(driver.requests[0])
    driver.tick(500)
    driver.pilot.on_plan(plan)
    directive = driver.tick()
    assert directive.tracking.trajectory is plan
    assert directive.mode is PilotMode.FLYING
    assert directive.tracking.rate == 1.0
    assert 0.0 <= directive.tracking.time_s <= TICK_S


def test_the_clock_of_the_trajectory_runs_with_time(driver):
    driver.fly(ticks=50)
    before = driver.last.tracking.time_s
    assert driver.tick(50).tracking.time_s == pytest.approx(before + 1.0)


def test_a_trajectory_that_ends_short_of_the_goal_asks_for_the_next(driver):
    plan = driver.fly(count=4)
    driver.until(lambda d: d.mode is PilotMode.WAITING)
    assert driver.now_s == pytest.approx(1.02 + plan.duration_s, abs=0.05)
    assert len(driver.requests) == 2
    assert driver.last.tracking.hold_enu_m[0] == pytest.approx(4.0)  # the end: 3 m + 0.5 s at 2 m/s


def test_arrival_within_the_tolerance_ends_everything(driver):
    driver.fly()
    near = state(GOAL[0] - P.goal_tolerance_m, GOAL[1], GOAL[2])
    just_out = state(GOAL[0] - P.goal_tolerance_m - 1e-6, GOAL[1], GOAL[2])
    far_driver = Driver(tracking_error_max_m=100.0)
    far_driver.fly()
    assert far_driver.tick(at=just_out).mode is PilotMode.FLYING
    directive = far_driver.tick(at=near)
    assert directive.mode is PilotMode.ARRIVED
    assert directive.tracking.trajectory is None
    np.testing.assert_array_equal(directive.tracking.hold_enu_m, GOAL)
    assert far_driver.tick(100, at=state()).mode is PilotMode.ARRIVED
    assert len(far_driver.requests) == 1


def test_after_arrival_no_message_moves_it(driver):
    driver.tick()
    driver.tick(at=state(*GOAL))
    driver.pilot.on_plan(PlanFailure(stamp_s=driver.now_s, reason="too late"))
    assert driver.foresee(0.0, seq=9) is PilotMode.ARRIVED
    assert driver.tick(10).mode is PilotMode.ARRIVED


# Collisions foreseen -------------------------------------------------------------------------

BRAKE_S = 2.0 / P.brake_mps2 + P.margin_s  # at 2 m/s and full rate
SLOW_S = BRAKE_S + P.plan_lead_s + P.late_plan_s


@pytest.mark.parametrize(
    ("time_s", "mode"),
    [
        (math.inf, PilotMode.EVADING),
        (math.nextafter(SLOW_S, math.inf), PilotMode.EVADING),
        (SLOW_S, PilotMode.SLOWING),
        (math.nextafter(BRAKE_S, math.inf), PilotMode.SLOWING),
        (BRAKE_S, PilotMode.STOPPING),
        (0.0, PilotMode.STOPPING),
        (-5.0, PilotMode.STOPPING),
        (-math.inf, PilotMode.STOPPING),
        (math.nan, PilotMode.STOPPING),
    ],
)
def test_go_on_slow_down_or_stop_to_the_last_bit(driver, time_s, mode):
    driver.fly(speed=2.0)
    assert driver.foresee(time_s) is mode


def test_the_time_since_the_report_is_taken_off(driver):
    driver.fly(speed=2.0)
    assert driver.foresee(SLOW_S + 0.05, age_s=0.1) is PilotMode.SLOWING


def test_faster_flight_stops_earlier():
    for speed, mode in ((1.0, PilotMode.SLOWING), (3.0, PilotMode.STOPPING)):
        driver = Driver()
        driver.fly(speed=speed)
        assert driver.foresee(1.0) is mode


def test_it_only_gets_more_careful(driver):
    driver.fly()
    modes = [driver.foresee(t) for t in (9.0, 1.5, 9.0, 0.1, 9.0)]
    assert modes == [
        PilotMode.EVADING,
        PilotMode.SLOWING,
        PilotMode.SLOWING,
        PilotMode.STOPPING,
        PilotMode.STOPPING,
    ]
    counters = driver.pilot.counters
    assert (counters.collisions_foreseen, counters.slowdowns, counters.stops) == (1, 1, 1)


def test_evading_goes_on_at_full_speed_and_plans_from_ahead(driver):
    plan = driver.fly(speed=2.0)
    driver.foresee(9.0)
    directive = driver.tick()
    assert directive.tracking.rate == 1.0
    request = driver.requests[-1]
    assert request.stamp_s == pytest.approx(driver.now_s + P.plan_lead_s)
    ahead_m = 2.0 * (directive.tracking.time_s + P.plan_lead_s)
    assert request.position_enu_m[0] == pytest.approx(plan.waypoints[0, 0] + ahead_m)
    assert request.velocity_enu_mps[0] == pytest.approx(2.0)
    assert request.future_collision_seq == 1


def test_slowing_ramps_to_the_slow_rate_within_the_braking_limit(driver):
    driver.fly(speed=2.0)
    driver.foresee(SLOW_S)
    rates = [driver.tick().tracking.rate for _ in range(100)]
    steps = -np.diff([1.0, *rates])
    assert steps.max() * 2.0 <= P.brake_mps2 * TICK_S + 1e-9
    assert rates[-1] == pytest.approx(P.slow_rate)
    assert driver.last.tracking.rate_change_per_s == 0.0


def test_stopping_stands_within_the_braking_distance_then_plans_from_there(driver):
    plan = driver.fly(speed=2.0)
    begun_m = driver.vehicle().position_enu_m[0]
    driver.foresee(0.0)
    begun_s = driver.now_s
    driver.until(lambda d: d.mode is PilotMode.WAITING)
    assert driver.now_s - begun_s == pytest.approx(2.0 / P.brake_mps2, abs=2 * TICK_S)
    way_m = driver.last.tracking.hold_enu_m[0] - begun_m
    assert way_m == pytest.approx(2.0**2 / (2.0 * P.brake_mps2), abs=0.05)
    assert driver.last.tracking.trajectory is None
    assert plan.waypoints[0, 1] == driver.last.tracking.hold_enu_m[1]
    request = driver.requests[-1]
    np.testing.assert_array_equal(request.position_enu_m, driver.last.tracking.hold_enu_m)
    np.testing.assert_array_equal(request.velocity_enu_mps, np.zeros(3))


def test_no_plan_is_asked_for_while_braking(driver):
    driver.fly(speed=2.0)
    driver.foresee(0.0)
    asked = len(driver.requests)
    while driver.tick().mode is PilotMode.STOPPING:
        assert len(driver.requests) == asked
    assert len(driver.requests) == asked + 1


def test_a_stale_report_is_ignored(driver):
    driver.fly()
    driver.foresee(9.0, seq=5)
    assert driver.foresee(0.0, seq=4) is PilotMode.EVADING
    assert driver.pilot.counters.reports_ignored == 1


def test_a_report_without_a_collision_changes_nothing(driver):
    driver.fly()
    driver.pilot.on_report(
        CollisionReport(stamp_s=driver.now_s, collision=False, time_to_collision_s=0.0,
                        future_collision_seq=7)
    )  # fmt: skip
    assert driver.tick().mode is PilotMode.FLYING
    assert len(driver.requests) == 1


@pytest.mark.parametrize("uses", [True, False])
def test_the_time_to_collision_counts_as_read_only_if_it_is_used(uses):
    driver = Driver(uses_time_to_collision=uses)
    driver.fly()
    report = CollisionReport(stamp_s=driver.now_s, collision=True, time_to_collision_s=9.0,
                             future_collision_seq=1)  # fmt: skip
    assert driver.pilot.on_report(report) is uses
    assert driver.pilot.mode is (PilotMode.EVADING if uses else PilotMode.STOPPING)


# Plans in flight -----------------------------------------------------------------------------


def evading(driver):
    driver.fly()
    driver.foresee(9.0)
    driver.tick()
    return driver.requests[-1]


def test_the_next_plan_takes_over_at_its_own_stamp_without_a_jump(driver):
    request = evading(driver)
    plan = straight(request)
    driver.tick(4)
    driver.pilot.on_plan(plan)
    before = driver.last
    while driver.last.tracking.trajectory is not plan:
        before = driver.last
        driver.tick()
    assert driver.now_s - TICK_S < request.stamp_s <= driver.now_s
    assert driver.last.mode is PilotMode.FLYING
    old_x = before.tracking.trajectory.waypoints[0, 0] + 2.0 * before.tracking.time_s
    assert plan.waypoints[0, 0] + 2.0 * driver.last.tracking.time_s == pytest.approx(
        old_x + 2.0 * TICK_S
    )
    assert driver.pilot.counters.replans == 1


def test_a_late_plan_is_entered_where_it_should_be_by_now(driver):
    request = evading(driver)
    driver.tick(round((P.plan_lead_s + 0.3) / TICK_S))
    plan = straight(request)
    driver.pilot.on_plan(plan)
    directive = driver.tick()
    assert directive.tracking.trajectory is plan
    assert directive.tracking.time_s == pytest.approx(driver.now_s - request.stamp_s, abs=1e-9)


@pytest.mark.parametrize(("asked_after", "answered_after"), [(100, 1), (5, 10)])
def test_a_plan_made_while_slowing_goes_on_at_the_velocity_that_it_has(
    driver, asked_after, answered_after
):
    """The plan departs at the slowed velocity: at rate 1, or less where it slowed on meanwhile."""
    driver.fly(speed=2.0)
    driver.foresee(SLOW_S)
    driver.pilot._wanted = False
    driver.tick(asked_after)
    driver.pilot._wanted = True
    driver.tick()
    request = driver.requests[-1]
    speed = float(request.velocity_enu_mps[0])
    assert speed == pytest.approx(2.0 * driver.last.tracking.rate)
    driver.tick(answered_after)
    plan = straight(request, speed=speed)
    driver.pilot.on_plan(plan)
    before = driver.last
    while driver.last.tracking.trajectory is not plan:
        before = driver.last
        driver.tick()
    assert speed * driver.last.tracking.rate == pytest.approx(2.0 * before.tracking.rate, abs=0.07)
    assert driver.until(lambda d: d.tracking.rate == 1.0).tracking.trajectory is plan


def test_a_plan_that_is_too_late_is_not_flown_and_it_stops(driver):
    request = evading(driver)
    driver.until(lambda _d: driver.now_s - request.stamp_s > P.late_plan_s)
    driver.pilot.on_plan(straight(request))
    assert driver.pilot.mode is PilotMode.STOPPING
    assert driver.pilot.counters.plans_ignored == 1
    assert driver.pilot.counters.stops == 1
    driver.until(lambda d: d.plan is not None)
    assert driver.last.mode is PilotMode.WAITING


@pytest.mark.parametrize(
    "changes", [{"trajectory_seq": 1}, {"trajectory_seq": -7}, {"future_collision_seq": 0}]
)
def test_a_plan_out_of_order_or_ignorant_of_the_newest_collision_is_asked_for_again(
    driver, changes
):
    request = evading(driver)
    driver.pilot.on_plan(straight(request, **changes))
    assert driver.pilot.counters.plans_ignored == 1
    driver.tick()
    assert len(driver.requests) == 3
    assert driver.requests[-1].attempt == 3


def test_a_plan_that_nobody_asked_for_is_ignored(driver):
    plan = driver.fly()
    driver.pilot.on_plan(replace(plan, trajectory_seq=5, stamp_s=driver.now_s))
    assert driver.tick(10).tracking.trajectory is plan


def test_a_new_collision_before_the_change_asks_for_yet_another_plan(driver):
    request = evading(driver)
    driver.pilot.on_plan(straight(request))
    driver.foresee(9.0, seq=2)
    driver.tick(30)
    assert driver.requests[-1].future_collision_seq == 2
    assert len(driver.requests) == 3


def test_the_answer_to_an_abandoned_request_is_not_taken_for_the_new_one(driver):
    """The old plan begins in motion, and elsewhere: from a hover it would jump there."""
    old = straight(evading(driver))
    driver.foresee(0.0)
    driver.until(lambda d: d.mode is PilotMode.WAITING)
    assert len(driver.requests) == 3
    driver.pilot.on_plan(old)
    assert driver.tick().tracking.trajectory is None
    new = straight(driver.requests[-1])
    driver.pilot.on_plan(new)
    assert driver.tick().tracking.trajectory is new


@pytest.mark.parametrize("stamp_s", [math.inf, math.nan, 1e9])
def test_a_plan_that_never_begins_is_not_waited_for(driver, stamp_s):
    driver.tick()
    driver.pilot.on_plan(straight(driver.requests[0], stamp_s=stamp_s))
    driver.tick(3)
    assert len(driver.requests) == 2


# Failed plans --------------------------------------------------------------------------------


def fail(driver):
    driver.pilot.on_plan(PlanFailure(stamp_s=driver.requests[-1].stamp_s, reason="no way"))


def test_a_failed_plan_is_tried_again_after_a_pause_with_a_new_attempt(driver):
    driver.tick()
    fail(driver)
    failed_s = driver.now_s
    driver.until(lambda d: d.plan is not None)
    assert driver.now_s == pytest.approx(failed_s + P.retry_s, abs=TICK_S)
    assert driver.now_s >= failed_s + P.retry_s
    assert driver.last.plan.attempt == 2


def test_the_first_plan_that_is_flown_is_no_replan_however_many_failed(driver):
    driver.tick()
    fail(driver)
    driver.until(lambda d: d.plan is not None)
    driver.pilot.on_plan(straight(driver.requests[-1]))
    driver.tick(5)
    assert driver.pilot.counters.replans == 0


def test_a_failed_plan_in_flight_stops_it(driver):
    evading(driver)
    fail(driver)
    assert driver.pilot.mode is PilotMode.STOPPING
    assert driver.pilot.counters.stops == 1


def test_three_failures_look_all_round_once(driver):
    for _ in range(P.look_round_after):
        driver.until(lambda d: d.plan is not None)
        assert driver.last.tracking.hold_yaw_rad == 0.0
        fail(driver)
    begun_s = driver.now_s
    assert driver.tick(50).tracking.hold_yaw_rad == pytest.approx(
        (driver.now_s - begun_s) * math.tau / 6
    )
    driver.tick(400)
    assert driver.last.tracking.hold_yaw_rad == pytest.approx(math.tau)
    assert driver.pilot.counters.look_rounds == 1


def test_it_gives_up_after_the_last_attempt_and_not_before():
    driver = Driver(attempts_max=5)
    for attempt in range(1, 6):
        assert driver.pilot.mode is not PilotMode.GAVE_UP
        driver.until(lambda d: d.plan is not None)
        assert driver.last.plan.attempt == attempt
        fail(driver)
    assert driver.tick(100).mode is PilotMode.GAVE_UP
    assert len(driver.requests) == 5
    assert driver.pilot.counters.plans_failed == 5


def test_the_failure_of_an_abandoned_request_is_not_taken_for_the_new_one_s(driver):
    old = evading(driver)
    driver.foresee(0.0)
    driver.until(lambda d: d.mode is PilotMode.WAITING)
    driver.pilot.on_plan(PlanFailure(stamp_s=old.stamp_s, reason="no way"))
    assert driver.pilot.counters.plans_failed == 0
    driver.tick(20)
    assert len(driver.requests) == 3


def test_a_plan_that_was_lost_is_asked_for_again_but_only_if_it_is_awaited(driver):
    driver.pilot.plan_lost()
    driver.tick(5)
    assert len(driver.requests) == 1  # it had asked for none yet
    driver.pilot.plan_lost()
    driver.tick(5)
    first, again = driver.requests
    assert again.attempt == first.attempt + 1
    assert driver.pilot.counters.plans_failed == 0
    driver.pilot.on_plan(straight(again))
    driver.tick(5)
    driver.pilot.plan_lost()
    driver.tick(5)
    assert len(driver.requests) == 2


def test_a_success_forgives_the_failures_before_it():
    driver = Driver(attempts_max=3)
    for _ in range(4):
        for _ in range(2):
            driver.until(lambda d: d.plan is not None)
            fail(driver)
        driver.until(lambda d: d.plan is not None)
        driver.pilot.on_plan(straight(driver.requests[-1], count=2))
        driver.tick()
    assert driver.pilot.mode is not PilotMode.GAVE_UP


# Off the path --------------------------------------------------------------------------------


@pytest.mark.parametrize("off_m", [P.tracking_error_max_m + 1e-6, 1e6, math.nan, math.inf])
def test_too_far_from_the_reference_it_stops_and_plans_from_where_it_is(driver, off_m):
    driver.fly()
    here = driver.vehicle().position_enu_m
    directive = driver.tick(at=state(here[0] + 2.0 * TICK_S, off_m, 5.0))
    assert directive.mode is PilotMode.WAITING
    assert directive.tracking.trajectory is None
    assert directive.plan is not None
    np.testing.assert_array_equal(directive.plan.position_enu_m[1], off_m)


def test_within_the_tracking_error_it_flies_on(driver):
    driver.fly()
    here = driver.vehicle().position_enu_m
    at = state(here[0] + 2.0 * TICK_S, P.tracking_error_max_m - 1e-6, 5.0)
    assert driver.tick(at=at).mode is PilotMode.FLYING


# Anything at all -----------------------------------------------------------------------------

numbers = st.floats(allow_nan=True, allow_infinity=True) | st.floats(-50.0, 50.0)
counts = st.integers(-(2**31), 2**31 - 1) | st.integers(-2, 6)
reports = st.builds(
    CollisionReport, stamp_s=numbers, collision=st.booleans(), time_to_collision_s=numbers,
    future_collision_seq=counts,
)  # fmt: skip


@st.composite
def corrupted_plans(draw):
    """Changes to a sound plan: a few numbers of it replaced by anything."""
    count = draw(st.integers(0, 5))
    waypoints = np.cumsum(np.full((count, 10), 0.3), axis=0)
    durations = np.full(count, 0.5)
    for _ in range(draw(st.integers(0, 4)) if count else 0):
        row = draw(st.integers(0, count - 1))
        column = draw(st.integers(0, 10))
        if column == 10:
            durations[row] = draw(numbers)
        else:
            waypoints[row, column] = draw(numbers)
    changes = {"waypoints": waypoints, "durations_s": durations}
    for name, values in (("trajectory_seq", counts), ("future_collision_seq", counts),
                         ("stamp_s", numbers)):  # fmt: skip
        if draw(st.integers(0, 3)) == 0:
            changes[name] = draw(values)
    return changes


positions = st.tuples(numbers, numbers, numbers) | st.just((0.0, 0.0, 5.0))
steps = st.lists(
    st.one_of(
        reports,
        corrupted_plans(),
        st.just("failure"),
        st.tuples(st.integers(1, 40), positions, numbers),
    ),
    max_size=25,
)


@given(steps)
@settings(max_examples=150, deadline=None)
def test_no_sequence_of_messages_breaks_it(plan):
    driver = Driver()
    driver.tick()
    for step in plan:
        if step == "failure":
            fail(driver)
        elif isinstance(step, CollisionReport):
            driver.pilot.on_report(step)
        elif isinstance(step, dict):
            driver.pilot.on_plan(straight(driver.requests[-1], **step))
        else:
            ticks, place, yaw = step
            driver.tick(ticks, at=state(*place, yaw=yaw))
        assert 0.0 <= driver.last.tracking.rate <= 1.0
        assert driver.last.tracking.time_s >= 0.0
        hovers = driver.pilot.active.trajectory is None
        assert hovers or driver.pilot.mode not in (PilotMode.WAITING, PilotMode.ARRIVED)


@given(st.lists(corrupted_plans() | st.just("failure"), max_size=8))
@settings(max_examples=60, deadline=None)
def test_it_never_waits_for_ever_without_asking(plans):
    """Whatever answers it got, soon it flies, asks again, or has ended."""
    driver = Driver()
    driver.tick()
    for answer in plans:
        if answer == "failure":
            fail(driver)
        else:
            driver.pilot.on_plan(straight(driver.requests[-1], **answer))
        asked = len(driver.requests)
        for _ in range(60):
            driver.tick(at=state())
            if driver.pilot.mode in (PilotMode.FLYING, PilotMode.ARRIVED, PilotMode.GAVE_UP):
                break
        assert len(driver.requests) > asked or driver.pilot.mode is not PilotMode.WAITING
        if driver.pilot.mode is not PilotMode.WAITING:
            return


# The paper's stack ---------------------------------------------------------------------------

PAPER = {
    "guards_tracking": False, "stops_on_report": True, "acts_on_report_once": True,
    "owns_sequence_numbers": True, "plans_in_motion": False, "arrives_at_rest": True,
    "goal_tolerance_m": 8.0, "rejected_plan_pause_s": 1.0,
}  # fmt: skip


def moving(x, speed):
    return replace(state(x), velocity_enu_mps=np.array([speed, 0.0, 0.0]))


@pytest.mark.parametrize(("uses", "waits_s"), [(True, 3.0 - 2.0 / 3.0 - 0.4), (False, 0.0)])
def test_a_report_stops_the_vehicle_when_braking_has_to_begin_or_at_once(uses, waits_s):
    driver = Driver(**PAPER, uses_time_to_collision=uses)
    driver.fly()
    begun_s = driver.now_s
    driver.foresee(3.0)
    driver.foresee(0.1)  # the same number: only the first counts
    driver.until(lambda d: d.tracking.trajectory is None)
    assert driver.now_s - begun_s == pytest.approx(waits_s, abs=1.5 * TICK_S)
    assert driver.pilot.counters.stops == 1


@pytest.mark.parametrize("time_s", [math.inf, 1e300])
def test_a_corrupted_time_to_collision_puts_the_stop_off_for_ever(time_s):
    driver = Driver(**PAPER)
    driver.fly(count=200)
    driver.foresee(time_s)
    driver.tick(200)
    assert driver.pilot.mode is PilotMode.FLYING
    assert driver.foresee(math.nan, seq=2) is PilotMode.FLYING
    assert driver.tick().tracking.trajectory is None  # a NaN is no time at all


def test_it_hovers_where_it_has_braked_and_only_then_plans():
    driver = Driver(**PAPER)
    driver.fly()
    driver.foresee(0.0)
    driver.tick(at=moving(10.0, 2.0))
    for x, speed in [(10.4, 1.0), (10.5, 0.4)]:
        directive = driver.tick(at=moving(x, speed))
        assert directive.mode is PilotMode.STOPPING
        assert directive.tracking.hold_enu_m[0] == x
        assert len(driver.requests) == 1
    directive = driver.tick(at=moving(10.6, 0.2))
    assert directive.mode is PilotMode.WAITING
    assert driver.requests[-1].position_enu_m[0] == 10.6
    np.testing.assert_array_equal(driver.requests[-1].velocity_enu_mps, np.zeros(3))


def test_a_larger_number_makes_it_reject_what_is_older_at_a_bounded_rate():
    driver = Driver(**PAPER)
    driver.tick()
    driver.pilot.on_plan(straight(driver.requests[-1], count=4, trajectory_seq=2**30))
    driver.until(lambda d: d.mode is PilotMode.FLYING)
    driver.until(lambda d: d.tracking.trajectory is None)
    begun_s = driver.now_s
    for number in range(2, 8):
        asked = len(driver.requests)
        driver.pilot.on_plan(straight(driver.requests[-1], trajectory_seq=number))
        driver.until(lambda _, n=asked: len(driver.requests) > n)
    assert driver.pilot.counters.plans_ignored == 6
    assert driver.now_s - begun_s >= 5.9


def test_a_plan_that_knows_of_a_later_collision_makes_it_ignore_reports():
    driver = Driver(**PAPER)
    driver.fly(future_collision_seq=1000, count=400)
    assert driver.foresee(0.0, seq=5) is PilotMode.FLYING
    assert driver.tick(20).mode is PilotMode.FLYING
    assert driver.pilot.counters.reports_ignored == 1


def test_it_has_arrived_only_at_rest_and_only_without_a_plan():
    driver = Driver(**PAPER)
    driver.fly(speed=2.0, count=40)  # the trajectory ends at the goal
    driver.until(lambda d: d.tracking.trajectory is None)
    assert driver.now_s > 20.0
    assert driver.pilot.mode is PilotMode.ARRIVED


def test_the_turn_before_departure_looks_all_round_and_asks_for_nothing():
    driver = Driver(**PAPER, turns_before_departure=True)
    yaws = [driver.tick().tracking.hold_yaw_rad for _ in range(299)]
    assert driver.requests == []
    assert yaws == sorted(yaws)
    assert yaws[-1] == pytest.approx(2.0 * math.pi, abs=0.05)
    driver.tick(3)
    assert len(driver.requests) == 1


@pytest.mark.parametrize("place", [math.nan, math.inf, 1e300, -50.0])
def test_a_plan_never_begins_at_a_corrupted_waypoint(place):
    """One that did ended the companion: smoothing takes the ceiling of its duration."""
    driver = Driver(guards_tracking=False)
    plan = driver.fly()
    corrupted = plan.waypoints.copy()
    corrupted[:, 0] = place
    driver.pilot.active.trajectory = replace(plan, waypoints=corrupted)
    driver.foresee(30.0)
    driver.tick(at=moving(5.0, 2.0))
    assert driver.requests[-1].position_enu_m[0] == 5.0
    np.testing.assert_array_equal(driver.requests[-1].velocity_enu_mps, np.zeros(3))


def test_it_slows_down_where_it_does_not_look():
    for yaw, rate in [(0.0, 1.0), (math.pi / 4.0 + 0.01, 0.5)]:
        driver = Driver(slows_where_blind=True)
        driver.fly()
        for _ in range(100):
            here = driver.vehicle().position_enu_m
            driver.tick(at=state(*here, yaw=yaw))
        assert driver.last.tracking.rate == rate
