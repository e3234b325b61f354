"""Sizes of differences between kernel outputs."""

import math

import numpy as np
import pytest

from mavfi_cli.attack.kernels.catalogue import numbers, pack, paths, unpack, voxels
from mavfi_cli.autonomy.occupancy import snapshot_of


def path(points, found=True):
    return {"found": np.array(found), "path_enu_m": np.array(points, float).reshape(-1, 3)}


def grid(points, nodes=50):
    payload = np.frombuffer(snapshot_of(np.array(points, float)).payload, np.uint8)
    return {"payload": payload, "nodes": np.array(nodes)}


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


def test_maps_differ_by_voxels():
    golden = grid([[0.1, 0.1, 0.1], [0.5, 0.1, 0.1]])
    found = voxels(golden, grid([[0.1, 0.1, 0.1], [0.9, 0.1, 0.1], [3.1, 0.1, 0.1]]))
    assert (found.absolute, found.relative) == (3.0, 1.5)
    assert found.text == "1 voxels missing, 2 added"
    assert voxels(golden, golden | {"nodes": np.array(55)}).relative == pytest.approx(0.1)


def test_paths_differ_by_length_and_ends():
    golden = path([[0, 0, 0], [10, 0, 0]])
    found = paths(golden, path([[0, 0, 0], [5, 0, 0], [5, 3, 0], [10, 3, 0]]))
    assert found.absolute == pytest.approx(3.0)
    assert found.relative == pytest.approx(0.3)
    assert math.isinf(paths(golden, path([], found=False)).relative)
    assert math.isinf(paths(golden, path([[0, 0, 0], [math.nan, 0, 0]])).relative)
