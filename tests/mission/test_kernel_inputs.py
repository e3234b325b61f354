"""Inputs of isolated kernels: several of each, the same every time."""

import math

import pytest
from missions import POSTS

from mavfi_cli.attack.kernels.inputs import load_inputs, save_inputs
from mavfi_cli.autonomy import collision
from mavfi_cli.autonomy.planners import PlanningParams, PlanningProblem
from mavfi_cli.core.errors import ConfigError, TargetError
from mavfi_cli.mission.kernel_inputs import kernel_targets, record_inputs
from mavfi_cli.spec.mission import MissionConfig


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    world = tmp_path_factory.mktemp("posts") / "posts.toml"
    world.write_text(POSTS)
    return MissionConfig(world=str(world), seed=2, stack="hardened")


@pytest.fixture(scope="module")
def inputs(config):
    return record_inputs(config)


@pytest.mark.slow
def test_every_kernel_has_five_inputs_that_differ(inputs):
    assert len(inputs) == 5
    assert len({each.frame.stamp_s for each in inputs}) == 5
    assert len({len(each.mapped) for each in inputs}) == 5
    assert len({each.check.time_s for each in inputs}) == 5
    assert len({each.tracking.stamp_s for each in inputs}) == 5
    problems = {(*each.task.start_enu_m.tolist(), each.task.snapshot.payload) for each in inputs}
    assert len(problems) == 5


@pytest.mark.slow
def test_a_straight_line_answers_none_of_the_planning_problems(inputs):
    for task in (each.task for each in inputs):
        posed = PlanningProblem.pose(
            task.snapshot, task.start_enu_m, task.goal_enu_m, task.bounds_enu_m, PlanningParams()
        )
        assert posed.grid.point_free(task.start_enu_m)
        assert posed.grid.point_free(task.goal_enu_m)
        assert not posed.grid.segment_free(task.start_enu_m, task.goal_enu_m)


def test_some_trajectories_are_free_and_some_are_not_if_the_flight_had_both(inputs):
    params, checks = collision.CollisionParams(), [each.check for each in inputs]
    times_s = [
        collision.step(collision.CollisionState(), check, params)[1].time_to_collision_s
        for check in checks
    ]
    assert sum(map(math.isinf, times_s)) >= 3


@pytest.mark.slow
def test_the_same_mission_gives_the_same_bytes(config, inputs, tmp_path):
    (target,) = kernel_targets(["control"], config, tmp_path)
    assert target.inputs_sha256 == save_inputs(tmp_path / "again.npz", inputs)
    assert load_inputs(target.inputs)[1] == target.inputs_sha256
    with pytest.raises(ConfigError, match="inputs come from another flight"):
        kernel_targets([], MissionConfig(world="farm"), tmp_path)


@pytest.mark.slow
def test_a_flight_without_a_detour_has_no_planning_problems(monkeypatch):
    monkeypatch.setattr("mavfi_cli.mission.kernel_inputs._FLIGHTS", 2)
    with pytest.raises(TargetError, match="had to avoid obstacles too few times"):
        record_inputs(MissionConfig(world="farm", seed=1, stack="hardened"))
