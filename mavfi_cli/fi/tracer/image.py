"""Memory maps of a process and its ELF files: objects, build ids, functions and code in scope.

A location is `(object, offset)`. For an ELF object, the offset is the address that the linker
assigned (as printed by `objdump` and `nm`), so it does not depend on where the object was loaded.
Compiled code without a file (numba) is a named region, whose offsets count from its start.

Functions are read from the raw symbol tables, because a library of 10 MB has tens of thousands of
them and a slower reader would delay the mission.
"""

from __future__ import annotations

import bisect
import functools
import hashlib
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from elftools.common.exceptions import ELFError
from elftools.elf.elffile import ELFFile
from numpy.typing import NDArray

from mavfi_cli.core.errors import FaultError, UnknownName

# Elf64_Sym, and the symbol types of functions (STT_FUNC, and STT_LOOS for indirect ones).
_SYMBOL = np.dtype(
    [("name", "<u4"), ("info", "u1"), ("other", "u1"), ("section", "<u2"), ("value", "<u8"),
     ("size", "<u8")]
)  # fmt: skip
_FUNCTION_TYPES = (2, 10)


class Function(NamedTuple):
    """One function, at its linked address."""

    start: int
    size: int
    name: str


@dataclass(frozen=True, kw_only=True)
class _ElfFacts:
    """Build id, code and functions of one ELF file."""

    path: str
    build_id: str
    text: tuple[range, ...]  # linked addresses of its own code, without PLT and start-up stubs
    first_segment: int  # linked address of file offset 0

    @functools.cached_property
    def functions(self) -> tuple[Function, ...]:
        """All functions by address; read on first use, because they are rarely needed."""
        try:
            with open(self.path, "rb") as stream:
                return tuple(sorted(set(_functions(ELFFile(stream)))))
        except (OSError, ELFError) as error:
            raise FaultError(f"{self.path}: not a readable ELF object ({error})") from None

    def function_at(self, address: int) -> Function | None:
        """Return the function that contains a linked address, or None if no function does.

        If several start at the same address, the largest is returned; among equally large ones, the
        last by name. A function without a size extends to the next one.
        """
        end = bisect.bisect_right(self.functions, address, key=attrgetter("start"))
        if not end:
            return None
        last = self.functions[end - 1]
        return None if last.size and address >= last.start + last.size else last


@functools.lru_cache(maxsize=256)
def _elf_facts(path: str, _modified_ns: int) -> _ElfFacts:
    """Read the build id, the code and the first address of an ELF file.

    A hash of the file's contents replaces a missing build id.

    Raises:
        FaultError: the file cannot be read or is not an ELF file.
    """
    try:
        with open(path, "rb") as stream:
            elf: Any = ELFFile(stream)
            text = _text(elf)
            loads = [s for s in elf.iter_segments() if s["p_type"] == "PT_LOAD"]
            first = loads[0]["p_vaddr"] - loads[0]["p_offset"]
            build_id = _build_id(elf)
    except (OSError, ELFError) as error:
        raise FaultError(f"{path}: not a readable ELF object ({error})") from None
    if not build_id:
        build_id = "sha256:" + hashlib.sha256(Path(path).read_bytes()).hexdigest()[:40]
    return _ElfFacts(path=path, build_id=build_id, text=text, first_segment=first)


def _build_id(elf: Any) -> str:
    section = elf.get_section_by_name(".note.gnu.build-id")
    if section is None:
        return ""
    return next((str(n["n_desc"]) for n in section.iter_notes()), "")


def _text(elf: Any) -> tuple[range, ...]:
    section = elf.get_section_by_name(".text")
    if section is not None:
        return (range(section["sh_addr"], section["sh_addr"] + section["sh_size"]),)
    return tuple(
        range(segment["p_vaddr"], segment["p_vaddr"] + segment["p_memsz"])
        for segment in elf.iter_segments()
        if segment["p_type"] == "PT_LOAD" and segment["p_flags"] & 1
    )


def _functions(elf: Any) -> Iterator[Function]:
    """Yield the functions that the symbol tables of an ELF file list."""
    for table in (".symtab", ".dynsym"):
        section = elf.get_section_by_name(table)
        if section is None or not section["sh_size"]:
            continue
        names: bytes = elf.get_section(section["sh_link"]).data()
        symbols = np.frombuffer(section.data(), _SYMBOL)
        wanted = np.isin(symbols["info"] & 0xF, _FUNCTION_TYPES) & (symbols["value"] != 0)
        for at, start, size in symbols[wanted][["name", "value", "size"]].tolist():
            name = names[at : names.index(b"\0", at)].decode(errors="replace")
            yield Function(start, size, name)


