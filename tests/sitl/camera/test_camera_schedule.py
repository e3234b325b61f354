from __future__ import annotations

import pytest

from sitl.camera.component import PeriodicSchedule


def count(schedule: PeriodicSchedule, stamps: list[float]) -> int:
    return sum(schedule.due(stamp) for stamp in stamps)


@pytest.mark.parametrize(("interval", "expected"), [(0.1, 100), (0.02, 500), (0.15, 67), (3.0, 4)])
def test_ten_seconds_of_ticks_hold_as_many_turns_as_intervals(
    interval: float, expected: int
) -> None:
    stamps, stamp = [], 7.0
    for _ in range(500):
        stamps.append(stamp)
        stamp += 0.02  # summed, with its rounding
    assert count(PeriodicSchedule(interval_s=interval), stamps) == expected


def test_a_late_poll_neither_shifts_the_phase_nor_is_made_up_for() -> None:
    schedule = PeriodicSchedule(interval_s=1.0)
    turns = [s for s in (0.0, 0.5, 3.7, 3.9, 4.0, 4.9, 5.0) if schedule.due(s)]
    assert turns == [0.0, 3.7, 4.0, 5.0]


def test_after_a_restart_it_is_due_at_once() -> None:
    schedule = PeriodicSchedule(interval_s=1.0)
    assert schedule.due(100.0)
    schedule.restart()
    assert schedule.due(1.0)
    assert not schedule.due(1.5)
