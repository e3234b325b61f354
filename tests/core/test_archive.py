"""Archives: what is written reads back equal; nothing that somebody else wrote is executed."""

import io
import json
import os
from dataclasses import dataclass, replace

import numpy as np
import pytest

from mavfi_cli.core.archive import pack, unpack
from mavfi_cli.core.types import DepthFrame, FloatArray, Trajectory


@dataclass(frozen=True, kw_only=True)
class _Value:
    frames: tuple[tuple[DepthFrame, float], ...]
    plan: Trajectory | None = None
    payload: bytes = b""
    points_enu_m: FloatArray


def value():
    place = np.array([1.0, -np.inf, 3.0])
    frame = DepthFrame(
        stamp_s=0.1,
        depth_m=np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        hfov_rad=np.float64(1.5),
        position_enu_m=place,
        quaternion=np.ones(4),
    )
    points = np.arange(6.0).reshape(2, 3)
    points.flags.writeable = False
    moved = (replace(frame, stamp_s=0.2), np.inf)
    return _Value(frames=((frame, 0.5), moved), payload=b"\0\xff", points_enu_m=points)


def test_a_value_reads_back_with_its_arrays_as_they_were():
    (first, _), (second, end_s) = unpack(pack(value()), _Value).frames
    assert first.depth_m.flags.f_contiguous
    assert not first.depth_m.flags.c_contiguous
    np.testing.assert_array_equal(first.depth_m, value().frames[0][0].depth_m)
    assert second.position_enu_m is first.position_enu_m  # as in what was written
    assert (second.stamp_s, first.hfov_rad, end_s) == (0.2, 1.5, np.inf)
    back = unpack(pack(value()), _Value)
    assert (back.plan, back.payload) == (None, b"\0\xff")
    assert not back.points_enu_m.flags.writeable
    assert pack(back) == pack(value())


class _Bomb:
    def __reduce__(self):
        return os._exit, (3,)


def archive(text, data=b"", save=np.savez):
    file = io.BytesIO()
    save(file, value=text, data=np.frombuffer(data, np.uint8))
    return file.getvalue()


def changed(change):
    """An archive whose JSON is changed."""
    with np.load(io.BytesIO(pack(value()))) as arrays:
        tree, data = json.loads(arrays["value"].tobytes()), arrays["data"].tobytes()
    change(tree)
    return archive(np.frombuffer(json.dumps(tree).encode(), np.uint8), data)


def setter(key, item):
    return lambda tree: tree.__setitem__(key, item)


@pytest.mark.parametrize(
    ("foreign", "problem"),
    [
        (b"", "BadZipFile"),
        (archive(np.array([_Bomb()], object)), "allow_pickle"),
        (archive(np.zeros(1 << 20, np.uint8), save=np.savez_compressed), "compressed"),
        (archive(np.frombuffer(b"[" * 10**6, np.uint8)), "Recursion"),
        (changed(setter("other", 1)), "other"),
        (changed(setter("frames", 7)), "TypeError"),
        (changed(setter("plan", {"stamp_s": "now"})), "must be of type float"),
        (changed(setter("points_enu_m", {"$array": [0, "<f8", [2, 2], "C", True]})), r"\(2, 2\)"),
        (changed(setter("points_enu_m", {"$array": [0, "<f8", [9**9, 3], "C", 1]})), "buffer"),
        (
            changed(setter("points_enu_m", {"$array": [0, "|O", [2, 3], "C", True]})),
            "unsupported kind",
        ),
        (
            changed(setter("points_enu_m", {"$array": [-8, "<f8", [1, 3], "C", 1]})),
            "unsupported kind",
        ),
        (changed(setter("points_enu_m", [[1.0, 2.0, 3.0]])), "must be an array"),
    ],
)
def test_what_somebody_else_wrote_is_one_clear_error(foreign, problem):
    with pytest.raises(ValueError, match=problem):
        unpack(foreign, _Value)
