"""Files that are whole at any moment: a kill leaves the old one or the new one, never half."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

from mavfi_cli.core.errors import RecordError


def write_atomically(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Write a file beside its place, make it durable, then move it there.

    Several processes may write the same file: each writes beside it under a name of its own, and
    the last one stays.

    Raises:
        RecordError: the file could not be written (disk full, no permission); the old one stays.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with temporary.open("wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise RecordError(f"{path}: {error.strerror or error}") from None


def require_svg(path: Path) -> None:
    """Refuse a name for a picture that promises another format.

    Raises:
        RecordError: it does not end in .svg.
    """
    if path.suffix.lower() != ".svg":
        raise RecordError(f"{path}: pictures are SVG: name a file that ends in .svg")


def write_text(path: Path, text: str) -> None:
    """Write a UTF-8 text file atomically."""
    write_atomically(path, lambda file: file.write(text.encode()))


def write_json(path: Path, value: Any) -> None:
    """Write JSON atomically: sorted keys; a number that is not finite becomes null."""
    write_text(path, json.dumps(plain(value), indent=2, sort_keys=True, allow_nan=False) + "\n")


def plain(value: Any) -> Any:
    """JSON-ready copy: numpy scalars and arrays become numbers and lists, non-finite null."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float) and (value != value or value in (float("inf"), float("-inf"))):
        return None
    return value
