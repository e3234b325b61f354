"""Load TOML into frozen dataclasses with strict types. An unknown key is an error."""

from __future__ import annotations

import dataclasses
import functools
import math
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

import cattrs
from cattrs import AttributeValidationNote, IterableValidationNote
from cattrs.gen import make_dict_structure_fn

from mavfi_cli.core.errors import ConfigError, UnknownKey, UnknownName

T = TypeVar("T")


def load_toml(path: Path, cls: type[T]) -> T:
    """Read a TOML file into the frozen dataclass `cls`.

    Raises:
        ConfigError: The file cannot be read or parsed, a key is missing or has the wrong type, or
            `cls` rejects a value (a ValueError from `__post_init__`). Names file, line and key.
        UnknownKey: `cls` does not have this key. Names the nearest key.
    """
    data, text = read_toml(path)
    return structure(data, cls, path=path, text=text)


def read_toml(path: Path) -> tuple[dict[str, Any], str]:
    """Parse a TOML file. Return its data and its text.

    `structure` uses the text to find the line of an error.

    Raises:
        ConfigError: The file cannot be read or parsed. Names file and line.
    """
    text = read_text(path)
    try:
        return tomllib.loads(text), text
    except tomllib.TOMLDecodeError as error:
        raise syntax_error(error, path) from None


def shipped_names(folder: Path) -> list[str]:
    """Return the names of the TOML files in a folder, in alphabetical order."""
    return sorted(path.stem for path in folder.glob("*.toml"))


def shipped_path(kind: str, name_or_path: str, folder: Path) -> Path:
    """Find the TOML file of a shipped `kind` by its name, or a user's own file by its path.

    Raises:
        UnknownName: Nothing shipped has this name, and it is not a path to a TOML file.
        ConfigError: It is a path to a TOML file that does not exist.
    """
    path = Path(name_or_path)
    if path.suffix != ".toml":
        if name_or_path not in shipped_names(folder):
            raise UnknownName(kind, name_or_path, shipped_names(folder))
        return folder / f"{name_or_path}.toml"
    if not path.is_file():
        raise ConfigError("no such file", path=path)
    return path


def load_shipped(kind: str, name_or_path: str, folder: Path, cls: type[T]) -> T:
    """Load a shipped `kind` by its name, or a user's own TOML file by its path, as `cls`.

    Raises:
        UnknownName: Nothing shipped has this name, and it is not a path to a TOML file.
        ConfigError: The file cannot be used.
    """
    return load_toml(shipped_path(kind, name_or_path, folder), cls)


def syntax_error(error: tomllib.TOMLDecodeError, path: Path) -> ConfigError:
    """Convert a TOML syntax error, with its line if the parser reports one."""
    problem, at, place = str(error).rpartition(" (at line ")
    if not at:
        return ConfigError(str(error), path=path)
    line, _, column = place.rstrip(")").partition(", ")
    return ConfigError(f"{problem} ({column})", path=path, line=int(line))


def structure(
    data: Mapping[str, Any], cls: type[T], *, path: Path | None = None, text: str = ""
) -> T:
    """Build the dataclass `cls` from a plain mapping under the rules of `load_toml`."""
    _refuse_unknown(data, cls, path, text, prefix="")
    try:
        return _CONVERTER.structure(data, cls)
    except cattrs.BaseValidationError as error:
        key, problem = _first_problem(error, "")
        raise ConfigError(problem, path=path, line=_line_of(text, key), key=key) from None


def read_text(path: Path) -> str:
    """Read a text file in UTF-8.

    Raises:
        ConfigError: The file cannot be read.
    """
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(error.strerror or str(error), path=path) from None
    except UnicodeDecodeError:
        raise ConfigError("not a UTF-8 text file", path=path) from None


def _strict(kind: type, *accepted: type) -> Any:
    def hook(value: Any, _cls: Any) -> Any:
        """Raise TypeError for a value of another type and ValueError for one that is not finite."""
        if isinstance(value, bool) is not (kind is bool) or not isinstance(
            value, (kind, *accepted)
        ):
            raise TypeError(f"expected {kind.__name__}, got {value!r}")
        if isinstance(value, float) and not math.isfinite(value):
            raise ValueError(f"expected a finite number, got {value!r}")
        return kind(value)

    return hook


