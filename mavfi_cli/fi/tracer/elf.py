"""Reads build id, code and functions of an ELF file.

Functions are searched in the raw tables: a library of 10 MB has tens of thousands of them with
long names, and a mission waits for the answer.
"""

from __future__ import annotations

import functools
import hashlib
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from elftools.common.exceptions import ELFError
from elftools.elf.elffile import ELFFile
from numpy.typing import NDArray

from mavfi_cli.core.errors import FaultError

# Elf64_Sym, and the symbol types of functions (STT_FUNC, and STT_LOOS for indirect ones).
_SYMBOL = np.dtype(
    [("name", "<u4"), ("info", "u1"), ("other", "u1"), ("section", "<u2"), ("value", "<u8"),
     ("size", "<u8")]
)  # fmt: skip
_FUNCTION_TYPES = (2, 10)


@dataclass(frozen=True, slots=True, order=True)
class Function:
    """One function, at its linked address."""

    start: int
    size: int
    name: str


class _Table:
    """The functions of one symbol table, ascending, with their names in one string."""

    def __init__(self, symbols: NDArray[np.void], names: bytes) -> None:
        wanted = np.isin(symbols["info"] & 0xF, _FUNCTION_TYPES) & (symbols["value"] != 0)
        found = symbols[wanted]
        self._symbols = found[np.argsort(found["value"], kind="stable")]
        self._names = names

    def _function(self, index: int) -> Function:
        _, size, at = (int(self._symbols[key][index]) for key in ("value", "size", "name"))
        name = self._names[at : self._names.index(b"\0", at)].decode(errors="replace")
        return Function(int(self._symbols["value"][index]), size, name)

    def __iter__(self) -> Iterator[Function]:
        return map(self._function, range(len(self._symbols)))

    def at(self, address: int) -> Iterator[Function]:
        """The last functions that start no later than the address."""
        starts = self._symbols["value"]
        end = int(np.searchsorted(starts, address, side="right"))
        first = int(np.searchsorted(starts, starts[end - 1])) if end else 0
        return map(self._function, range(first, end))

    def named(self, name: str) -> Iterator[Function]:
        """The functions of exactly this name; a name may be stored as the end of a longer one."""
        end = name.encode() + b"\0"
        places = [match.start() for match in re.finditer(re.escape(end), self._names)]
        return map(self._function, np.flatnonzero(np.isin(self._symbols["name"], places)).tolist())

    def containing(self, part: str) -> NDArray[np.bool_]:
        """(n,) mask of the functions whose names contain the text."""
        places = np.array([m.start() for m in re.finditer(re.escape(part.encode()), self._names)])
        ends = np.flatnonzero(np.frombuffer(self._names, np.uint8) == 0)
        begins = self._symbols["name"]
        stops = ends[np.searchsorted(ends, begins)]
        hits = np.searchsorted(places, begins) < np.searchsorted(places, stops)
        return np.asarray(hits, np.bool_)

    def with_any(self, parts: Iterable[str]) -> Iterator[Function]:
        """The functions whose names contain one of the texts."""
        hits = np.zeros(len(self._symbols), np.bool_)
        for part in parts:
            hits |= self.containing(part)
        return map(self._function, np.flatnonzero(hits).tolist())


@dataclass(frozen=True, kw_only=True)
class ElfFacts:
    """Build id, code and functions of one ELF file."""

    path: str
    build_id: str
    text: tuple[range, ...]  # linked addresses of its own code, without PLT and start-up stubs
    first_segment: int  # linked address of file offset 0

    @functools.cached_property
    def _tables(self) -> tuple[_Table, ...]:
        """The symbol tables, read on first use: few objects of a Python process are needed."""
        try:
            with open(self.path, "rb") as stream:
                return tuple(_read_tables(ELFFile(stream)))
        except (OSError, ELFError) as error:
            raise FaultError(f"{self.path}: not a readable ELF object ({error})") from None

    def functions(self) -> list[Function]:
        """All functions, ascending."""
        return sorted({function for table in self._tables for function in table})

    def function_at(self, address: int) -> Function | None:
        """The function that holds a linked address.

        If several start at one address, the last of the greatest size and name counts. A
        function without a size reaches to the next.
        """
        found = [function for table in self._tables for function in table.at(address)]
        last = max(found, default=None)
        if last is None or (last.size and address >= last.start + last.size):
            return None
        return last

    def function(self, name: str) -> Function | None:
        """The first function of exactly this name."""
        return min((f for table in self._tables for f in table.named(name)), default=None)

    def functions_with(self, *parts: str) -> list[Function]:
        """The functions whose names contain one of the texts, ascending."""
        return sorted({f for table in self._tables for f in table.with_any(parts)})


@functools.lru_cache(maxsize=256)
def elf_facts(path: str, _modified_ns: int = 0) -> ElfFacts:
    """Read an ELF file; the hash of its contents replaces a missing build id.

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


def _read_tables(elf: Any) -> Iterator[_Table]:
    for name in (".symtab", ".dynsym"):
        section = elf.get_section_by_name(name)
        if section is not None and section["sh_size"]:
            names: bytes = elf.get_section(section["sh_link"]).data()
            yield _Table(np.frombuffer(section.data(), _SYMBOL), names)
