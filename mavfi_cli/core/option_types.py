"""Types of command-line options: numbers, coordinates, and files and folders to write."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import click

from mavfi_cli.core.errors import RecordError
from mavfi_cli.core.files import require_folder, require_output


class Number(click.FloatRange):
    """The type of an option that takes a number within bounds.

    Unlike click's own range, it rejects NaN.

    Args:
        limits: smallest and largest number.
        words: words that stand for numbers, keyed by word.
    """

    def __init__(self, *limits: Any, words: Mapping[str, float] | None = None, **how: Any) -> None:
        super().__init__(*limits, **how)
        self._words = words or {}

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Convert a word, or a value as click does, and fail if it is NaN."""
        try:
            number = float(super().convert(self._words.get(value, value), param, ctx))
        except click.BadParameter as error:
            meanings = (f" {word!r} means {own:g}." for word, own in self._words.items())
            self.fail(f"{error.message}{''.join(meanings)}", param, ctx)
        return self.fail(f"{value} is not a number.", param, ctx) if number != number else number


Coordinates = tuple[float, float, float]


class Place(click.ParamType[Coordinates]):
    """The type of an option that takes three finite numbers, such as east, north and up in m."""

    name = "x,y,z"

    def convert(self, value: Any, param: Any, ctx: Any) -> Coordinates:
        """Return the three numbers, or fail if they are not three finite numbers."""
        try:
            x, y, z = (float(part) for part in str(value).split(","))
        except ValueError:
            x = y = z = math.nan
        if not all(map(math.isfinite, (x, y, z))):
            self.fail(f"must be three finite numbers such as 30,40,5, got {value!r}", param, ctx)
        return x, y, z


class _OutPath(click.Path):
    """The type of an option that takes the path of a file or folder to write.

    An empty path is rejected, because it would mean the current folder.

    Args:
        require: raises RecordError for a path that cannot be written.
    """

    def __init__(self, require: Callable[[Path], None], **kinds: bool) -> None:
        super().__init__(path_type=Path, **kinds)
        self._require = require

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        """Return the path, or fail if it cannot be written."""
        if not str(value):
            self.fail("the name is empty.", param, ctx)
        path = super().convert(value, param, ctx)
        try:
            self._require(Path(str(path)))
        except RecordError as error:
            self.fail(f"{error}.", param, ctx)
        return path


class OutFolder(_OutPath):
    """The type of an option that takes a folder for results. The folder need not exist."""

    def __init__(self) -> None:
        super().__init__(require_folder, file_okay=False)


class OutFile(_OutPath):
    """The type of an option that takes a file to write.

    Args:
        suffixes: allowed suffixes of the file name; empty allows all.
        allow_dash: whether `-` is accepted, which means stdout.
    """

    def __init__(self, suffixes: Sequence[str] = (), *, allow_dash: bool = False) -> None:
        def require(path: Path) -> None:
            if not (allow_dash and str(path) == "-"):
                require_output(path, suffixes)

        super().__init__(require, dir_okay=False, allow_dash=allow_dash)
