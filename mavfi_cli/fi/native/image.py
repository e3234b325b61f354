"""What is mapped where: objects, build ids, symbols, and the code that is in scope.

A place is `(object, offset)`. For an ELF object the offset is the address as the linker wrote it
(what `objdump` and `nm` print), so it does not depend on where the object was loaded. Compiled
code without a file (numba) is a named region, with offsets from its start.
"""

from __future__ import annotations

import bisect
import functools
import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from elftools.common.exceptions import ELFError
from elftools.elf.elffile import ELFFile

from mavfi_cli.core.errors import FaultError, UnknownName


@dataclass(frozen=True, slots=True, order=True)
class Location:
    """One instruction, wherever its object is loaded."""

    object: str  # file name of the object, or the name of a region
    offset: int

    def __str__(self) -> str:
        return f"{self.object}+{self.offset:#x}"


@dataclass(frozen=True, kw_only=True)
class ElfFacts:
    """What one ELF file says about itself."""

    path: str
    build_id: str
    text: tuple[range, ...]  # linked addresses of its own code, without PLT and start-up stubs
    first_segment: int  # linked address of file offset 0

    @functools.cached_property
    def functions(self) -> tuple[tuple[int, int, str], ...]:
        """Start, size and name of all functions, ascending; read when first asked for.

        Of all objects of a Python process that takes ten seconds, and few are asked.
        """
        try:
            with open(self.path, "rb") as stream:
                return tuple(sorted(set(_functions(ELFFile(stream)))))
        except (OSError, ELFError) as error:
            raise FaultError(f"{self.path}: not a readable ELF object ({error})") from None

    @functools.cached_property
    def starts(self) -> tuple[int, ...]:
        """Where the functions begin."""
        return tuple(start for start, _, _ in self.functions)


@functools.lru_cache(maxsize=256)
def elf_facts(path: str, _modified_ns: int = 0) -> ElfFacts:
    """Read an ELF file; a file without build id is named by the hash of its contents.

    Raises:
        FaultError: not an ELF file.
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
    return ElfFacts(path=path, build_id=build_id, text=text, first_segment=first)


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


# Elf64_Sym, and the symbol types of functions (STT_FUNC, and STT_LOOS for indirect ones). Read in
# one piece: a library of 10 MB has tens of thousands of symbols.
_SYMBOL = np.dtype(
    [("name", "<u4"), ("info", "u1"), ("other", "u1"), ("section", "<u2"), ("value", "<u8"),
     ("size", "<u8")]
)  # fmt: skip
_FUNCTION_TYPES = (2, 10)


def _functions(elf: Any) -> Iterable[tuple[int, int, str]]:
    for name in (".symtab", ".dynsym"):
        section = elf.get_section_by_name(name)
        if section is None or not section["sh_size"]:
            continue
        names: bytes = elf.get_section(section["sh_link"]).data()
        symbols = np.frombuffer(section.data(), _SYMBOL)
        wanted = np.isin(symbols["info"] & 0xF, _FUNCTION_TYPES) & (symbols["value"] != 0)
        for start, size, at in symbols[wanted][["value", "size", "name"]].tolist():
            yield start, size, names[at : names.index(b"\0", at)].decode(errors="replace")


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
    """Of an object, the only code that counts as its text."""

    text: tuple[range, ...]  # offsets, ascending


Regions = Mapping[str, "range | Region | Part"]


class Image:
    """The objects of one process at one moment."""

    def __init__(self, pid: int, regions: Regions | None = None) -> None:
        """Read the maps of a process.

        Args:
            pid: the process.
            regions: by name, addresses of compiled code without a file, and which part of a
                loaded object counts as its text.
        """
        self.objects: dict[str, LoadedObject] = {}
        for path, mappings in _files(pid).items():
            loaded = _load(path, mappings)
            if loaded is not None:
                self.objects.setdefault(loaded.name, loaded)
        for name, what in (regions or {}).items():
            if isinstance(what, Part):
                self.objects[name] = replace(self.named(name), text=what.text)
            else:
                region = what if isinstance(what, Region) else Region(span=what)
                self.objects[name] = _region(pid, name, region)
        self._sorted = sorted(self.objects.values(), key=lambda loaded: loaded.start)
        self._starts = [loaded.start for loaded in self._sorted]

    def object_at(self, address: int) -> LoadedObject | None:
        """The object that holds an address."""
        index = bisect.bisect_right(self._starts, address) - 1
        if index < 0 or address >= self._sorted[index].end:
            return None
        return self._sorted[index]

    def named(self, name: str) -> LoadedObject:
        """An object by its file name.

        Raises:
            UnknownName: no such object is loaded.
        """
        try:
            return self.objects[name]
        except KeyError:
            raise UnknownName("object", name, self.objects) from None

    def locate(self, address: int) -> Location:
        """The place of an address; unknown memory is the object `?`."""
        loaded = self.object_at(address)
        if loaded is None:
            return Location("?", address)
        return Location(loaded.name, address - loaded.bias)

    def address(self, location: Location) -> int:
        """Where a place is in this process.

        Raises:
            UnknownName: its object is not loaded.
        """
        return self.named(location.object).bias + location.offset

    def symbol(self, location: Location) -> str:
        """`function+offset` of a place, or the empty string."""
        loaded = self.objects.get(location.object)
        if loaded is None or loaded.path is None:
            return ""
        facts = elf_facts(loaded.path)
        index = bisect.bisect_right(facts.starts, location.offset) - 1
        if index < 0:
            return ""
        start, size, name = facts.functions[index]
        if size and location.offset >= start + size:
            return ""
        return f"{name}+{location.offset - start:#x}"

    def function(self, name: str, objects: Iterable[str]) -> Location:
        """The entry of a function in one of the named objects.

        Raises:
            UnknownName: none of them has it; names the nearest.
        """
        known: list[str] = []
        for object_name in objects:
            loaded = self.named(object_name)
            if loaded.path is None:
                continue
            for start, _, symbol in elf_facts(loaded.path).functions:
                if symbol == name:
                    return Location(object_name, start)
                known.append(symbol)
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
