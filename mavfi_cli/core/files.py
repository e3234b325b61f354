"""Handles files: atomic writes, bounded reads and scratch folders.

A process that is killed while it writes leaves the old file or the new one, never a partial one. A
folder of results is untrusted: nothing is written through a link in it, and every read from it has
a limit of size.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import json
import os
import shutil
import stat
import tempfile
import weakref
import zlib
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO

from mavfi_cli.core.compiled import can_write
from mavfi_cli.core.errors import RecordError, lack_of

Json = dict[str, Any]  # a JSON object, as plain values
_LARGEST = 1 << 32  # largest table, bytes
_DEEPEST = 64  # levels of nested values in a JSON file
_READ = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC


def file_digest(name: str | Path) -> str:
    """Return the SHA-256 of a file's contents in hexadecimal, or "" if it cannot be read.

    Only regular files are read.
    """
    try:
        with open(os.open(name, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
            if stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                return hashlib.file_digest(file, "sha256").hexdigest()
    except (OSError, ValueError):
        pass
    return ""


@contextlib.contextmanager
def writing(place: Path) -> Iterator[None]:
    """Return a context manager that converts an OSError into a RecordError naming `place`."""
    try:
        yield
    except OSError as error:
        problem = "is a link" if error.errno == errno.ELOOP else error.strerror or error
        raise RecordError(f"{place}: {problem}") from None


@contextlib.contextmanager
def reading(place: Path) -> Iterator[None]:
    """Return a context manager that converts errors about a file's contents into RecordError.

    These are the exceptions that using damaged contents raises. The message names `place`.
    """
    try:
        yield
    except (
        ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError,
    ) as error:  # fmt: skip
        raise RecordError(f"{place}: damaged ({lack_of(error)})") from error


def read_bounded(path: Path, limit: int) -> bytes:
    """Return the contents of a regular file, without following links or waiting for pipes.

    Args:
        limit: largest allowed size of the file in bytes.

    Raises:
        RecordError: The file cannot be read, is not a regular file, or is larger than `limit`.
    """
    with writing(path), open(os.open(path, _READ), "rb") as file:
        about = os.fstat(file.fileno())
        if not stat.S_ISREG(about.st_mode):
            raise RecordError(f"{path}: is not a regular file")
        if about.st_size > limit:
            raise RecordError(f"{path}: must have at most {limit} bytes, got {about.st_size}")
        return file.read(limit)


def read_json(path: Path, limit: int) -> Json:
    """Read a JSON object from a file.

    Raises:
        RecordError: The file cannot be read, is not a regular file, is larger than `limit` bytes,
            or does not contain a JSON object.
    """
    with reading(path):
        value = json.loads(read_bounded(path, limit))
    if not isinstance(value, dict):
        raise RecordError(f"{path}: not a JSON object")
    level: list[Any] = [value]
    for _ in range(_DEEPEST):
        level = [
            part
            for parts in level
            for part in (parts.values() if isinstance(parts, dict) else parts)
            if isinstance(part, (dict, list))
        ]
    if level:
        raise RecordError(f"{path}: its values are nested more than {_DEEPEST} deep")
    return value


def open_own(path: Path, flags: int) -> int:
    """Open a file that mavfi owns, or create it, and return its descriptor.

    Raises:
        OSError: The file cannot be opened, or it is a link.
    """
    return os.open(path, flags | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)


def own_folder(path: Path) -> Path:
    """Create a folder that mavfi owns, unless it exists, and return its path.

    Raises:
        RecordError: The folder cannot be created, or something that is not a folder has its name. A
            link to a folder is refused too, because mavfi deletes files in its folders.
    """
    with writing(path):
        path.mkdir(parents=True, exist_ok=True)
    if path.is_symlink():
        raise RecordError(f"{path}: is a link, but mavfi deletes files in this folder")
    return path


def inflate(data: bytes, limit: int) -> bytes:
    """Decompress data in zlib's format and return the result.

    Raises:
        ValueError: The data are damaged or truncated, or decompress to more than `limit` bytes.
    """
    inflater = zlib.decompressobj()
    try:
        whole = inflater.decompress(data, limit)
    except zlib.error as error:
        raise ValueError(str(error)) from None
    if not inflater.eof:
        too_large = len(whole) >= limit
        raise ValueError(f"must have at most {limit >> 20} MB" if too_large else "is truncated")
    return whole


_unsynced: set[Path] = set()


def leave_unsynced(folder: Path) -> None:
    """Let `write_atomically` skip syncing files below a folder, in this process and its forks.

    Use it for a folder that need not survive a power failure, because its files are temporary or
    are synced later by `sync_folder`. Each sync takes 10 to 300 ms, during which nothing else runs.
    """
    _unsynced.add(folder.absolute())


def sync_folder(folder: Path) -> None:
    """Sync a folder and all regular files and folders below it to disk.

    Raises:
        RecordError: A file or folder cannot be synced.
    """
    for parent, _, names in os.walk(folder):
        paths = [Path(parent, name) for name in names]
        for path in [*(p for p in paths if stat.S_ISREG(p.lstat().st_mode)), Path(parent)]:
            with writing(path):
                descriptor = os.open(path, _READ)
                try:
                    os.fsync(descriptor)
                finally:
                    os.close(descriptor)


def write_atomically(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Write to a temporary file in the same folder, sync it to disk, then rename it to `path`.

    Files below a folder that was passed to `leave_unsynced` are not synced.

    Several processes may write the same file. Each uses a temporary file of its own, and the last
    rename wins.

    Args:
        write: Writes the contents to the open file that it gets.

    Raises:
        RecordError: The file could not be written (disk full, no permission). The old file stays.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.partial")
    with writing(path):
        temporary.unlink(missing_ok=True)  # left by a killed process, or a link
        try:
            with open(open_own(temporary, os.O_WRONLY | os.O_EXCL), "wb") as file:
                write(file)
                file.flush()
                if _unsynced.isdisjoint(path.absolute().parents):
                    os.fsync(file.fileno())
            temporary.replace(path)
        except BaseException:
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise


_SCRATCH, _OWNED = "mavfi-", ".mavfi-scratch"

_TRIES = 10  # attempts to remove a folder, in which a dying program may still create files


class ScratchFolder:
    """A private temporary folder that is removed however the process ends.

    The folder is removed by `close`, when the object is deleted, or when the process exits. A
    killed process leaves it behind, and the next process that makes a scratch folder in the same
    place removes it. A lock on a file in the folder shows that the process, or a fork of it, is
    still running. A fork never removes the folder of its parent.

    As a context manager, the object returns the path.

    Args:
        what: A word in the name of the folder, `mavfi-WHAT-...`.
        parent: Where to create the folder; its name then begins with a dot. None selects the
            temporary directory.

    Attributes:
        path: Path of the folder.
        close: Removes the folder. Safe to call more than once.

    Raises:
        RecordError: The folder cannot be created.
    """

    def __init__(self, what: str, parent: Path | None = None) -> None:
        place, hidden = (parent, ".") if parent is not None else (Path(tempfile.gettempdir()), "")
        with writing(place):
            _remove_abandoned(place)
            self.path, lock = _locked_folder(place, f"{hidden}{_SCRATCH}{what}-")
        self.close = weakref.finalize(self, _remove_scratch, self.path, lock, os.getpid())

    def __enter__(self) -> Path:
        return self.path

    def __exit__(self, *_error: object) -> None:
        self.close()


def _locked_folder(place: Path, prefix: str) -> tuple[Path, int]:
    """Create a scratch folder. Return its path, and the descriptor of the locked file in it."""
    while True:
        path = Path(tempfile.mkdtemp(prefix=prefix, dir=place))
        lock = os.open(path / _OWNED, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
        fcntl.flock(lock, fcntl.LOCK_EX)
        if os.fstat(lock).st_nlink:
            return path, lock
        os.close(lock)  # another process removed it as abandoned before it was locked


def _remove_scratch(path: Path, lock: int, owner: int) -> None:
    if os.getpid() == owner:
        for _ in range(_TRIES):
            shutil.rmtree(path, ignore_errors=True)
            if not path.exists():
                break
        os.close(lock)


@cache
def _remove_abandoned(place: Path) -> None:
    """Remove the scratch folders in `place` that killed processes of this user left behind.

    Only the first call with a path does so; later calls in the same process return at once.
    """
    for path in [*place.glob(f"{_SCRATCH}*"), *place.glob(f".{_SCRATCH}*")]:
        with contextlib.suppress(OSError):  # not ours, or its process is running
            about = path.lstat()
            if not stat.S_ISDIR(about.st_mode) or about.st_uid != os.getuid():
                continue
            lock = os.open(path / _OWNED, os.O_RDWR | os.O_NOFOLLOW)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(path, ignore_errors=True)
            finally:
                os.close(lock)


def gains_rights(program: Path) -> bool:
    """Return True if a program gets rights that its user lacks.

    It does if it is set-uid or set-gid, or has file capabilities.
    """
    try:
        os.getxattr(program, "security.capability")
    except OSError:  # it has none, or the file system stores none
        return bool(program.stat().st_mode & (stat.S_ISUID | stat.S_ISGID))
    return True


def require_output(path: Path, suffixes: Sequence[str] = ()) -> None:
    """Raise an error if a file cannot be written. Call it before computing the contents.

    Args:
        suffixes: allowed suffixes of the name; empty allows all.

    Raises:
        RecordError: The name has none of the given suffixes, the folder does not exist or cannot be
            written, or the path exists and is not a regular file.
    """
    if suffixes and path.suffix.lower() not in suffixes:
        *others, last = suffixes
        known = f"{', '.join(others)} or {last}" if others else last
        raise RecordError(f"{path}: the file name must end in {known}")
    if not path.absolute().parent.is_dir():
        raise RecordError(f"{path}: its folder does not exist")
    if path.exists() and not path.is_file():
        raise RecordError(f"{path}: not a regular file")
    require_folder(path.parent)


def require_folder(folder: Path) -> None:
    """Raise an error if a folder cannot be created or written. Call it before computing contents.

    Raises:
        RecordError: The name of the folder is not UTF-8, as tables require, or the folder cannot be
            created or written.
    """
    try:
        str(folder).encode()
    except UnicodeEncodeError:
        raise RecordError(f"{str(folder)!r}: not a UTF-8 name") from None
    if not can_write(folder):
        raise RecordError(f"{folder}: this folder cannot be created or written")


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically, in UTF-8.

    Lone surrogates, which UTF-8 cannot encode, are escaped.
    """
    write_atomically(path, lambda file: file.write(text.encode(errors="backslashreplace")))