def short_name(symbol: str) -> str:
    """Return the unqualified name of a function from its mangled symbol."""
    mangled = symbol.partition("+")[0]
    for size in re.finditer(r"\d+", mangled):
        end = size.end() + int(size.group())
        name = mangled[size.end() : end]
        if name[:1].islower() and mangled[end : end + 1] in ("E", "I"):
            return name
    return mangled or "its entry"


@dataclass(frozen=True, slots=True, order=True)
class Location:
    """The location of one instruction, independent of its object's load address."""

    object: str  # file name of the object, or the name of a region
    offset: int

    def __str__(self) -> str:
        return f"{self.object}+{self.offset:#x}"


class _Mapping(NamedTuple):
    """One line of /proc/PID/maps."""

    start: int
    end: int
    access: str
    offset: int  # in the file
    path: str  # empty for memory without a name


@dataclass(frozen=True, slots=True, kw_only=True)
class _LoadedObject:
    """An ELF object or a named region in a process."""

    name: str
    facts: _ElfFacts | None  # None for a region
    bias: int  # address = bias + offset
    build_id: str
    text: tuple[range, ...]  # offsets

    @property
    def path(self) -> str | None:
        """Path of the object's file, or None for a region."""
        return None if self.facts is None else self.facts.path

    @property
    def functions(self) -> tuple[Function, ...]:
        """All functions by address; a region has none."""
        return () if self.facts is None else self.facts.functions


@dataclass(frozen=True, slots=True, kw_only=True)
class Region:
    """Compiled code without a file, identified by a build id or else by its bytes in memory."""

    span: range  # addresses
    build_id: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """The part of an object that counts as its text."""

    text: tuple[range, ...]  # offsets, ascending


@dataclass(frozen=True, slots=True, kw_only=True)
class Scope:
    """The code in scope: the text of these objects, as address ranges in one process."""

    objects: tuple[str, ...]
    spans: tuple[range, ...]

    def __contains__(self, address: int) -> bool:
        return any(address in span for span in self.spans)

    @property
    def bounds(self) -> NDArray[np.int64]:
        """The start and end of each span, as an array of shape (n, 2)."""
        return np.array([[span.start, span.stop] for span in self.spans], np.int64)


Regions = Mapping[str, "range | Region | Part"]


