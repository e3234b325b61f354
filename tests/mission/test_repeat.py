"""The same mission gives the same bytes, whatever else the machine does."""

import contextlib
import json
import subprocess
import sys
from dataclasses import replace

import pytest

from mavfi_cli.mission.progress import Watcher
from mavfi_cli.mission.run import fly_mission


def record(folder):
    """What must repeat: both files to the byte, and result.json but for the host's part."""
    result = json.loads(folder.result.read_text())
    del result["host"]
    return folder.trace.read_bytes(), folder.tlog.read_bytes(), json.dumps(result)


@contextlib.contextmanager
def both_cores_loaded():
    with contextlib.ExitStack() as stack:
        for _ in range(2):
            busy = subprocess.Popen([sys.executable, "-c", "while True: pass"])
            stack.callback(busy.wait)
            stack.callback(busy.kill)
        yield


@pytest.fixture(scope="module")
def golden(troubled_flight):
    """Of a flight that slows, stops and replans: much more could differ than on a straight."""
    config = json.loads(troubled_flight.result.read_text())["config"]
    return config, record(troubled_flight)


@pytest.fixture
def again(golden, short_config, tmp_path):
    config, _ = golden

    def fly(**changes):
        mission = replace(short_config, **{**config, **changes})
        return fly_mission(mission, tmp_path / "again", Watcher())

    return fly


@pytest.mark.slow
def test_twice_and_on_a_busy_machine_byte_for_byte(golden, again):
    assert record(again()) == golden[1]
    with both_cores_loaded():
        assert record(again()) == golden[1]


@pytest.mark.slow
def test_nodes_in_processes_of_their_own_change_nothing(golden, again):
    folder = again(isolate=("octomap", "planner"))
    assert record(folder) == golden[1]
    assert json.loads(folder.result.read_text())["host"]["isolated"] == ["octomap", "planner"]


def test_another_seed_is_another_flight(golden, again):
    trace, tlog, _ = record(again(seed=3))
    assert trace != golden[1][0]
    assert tlog != golden[1][1]
