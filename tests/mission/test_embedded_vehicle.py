"""The vehicle inside the mission's process: its records, and what becomes of its errors."""

import select
from dataclasses import replace

import pytest
from record_digest import record_digest

from mavfi_cli.campaigns.begin import check_names
from mavfi_cli.core.errors import PlaceError, UnknownName, VehicleProcessError
from mavfi_cli.mission.run_folder import load_run
from mavfi_cli.mission.vehicle import Vehicle, VehicleProcess
from mavfi_cli.spec.detector import DetectorConfig
from mavfi_cli.spec.fault import FaultConfig
from sitl.simulation import Simulation

FAULT = FaultConfig(target="command_velocity", at="time=1", together=True, field="exponent", seed=2)
FILES = ("flight.tlog", "trace.parquet", "plans.parquet", "kernels.parquet")


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"stack": "mavbench", "land": True},
        {"fault": FAULT, "detector": DetectorConfig(name="gad")},
        {"isolate": ("octomap", "planner")},
    ],
)
def test_the_record_is_that_of_two_processes_with_a_socket_between(fly_short, changes):
    here, apart = fly_short(**changes), fly_short(launch=VehicleProcess, **changes)
    for name in FILES:
        assert (here.path / name).read_bytes() == (apart.path / name).read_bytes(), name
    assert record_digest(here.path) == record_digest(apart.path)


def test_only_a_flight_by_the_wall_clock_has_a_vehicle_in_another_process(short_config):
    paced = replace(short_config, realtime=True)
    for config, expected in ((short_config, False), (paced, True)):
        vehicle = Vehicle.start(config)
        assert isinstance(vehicle, VehicleProcess) == expected
        assert vehicle.end() is None


@pytest.mark.parametrize("start", [Vehicle.start, VehicleProcess])
def test_the_vehicle_starts_where_the_mission_does_to_the_last_digit(short_config, start):
    place = (1.0 / 3.0, -2.0 / 7.0, 0.0)
    vehicle = start(replace(short_config, world="sparse", start=place, goal=None))
    if isinstance(vehicle, VehicleProcess):
        select.select([vehicle.link.fileno()], [], [])  # its first message follows the briefing
    assert vehicle.briefing().start_enu_m.tolist() == list(place)
    assert vehicle.end() is None
    assert vehicle.truth is not None


@pytest.fixture
def fails_at(monkeypatch):
    """Have the simulation raise an error at a stamp."""
    advance = Simulation.advance

    def fail(stamp_s, error):
        def advance_or_fail(self):
            if self.stamp_us >= stamp_s * 1e6:
                raise error
            advance(self)

        monkeypatch.setattr(Simulation, "advance", advance_or_fail)

    return fail


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (VehicleProcessError("physics diverged at 12.00 s"), "physics diverged at 12.00 s"),
        (IndexError("a defect"), "IndexError: a defect"),
    ],
)
def test_a_vehicle_that_breaks_is_a_lost_link_with_its_reason(fly_short, fails_at, error, told):
    fails_at(12.0, error)
    run = load_run(fly_short().path)
    assert run.result["outcome"] == "link_lost"
    assert run.result["reason"].endswith(told)
    assert run.result["referee"] is not None  # the truth up to there
    assert run.result["simulated_s"] == 12.0


@pytest.mark.parametrize(
    ("changes", "error", "text"),
    [
        ({"world": "fram"}, UnknownName, "'fram'.* 'farm'"),
        ({"vehicle": "sole"}, UnknownName, "'sole'"),
        ({"goal": (1e6, 0.0, 5.0)}, PlaceError, "goal"),
    ],
)
def test_what_the_vehicle_refuses_is_one_clear_error(
    short_config, fly_short, changes, error, text, capfd
):
    with pytest.raises(error, match=text):
        fly_short(**changes)
    with pytest.raises(VehicleProcessError, match=text):
        check_names(replace(short_config, **changes))
    assert capfd.readouterr().err == ""
