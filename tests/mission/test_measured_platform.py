"""`measured:FACTOR`: the host's own kernel times are the latencies, in real time only."""

import json
import re
from dataclasses import asdict

import pytest

from mavfi_cli.companion.executor import Executor, LatencyModel, Node
from mavfi_cli.core.errors import ConfigError, RecordError, UnknownName
from mavfi_cli.core.types import KERNELS
from mavfi_cli.core.wall import WallClock
from mavfi_cli.mission.measures import FlightRecord
from mavfi_cli.mission.run_folder import load_run
from mavfi_cli.report.summary import summary_lines
from mavfi_cli.spec.mission import MissionConfig
from mavfi_cli.spec.platform import load_platform


def test_the_profile():
    profile = load_platform("measured:2.5")
    assert (profile.name, profile.measured_factor) == ("measured:2.5", 2.5)
    assert profile.cores >= 1
    assert not profile.carried
    assert load_platform("x86").measured_factor is None


@pytest.mark.parametrize("text", ["", "x", "nan", "inf", "0", "-1", "0.001", "1001", "1:2"])
def test_a_factor_that_is_none(text):
    with pytest.raises(ConfigError, match=r"between 0\.01 and 1000, got") as error:
        load_platform(f"measured:{text}")
    assert "\n" not in str(error.value)


def test_a_slip_of_the_name():
    with pytest.raises(UnknownName, match="did you mean 'measured:FACTOR'"):
        load_platform("measred:2")


def test_it_is_refused_where_it_would_have_to_repeat():
    with pytest.raises(ConfigError, match="measured:2 needs --realtime"):
        MissionConfig(platform="measured:2")
    with pytest.raises(ConfigError, match="cannot be combined with isolate"):
        MissionConfig(platform="measured:2", realtime=True, isolate=("planner",))
    assert MissionConfig(platform="measured:2", realtime=True).platform == "measured:2"


def test_an_invocation_takes_what_it_took_times_the_factor():
    """With a wall clock that says what each invocation took."""
    wall, took_s = WallClock(), iter([0.010, 0.030, 0.020])
    model = LatencyModel(load_platform("measured:4"), 1, wall)

    def work(value, _start_s):
        return value

    published = []
    executor = Executor(draw_latency_s=model.draw_s, cores=2, compute_first=True, wall=wall)
    octomap = executor.add(Node("octomap", work))

    async def turn(value):
        published.append((await octomap.run(value), executor.now_s))

    class Told:
        """Measures what the test says."""

        def __init__(self, name):
            self.name = name

        def __enter__(self):
            return None

        def __exit__(self, *_):
            wall.add(self.name, next(took_s))

    wall.measure = Told
    for start_s, value in ((0.0, "a"), (1.0, "b"), (2.0, "c")):
        executor.advance(start_s)
        executor.start(turn(value))
    executor.advance(3.0)
    assert [value for value, _ in published] == ["a", "b", "c"]
    assert [stamp_s for _, stamp_s in published] == pytest.approx([0.04, 1.12, 2.08])
    told = model.summary()
    assert (told.platform, told.factor) == ("measured:4", 4.0)
    assert asdict(told.kernels["octomap"]) == pytest.approx(
        {"host_median_s": 0.020, "latency_median_s": 0.080, "invocations": 3}
    )
    assert octomap.busy_s == pytest.approx(0.24)


def test_other_platforms_measure_nothing(short_flight):
    assert LatencyModel(load_platform("x86"), 1, WallClock()).summary() is None
    result = json.loads(short_flight.result.read_text())
    assert result["measured_platform"] is None
    assert not any(line.startswith("Measured") for line in summary_lines(FlightRecord.of(result)))


@pytest.mark.slow
def test_a_flight_on_this_host_ten_times_as_slow(fly_short):
    """The record says platform and factor; response time follows from what was measured."""
    folder = fly_short(platform="measured:10", realtime=True)
    run = load_run(folder.path)
    result = run.result
    assert result["outcome"] == "success"
    told = result["measured_platform"]
    assert (told["platform"], told["factor"]) == ("measured:10", 10.0)
    assert set(told["kernels"]) == set(KERNELS)
    for name, kernel in told["kernels"].items():
        assert kernel["latency_median_s"] == pytest.approx(10.0 * kernel["host_median_s"])
        assert kernel["invocations"] == result["kernels"][name]["invocations"]
        assert kernel["host_median_s"] > 0.0
    waits_s = sum(told["kernels"][name]["latency_median_s"] for name in ("point_cloud", "octomap"))
    assert result["response_time_s"]["p95"] >= waits_s
    busy_s, wall_s = result["kernels"]["octomap"]["busy_s"], result["host"]["stage_wall_s"]
    assert busy_s == pytest.approx(10.0 * wall_s["octomap"], rel=0.02, abs=0.01)
    text = " ".join(" ".join(summary_lines(FlightRecord.of(result))).split())
    assert re.search(r"Measured .*octomap .* ms \(medians", text)
    assert "x 10 in the flight" in text
    with pytest.raises(RecordError, match="is not repeatable"):
        run.mission()