def _converter() -> cattrs.Converter:
    converter = cattrs.Converter()
    converter.register_structure_hook(float, _strict(float, int))
    converter.register_structure_hook(int, _strict(int))
    converter.register_structure_hook(bool, _strict(bool))
    converter.register_structure_hook(str, _strict(str))
    converter.register_structure_hook_factory(
        dataclasses.is_dataclass, lambda cls: make_dict_structure_fn(cls, converter)
    )
    return converter


_CONVERTER = _converter()


def _refuse_unknown(data: Any, cls: Any, path: Path | None, text: str, prefix: str) -> None:
    """Walk nested dataclass fields; refuse any key that none of them has, and any wrong shape."""
    hints = _hints(cls)
    for key, value in data.items():
        full = f"{prefix}{key}"
        if key not in hints:
            raise UnknownKey(full, hints, path=path, line=_line_of(text, full))
        _refuse_shape(value, hints[key], path, text, full)
        for nested in _dataclasses_in(hints[key]):
            for name, item in _items(value, hints[key]):
                if item is not None:
                    _refuse_shape(item, nested, path, text, f"{full}.{name}".rstrip("."))
                    _refuse_unknown(item, nested, path, text, prefix=f"{full}.{name}")


@functools.cache
def _hints(cls: Any) -> Mapping[str, Any]:
    """Types by field: Python evaluates the texts of annotations each time that it is asked."""
    return get_type_hints(cls)


def _refuse_shape(value: Any, hint: Any, path: Path | None, text: str, key: str) -> None:
    """Refuse what is no table, or no array, where one belongs: text is an array of letters."""
    wanted, accepted = _shape(hint)
    if not isinstance(value, accepted):
        raise ConfigError(
            f"expected {wanted}, got {value!r}", path=path, line=_line_of(text, key), key=key
        )


@functools.cache
def _shape(hint: Any) -> tuple[str, tuple[type, ...]]:
    """What a type wants, in words, and the types that have this shape."""
    hints = get_args(hint) if isinstance(hint, UnionType) else (hint,)
    kinds = [get_origin(each) or each for each in hints if each is not NoneType]
    none = (NoneType,) if NoneType in hints else ()
    if all(kind is dict or dataclasses.is_dataclass(kind) for kind in kinds):
        return "a table", (Mapping, *none)
    if all(kind in (list, tuple) for kind in kinds):
        return "an array", (list, tuple, *none)
    return "", (object,)


def _items(value: Any, hint: Any) -> list[tuple[str, Any]]:
    """Return the tables inside a value, each with its suffix of the key's name."""
    if isinstance(value, list):
        return [("", item) for item in value]
    if get_origin(hint) is dict and isinstance(value, Mapping):
        return [(f"{name}.", item) for name, item in value.items()]
    return [("", value)]


@functools.cache
def _dataclasses_in(hint: Any) -> Sequence[Any]:
    if dataclasses.is_dataclass(hint):
        return [hint]
    return [found for arg in get_args(hint) for found in _dataclasses_in(arg)]


def _first_problem(error: BaseException, key: str) -> tuple[str, str]:
    """Return key and message of the innermost first failure of a cattrs error group."""
    if isinstance(error, BaseExceptionGroup):
        inner = error.exceptions[0]
        for note in getattr(inner, "__notes__", []):
            if isinstance(note, AttributeValidationNote):
                key = f"{key}.{note.name}" if key else note.name
            elif isinstance(note, IterableValidationNote):
                key += f".{note.index}" if isinstance(note.index, str) else f"[{note.index}]"
        return _first_problem(inner, key)
    return key, "is missing" if isinstance(error, KeyError) else str(error)


def _line_of(text: str, key: str) -> int | None:
    """Find the line that sets the last part of a dotted key, by a search of the text."""
    parts = [part for part in key.replace("[", ".[").split(".") if part and part[0] != "["]
    if not text or not parts:
        return None
    section = ".".join(parts[:-1])
    current, fallback = "", None
    for number, line in enumerate(text.splitlines(), start=1):
        stripped = line.strip()
        if stripped.startswith("["):
            current = stripped.strip("[] ").split("]")[0]
            if current == key:
                return number
        elif stripped.split("=")[0].strip().strip('"') == parts[-1]:
            if current == section:
                return number
            fallback = fallback or number
    return fallback


def require_distinct(names: Sequence[str], key: str) -> None:
    """Reject a list that contains a name twice.

    Args:
        names: Names to check.
        key: Configuration key of the list, for the error.

    Raises:
        ConfigError: A name occurs twice. Names it.
    """
    for place, name in enumerate(names):
        if name in names[:place]:
            raise ConfigError(f"{name} is named twice", key=key)
