"""Sizes of differences between kernel outputs."""

import math

import numpy as np
import pytest

from mavfi_cli.attack.kernels.catalogue import KERNELS, pack, unpack
from mavfi_cli.autonomy.occupancy import MapSnapshot, OccupancyMap, OccupancyParams
from mavfi_cli.core.types import PointCloud

numbers, maps, checks, paths = (
    KERNELS[name].compare for name in ("control", "octomap", "collision_check", "rrt")
)


def path(points, found=True):
    return {"found": np.array(found), "path_enu_m": np.array(points, float).reshape(-1, 3)}


@pytest.fixture(scope="module")
def mapped():
    """A map of one cloud, as the kernel returns it."""
    world = OccupancyMap(OccupancyParams())
    points = np.array([[3.1, 0.1, 1.1], [3.1, 0.5, 1.1], [3.1, 0.9, 1.1]])
    world.insert(PointCloud(stamp_s=0.0, points_enu_m=points, origin_enu_m=np.array([0.0, 0, 1])))
    payload = np.frombuffer(world.snapshot().payload, np.uint8)
    return pack({"payload": payload, "tree": lambda: np.frombuffer(world.tree(), np.uint8)})


def changed(mapped, node, value=None, children=None):
    """That map with another value of one node, or other children."""
    output = unpack(mapped)
    tree = output["tree"].copy()
    begin = tree.tobytes().index(b"\ndata\n") + 6 + 5 * node
    if value is not None:
        tree[begin : begin + 4] = np.frombuffer(np.float32(value).tobytes(), np.uint8)
    if children is not None:
        tree[begin + 4] = children
    return output | {"tree": tree}


def test_packed_outputs_come_back():
    output = {"a": np.arange(6.0).reshape(2, 3), "b": np.array([True]), "c": np.empty((0, 3))}
    back = unpack(pack(output))
    assert list(back) == list(output)
    for name, array in output.items():
        assert back[name].dtype == array.dtype
        np.testing.assert_array_equal(back[name], array)
    assert pack(back) == pack(output)


def test_damaged_bytes_are_refused():
    data = bytearray(pack({"a": np.arange(4.0)}))
    data[3] ^= 0xFF
    with pytest.raises(ValueError, match=r"damaged|pickled"):
        unpack(bytes(data))


def test_whatever_the_damage_it_is_one_error():
    """A kernel that goes wrong may write anything; a header of an array is a Python literal."""
    whole = pack({"a": np.arange(24.0).reshape(2, 12), "b": np.array([True])})
    rng = np.random.default_rng(1)
    letters = np.frombuffer(b"0123456789'(){}[],:<>fiuVOS \n\"", np.uint8)
    refused = 0
    for _ in range(3000):
        data = np.frombuffer(whole, np.uint8).copy()
        data[rng.integers(len(data), size=3)] = rng.choice(letters, 3)
        try:
            unpack(data.tobytes())
        except ValueError:
            refused += 1
    assert 1000 < refused < 3000


def test_numbers_have_an_absolute_and_a_relative_size():
    golden = {"v": np.array([2.0, 0.0, math.nan, math.inf])}
    found = numbers(golden, {"v": np.array([2.5, 0.125, math.nan, math.inf])})
    assert (found.absolute, found.relative) == (0.5, 0.25)
    assert found.text == "2 of 4 numbers"


@pytest.mark.parametrize("other", [[2.0], [2.0, math.nan], [2.0, math.inf]])
def test_what_cannot_be_compared_is_infinitely_different(other):
    found = numbers({"v": np.array([2.0, 3.0])}, {"v": np.array(other)})
    assert math.isinf(found.relative)
    assert found.to_json()["relative"] is None


@pytest.mark.parametrize(
    "damage",
    [
        b"",
        b"\ndata\n",
        b"\ndata\n" + bytes(4),
        b"\ndata\n" + bytes([0, 0, 0, 0, 1]),
        b"\ndata\n" + bytes([0, 0, 0, 0, 1]) * 40,
    ],
)
def test_what_is_no_tree_cannot_be_compared(mapped, damage):
    golden = unpack(mapped)
    found = maps(golden, golden | {"tree": np.frombuffer(damage, np.uint8)})
    assert (found.relative, found.text) == (math.inf, "the tree cannot be read")