class Image:
    """The objects and regions of code that one process has loaded, as of one moment."""

    def __init__(self, pid: int, regions: Regions | None = None) -> None:
        """Read the memory maps of a process.

        Args:
            regions: maps a name to the addresses of compiled code without a file, or to the part of
                a loaded object that counts as its text.
        """
        self._files: dict[str, list[_Mapping]] = {}
        for mapping in _mappings(pid):
            if mapping.path.startswith("/"):
                self._files.setdefault(mapping.path, []).append(mapping)
        self._paths: dict[str, str] = {}
        for path in self._files:
            self._paths.setdefault(Path(path).name, path)
        self._loaded: dict[str, _LoadedObject | None] = {}
        for name, what in (regions or {}).items():
            if isinstance(what, Part):
                self._loaded[name] = replace(self.named(name), text=what.text)
            else:
                region = what if isinstance(what, Region) else Region(span=what)
                self._loaded[name] = _region(pid, name, region)
        regions_of_code = [
            (region.bias, region.bias + region.text[0].stop, region.name)
            for region in self._loaded.values()
            if region is not None and region.facts is None
        ]
        spans = [
            (min(m.start for m in mappings), max(m.end for m in mappings), Path(path).name)
            for path, mappings in self._files.items()
        ]
        self._sorted = sorted({*spans, *regions_of_code})
        self._starts = [start for start, _, _ in self._sorted]

    @property
    def names(self) -> list[str]:
        """Names of all mapped files and regions; a file need not be an ELF object."""
        return [*self._loaded, *(name for name in self._paths if name not in self._loaded)]

    def path_of(self, name: str) -> str:
        """Return the path of a mapped file, or an empty string for a region."""
        return self._paths.get(name, "")

    def find(self, name: str) -> _LoadedObject | None:
        """Return the object or region with this name, or None if it is not loaded.

        An object is read on first use, because a Python process loads hundreds of them.
        """
        if name not in self._loaded:
            path = self._paths.get(name)
            self._loaded[name] = None if path is None else _load(path, self._files[path])
        return self._loaded[name]

    def object_at(self, address: int) -> _LoadedObject | None:
        """Return the object or region that contains an address, or None if none does."""
        index = bisect.bisect_right(self._starts, address) - 1
        if index < 0 or address >= self._sorted[index][1]:
            return None
        return self.find(self._sorted[index][2])

    def named(self, name: str) -> _LoadedObject:
        """Return the object or region with this name.

        Raises:
            UnknownName: no such object is loaded.
        """
        loaded = self.find(name)
        if loaded is None:
            raise UnknownName("object", name, [n for n in self.names if self.find(n) is not None])
        return loaded

    def locate(self, address: int) -> Location:
        """Return the location of an address. If no object contains it, the object is `?`."""
        loaded = self.object_at(address)
        if loaded is None:
            return Location("?", address)
        return Location(loaded.name, address - loaded.bias)

    def address(self, location: Location) -> int:
        """Return the address of a location in this process.

        Raises:
            UnknownName: the location's object is not loaded.
        """
        return self.named(location.object).bias + location.offset

    def symbol(self, location: Location) -> str:
        """Return a location as `function+offset`, or an empty string if its function is unknown."""
        loaded = self.find(location.object)
        if loaded is None or loaded.facts is None:
            return ""
        function = loaded.facts.function_at(location.offset)
        return "" if function is None else f"{function.name}+{location.offset - function.start:#x}"

    def function(self, name: str, objects: Iterable[str]) -> Location:
        """Return the entry of a function in the first of the named objects that has it.

        Raises:
            UnknownName: no object has this function; the message suggests the nearest name.
            FaultError: the objects have no symbols.
        """
        known: list[str] = []
        for loaded in map(self.named, objects):
            function = next((entry for entry in loaded.functions if entry.name == name), None)
            if function is not None:
                return Location(loaded.name, function.start)
            known += [function.name for function in loaded.functions]
        if not known:
            raise FaultError(f"{', '.join(objects)}: no function {name!r}: no symbol table")
        raise UnknownName("function", name, known[:200])

    def scope(self, objects: Iterable[str]) -> Scope:
        """Return a scope that contains the code of the named objects.

        Raises:
            UnknownName: an object is not loaded; the message suggests the nearest name.
        """
        names = tuple(objects)
        spans = [
            range(loaded.bias + text.start, loaded.bias + text.stop)
            for loaded in map(self.named, names)
            for text in loaded.text
        ]
        return Scope(objects=names, spans=tuple(sorted(spans, key=lambda span: span.start)))


def _mappings(pid: int) -> Iterator[_Mapping]:
    for line in Path(f"/proc/{pid}/maps").read_text().splitlines():
        edges, access, offset, _, _, *path = line.split(maxsplit=5)
        start, end = (int(edge, 16) for edge in edges.split("-"))
        yield _Mapping(start, end, access, int(offset, 16), path[0] if path else "")


def executable_mapping(pid: int, address: int) -> range:
    """Return the range of the executable mapping that contains an address.

    The address may be that of a just-in-time compiled kernel.

    Raises:
        FaultError: nothing executable is mapped there.
    """
    for mapping in _mappings(pid):
        if mapping.start <= address < mapping.end and "x" in mapping.access:
            return range(mapping.start, mapping.end)
    raise FaultError(f"no executable code at {address:#x} in process {pid}")


def _load(path: str, mappings: list[_Mapping]) -> _LoadedObject | None:
    """Return the object of a mapped file, or None if it is not a readable ELF file."""
    if not Path(path).is_file():
        return None
    try:
        facts = _elf_facts(path, Path(path).stat().st_mtime_ns)
    except FaultError:
        return None
    first = min(mappings, key=lambda mapping: mapping.offset)
    return _LoadedObject(
        name=Path(path).name,
        facts=facts,
        bias=first.start - first.offset - facts.first_segment,
        build_id=facts.build_id,
        text=facts.text,
    )


def _region(pid: int, name: str, region: Region) -> _LoadedObject:
    span, build_id = region.span, region.build_id
    if not build_id:
        with open(f"/proc/{pid}/mem", "rb", buffering=0) as memory:
            memory.seek(span.start)
            code = memory.read(len(span))
        build_id = "sha256:" + hashlib.sha256(code).hexdigest()[:40]
    return _LoadedObject(
        name=name,
        facts=None,
        bias=span.start,
        build_id=build_id,
        text=(range(len(span)),),
    )
