"""Reads TOML files into frozen dataclasses, and writes TOML.

Types are strict, and unknown keys are errors.
"""

from __future__ import annotations

import dataclasses
import math
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin

import cattrs
from cattrs import AttributeValidationNote, ForbiddenExtraKeysError, IterableValidationNote
from cattrs.gen import make_dict_structure_fn, make_mapping_structure_fn
from cattrs.strategies import configure_union_passthrough

from mavfi_cli.core.errors import ConfigError, UnknownName

T = TypeVar("T")


def load_toml(path: Path, cls: type[T]) -> T:
    """Read a TOML file and return an instance of the dataclass `cls` with its values.

    Raises:
        ConfigError: The file cannot be read or parsed, a key is missing or unknown, a value has the
            wrong type, or `cls` rejects a value (a ValueError from `__post_init__`). The message
            names file, line and key, and suggests the nearest known key.
    """
    data, text = read_toml(path)
    return structure(data, cls, path=path, text=text)


def read_toml(path: Path) -> tuple[dict[str, Any], str]:
    """Parse a TOML file. Return its values as a dictionary, and its text.

    `structure` needs the text to find the line of an error.

    Raises:
        ConfigError: The file cannot be read or parsed. The message names file and line.
    """
    text = read_text(path)
    return parse_toml(text, path), text


def parse_toml(text: str, path: Path) -> dict[str, Any]:
    """Parse TOML text and return its values.

    Args:
        path: The file that the text comes from, for error messages.

    Raises:
        ConfigError: The text is not TOML. The message names the file, and the line if the parser
            reports it.
    """
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        problem, at, place = str(error).rpartition(" (at line ")
        if not at:
            raise ConfigError(str(error), path=path) from None
        line, _, column = place.rstrip(")").partition(", ")
        raise ConfigError(f"{problem} ({column})", path=path, line=int(line)) from None
    except ValueError:  # Python refuses to convert it
        raise ConfigError("an integer has too many digits", path=path) from None
    except RecursionError:
        raise ConfigError("arrays or tables are nested too deeply", path=path) from None


def toml_text(values: Mapping[str, Any]) -> str:
    """Convert values to TOML text that reads back as equal values. Empty tables are omitted.

    Args:
        values: Strings, finite numbers, booleans, arrays of them, tables, and arrays of tables.
    """
    import tomli_w

    return tomli_w.dumps(_without_empty_tables(values), indent=2)


def _without_empty_tables(values: Mapping[str, Any]) -> dict[str, Any]:
    inner = {
        key: _without_empty_tables(value) if isinstance(value, Mapping) else value
        for key, value in values.items()
    }
    return {key: value for key, value in inner.items() if value != {}}


@dataclasses.dataclass(frozen=True, slots=True)
class Shipped:
    """The TOML files of one kind that ship with mavfi, such as its platforms.

    Attributes:
        kind: Word for such a file in error messages.
        folder: The folder that contains the files.
    """

    kind: str
    folder: Path

    @property
    def names(self) -> list[str]:
        """The names of the files without their suffix, in alphabetical order."""
        return sorted(path.stem for path in self.folder.glob("*.toml"))

    def path(self, name_or_path: str) -> Path:
        """Return the path of a shipped file that is given by name, or of a file given by path.

        Raises:
            UnknownName: No shipped file has this name, and it does not end in `.toml`.
            ConfigError: It ends in `.toml`, and there is no such file.
        """
        path = Path(name_or_path)
        if path.suffix != ".toml":
            if name_or_path not in self.names:
                raise UnknownName(self.kind, name_or_path, self.names)
            return self.folder / f"{name_or_path}.toml"
        if not path.is_file():
            raise ConfigError("no such file", path=path)
        return path

    def base(self, name: object, path: Path) -> str:
        """Return `name`, the value of `base` in a file, after checking that it is a shipped file.

        Args:
            name: Value of the key `base`.
            path: The file that contains the key.

        Raises:
            ConfigError: No other shipped file has this name. The message suggests the nearest name.
        """
        if name not in self.names or path == self.folder / f"{name}.toml":
            error = UnknownName(self.kind, str(name), set(self.names) - {path.stem})
            raise ConfigError(str(error), path=path, key="base")
        return str(name)


def structure(
    data: Mapping[str, Any], cls: type[T], *, path: Path | None = None, text: str = ""
) -> T:
    """Create an instance of the dataclass `cls` from a mapping, with the checks of `load_toml`.

    Args:
        path, text: The file that the data come from, and its text, for error messages.

    Raises:
        ConfigError: As in `load_toml`.
    """
    try:
        return _CONVERTER.structure(data, cls)
    except cattrs.BaseValidationError as group:
        key, error = _first_problem(group, "")
    except TypeError as wrong:  # `data` is not a mapping
        key, error = "", wrong
    if isinstance(error, ForbiddenExtraKeysError):
        known = [entry.name for entry in dataclasses.fields(error.cl)]
        key = f"{key}.{min(error.extra_fields)}".lstrip(".")
        raise ConfigError.unknown_key(key, known, path=path, line=_line_of(text, key))
    problem = "is missing" if isinstance(error, KeyError) else str(error)
    raise ConfigError(problem, path=path, line=_line_of(text, key), key=key)


