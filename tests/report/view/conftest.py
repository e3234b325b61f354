"""One flight with a fault and its golden flight, watched as they were flown."""

from dataclasses import replace
from importlib.util import find_spec

import pytest

from mavfi_cli.mission.progress import Recorder, Watcher
from mavfi_cli.mission.run import fly_mission
from mavfi_cli.mission.run_folder import load_run
from mavfi_cli.report.view.entries import ViewedFlight
from mavfi_cli.spec.detector import DetectorConfig
from mavfi_cli.spec.fault import FaultConfig

_NEEDED = {"test_mcap_file.py": "mcap_protobuf", "test_rerun_file.py": "rerun"}
collect_ignore = [name for name, package in _NEEDED.items() if find_spec(package) is None]
FAULT = FaultConfig(target="waypoint_position", field="exponent", together=True, at="time=2")


@pytest.fixture(scope="session")
def pair(short_config, tmp_path_factory):
    """A golden flight, and one with a fault that a detector sees."""
    out = tmp_path_factory.mktemp("watched")
    struck = replace(short_config, fault=FAULT, detector=DetectorConfig(name="aad"))
    flights = []
    for name, config in (("golden", short_config), ("faulty", struck)):
        recorder = Recorder()
        run = load_run(fly_mission(config, out, Watcher(), recorder=recorder).path)
        flights.append(ViewedFlight(name=name, run=run, recorder=recorder))
    return flights
