"""Compares all the state that stopped forks of one process retain.

A fork shares the pages of its process until it writes to them, and then owns a copy. So two forks
can differ only in pages that one of them owns (bit 56 of the page map, proc_pid_pagemap(5)), in
registers, and in what their system calls have changed in the operating system. Forks that made the
same system calls, with the same arguments, have the same files, signals, threads and limits; the
list of mappings and the state of signals are compared as well.

Three things are ignored: memory below the stack pointer and its red zone; the vector registers,
which no function preserves for its caller (System V ABI, section 3.2.1); and clock readings, which
differ even between unstruck forks. All forks must run on one processor, because the operating
system writes the processor's number into their memory (struct rseq, the area of restartable
sequences that the C library registers for each thread).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.fi.tracer.tracee import Tracee

_PAGE = 4096
_OWN = np.uint64(1 << 56 | 1 << 62)  # flags: no other process maps the page; it is swapped out
_RED_ZONE = 128  # bytes below the stack pointer that a function may use
_KEPT_X87, _KEPT_SSE = slice(0, 5), slice(24, 28)  # control, status and tags; MXCSR
_KERNEL_OWN = ("[vvar]", "[vvar_vclock]", "[vsyscall]", "[vdso]")
# SigQ counts the queued signals of the user, in all processes.
_SIGNALS = re.compile(r"^(?:Sig(?!Q)|Shd|Threads)\w*:.*", re.MULTILINE)


@dataclass(frozen=True, slots=True, kw_only=True)
class StoppedFork:
    """A fork that is stopped at the start of a system call.

    Attributes:
        calls: number and arguments of each of its system calls since the forks were identical.
        clock: the bytes of a clock reading. All copies of them in its memory, even unaligned ones,
            count as zeros.
    """

    tracee: Tracee
    calls: Sequence[tuple[int, ...]]
    clock: bytes = b""

    @property
    def _process(self) -> Path:
        return Path(f"/proc/{self.tracee.pid}")

    def _outline(self) -> tuple[object, ...]:
        """Return the values to compare directly: calls, registers, mappings, signals, threads."""
        registers = self.tracee.registers
        vector = registers.extended()
        return (
            self.calls,
            registers.general(),
            vector[_KEPT_X87],
            vector[_KEPT_SSE],
            self._maps(),
            _SIGNALS.findall((self._process / "status").read_text()),
        )

    def _maps(self) -> str:
        return (self._process / "maps").read_text()

    def _own_pages(self) -> NDArray[np.int64]:
        """Return the numbers of the pages that the fork alone maps or that are swapped out.

        The array has shape (n,).
        """
        numbers = []
        with (self._process / "pagemap").open("rb", buffering=0) as table:
            for line in self._maps().splitlines():
                if line.endswith(_KERNEL_OWN):
                    continue
                first, end = (int(part, 16) // _PAGE for part in line.split()[0].split("-"))
                table.seek(8 * first)
                entries = np.frombuffer(table.read(8 * (end - first)), np.uint64)
                numbers.append(first + np.flatnonzero(entries & _OWN))
        return np.concatenate(numbers)

    def _words(self, pages: NDArray[np.int64]) -> NDArray[np.uint64]:
        """Return the contents of pages as words, of shape (n, 512), with ignored words set to 0."""
        memory, data = self.tracee.memory, bytearray()
        for run in np.split(pages, np.flatnonzero(np.diff(pages) != 1) + 1):
            data += memory.read(int(run[0]) * _PAGE, len(run) * _PAGE)
        if self.clock:
            data = data.replace(self.clock, bytes(len(self.clock)))
        words = np.frombuffer(data, np.uint64).reshape(-1, _PAGE // 8).copy()
        below = self.tracee.registers.sp - _RED_ZONE
        addresses = pages[:, None] * _PAGE + np.arange(0, _PAGE, 8)
        words[(addresses < below) & (addresses >= self._stack_start(below))] = 0
        return words

    def _stack_start(self, inside: int) -> int:
        for line in self._maps().splitlines():
            start, end = (int(part, 16) for part in line.split()[0].split("-"))
            if start <= inside < end:
                return start
        return inside


def remembers_the_same(struck: StoppedFork, unstruck: Sequence[StoppedFork]) -> bool:
    """Return True if a struck fork can no longer behave differently from unstruck ones.

    Args:
        unstruck: two unstruck forks. Memory words in which they differ from each other are assumed
            to hold clock readings, and are ignored.

    Raises:
        OSError: the operating system does not allow the memory to be read.
    """
    forks = (struck, *unstruck)
    if any(fork._outline() != struck._outline() for fork in unstruck):
        return False
    pages = np.unique(np.concatenate([fork._own_pages() for fork in forks]))
    if not len(pages):
        return True
    own, first, second = (fork._words(pages) for fork in forks)
    return not np.any((own != first) & (first == second))
