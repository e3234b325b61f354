"""Packs dataclasses with arrays into bytes, as numpy's `.npz`. Reading them executes no code.

An archive has two arrays of bytes. `value` is JSON, in which an array is given by its offset in
`data`, dtype, shape, order and writeability. An array that occurs twice is stored once. Equal
values give equal bytes. An archive is untrusted: sizes are bounded, types and shapes are checked.
"""

from __future__ import annotations

import dataclasses
import io
import json
import zipfile
from collections.abc import Mapping
from typing import Any, Literal, TypeVar, get_args, get_origin

import cattrs
import numpy as np
from cattrs.gen import make_dict_structure_fn

T = TypeVar("T")
_TYPES = {np.dtype(kind).str for kind in ("f8", "i8", "i4", "u1", "?")}
_MARK = "$array"
_XYZ, _MANY = (3,), None
_SHAPES: Mapping[str, tuple[int | None, ...]] = {
    **dict.fromkeys(
        (
            "start_enu_m", "goal_enu_m", "position_enu_m", "velocity_enu_mps", "origin_enu_m",
            "hold_enu_m", "front_enu_m", "camera_offset_flu_m", "integral_mps",
        ),
        _XYZ,
    ),
    "quaternion": (4,),
    "bounds_enu_m": (6,),
    "points_enu_m": (_MANY, 3),
    "depth_m": (_MANY, _MANY),
    "waypoints": (_MANY, 10),
    "durations_s": (_MANY,),
    "trace": (_MANY,),
}  # fmt: skip
"""Required shape of the array in each field, by the name of the field."""


def pack(value: Any) -> bytes:
    """Pack a dataclass into an archive and return its bytes.

    Fields may contain numbers, strings, arrays, bytes and other dataclasses.
    """
    data, places = bytearray(), dict[int, dict[str, Any]]()

    def place(item: Any) -> Any:
        """Convert a value that JSON cannot represent: a numpy scalar, an array or bytes.

        An array is appended to the data, and replaced by its offset and properties.
        """
        if isinstance(item, np.generic):
            return item.item()
        if id(item) not in places:
            array = np.frombuffer(item, np.uint8) if isinstance(item, bytes) else item
            columns_first = array.flags.f_contiguous and not array.flags.c_contiguous
            order: Literal["C", "F"] = "F" if columns_first else "C"
            about = [len(data), array.dtype.str, array.shape, order, array.flags.writeable]
            data.extend(array.tobytes(order))
            places[id(item)] = {_MARK: about}
        return places[id(item)]

    text = json.dumps(_CONVERTER.unstructure(value), default=place, separators=(",", ":"))
    file = io.BytesIO()
    np.savez(file, value=np.frombuffer(text.encode(), np.uint8), data=np.frombuffer(data, np.uint8))
    return file.getvalue()


def unpack(archive: bytes, kind: type[T]) -> T:
    """Unpack an archive that `pack` made, and return the dataclass in it.

    Args:
        kind: The class of the dataclass.

    Raises:
        ValueError: The bytes are not an archive of this dataclass.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(archive)) as parts:
            if any(part.compress_type != zipfile.ZIP_STORED for part in parts.infolist()):
                raise ValueError("the archive must not be compressed")
        with np.load(io.BytesIO(archive), allow_pickle=False) as arrays:
            text, data = arrays["value"].tobytes(), arrays["data"].tobytes()
        known: dict[Any, Any] = {}

        def array(item: dict[str, Any]) -> Any:
            """Convert a JSON object that stands for an array to the array.

            Objects that stand for the same array share it. Other objects are returned unchanged.
            """
            if _MARK not in item:
                return item
            at, dtype, shape, order, writeable = item[_MARK]
            place = at, dtype, *shape, order, writeable
            if place not in known:
                if dtype not in _TYPES or at < 0 or min(shape, default=0) < 0:
                    raise ValueError("the archive has an array of an unsupported kind")
                count = int(np.prod(shape, dtype=object))
                made = np.frombuffer(data, dtype, count, at).copy().reshape(shape, order=order)
                made.flags.writeable = writeable
                known[place] = made
            return known[place]

        return _CONVERTER.structure(json.loads(text, object_hook=array), kind)
    except Exception as error:  # the file may be anything
        raise ValueError(f"{type(error).__name__}: {error}"[:200]) from None


def _converter() -> cattrs.Converter:
    converter = cattrs.Converter(detailed_validation=False, forbid_extra_keys=True)
    for kind, *others in ((float, int), (int,), (bool,), (str,)):
        converter.register_structure_hook(kind, _as_it_is(kind, *others))
    converter.register_unstructure_hook(bytes, lambda value: value)
    converter.register_structure_hook(bytes, lambda value, _: value.tobytes())
    converter.register_unstructure_hook_func(_is_array, lambda value: value)
    converter.register_structure_hook_func(_is_array, _checked_array)

    @converter.register_structure_hook_factory(dataclasses.is_dataclass)
    def _shaped(cls: Any) -> Any:
        make = make_dict_structure_fn(
            cls, converter, _cattrs_forbid_extra_keys=True, _cattrs_detailed_validation=False
        )

        def hook(value: Any, kind: Any) -> Any:
            """Create the dataclass from its values.

            Raises:
                ValueError: An array in it has the wrong shape.
            """
            made = make(value, kind)
            for name, shape in _SHAPES.items():
                array = getattr(made, name, None)
                if array is not None and not _fits(array.shape, shape):
                    raise ValueError(f"{name} must have the shape {shape}, got {array.shape}")
            return made

        return hook

    return converter


def _as_it_is(*kinds: type) -> Any:
    def hook(value: Any, _: Any) -> Any:
        """Return the value unchanged if it is valid.

        Raises:
            TypeError: The value has the wrong type.
            ValueError: The value is an integer that does not fit in 64 bits.
        """
        if isinstance(value, bool) is not (kinds[0] is bool) or not isinstance(value, kinds):
            raise TypeError(f"must be of type {kinds[0].__name__}, got {value!r}")
        if isinstance(value, int) and not -(2**63) <= value < 2**63:
            raise ValueError(f"must fit in 64 bits, got {value}")
        return value

    return hook


def _is_array(kind: Any) -> bool:
    return get_origin(kind) is np.ndarray


def _checked_array(value: Any, kind: Any) -> Any:
    (scalar,) = get_args(get_args(kind)[1])
    if not isinstance(value, np.ndarray) or value.dtype != np.dtype(scalar):
        raise TypeError(f"must be an array of {scalar.__name__}")
    return value


def _fits(shape: tuple[int, ...], wanted: tuple[int | None, ...]) -> bool:
    return len(shape) == len(wanted) and all(
        size == known or known is _MANY for size, known in zip(shape, wanted, strict=True)
    )


_CONVERTER = _converter()
