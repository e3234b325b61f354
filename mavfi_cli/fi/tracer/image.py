"""Memory maps of a process: objects, build ids, symbols, and the code in scope.

A location is `(object, offset)`. For an ELF object the offset is the address that the linker wrote
(what `objdump` and `nm` print), so it does not depend on where the object was loaded. Compiled
code without a file (numba) is a named region, with offsets from its start.
"""

from __future__ import annotations

import bisect
import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from mavfi_cli.core.errors import FaultError, UnknownName
from mavfi_cli.fi.tracer.elf import elf_facts


@dataclass(frozen=True, slots=True, order=True)
class Location:
    """One instruction, wherever its object is loaded."""

    object: str  # file name of the object, or the name of a region
    offset: int

    def __str__(self) -> str:
        return f"{self.object}+{self.offset:#x}"


@dataclass(frozen=True, slots=True, kw_only=True)
class FileMapping:
    """One line of /proc/PID/maps that belongs to a file."""

    start: int
    end: int
    file_offset: int
    path: str


@dataclass(frozen=True, slots=True, kw_only=True)
class LoadedObject:
    """An ELF object or a named region in a process."""

    name: str
    path: str | None  # None for a region
    bias: int  # address = bias + offset
    start: int
    end: int
    build_id: str
    text: tuple[range, ...]  # offsets


@dataclass(frozen=True, slots=True, kw_only=True)
class Region:
    """Compiled code without a file, named by its build or by the bytes in memory."""

    span: range  # addresses
    build_id: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """The only code of an object that counts as its text."""

    text: tuple[range, ...]  # offsets, ascending


Regions = Mapping[str, "range | Region | Part"]


class Image:
    """The objects of one process at one moment."""

    def __init__(self, pid: int, regions: Regions | None = None) -> None:
        """Read the maps of a process.

        Args:
            pid: the process.
            regions: by name, the addresses of compiled code without a file, and the parts of loaded
                objects that count as their text.
        """
        self._files = _files(pid)
        self._paths: dict[str, str] = {}
        for path in self._files:
            self._paths.setdefault(Path(path).name, path)
        self._loaded: dict[str, LoadedObject | None] = {}
        for name, what in (regions or {}).items():
            if isinstance(what, Part):
                self._loaded[name] = replace(self.named(name), text=what.text)
            else:
                region = what if isinstance(what, Region) else Region(span=what)
                self._loaded[name] = _region(pid, name, region)
        regions_of_code = [(o.start, o.end, name) for name, o in self._loaded.items() if o]
        spans = [
            (min(m.start for m in mappings), max(m.end for m in mappings), Path(path).name)
            for path, mappings in self._files.items()
        ]
        self._sorted = sorted({*spans, *regions_of_code})
        self._starts = [start for start, _, _ in self._sorted]

    @property
    def names(self) -> list[str]:
        """Names of all mapped files and regions; a file need not be an object."""
        return [*self._loaded, *(name for name in self._paths if name not in self._loaded)]

    def path_of(self, name: str) -> str:
        """Path of a mapped file; empty for a region."""
        return self._paths.get(name, "")

    def find(self, name: str) -> LoadedObject | None:
        """An object or region by its name; None if no such object is loaded.

        An object is read on first use, because a Python process has hundreds.
        """
        if name not in self._loaded:
            path = self._paths.get(name)
            self._loaded[name] = None if path is None else _load(path, self._files[path])
        return self._loaded[name]

    def object_at(self, address: int) -> LoadedObject | None:
        """The object that holds an address."""
        index = bisect.bisect_right(self._starts, address) - 1
        if index < 0 or address >= self._sorted[index][1]:
            return None
        return self.find(self._sorted[index][2])

    def named(self, name: str) -> LoadedObject:
        """An object by its file name.

        Raises:
            UnknownName: no such object is loaded.
        """
        found = self.find(name)
        if found is None:
            raise UnknownName("object", name, [n for n in self.names if self.find(n) is not None])
        return found

    def locate(self, address: int) -> Location:
        """The location of an address; unknown memory is the object `?`."""
        loaded = self.object_at(address)
        if loaded is None:
            return Location("?", address)
        return Location(loaded.name, address - loaded.bias)

    def address(self, location: Location) -> int:
        """The address of a location in this process.

        Raises:
            UnknownName: its object is not loaded.
        """
        return self.named(location.object).bias + location.offset

    def symbol(self, location: Location) -> str:
        """`function+offset` of a location, or the empty string."""
        loaded = self.find(location.object)
        if loaded is None or loaded.path is None:
            return ""
        found = elf_facts(loaded.path).function_at(location.offset)
        return "" if found is None else f"{found.name}+{location.offset - found.start:#x}"

    def function(self, name: str, objects: Iterable[str]) -> Location:
        """The entry of a function in one of the named objects.

        Raises:
            UnknownName: none of them has it; names the nearest.
        """
        known: list[str] = []
        for loaded in map(self.named, objects):
            if loaded.path is None:
                continue
            facts = elf_facts(loaded.path)
            found = facts.function(name)
            if found is not None:
                return Location(loaded.name, found.start)
            known += [function.name for function in facts.functions()]
        raise UnknownName("function", name, known[:200])


