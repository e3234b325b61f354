"""Every registered planner passes the contract suite."""

from importlib.metadata import EntryPoint, EntryPoints

import numpy as np
import pytest

from mavfi_cli.autonomy import OUR_PLANNERS, planners
from mavfi_cli.autonomy.occupancy import MapSnapshot
from mavfi_cli.core import installed
from mavfi_cli.core.errors import MavfiError, UnknownName
from mavfi_cli.testing import PlannerContract
from mavfi_cli.testing.suites import PARAMS

posed, wall_with_gap = PlannerContract.posed, PlannerContract.wall_with_gap


class TestPlanners(PlannerContract):
    @pytest.fixture(params=planners.PLANNERS.names)
    def name(self, request):
        return request.param


def test_a_start_outside_the_bounds_widens_them():
    start = np.array([-9.0, 0.0, 0.5])
    problem = posed(MapSnapshot.empty(), start)
    assert problem.grid.bounds_enu_m.tolist() == [-9, -12, 0.5, 25, 12, 10]


def length_m(result):
    return np.linalg.norm(np.diff(result.path_enu_m, axis=0), axis=1).sum()


def test_rrt_star_is_no_longer_than_rrt():
    problem = posed(wall_with_gap())
    seeds = range(5)
    star, plain = (
        np.mean([length_m(planners.find(name).plan(problem, seed)) for seed in seeds])
        for name in ("rrtstar", "rrt")
    )
    shortest = 2 * np.hypot(10.2, 4 + PARAMS.radius_m)
    assert star < 0.95 * plain
    assert star < 1.1 * shortest


def test_names_are_found_however_they_are_written():
    for written in ("RRT*", "rrt-star", "RRTStar", "rrt_star"):
        assert planners.find(written).name == "rrtstar"


def test_an_unknown_name_names_the_nearest():
    with pytest.raises(UnknownName, match="did you mean 'rrtconnect'"):
        planners.find("rrtconect")


@pytest.mark.parametrize("name", ["rrtstar", "rrt", "rrtconnect"])
def test_another_seed_draws_another_path(name):
    problem, planner = posed(wall_with_gap()), planners.find(name)
    paths = [planner.plan(problem, seed).path_enu_m for seed in (7, 8)]
    assert not np.array_equal(*paths)


class Straight:
    name = "straight"

    def plan(self, problem, seed):
        return None


@pytest.fixture
def plugged_in(monkeypatch):
    """Two plug-ins: one that works, and one whose module does not exist."""
    entries = EntryPoints(
        EntryPoint(name, value, "mavfi.planners")
        for name, value in (("straight", f"{__name__}:Straight"), ("gone", "nowhere_at_all:Gone"))
    )
    monkeypatch.setattr(installed, "entry_points", lambda group: entries)
    found = installed.PlugIns("mavfi.planners", "planner", OUR_PLANNERS)
    monkeypatch.setattr(planners, "PLANNERS", found)


def test_other_packages_plug_in_by_entry_point(plugged_in):
    assert planners.PLANNERS.names[3:] == ["gone", "straight"]
    assert planners.find("straight").name == "straight"


def test_a_plug_in_that_does_not_load_is_an_error_of_one_line(plugged_in):
    with pytest.raises(MavfiError, match=r"'gone' \(nowhere_at_all:Gone\) cannot be loaded: Mod"):
        planners.find("gone")


@pytest.mark.parametrize("spelling", ["rrt-star", "RRT*", "rrt_star", "RRTstar", "rrtstar"])
def test_a_mission_keeps_the_one_name_of_a_planner(spelling):
    """So that flights are grouped together, and paired, whatever was typed."""
    from mavfi_cli.spec.mission import MissionConfig

    assert MissionConfig(planner=spelling).to_dict()["planner"] == "rrtstar"
    assert MissionConfig(planner="Straight-Up").planner == "Straight-Up"  # a plug-in's own
