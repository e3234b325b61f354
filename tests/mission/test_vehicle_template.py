"""Vehicles that are forks of a warm template: as good as programs, and none is left."""

import json
import os
import signal
from dataclasses import replace

import pytest

from mavfi_cli.core.errors import VehicleProcessError
from mavfi_cli.mission.progress import Watcher
from mavfi_cli.mission.run import fly_mission
from mavfi_cli.mission.vehicle_process import VehicleProcess
from mavfi_cli.mission.vehicle_template import VehicleTemplate

LONG_S = 60.0


@pytest.fixture
def template():
    with_vehicles = VehicleTemplate()
    yield with_vehicles
    with_vehicles.close()


def children(pid):
    with open(f"/proc/{pid}/task/{pid}/children") as listed:
        return [int(child) for child in listed.read().split()]


def start(template, config, folder):
    """A vehicle, the companion's end of its link, and its process id once it is there."""
    process = VehicleProcess(config, folder, template)
    link = process.detach()
    os.read(link, 1 << 16)  # the first tick
    (pid,) = children(template.pid)
    return process, link, pid


def record(folder):
    result = json.loads(folder.result.read_text())
    del result["host"]
    files = (folder.trace, folder.plans, folder.tlog)
    return result, [path.read_bytes() for path in files]


def test_one_template_serves_missions_in_turns_and_each_is_as_by_itself(
    template, short_config, fly_short, tmp_path
):
    for seed in (5, 6, 5):
        mission = replace(short_config, seed=seed)
        flown = fly_mission(mission, tmp_path, Watcher(), vehicles=template)
        assert record(flown) == record(fly_short(seed=seed))
        assert children(template.pid) == []


def test_a_world_that_cannot_be_flown_is_told_as_the_program_tells_it(
    template, short_config, tmp_path
):
    blocked = replace(short_config, start=(-100.0, 0.0, 0.0))
    said = []
    for vehicles in (None, template):
        with pytest.raises(VehicleProcessError) as caught:
            fly_mission(blocked, tmp_path, Watcher(), vehicles=vehicles)
        said.append(str(caught.value))
    assert said[0] == said[1]
    assert "start" in said[0]


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSEGV])
def test_what_killed_a_vehicle_is_known(template, short_config, tmp_path, number):
    process, link, pid = start(template, short_config, tmp_path)
    os.kill(pid, number)
    process.stop(LONG_S)
    assert str(process.failure()) == f"the vehicle process was killed by {number.name}"
    os.close(link)
    process.close()


def test_a_vehicle_that_does_not_end_is_killed(template, short_config, tmp_path):
    process, link, _ = start(template, short_config, tmp_path)
    process.stop(0.0)  # the link is still open
    assert str(process.failure()).endswith("killed by SIGKILL")
    assert children(template.pid) == []
    os.close(link)
    process.close()


def test_a_vehicle_ends_well_when_the_link_closes(template, short_config, tmp_path):
    process, link, _ = start(template, short_config, tmp_path)
    os.close(link)
    process.stop(LONG_S)
    assert process.failure() is None
    assert (tmp_path / "truth.json").is_file()
    process.close()


def test_settling_leaves_no_vehicle_and_a_template_that_goes_on(template, short_config, tmp_path):
    process, link, _ = start(template, short_config, tmp_path)
    assert template.settle(LONG_S)
    assert children(template.pid) == []
    assert str(process.failure()).endswith("killed by SIGKILL")
    os.close(link)
    process.close()
    again, link, _ = start(template, short_config, tmp_path)
    os.close(link)
    again.stop(LONG_S)
    assert again.failure() is None
    again.close()


def test_a_killed_template_takes_its_vehicles_along_and_is_not_started_from(
    template, short_config, tmp_path, await_end
):
    process, link, pid = start(template, short_config, tmp_path)
    vehicle = os.pidfd_open(pid)
    os.kill(template.pid, signal.SIGKILL)
    await_end(vehicle)
    os.close(vehicle)
    process.stop(LONG_S)
    assert str(process.failure()).endswith("killed by SIGKILL")
    os.close(link)
    process.close()
    assert not template.settle(LONG_S)
    with pytest.raises(VehicleProcessError, match="its template is gone"):
        VehicleProcess(short_config, tmp_path, template)
