"""The overhead of detection and recovery, from records of flights."""

import json
import re

import pytest
from click.testing import CliRunner
from made_flights import watched

from mavfi_cli.analysis.overhead import ComputeOverhead, recorded_overheads
from mavfi_cli.cli.vpm import vpm
from mavfi_cli.core.errors import RecordError
from mavfi_cli.mission.measures import HOST_CHECKS, FlightRecord


def flight(detector="gad", alarms=(), *, gate_s=0.02, platform="x86", **changes):
    told = {"quality_of_flight": {"flight_time_s": 20.0}, "config": {"platform": platform}}
    return FlightRecord.of(watched(detector, gate_s, alarms) | told | changes)


def test_checks_alone():
    found = ComputeOverhead.of([flight()])["gad"]
    assert found.share == pytest.approx(0.02 / 9.0)
    assert found.checks_share == pytest.approx(found.share)
    assert found.checks_host_share == pytest.approx(0.02 / 0.2)
    assert (found.flights, found.alarms) == (1, 0)


def test_recomputation_costs_a_run_of_the_stage():
    alarms = [("perception", "recompute"), ("planning", "hold"), ("control", "recompute"),
              ("control", "accept")]  # fmt: skip
    found = ComputeOverhead.of([flight("gad", alarms)])["gad"]
    again_s = 0.36 + 0.2 + 0.0005
    assert found.recompute_s == pytest.approx(again_s)
    assert found.share == pytest.approx((0.02 + again_s) / (9.0 - again_s))
    assert found.alarms == 3
    assert "3 recomputations" in found.describe("somewhere")


def test_alarms_beyond_the_listed_ones_are_counted():
    alarms = [("planning", "recompute")] * 3 + [("control", "recompute")]
    detection = watched("gad", 0.02, alarms, responses={"recompute": 8})["detection"]
    found = ComputeOverhead.of([flight(detection=detection)])["gad"]
    assert found.recompute_s == pytest.approx(6 * 0.2 + 2 * 0.0005)
    assert found.alarms == 8


def test_flights_are_taken_together_and_faulty_ones_left_out():
    left_out = [flight(detection=None), flight(fault={"state": "x"}), FlightRecord(outcome="crash")]
    found = ComputeOverhead.of([flight(), flight(gate_s=0.04), flight("aad"), *left_out])
    assert set(found) == {"gad", "aad"}
    assert found["gad"].flights == 2
    assert found["gad"].share == pytest.approx(0.06 / 18.0)
    assert re.search("2 flights of here on x86: .* 0.3333 %", found["gad"].describe("here"))
    assert "1 flight of here on x86: " in found["aad"].describe("here")


def test_flights_on_another_platform_do_not_count():
    """Recomputations and kernels are those of the flight's platform; the checks are not scaled."""
    flights = [flight(), flight(gate_s=0.04, platform="tx2"), flight("aad")]
    assert ComputeOverhead.of(flights)["gad"].platforms == ("tx2", "x86")
    found = ComputeOverhead.of(flights, "tx2")
    assert set(found) == {"gad"}
    assert found["gad"].share == pytest.approx(0.04 / 9.0)
    told = found["gad"].describe("here")
    assert re.search(r"1 flight of here on tx2 \(1 .* left out\): ", told)
    assert told.endswith(HOST_CHECKS)


@pytest.mark.parametrize(
    ("name", "counts"),
    [("tx2 x 1.0222", True), ("tx2 x 2.1", False), ("tx2 x heavy", False), ("tx2-2c", False)],
)
def test_a_platform_scaled_for_a_detector_s_share_is_the_platform(tmp_path, name, counts):
    """`mavfi vpm --fly` flies with such files; a file that is gone leaves its own name."""
    path = tmp_path / "flown.toml"
    path.write_text(f'name = "{name}"\nbase = "tx2"\ncores = 4\nscale = 1.0222\n')
    assert ("gad" in ComputeOverhead.of([flight(platform=str(path))], "tx2")) is counts
    path.unlink()
    assert ComputeOverhead.of([flight(platform=str(path))])["gad"].platforms == ("flown",)


@pytest.mark.slow
def test_a_real_record_has_what_it_takes(watched_flight):
    result = json.loads(watched_flight.result.read_text())
    found = ComputeOverhead.of([FlightRecord.of(result)])["gad"]
    assert found.detection_s == result["host"]["stage_wall_s"]["gate"] > 0.0
    assert found.compute_s == pytest.approx(sum(k["busy_s"] for k in result["kernels"].values()))
    assert 0.0 < found.share < 0.5


def measured(path, platform=None):
    return recorded_overheads(path, ("gad", "aad"), platform)["gad"]


@pytest.mark.slow
def test_the_command_takes_a_run_folder(watched_flight, tmp_path):
    folder = watched_flight.path
    found = measured(folder)
    assert "1 flight of here on x86: " in found.describe("here")
    assert measured(watched_flight.result) == measured(folder, "x86") == found
    assert measured(folder.parent).share > 0.0  # the folder of runs
    asked = ["--overhead", str(folder), "--overhead", "aad=0.5", "--json"]
    told = json.loads(CliRunner().invoke(vpm, asked).stdout)["vehicles"][0]["schemes"]
    given = {row["scheme"]: (row["overhead_percent"], row["source"]) for row in told}
    assert given["aad"] == (0.5, "--overhead")
    assert given["gad"] == (pytest.approx(100.0 * found.share), found.describe(str(folder)))
    with pytest.raises(RecordError, match=r"tx2 \(--platform\) .* gad on x86"):
        measured(folder, "tx2")
    with pytest.raises(RecordError, match="gad or aad"):
        measured(tmp_path)
    refused = CliRunner().invoke(vpm, ["--overhead", str(tmp_path / "nowhere")])
    assert "aad=0.0062" in refused.stderr
