"""Whole flights that several test modules read: flown once a test process."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace

import pytest

from mavfi_cli.mission.config import MissionConfig
from mavfi_cli.mission.progress import Watcher
from mavfi_cli.mission.run import fly_mission

SHORT = MissionConfig(world="farm", seed=5, start=(2.0, 2.0, 0.0), goal=(10.0, 6.0, 5.0))


@pytest.fixture(scope="session")
def short_config():
    """A mission of some 20 simulated seconds, take-off included; less than a second of work."""
    return SHORT


@pytest.fixture(scope="session")
def fly_short(tmp_path_factory):
    """Fly the short mission with changes, in this process; its run folder."""
    out = tmp_path_factory.mktemp("runs")

    def fly(watcher=None, **changes):
        return fly_mission(replace(SHORT, **changes), out, watcher or Watcher())

    return fly


@pytest.fixture(scope="session")
def short_flight(fly_short):
    """Run folder of one successful flight; do not change it."""
    return fly_short()


@pytest.fixture(scope="session")
def troubled_flight(tmp_path_factory):
    """Run folder of a flight that had to replan: boxes stand in the straight way."""
    folder = tmp_path_factory.mktemp("troubled")
    world = folder / "posts.toml"
    world.write_text(
        'name = "posts"\nbounds_enu_m = [-10.0, -20.0, 0.0, 40.0, 20.0, 20.0]\n'
        "start_enu_m = [0.0, 0.0, 0.0]\ngoal_enu_m = [20.0, 0.0, 5.0]\n"
        "[[box]]\nmin_enu_m = [9.0, -4.0, 0.0]\nmax_enu_m = [12.0, 3.0, 12.0]\n"
    )
    return fly_mission(MissionConfig(world=str(world), seed=2), folder / "runs", Watcher())


@pytest.fixture(scope="session")
def mavfi():
    """Run the command line in a process of its own, as a user does."""

    def run(*arguments, timeout=120.0, **options):
        return subprocess.run(
            [sys.executable, "-m", "mavfi_cli", *map(str, arguments)],
            capture_output=True, text=True, timeout=timeout, check=False,
            env={**os.environ, "PYTHONWARNINGS": "error"}, **options,
        )  # fmt: skip

    return run
