"""Source-level faults in whole missions: equal up to the strike, recorded, read, repeatable."""

import json
import math
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from mavfi_cli.autonomy.pilot import PilotMode
from mavfi_cli.mission.progress import Watcher
from mavfi_cli.mission.run import fly_mission, paired_golden
from mavfi_cli.mission.run_folder import load_run
from mavfi_cli.report.summary import difference_lines
from mavfi_cli.spec.fault import FaultConfig
from mavfi_cli.spec.mission import MissionConfig


@pytest.fixture(scope="module")
def struck(fly_short, short_flight):
    """Flies with a fault, and puts the golden flight where `paired_golden` would."""

    def fly(target, **asked):
        folder = fly_short(fault=FaultConfig(target=target, **asked))
        shutil.copytree(short_flight.path, folder.golden)
        return load_run(folder.path)

    return fly


@pytest.fixture(scope="module")
def sideways(struck):
    """A velocity command with its sign flipped, 3 s into the flight."""
    return struck("command_vx", at="time=3", exact_bits=(63,))


@pytest.fixture(scope="module")
def troubled(troubled_flight):
    """A mission that foresees collisions."""
    return load_run(troubled_flight.path).mission()


@pytest.fixture(scope="module")
def evaded(tmp_path_factory):
    fault = FaultConfig(target="time_to_collision", field="exponent", at="phase=evading")
    out = tmp_path_factory.mktemp("evaded")
    mission = MissionConfig(world="dense", seed=3, stack="hardened", fault=fault)
    return load_run(fly_mission(mission, out, Watcher()).path)


def test_golden_and_faulty_flight_part_at_the_strike(sideways):
    fault = sideways.result["fault"]
    (strike,) = fault["strikes"]
    (change,) = strike["changes"]
    assert change["after"] == -change["before"] != 0.0
    parting = sideways.first_difference(paired_golden(sideways))
    assert (parting.column, parting.stamp_s) == ("command_vx", strike["stamp_s"])
    assert (parting.this, parting.other) == (change["after"], change["before"])
    assert fault["activation"]["activation"] == "read"
    assert fault["activation"]["first_reader"] == {
        "name": "setpoint", "stamp_s": strike["stamp_s"], "state": "command_vx",
    }  # fmt: skip
    assert json.loads(sideways.folder.fault.read_text()) == fault


def test_a_vehicle_whose_flight_has_ended_stays_where_it_is(sideways):
    """Else a fault that sends the vehicle far away late would seem harmless."""
    rows = sideways.trace.num_rows // 2
    cut = replace(sideways, trace=sideways.trace.slice(0, rows))
    flown = [sideways.trace[name].to_numpy()[rows - 1 :] for name in ("x_m", "y_m", "z_m")]
    farthest_m = max(math.dist(place, [p[0] for p in flown]) for place in zip(*flown, strict=True))
    assert farthest_m > 1.0
    assert sideways.largest_deviation_m(cut) == pytest.approx(farthest_m)
    assert cut.largest_deviation_m(sideways) == pytest.approx(farthest_m)
    assert math.isnan(sideways.largest_deviation_m(replace(cut, trace=None)))


def test_a_fault_repeats_to_the_byte(sideways, tmp_path):
    again = load_run(fly_mission(sideways.mission(), tmp_path, Watcher()).path)
    assert again.folder.trace.read_bytes() == sideways.folder.trace.read_bytes()
    assert again.folder.tlog.read_bytes() == sideways.folder.tlog.read_bytes()
    assert not again.differing_sections(sideways)


def test_a_flip_that_is_read_and_moves_nothing_is_masked(struck):
    run = struck("future_collision_seq", at="time=3", exact_bits=(3,))
    assert run.result["fault"]["activation"]["activation"] == "read"
    (line,) = difference_lines(run, paired_golden(run))
    assert "masked" in line


def test_a_time_to_no_collision_is_overwritten_unread(struck):
    run = struck("time_to_collision", at="time=3", exact_bits=(61,))
    assert run.result["fault"]["activation"]["activation"] == "overwritten"
    (line,) = difference_lines(run, paired_golden(run))
    assert "masked" not in line
    assert "overwritten" in line


def test_a_flip_in_a_flown_plan_is_read_by_the_next_check_and_causes_none_by_itself(struck):
    run = struck("waypoint_x", at="time=3", exact_bits=(0,))
    golden = paired_golden(run)
    assert run.result["fault"]["activation"]["activation"] == "read"
    assert run.result["fault"]["activation"]["first_reader"]["name"] == "collision_check"
    assert run.result["nodes"] == golden.result["nodes"]
    assert run.result["kernels"] == golden.result["kernels"]
    assert run.result["response_time_s"] == golden.result["response_time_s"]


@pytest.mark.slow
def test_a_phase_between_two_reports_is_not_missed(evaded):
    """In this flight every report comes before the pilot is evading, or after it."""
    evading = next(
        row["stamp_s"]
        for row in evaded.trace.to_pylist()
        if row["phase"] == PilotMode.EVADING.value
    )
    (strike,) = evaded.result["fault"]["strikes"]
    assert evading < strike["stamp_s"] < evading + 0.5
    assert strike["phase"] != PilotMode.EVADING.value


def test_a_time_to_a_collision_that_is_foreseen_is_read(troubled, tmp_path):
    fault = FaultConfig(target="time_to_collision", field="exponent", at="foreseen", seed=2)
    run = load_run(fly_mission(replace(troubled, fault=fault), tmp_path, Watcher()).path)
    recorded = run.result["fault"]
    assert len(recorded["strikes"]) == 1
    assert math.isfinite(recorded["strikes"][0]["changes"][0]["before"])
    assert recorded["activation"]["first_reader"]["state"] == "time_to_collision"


def test_the_document_lists_the_phases():
    text = (Path(__file__).parents[2] / "docs" / "reference" / "faults.md").read_text()
    (listed,) = re.findall(r"`phase=slowing` \|.*? The modes are (.*?)\.", text)
    assert re.split(", | and ", listed) == [mode.value for mode in PilotMode]


def test_a_trigger_that_never_comes_is_not_injected(struck):
    fault = struck("planning", at="time=299").result["fault"]
    assert (fault["state"], fault["activation"]["activation"]) == ("not_injected", "not_injected")
    assert fault["reason"]
