"""Real firmware flies our vehicle, where the environment names its SITL binary."""

import os
from dataclasses import replace

import numpy as np
import pytest
from missions import SHORT

from mavfi_cli.mission.progress import Watcher
from mavfi_cli.mission.record.run_folder import load_run
from mavfi_cli.mission.run import fly_mission
from mavfi_cli.spec.mission import FIRMWARE

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module", params=sorted(FIRMWARE))
def run(request, tmp_path_factory):
    autopilot = request.param
    if not os.environ.get(FIRMWARE[autopilot]):
        pytest.skip(f"{FIRMWARE[autopilot]} names no SITL binary of {autopilot}")
    config = replace(SHORT, autopilot=autopilot)
    folder = fly_mission(config, tmp_path_factory.mktemp(autopilot), Watcher())
    return load_run(folder.path)


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
