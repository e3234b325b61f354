"""Real firmware flies our vehicle, where the environment names its SITL binary."""

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from missions import SHORT

from mavfi_cli.core.files import file_digest
from mavfi_cli.mission.progress import Watcher
from mavfi_cli.mission.run import fly_mission
from mavfi_cli.mission.run_folder import load_run
from mavfi_cli.spec.detector import DetectorConfig
from mavfi_cli.spec.fault import FaultConfig
from mavfi_cli.spec.mission import FIRMWARE

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module", params=sorted(FIRMWARE))
def fly(request, tmp_path_factory):
    """Fly the short mission with a real autopilot and changes; its loaded run."""
    autopilot = request.param
    if not os.environ.get(FIRMWARE[autopilot]):
        pytest.skip(f"{FIRMWARE[autopilot]} names no SITL binary of {autopilot}")

    def flown(**changes):
        config = replace(SHORT, autopilot=autopilot, **changes)
        return load_run(fly_mission(config, tmp_path_factory.mktemp(autopilot), Watcher()).path)

    return flown


@pytest.fixture(scope="module")
def run(fly):
    return fly()


def test_it_reaches_the_goal_and_the_referee_saw_it(run):
    assert run.result["outcome"] == "success"
    assert run.result["referee"]["collision"] is None
    assert run.result["referee"]["min_clearance_m"] > 0.5
    flown = run.result["quality_of_flight"]
    assert flown["goal_distance_m"] < run.result["config"]["goal_tolerance_m"] + 0.5


def test_its_estimate_is_in_world_coordinates(run):
    names = ("x_m", "y_m", "z_m")
    told = np.array([run.trace[name].to_numpy() for name in names])
    true = np.array([run.trace[f"truth_{name}"].to_numpy() for name in names])
    errors_m = np.abs(told - true)
    assert np.isfinite(errors_m).mean() > 0.99
    assert np.nanmax(errors_m) < 0.6


def test_the_record_names_the_autopilot_and_repeats_its_settings(run):
    config = run.result["config"]
    assert config["autopilot"] in FIRMWARE
    assert config["world"] == SHORT.world
    binary = os.environ[FIRMWARE[config["autopilot"]]]
    assert config["firmware"] == binary
    assert run.result["files"] == {binary: file_digest(binary)}


@pytest.mark.parametrize("changes", [{"realtime": True}, {"vehicle": "spark"}], ids=str)
def test_it_flies_by_the_wall_s_clock_and_another_vehicle(fly, changes):
    result = fly(**changes).result
    assert result["outcome"] == "success"
    if "realtime" in changes:
        assert result["host"]["flight_wall_s"] > result["quality_of_flight"]["flight_time_s"]


def test_a_fault_is_withheld_by_a_detector_as_with_our_autopilot(fly):
    fault = FaultConfig(
        target="command_velocity", at="time=1", together=True, exact_bits=(62,), seed=2
    )
    result = fly(fault=fault, detector=DetectorConfig(name="gad")).result
    assert result["outcome"] == "success"
    assert result["detection"]["alarms"][0]["stage"] == "control"
    assert result["fault"]["activation"]["activation"] == "withheld"


@pytest.mark.parametrize(("option", "autopilot"), [("--hil", "px4"), ("--json", "ardupilot")])
def test_the_recipe_with_parts(option, autopilot, mavfi, free_port, tmp_path):
    """`mavfi sitl` in one terminal, `mavfi fly --link` in another."""
    if not (binary := os.environ.get(FIRMWARE[autopilot])):
        pytest.skip(f"{FIRMWARE[autopilot]} names no SITL binary of {autopilot}")
    line = ["sitl", option, autopilot, "--firmware", binary, "--world", "sparse", "--seed", "1"]
    line += ["--link", f"onboard=udpin:127.0.0.1:{free_port}"]
    with subprocess.Popen(
        [sys.executable, "-m", "mavfi_cli", *line], stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            assert any(f"{autopilot} is ready" in told for told in process.stderr)
            url = f"udpout:127.0.0.1:{free_port}"
            done = mavfi("fly", "--link", url, "--goal", "30,40,5", "--quiet", cwd=tmp_path)
        finally:
            process.terminate()
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("SUCCESS")