def structure_record(data: Mapping[str, Any], cls: type[T]) -> T:
    """Create an instance of the dataclass `cls` from a section of a record.

    Unknown keys, which other versions of mavfi wrote, are ignored. Missing fields get their
    defaults.

    Raises:
        ValueError: A value has the wrong type, or a field without a default is missing.
    """
    try:
        return _RECORDS.structure(data, cls)
    except cattrs.BaseValidationError as group:
        key, error = _first_problem(group, "")
    problem = f"it has no {key}" if isinstance(error, KeyError) else f"{key}: {error}"
    raise ValueError(problem)


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


_IN_WORDS = {int: "a whole number", float: "a number", bool: "true or false", str: "text"}


def _strict(kind: type, *accepted: type) -> Any:
    def hook(value: Any, _cls: Any) -> Any:
        """Check the type of a value and convert it to `kind`.

        Raises:
            TypeError: The value has the wrong type.
            ValueError: The value is infinite or NaN.
        """
        if isinstance(value, bool) is not (kind is bool) or not isinstance(
            value, (kind, *accepted)
        ):
            raise TypeError(f"must be {_IN_WORDS[kind]}, got {value!r}")
        if isinstance(value, float) and not math.isfinite(value):
            raise ValueError(f"must be a finite number, got {value!r}")
        return kind(value)

    return hook


def _shaped(accepted: Any, wanted: str, structured: Any, length: int | None = None) -> Any:
    def hook(value: Any, cls: Any) -> Any:
        """Check the type and length of a table or array, and convert its items.

        Raises:
            TypeError: The type or the length is wrong. A string is not an array.
        """
        if not isinstance(value, accepted):
            raise TypeError(f"must be {wanted}, got {value!r}")
        if length is not None and len(value) != length:
            raise TypeError(f"must have {length} values, got {len(value)}")
        return structured(value, cls)

    return hook


_origin: Any = get_origin  # otherwise mypy takes its argument for a ParamSpec


def _converter(*, forbids_others: bool) -> cattrs.Converter:
    converter = cattrs.Converter()
    for kind, *accepted in ((float, int), (int,), (bool,), (str,)):
        converter.register_structure_hook(kind, _strict(kind, *accepted))
    arrays: set[Any] = set()  # array types whose hook is being made

    @converter.register_structure_hook_factory(dataclasses.is_dataclass)
    def table(cls: Any) -> Any:
        made = make_dict_structure_fn(cls, converter, _cattrs_forbid_extra_keys=forbids_others)
        return _shaped(Mapping, "a table", made)

    @converter.register_structure_hook_factory(lambda cls: _origin(cls) is dict)
    def named(cls: Any) -> Any:
        return _shaped(Mapping, "a table", make_mapping_structure_fn(cls, converter))

    @converter.register_structure_hook_factory(
        lambda cls: _origin(cls) in (list, tuple) and cls not in arrays
    )
    def array(cls: Any) -> Any:
        arrays.add(cls)
        structured = converter.get_structure_hook(cls, cache_result=False)
        arrays.remove(cls)
        items = get_args(cls)
        length = len(items) if _origin(cls) is tuple and ... not in items else None
        return _shaped((list, tuple), "an array", structured, length=length)

    return converter


_CONVERTER, _RECORDS = _converter(forbids_others=True), _converter(forbids_others=False)
configure_union_passthrough(float | int | bool | None, _RECORDS)


def _first_problem(error: Exception, key: str) -> tuple[str, Exception]:
    """Return the dotted key and the innermost exception of the first failure in a cattrs error.

    Args:
        key: Dotted key of the value that `error` is about.
    """
    if not isinstance(error, ExceptionGroup):
        return key, error
    extra = [item for item in error.exceptions if isinstance(item, ForbiddenExtraKeysError)]
    inner = (extra or error.exceptions)[0]
    for note in getattr(inner, "__notes__", []):
        if isinstance(note, AttributeValidationNote):
            key = f"{key}.{note.name}" if key else note.name
        elif isinstance(note, IterableValidationNote):
            key += f".{note.index}" if isinstance(note.index, str) else f"[{note.index}]"
    return _first_problem(inner, key)


def _line_of(text: str, key: str) -> int | None:
    """Return the number of the line that sets a dotted key, or else of its table's header, or None.

    None means that the text has neither.
    """
    section, _, last = key.rpartition(".")
    last = last.partition("[")[0]
    current, head = "", None
    counts: dict[str, int] = {}  # index of the newest table in each array of tables
    for number, line in enumerate(text.splitlines(), start=1):
        stripped = line.strip()
        if stripped.startswith("["):
            current = _table_of(stripped, counts)
            if current == key:
                return number
            head = number if current == section else head
        elif current == section and stripped.split("=")[0].strip().strip('"') == last:
            return number
    return head


def _table_of(head: str, counts: dict[str, int]) -> str:
    """Return the dotted name of the table that a header opens, with indices in arrays of tables.

    Args:
        head: The header, such as `[[setting]]`.
        counts: Index of the newest table in each array of tables; updated by this call.
    """
    parts = head.strip("[ ").split("]")[0].split(".")
    names = [".".join(parts[: end + 1]).strip() for end in range(len(parts))]
    if head.startswith("[["):
        counts[names[-1]] = counts.get(names[-1], -1) + 1
        for inner in [name for name in counts if name.startswith(f"{names[-1]}.")]:
            del counts[inner]
    return ".".join(
        f"{part.strip()}[{counts[name]}]" if name in counts else part.strip()
        for part, name in zip(parts, names, strict=True)
    )
