"""The folder in which a program runs: every run gets a fresh copy of the user's files.

A program may overwrite or delete its input files, and a corrupted one may do so by accident. So no
relative argument or link leads from its folder to a user's file.
"""

from __future__ import annotations

import os
import shutil
import stat
from collections.abc import Iterable, Mapping
from pathlib import Path, PurePosixPath

from mavfi_cli.core.errors import TargetError
from mavfi_cli.core.files import file_digest

LARGEST_BYTES = 1 << 30  # of all copied files
MOST_FILES = 100_000
_DEEPEST = 100  # folders within folders


def copied_arguments(
    argv: Iterable[str], directory: Path, folder: Path | None
) -> tuple[list[str], dict[str, Path]]:
    """Rewrite arguments that name the user's files so that they name copies.

    The text after the first `=` of an argument, as in `of=out.txt`, is treated as an argument. An
    argument that names a path below `folder` is made to name its copy. Any other relative argument
    that names a file, or contains a slash and names a folder, is made to name a copy at the same
    path relative to the program's folder. An absolute argument outside `folder` is left unchanged.

    Args:
        directory: The folder that relative arguments are relative to.
        folder: The folder that is copied for every run; None if there is none.

    Returns:
        The arguments, and the files and folders to copy by their path relative to the program's
        folder. A path may begin with `..`.
    """
    arguments, sources = [], {}
    places = [directory] if folder is None else [directory, folder]
    for argument in argv:
        option, equals, value = argument.partition("=")
        if not value or any(os.path.lexists(os.path.join(at, argument)) for at in places):
            option, equals, value = "", "", argument
        name, source = _copied(value, directory, folder)
        arguments.append(option + equals + name)
        if source is not None:
            sources[os.path.normpath(name)] = source
    return arguments, sources


def _copied(argument: str, directory: Path, folder: Path | None) -> tuple[str, Path | None]:
    """Return the argument with the name of the copy, and the file or folder to copy.

    The latter is None if nothing outside `folder` has to be copied.
    """
    # Unlike Path, the functions of os.path accept text of any length.
    path, absolute = os.path.join(directory, argument), os.path.isabs(argument)
    named = os.path.isfile(path) or ("/" in argument and os.path.isdir(path))
    if folder is not None:
        kept = os.path.join(folder, argument)
        if not absolute and os.path.exists(kept) and _place(kept, folder):
            return argument, None
        if (named or absolute) and (place := _place(path, folder)):
            return place, None
    if absolute or not named:
        return argument, None
    straight = ".." not in PurePosixPath(argument).parts
    name = argument if straight else os.path.relpath(_unlinked(path), os.path.realpath(directory))
    return name, Path(os.path.realpath(path))


def _unlinked(path: str) -> str:
    """Resolve the links in all but the last part of a path."""
    return os.path.join(os.path.realpath(os.path.dirname(path)), os.path.basename(path))


def _place(path: str, folder: Path) -> str:
    """Return the path relative to a folder, or an empty string if it is outside."""
    place = os.path.relpath(_unlinked(path), os.path.realpath(folder))
    return "" if PurePosixPath(place).parts[:1] == ("..",) else place


class WorkFolder:
    """The folder in which a program runs, recreated for every run.

    The user's files are copied once, including the targets of links. A link to another file of the
    same folder stays a link.

    Args:
        scratch: A scratch folder, in which the copies are made.
        folder: The folder whose contents are copied; None for an empty folder.
        sources: Further files and folders, by their path relative to the program's folder.
        name: The program's name in error messages.

    Attributes:
        path: The program's folder.
        tree: The folder that contains it and all copies.

    Raises:
        TargetError: The files are too large, unreadable, or not regular files.
    """

    def __init__(
        self, scratch: Path, folder: Path | None, sources: Mapping[str, Path], name: str
    ) -> None:
        self._name, self.tree, self._original = name, scratch / "run", scratch / "original"
        above = max((PurePosixPath(place).parts.count("..") for place in sources), default=0)
        levels = PurePosixPath(*["run"] * above)
        self.path, self._copy = self.tree / levels, self._original / levels
        self._copy.mkdir(parents=True)
        copier = _Copier(name)
        try:
            if folder is not None:
                copier.copy(folder.resolve(), self._copy)
            for place, source in sorted(sources.items()):
                target = Path(os.path.normpath(self._copy / place))
                target.parent.mkdir(parents=True, exist_ok=True)
                copier.copy(source, target)
        except OSError as error:
            raise TargetError(name, f"its files cannot be copied: {error}") from None

    def renew(self) -> None:
        """Restore the folder to its state before the first run.

        Raises:
            TargetError: The folder cannot be restored.
        """
        try:
            if self.tree.exists():
                shutil.rmtree(self.tree)  # follows no link
            shutil.copytree(self._original, self.tree, symlinks=True)
        except OSError as error:
            problem = f"its folder cannot be restored for the next run: {error}"
            raise TargetError(self._name, problem) from None

    def had(self, name: str) -> bool:
        """Return True if the file `name` was in the folder before the run."""
        return (self._copy / name).is_file()

    def wrote(self, name: str) -> bool:
        """Return True if the last run created or wrote to the file `name`, which must exist now."""
        before, after = self._copy / name, self.path / name
        if not before.is_file():
            return True
        was, now = before.stat(), after.stat()
        # Writes through a mapping may leave the time as it was.
        same = (was.st_mtime_ns, was.st_size) == (now.st_mtime_ns, now.st_size)
        return not same or file_digest(before) != file_digest(after)


class _Copier:
    """Copies a user's files and folders, including the targets of links, up to a limit."""

    def __init__(self, name: str) -> None:
        self._name, self._bytes, self._files = name, LARGEST_BYTES, MOST_FILES

    def copy(self, source: Path, target: Path) -> None:
        """Copy a file or a folder.

        Args:
            source: A path without links.
            target: Path of the copy, in an existing folder.
        """
        self._root, self._copy = source, target
        self._copy_one(source, target, ())

    def _copy_one(self, source: Path, target: Path, above: tuple[str, ...]) -> None:
        real, about = os.path.realpath(source), source.lstat()
        if stat.S_ISLNK(about.st_mode):
            if place := _place(real, self._root):
                target.symlink_to(os.path.relpath(self._copy / place, target.parent))
                return
            about = source.stat()
        self._files -= 1
        if stat.S_ISREG(about.st_mode):
            self._bytes -= about.st_size
            self._require_room()
            shutil.copy2(source, target)
        elif not stat.S_ISDIR(about.st_mode):
            raise TargetError(
                self._name, f"{source} cannot be copied: it is neither a file nor a folder"
            )
        elif real in above or len(above) > _DEEPEST:
            raise TargetError(
                self._name,
                f"{source} cannot be copied: it is part of a link cycle or nested too deeply",
            )
        else:
            self._require_room()
            target.mkdir(exist_ok=True)
            for entry in sorted(os.listdir(source)):
                self._copy_one(source / entry, target / entry, (*above, real))
            target.chmod(stat.S_IMODE(about.st_mode) | stat.S_IRWXU)

    def _require_room(self) -> None:
        if self._bytes < 0 or self._files < 0:
            raise TargetError(
                self._name,
                f"the files to copy for every run must total at most {LARGEST_BYTES >> 30} GB and "
                f"{MOST_FILES} files: name large inputs by absolute paths "
                "outside --folder, which are not copied",
            )
