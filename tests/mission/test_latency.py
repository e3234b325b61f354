"""Latencies of kernels: how they are drawn, and what they do to a flight."""

import json
import math

import numpy as np
import pytest
from missions import SOUND_PLATFORM

from mavfi_cli.companion.executor import LatencyModel
from mavfi_cli.core.types import KERNELS
from mavfi_cli.spec.platform import load_platform


def draws(model, kernel, count=4000):
    return np.array([model.draw_s(kernel) for _ in range(count)])


def test_latencies_are_log_normal_round_their_median(platform_of):
    logs = np.log(draws(LatencyModel(platform_of(SOUND_PLATFORM), 1), "octomap"))
    error = 0.5 / math.sqrt(len(logs))
    assert logs.mean() == pytest.approx(math.log(0.02), abs=4 * error)
    assert logs.std() == pytest.approx(0.5, rel=0.06)
    inside = np.abs(logs - math.log(0.02)) < 0.5
    assert inside.mean() == pytest.approx(0.6827, abs=0.03)


def test_without_spread_it_is_the_median_always(platform_of):
    model = LatencyModel(platform_of(SOUND_PLATFORM.replace("spread = 0.5", "spread = 0.0")), 1)
    assert set(draws(model, "planner", 50)) == {0.04}


def test_a_seed_repeats_and_another_differs(platform_of):
    profile = platform_of(SOUND_PLATFORM)
    once, twice = (draws(LatencyModel(profile, 5), "planner", 20) for _ in range(2))
    np.testing.assert_array_equal(once, twice)
    assert (draws(LatencyModel(profile, 6), "planner", 20) != once).all()


def test_one_kernel_s_draws_do_not_shift_another_s(platform_of):
    """So a faulty flight, whose kernels run at other times, stays paired with its golden one."""
    profile = platform_of(SOUND_PLATFORM)
    alone, mixed = LatencyModel(profile, 5), LatencyModel(profile, 5)
    expected = draws(alone, "planner", 50)
    found = []
    for _ in range(50):
        mixed.draw_s("octomap")
        found.append(mixed.draw_s("planner"))
    np.testing.assert_array_equal(found, expected)


def test_the_kernels_draws_are_independent(platform_of):
    model = LatencyModel(platform_of(SOUND_PLATFORM), 5)
    logs = np.log([draws(model, kernel, 2000) for kernel in KERNELS])
    correlation = np.corrcoef(logs) - np.eye(len(KERNELS))
    assert np.abs(correlation).max() < 0.1


def responses(folder):
    return json.loads(folder.result.read_text())["response_time_s"]


def test_a_flight_responds_as_late_as_its_platform_s_kernels(fly_short, short_flight, tmp_path):
    """The map is the slowest kernel on the way from a frame to a setpoint."""
    (tmp_path / "mine.toml").write_text('name = "mine"\nbase = "tx2"\ncores = 4\nscale = 0.5\n')
    platforms = ("tx2", str(tmp_path / "mine.toml"))
    found = [responses(short_flight), *(responses(fly_short(platform=p)) for p in platforms)]
    x86, tx2, mine = (response["median"] for response in found)
    assert x86 < mine < tx2
    octomap_s = load_platform("tx2").kernels["octomap"].latency_s
    assert octomap_s < tx2 < 2.0 * octomap_s
    assert octomap_s / 2 < mine < octomap_s


def test_a_frame_is_answered_by_a_command_that_knew_of_it(fly_short):
    """Control that takes most of a tick: what goes out next was computed before the verdict."""
    folder = fly_short(platform="tx2-2c-0.81")
    invocations, reactions = folder.read_timetable()
    control = [each for each in invocations if each.node == "control"]
    checks = [each.end_s for each in invocations if each.node == "collision_check"]
    assert reactions
    for reaction in reactions:
        out_s = reaction.setpoint_stamp_s
        verdict_s = max(end_s for end_s in checks if end_s <= out_s)
        assert any(c.start_s >= verdict_s - 1e-9 and c.end_s <= out_s + 1e-9 for c in control)
