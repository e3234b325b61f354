from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mavfi_cli.core.errors import ConfigError, MavfiError, UnknownName, WorldError
from sitl.world import load_world, named_worlds
from sitl.world.plan import check_world
from sitl.world.world import CLEAR_RADIUS_M, distance_to_boxes

YARD = """name = "yard"
bounds_enu_m = [-10, -10, 0, 40, 40, 30]
start_enu_m = [0, 0, 0]
goal_enu_m = [20, 20, 5]

[[box]]
min_enu_m = [5, 5, 0]
max_enu_m = [8, 9, 10]
"""


@pytest.fixture
def yard(tmp_path: Path) -> Path:
    path = tmp_path / "yard.toml"
    path.write_text(YARD)
    return path


def test_a_users_world_is_what_its_file_says(yard: Path) -> None:
    world = load_world(str(yard), seed=0)
    assert world.name == "yard"
    assert world.boxes_enu_m.tolist() == [[5, 5, 0, 8, 9, 10]]
    assert world.goal_enu_m.tolist() == [20, 20, 5]


@pytest.mark.parametrize("name", ["sparse", "dense", "factory", "farm", "train-0.2-3"])
def test_a_world_written_and_read_back_is_the_same(name: str, tmp_path: Path) -> None:
    world = load_world(name, seed=11)
    path = tmp_path / "made.toml"
    path.write_text(world.toml())
    again = load_world(str(path), seed=11)
    assert again.name == name
    for field in ("boxes_enu_m", "bounds_enu_m", "start_enu_m", "goal_enu_m"):
        assert np.array_equal(getattr(again, field), getattr(world, field))


@pytest.mark.parametrize("name", ["factory", "farm"])
def test_a_hundred_seeds_of_a_scene_are_a_hundred_flyable_missions(name: str) -> None:
    worlds = [load_world(name, seed=seed) for seed in range(100)]
    missions = {(*world.start_enu_m, *world.goal_enu_m) for world in worlds}
    assert len(missions) == 100
    for world in worlds:
        found = check_world(world)
        assert 45.0 <= found.straight_m <= 55.0
        assert found.path_exists
        for place in (world.start_enu_m, world.goal_enu_m):
            assert distance_to_boxes(world.boxes_enu_m, place, plan=True).min() >= CLEAR_RADIUS_M


def test_nothing_in_the_farm_reaches_flight_height() -> None:
    tops = load_world("farm", seed=0).boxes_enu_m[:, 5]
    assert 1.0 <= tops.min() <= tops.max() <= 2.0


def test_most_factory_missions_have_an_obstacle_on_the_straight_way() -> None:
    longer = [check_world(load_world("factory", seed=seed)) for seed in range(50)]
    assert sum(c.path_m > c.straight_m + 1.0 for c in longer if c.path_m) > 25


def test_given_start_and_goal_win(yard: Path) -> None:
    for name in ("factory", "dense", str(yard)):
        world = load_world(name, seed=5, start_enu_m=(1, 2, 0), goal_enu_m=(12, 20, 4))
        assert world.start_enu_m.tolist() == [1, 2, 0]
        assert world.goal_enu_m.tolist() == [12, 20, 4]


def test_arrays_cannot_be_written_to() -> None:
    with pytest.raises(ValueError, match="read-only"):
        load_world("dense", seed=0).boxes_enu_m[0, 0] = 1.0


def test_every_name_loads() -> None:
    for name in named_worlds():
        assert load_world(name, seed=0).name == name


def test_an_unknown_name_suggests_the_nearest() -> None:
    with pytest.raises(UnknownName, match="did you mean 'factory'"):
        load_world("factroy", seed=0)


