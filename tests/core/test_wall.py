"""Host time by stage: every block of a kernel, and a sample of the stages of every tick."""

import pytest

from mavfi_cli.core import wall


@pytest.fixture
def clock(monkeypatch):
    """A clock on which every reading is a second after the last."""
    now = iter(range(10_000))
    monkeypatch.setattr(wall, "perf_counter", lambda: float(next(now)))
    return wall.WallClock()


def test_a_measured_stage_counts_every_block(clock):
    for _ in range(10):
        with clock.measure("octomap"):
            pass
    assert clock.totals == {"octomap": 10.0}
    assert clock.newest == {"octomap": 1.0}


def test_a_sampled_stage_counts_one_tick_of_seven_sevenfold(clock):
    for _ in range(2 * wall.EVERY):
        clock.begin_tick()
        for _ in range(3):
            with clock.sample("link"):
                pass
    assert clock.totals == {"link": 2 * 3 * wall.EVERY}


def test_the_time_in_which_a_flight_waited_is_left_out(clock):
    with clock.sample("pilot"):
        clock.skipped_s += 0.75
    assert clock.totals == {"pilot": 0.25 * wall.EVERY}