def write_json(path: Path, value: Any) -> None:
    """Write a value to a JSON file atomically, with sorted keys.

    `plain` converts the value, so NaN and infinities become null.
    """
    write_text(path, json.dumps(plain(value), indent=2, sort_keys=True, allow_nan=False) + "\n")


def write_parquet(path: Path, table: Any) -> None:
    """Write an Arrow table as Parquet, atomically. Equal tables give equal bytes."""
    import pyarrow.parquet as pq

    write_atomically(path, lambda file: pq.write_table(table, file, compression="zstd"))


def read_parquet(path: Path, what: str) -> Any:
    """Read an Arrow table from a Parquet file.

    Args:
        what: what the file contains, for the error message.

    Raises:
        RecordError: The file is missing, damaged or too large.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with pq.ParquetFile(path) as file:
            about = file.metadata
            groups = map(about.row_group, range(about.num_row_groups))
            packed = sum(group.total_byte_size for group in groups)
            if max(packed, 8 * about.num_rows * about.num_columns) > _LARGEST:
                raise RecordError(f"{path}: must have at most {_LARGEST >> 20} MB")
            return file.read()  # pq.read_table would load pandas, if it is installed
    except (OSError, pa.ArrowException) as error:
        raise RecordError(f"{path}: the {what} cannot be read ({error})") from None


def plain(value: Any) -> Any:
    """Return a copy of a value that can be stored as JSON.

    numpy scalars and arrays become numbers and lists. NaN and infinities become None.
    """
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float) and (value != value or value in (float("inf"), float("-inf"))):
        return None
    return value