@dataclass(frozen=True, slots=True, kw_only=True)
class Scope:
    """The code that may be hit: the text of these objects, as addresses of one process."""

    objects: tuple[str, ...]
    spans: tuple[range, ...]

    def __contains__(self, address: int) -> bool:
        return any(address in span for span in self.spans)


def executable_mapping(pid: int, address: int) -> range:
    """The executable mapping that holds an address: the region of a just-in-time compiled kernel.

    Raises:
        FaultError: nothing executable is mapped there.
    """
    for line in Path(f"/proc/{pid}/maps").read_text().splitlines():
        edges, access = line.split(maxsplit=2)[:2]
        low, high = (int(edge, 16) for edge in edges.split("-"))
        if low <= address < high and "x" in access:
            return range(low, high)
    raise FaultError(f"no executable code at {address:#x} in process {pid}")


def scope_of(image: Image, objects: Iterable[str]) -> Scope:
    """The text of the named objects.

    Raises:
        UnknownName: an object is not loaded; names the nearest.
    """
    names = tuple(objects)
    spans = [
        range(loaded.bias + text.start, loaded.bias + text.stop)
        for loaded in map(image.named, names)
        for text in loaded.text
    ]
    return Scope(objects=names, spans=tuple(sorted(spans, key=lambda span: span.start)))


def _files(pid: int) -> dict[str, list[FileMapping]]:
    found: dict[str, list[FileMapping]] = {}
    for line in Path(f"/proc/{pid}/maps").read_text().splitlines():
        parts = line.split(maxsplit=5)
        if len(parts) < 6 or not parts[5].startswith("/"):
            continue
        low, high = (int(edge, 16) for edge in parts[0].split("-"))
        mapping = FileMapping(start=low, end=high, file_offset=int(parts[2], 16), path=parts[5])
        found.setdefault(parts[5], []).append(mapping)
    return found


def _load(path: str, mappings: list[FileMapping]) -> LoadedObject | None:
    if not Path(path).is_file():
        return None
    with open(path, "rb") as stream:
        if stream.read(4) != b"\x7fELF":
            return None
    try:
        facts = elf_facts(path, Path(path).stat().st_mtime_ns)
    except FaultError:
        return None
    first = min(mappings, key=lambda mapping: mapping.file_offset)
    return LoadedObject(
        name=Path(path).name,
        path=path,
        bias=first.start - first.file_offset - facts.first_segment,
        start=min(mapping.start for mapping in mappings),
        end=max(mapping.end for mapping in mappings),
        build_id=facts.build_id,
        text=facts.text,
    )


def _region(pid: int, name: str, region: Region) -> LoadedObject:
    span, build_id = region.span, region.build_id
    if not build_id:
        with open(f"/proc/{pid}/mem", "rb", buffering=0) as memory:
            memory.seek(span.start)
            code = memory.read(len(span))
        build_id = "sha256:" + hashlib.sha256(code).hexdigest()[:40]
    return LoadedObject(
        name=name,
        path=None,
        bias=span.start,
        start=span.start,
        end=span.stop,
        build_id=build_id,
        text=(range(len(span)),),
    )
