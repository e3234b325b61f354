"""Who reads a struck value first, and what it is called where nobody does."""

from dataclasses import replace

import numpy as np
import pytest

from mavfi_cli.core.flight_record import Change, Reader, Strike
from mavfi_cli.core.types import Trajectory
from mavfi_cli.fi.injector import Activation, Follower

STRUCK = Trajectory(
    stamp_s=0.0,
    waypoints=np.zeros((6, 10)),
    durations_s=np.full(6, 0.5),
    trajectory_seq=3,
    future_collision_seq=1,
)
OTHER = replace(STRUCK, trajectory_seq=4)


def strike(state="waypoint_x", index=4, bits=(62,)):
    change = Change(state=state, index=index, bits=bits, before=0.0, after=2.0,
                    before_hex="0x0", after_hex="0x4000000000000000")  # fmt: skip
    return Strike(stamp_s=9.0, tick=450, phase="flying", invocation=1, changes=(change,))


@pytest.fixture
def follower():
    found = Follower()
    assert found.activation is Activation.NOT_INJECTED
    found.struck(STRUCK, strike())
    return found


def test_unread_at_the_end_is_not_read(follower):
    assert follower.waits
    assert (follower.activation, follower.reader) == (Activation.NOT_READ, None)


def test_read_by_the_first_receiver_of_that_very_message_state_and_waypoint(follower):
    follower.read(OTHER, "control", 9.2, {"waypoint_x"})
    follower.read(STRUCK, "control", 9.3, {"waypoint_y"})
    follower.read(STRUCK, "control", 9.4, {"waypoint_x"}, index=3)
    assert follower.activation is Activation.NOT_READ
    follower.read(STRUCK, "control", 9.5, {"waypoint_y", "waypoint_x"}, index=4)
    follower.read(STRUCK, "collision_check", 9.6, {"waypoint_x"})
    assert follower.activation is Activation.READ
    assert follower.reader == Reader(name="control", stamp_s=9.5, state="waypoint_x")


def test_replaced_before_it_was_read_is_overwritten(follower):
    follower.settle(lambda message: message is STRUCK)
    assert follower.waits
    follower.settle(lambda message: message is OTHER)
    assert follower.activation is Activation.OVERWRITTEN
    follower.read(STRUCK, "control", 9.9, {"waypoint_x"})
    assert follower.activation is Activation.OVERWRITTEN


def test_what_the_gate_withholds_is_no_longer_on_its_way(follower):
    follower.withheld(OTHER)
    assert follower.waits
    follower.withheld(STRUCK)
    assert follower.activation is Activation.WITHHELD
    follower.settle(lambda _message: False)
    follower.struck(OTHER, strike())
    assert follower.activation is Activation.WITHHELD


def test_once_read_is_read_whatever_comes_later(follower):
    follower.read(STRUCK, "control", 9.5, {"waypoint_x"}, index=4)
    follower.struck(OTHER, strike())
    follower.settle(lambda _message: False)
    assert follower.activation is Activation.READ
    assert not follower.waits


def test_a_later_strike_of_a_lasting_fault_may_still_be_read(follower):
    follower.settle(lambda _message: False)
    follower.struck(OTHER, strike())
    assert follower.activation is Activation.NOT_READ
    follower.read(OTHER, "control", 9.5, {"waypoint_x"})
    assert follower.activation is Activation.READ


def test_what_passes_the_gate_after_another_was_withheld_is_read(follower):
    follower.withheld(STRUCK)
    follower.struck(OTHER, strike())
    follower.settle(lambda _message: False)
    assert follower.activation is Activation.WITHHELD
    follower.struck(OTHER, strike())
    follower.read(OTHER, "control", 9.5, {"waypoint_x"})
    assert follower.activation is Activation.READ
    assert follower.reader == Reader(name="control", stamp_s=9.5, state="waypoint_x")


def test_a_strike_that_changes_no_bit_is_unchanged():
    follower = Follower()
    follower.struck(STRUCK, strike(bits=()))
    assert follower.activation is Activation.UNCHANGED
    assert not follower.waits