def test_a_negative_seed_is_refused() -> None:
    with pytest.raises(WorldError, match=r"seed .*at least 0, got -1"):
        load_world("dense", seed=-1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"goal_enu_m": (30, 50, 5)}, "goal .* inside an obstacle"),
        ({"goal_enu_m": (300, 0, 5)}, "goal .* outside the world"),
        ({"start_enu_m": (18, 2, 0)}, "start .* blocked"),
        ({"start_enu_m": (-90, 2, 0)}, "start .* outside the world"),
        ({"goal_enu_m": (1, float("nan"), 5)}, "three finite numbers"),
        ({"start_enu_m": (1, 2)}, "three finite numbers"),
    ],
)
def test_unusable_places_say_why_in_one_line(arguments: dict[str, tuple[float]], message: str):
    with pytest.raises(WorldError, match=message) as caught:
        load_world("factory", seed=0, **arguments)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("before", "after", "line", "message"),
    [
        ("[20, 20, 5]", "[20, 20,, 5]", 4, "Invalid value"),
        ("goal_enu_m", "gaol_enu_m", 4, "did you mean 'goal_enu_m'"),
        ("max_enu_m", "maximum", 8, "maximum"),
        ("[8, 9, 10]", "[8, 4, 10]", 6, r"box\[0\]: max_enu_m must be above"),
        ("[8, 9, 10]", "[8, 9]", 8, "must have 3 values, got 2"),
        ("[20, 20, 5]", "[20, 20]", 4, "must have 3 values, got 2"),
        ("[20, 20, 5]", "[20, 20, nan]", 4, "finite"),
        ("[5, 5, 0]", '["a", 5, 0]', None, "must be a number"),
    ],
)
def test_a_malformed_file_says_where(
    yard: Path, before: str, after: str, line: int | None, message: str
) -> None:
    yard.write_text(YARD.replace(before, after))
    with pytest.raises(ConfigError, match=message) as caught:
        load_world(str(yard), seed=0)
    text = str(caught.value)
    assert text.startswith(f"{yard}:{line}: " if line else str(yard))
    assert "\n" not in text


@pytest.mark.parametrize(
    ("most", "line"), [("[1, 2, 2]", 10), ('["a", 2, 2]', 12), ("[2, 2]", 12), (None, 10)]
)
def test_a_second_bad_box_is_found_on_its_own_line(yard: Path, most: str, line: int) -> None:
    end = f"max_enu_m = {most}\n" if most else ""  # else it is missing
    yard.write_text(f"{YARD}\n[[box]]\nmin_enu_m = [1, 1, 1]\n{end}")
    with pytest.raises(ConfigError, match=rf"yard\.toml:{line}: box\[1\]"):
        load_world(str(yard), seed=0)


@pytest.mark.parametrize(
    "bounds", ["[0, 0, 0, -1, 40, 30]", "[-10, -10, 0, 40, 40, 0]", "[-10, -10, 0, 40, 40]"]
)
def test_bounds_that_bound_nothing_are_refused(yard: Path, bounds: str) -> None:
    yard.write_text(YARD.replace("[-10, -10, 0, 40, 40, 30]", bounds))
    with pytest.raises(MavfiError, match="bounds_enu_m"):
        load_world(str(yard), seed=0)


def test_a_scene_without_room_says_so(yard: Path) -> None:
    yard.write_text(YARD.replace("start_enu_m = [0, 0, 0]\n", "").replace("20, 20, 5", "15, 15, 5"))
    with pytest.raises(WorldError, match="found no start and goal"):
        load_world(str(yard), seed=0)


@pytest.mark.parametrize("spec", ["gen:", "gen:0.2", "gen:a,b", "gen:2,5", "gen:0.2,50"])
def test_a_spec_that_is_none_is_refused(spec: str) -> None:
    with pytest.raises(WorldError):
        load_world(spec, seed=0)


def test_a_missing_file_and_one_that_is_no_text(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="No such file"):
        load_world(str(tmp_path / "none.toml"), seed=0)
    (tmp_path / "b.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="UTF-8"):
        load_world(str(tmp_path / "b.toml"), seed=0)
