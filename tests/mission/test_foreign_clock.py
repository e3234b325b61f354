"""The clock of a foreign vehicle: estimated between states, at the pace of the vehicle."""

import pytest

from mavfi_cli.mission.flight import ForeignClock


class Wall:
    now_s = 1000.0

    def __call__(self):
        return self.now_s


def heard(clock, wall, pace, duration_s, first_s=50.0):
    """Let the vehicle fly for a wall time at a pace, with a state every 0.1 s of it."""
    begun_s = wall.now_s
    for step in range(round(duration_s / 0.1) + 1):
        wall.now_s = begun_s + 0.1 * step
        clock.hear(first_s + 0.1 * step * pace)


def test_a_clock_has_leapt_if_a_second_state_says_so():
    clock = ForeignClock(Wall())
    clock.hear(50.0)
    stamps = [50.0, 49.0, 54.0, 4e6, 54.0, 3e6, 4e6, 4e6 + 0.1]
    believed = [clock.believes(stamp_s, limit_s=5.0) for stamp_s in stamps]
    assert believed == [False, False, True, False, True, False, False, True]


@pytest.mark.parametrize(("pace", "silent_s"), [(1.0, 6.0), (1 / 3, 2.0), (20.0, 6.0)])
def test_silence_counts_when_it_has_passed_on_both_clocks(pace, silent_s):
    wall = Wall()
    clock = ForeignClock(wall)
    heard(clock, wall, pace, 10.0)
    assert clock.silence_s == 0.0
    for _ in range(60):
        clock.wait(0.1)
    assert clock.silence_s == pytest.approx(silent_s)
    assert clock.now_s == pytest.approx(50.0 + 10.0 * pace + silent_s)
    clock.hear(clock.stamp_s + 0.1)
    assert clock.silence_s == 0.0


def test_before_the_first_state_the_wall_s_clock_counts():
    clock = ForeignClock(Wall())
    clock.wait(0.4)
    assert (clock.heard, clock.now_s) == (False, 0.4)


def test_a_clock_that_starts_again_has_its_pace_measured_anew():
    wall = Wall()
    clock = ForeignClock(wall)
    heard(clock, wall, 0.5, 10.0)
    heard(clock, wall, 1.0, 10.0, first_s=0.0)
    clock.wait(1.0)
    assert clock.now_s == pytest.approx(11.0)