def test_maps_differ_by_nodes_and_by_what_a_planner_sees(mapped):
    golden = unpack(mapped)
    _, _, data = golden["tree"].tobytes().partition(b"\ndata\n")
    nodes = np.frombuffer(data, [("value", "<f4"), ("children", "u1")])
    leaf = nodes["children"] == 0
    hits = np.flatnonzero(leaf & (nodes["value"] > 0.0))
    hit, miss = int(hits[0]), int(np.flatnonzero(leaf & (nodes["value"] < 0.0))[0])
    assert len(hits) == 3
    same = maps(golden, golden)
    assert (same.relative, same.noticeable) == (0.0, False)
    unseen = maps(golden, changed(mapped, miss, value=-1.5))
    assert (unseen.absolute, unseen.unit, unseen.noticeable) == (1.0, "nodes", False)
    assert unseen.parts["log_odds"] == pytest.approx(1.5 + nodes["value"][miss])
    assert unseen.relative == 1.0 / len(nodes)
    free = maps(golden, changed(mapped, hit, value=-0.5))
    occupied = maps(golden, changed(mapped, miss, value=0.5))
    assert (free.parts["false_free"], free.parts["false_occupied"]) == (1, 0)
    assert (occupied.parts["false_free"], occupied.parts["false_occupied"]) == (0, 1)
    assert free.noticeable
    assert occupied.noticeable


def test_the_planners_map_may_differ_where_the_tree_does_not(mapped):
    golden = unpack(mapped)
    payload = np.frombuffer(MapSnapshot.of_points(np.array([[3.1, 0.1, 1.1]])).payload, np.uint8)
    found = maps(golden, golden | {"payload": payload})
    assert (found.parts["nodes"], found.parts["missing_for_planner"]) == (0, 2)
    assert (found.unit, found.absolute, found.noticeable) == ("voxels", 2.0, True)
    assert found.relative > 0.0


def test_a_lost_branch_makes_its_voxels_free(mapped):
    golden = unpack(mapped)
    root = changed(mapped, 0, value=-1.0, children=0)
    whole = root["tree"].tobytes()
    cut = np.frombuffer(whole[: whole.index(b"\ndata\n") + 6 + 5], np.uint8)
    found = maps(golden, golden | {"tree": cut})
    assert found.parts["false_free"] == 3
    assert math.isinf(maps(golden, root).relative)  # nodes after the end of the tree


def report(times_s):
    times_s = np.array(times_s)
    return {"collision": np.isfinite(times_s), "time_to_collision_s": times_s}


def test_checks_differ_pose_by_pose():
    golden = report([math.inf, 1.5, 0.5])
    missed = checks(golden, report([math.inf, math.inf, 0.5]))
    assert (missed.parts["missed"], missed.parts["false_alarms"]) == (1, 0)
    alarm = checks(golden, report([2.0, 1.5, 0.5]))
    assert (alarm.parts["missed"], alarm.parts["false_alarms"]) == (0, 1)
    late, much = (checks(golden, report([math.inf, 1.5, t])) for t in (0.55, 0.75))
    assert late.parts["gap_s"] == pytest.approx(0.05)
    assert [f.noticeable for f in (missed, alarm, late, much)] == [True, True, False, True]
    assert late.relative == pytest.approx(0.1)
    assert checks(golden, golden).relative == 0.0


def test_paths_differ_by_length_and_by_how_far_they_are_apart():
    golden = path([[0, 0, 0], [10, 0, 0]])
    found = paths(golden, path([[0, 0, 0], [5, 0, 0], [5, 3, 0], [10, 3, 0]]))
    assert found.parts == {"longer_m": pytest.approx(3.0), "apart_m": pytest.approx(3.0)}
    assert found.absolute == pytest.approx(3.0)
    assert found.relative == pytest.approx(0.3)
    assert math.isinf(paths(golden, path([], found=False)).relative)
    assert math.isinf(paths(golden, path([[0, 0, 0], [math.nan, 0, 0]])).relative)


def test_a_path_elsewhere_is_another_path_even_if_it_is_as_long():
    golden = path([[0, 0, 0], [5, 3, 0], [10, 0, 0]])
    mirrored = paths(golden, path([[0, 0, 0], [5, -3, 0], [10, 0, 0]]))
    assert mirrored.parts["longer_m"] == pytest.approx(0.0, abs=1e-12)
    assert mirrored.parts["apart_m"] > 2.0
    assert mirrored.noticeable
    near = paths(golden, path([[0, 0, 0], [5, 3.05, 0], [10, 0, 0]]))
    assert 0.0 < near.absolute < 0.1
    assert not near.noticeable
