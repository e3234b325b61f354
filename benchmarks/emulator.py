"""Runs a program in the Unicorn emulator, from a copy of the native process before `main`.

It exists to check the injector, and shares no code with it. The emulator executes SSE, but not AVX;
`ENVIRONMENT` makes the C library choose its SSE variants. Both injectors need the same environment,
so that the addresses of a run are the same.

The emulator accepts two kinds of invalid accesses that a processor refuses: addresses that no
process has (it drops their highest bits), and a misaligned vector operand that must be aligned. The
first kind is refused here when a page is first used, the second in the program's own code. The
stack may grow to its limit, as it may natively.
"""

from __future__ import annotations

import ctypes
import os
import re
import signal
import struct
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import unicorn
from elftools.elf.elffile import ELFFile
from numba import carray, cfunc, types
from unicorn import x86_const as x86
from unicorn.unicorn_py3.unicorn import uclib

ENVIRONMENT = {
    "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX512F,-AVX2,-AVX,-AVX_Fast_Unaligned_Load,-FMA,-ERMS",
    "LC_CTYPE": "C.UTF-8",  # as Python sets it in the C locale
    "LD_BIND_NOW": "1",  # or the first call of a function saves the registers by an AVX instruction
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "PATH": "/usr/bin",
}
AVX_PREFIXES = (0x62, 0xC4, 0xC5)
NOT_EMULATED = "AVX"  # instead of a reason to kill the process
PAGE = 4096
STACK_BYTES = 8 << 20
LARGEST_BYTES = 1 << 30  # of one request for memory
NOWHERE = 0x8000  # where no run ends: nothing is mapped there
VECTORS = 16
GENERAL = tuple("r15 r14 r13 r12 rbp rbx r11 r10 r9 r8 rax rcx rdx rsi rdi".split())  # noqa: SIM905
UNREADABLE = ("[vvar]", "[vvar_vclock]", "[vsyscall]")

LIBC = ctypes.CDLL(None, use_errno=True)
LIBC.ptrace.argtypes = [ctypes.c_long, ctypes.c_long, ctypes.c_void_p, ctypes.c_void_p]
LIBC.ptrace.restype = ctypes.c_long
TRACEME, CONT, GETREGS, GETFPREGS = 0, 7, 12, 14
FIXED_ADDRESSES = 0x0040000


@dataclass(frozen=True, slots=True, kw_only=True)
class Mapping:
    """One memory mapping of a process, with its contents."""

    start: int
    end: int
    rights: int  # as Unicorn counts them: 1 read, 2 write, 4 execute
    name: str
    data: bytes


@dataclass(frozen=True, kw_only=True)
class Snapshot:
    """A copy of a process that stopped before the first instruction of `main`.

    Attributes:
        registers: general registers, flags, instruction pointer and base of fs, by name.
        vectors: xmm0 to xmm15.
        bias: what is added to an address in the file to get the address in memory.
        heap: end of the heap.
        aligned: operands that must be aligned, by the instruction's address in the file.
    """

    program: Path
    registers: dict[str, int]
    vectors: tuple[int, ...]
    mxcsr: int
    bias: int
    heap: int
    mappings: tuple[Mapping, ...]
    aligned: dict[int, Access]


_UNALIGNED = re.compile(
    r"mov(?:[uhl]p[sd]|dqu|[qd]|s[sd]|ddup)|lddqu|\w+s[sd]|u?comis[sd]|cvt\w+|pinsr\w|pextr\w"
    r"|pmov[sz]x\w+|v\w+"
)
_ACCESS = re.compile(r"\s*([0-9a-f]+):\s+(\w+)\s.*?(-?0x[0-9a-f]+)?\(%(\w+)(?:,%(\w+),(\d))?\).*")


@dataclass(frozen=True, slots=True, kw_only=True)
class Access:
    """The address of an operand in memory: `base + index * scale + offset`."""

    base: str
    index: str  # empty for none
    scale: int
    offset: int


def aligned_accesses(program: Path) -> dict[int, Access]:
    """Return the vector operands in memory that must be aligned, keyed by instruction address."""
    listing = subprocess.run(
        ["objdump", "-d", "--no-show-raw-insn", str(program)], capture_output=True, text=True,
        check=True,
    )  # fmt: skip
    found = {}
    for line in listing.stdout.splitlines():
        match = _ACCESS.fullmatch(line.partition("#")[0])
        if match is None or "%xmm" not in line or _UNALIGNED.fullmatch(match[2]):
            continue
        address, _, offset, base, index, scale = match.groups()
        if base != "rip":  # such an operand cannot be wrong
            found[int(address, 16)] = Access(
                base=base, index=index or "", scale=int(scale or 1), offset=int(offset or "0", 16)
            )
    return found


def take_snapshot(program: Path) -> Snapshot:
    """Start a program, and return a copy of its process before the first instruction of `main`."""
    with program.open("rb") as file:
        elf = ELFFile(file)
        main = elf.get_section_by_name(".symtab").get_symbol_by_name("main")[0]["st_value"]
    process = subprocess.Popen(
        [str(program)], env=ENVIRONMENT, preexec_fn=_begin, stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
    )  # fmt: skip
    pid = process.pid
    try:
        os.waitpid(pid, 0)
        bias = next(m.start for m in _mappings(pid, None) if m.name == str(program))
        with open(f"/proc/{pid}/mem", "r+b", buffering=0) as memory:
            kept = os.pread(memory.fileno(), 1, bias + main)
            os.pwrite(memory.fileno(), b"\xcc", bias + main)
            _go_on(pid)
            os.pwrite(memory.fileno(), kept, bias + main)
            return _copy(pid, memory, program, bias, main)
    finally:
        os.kill(pid, signal.SIGKILL)
        process.wait()


def _begin() -> None:
    LIBC.personality(FIXED_ADDRESSES)
    _ptrace(TRACEME, 0)


def _ptrace(request: int, pid: int, data: Any = None) -> None:
    if LIBC.ptrace(request, pid, None, data) == -1:
        raise OSError(ctypes.get_errno(), f"ptrace request {request} failed")


def _go_on(pid: int) -> None:
    _ptrace(CONT, pid)
    _, status = os.waitpid(pid, 0)
    if not os.WIFSTOPPED(status) or os.WSTOPSIG(status) != signal.SIGTRAP:
        raise RuntimeError(f"the program ended before it reached main: wait status {status:#x}")


def _copy(pid: int, memory: BinaryIO, program: Path, bias: int, main: int) -> Snapshot:
    raw = ctypes.create_string_buffer(27 * 8)
    _ptrace(GETREGS, pid, raw)
    words = struct.unpack("27Q", raw.raw)
    if words[16] != bias + main + 1:
        raise RuntimeError(f"the program stopped at {words[16]:#x} instead of at main")
    registers = dict(zip(GENERAL, words, strict=False))
    registers |= {"rip": bias + main, "eflags": words[18], "rsp": words[19], "fs_base": words[21]}
    area = ctypes.create_string_buffer(512)
    _ptrace(GETFPREGS, pid, area)
    heap = int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[44])
    mappings = tuple(_mappings(pid, memory))
    return Snapshot(
        program=program, registers=registers, bias=bias, mappings=mappings,
        aligned=aligned_accesses(program),
        vectors=tuple(
            int.from_bytes(area.raw[160 + 16 * i : 176 + 16 * i], "little") for i in range(VECTORS)
        ),
        mxcsr=int.from_bytes(area.raw[24:28], "little"),
        heap=max([heap, *(m.end for m in mappings if m.name == "[heap]")]),
    )  # fmt: skip


def _mappings(pid: int, memory: BinaryIO | None) -> list[Mapping]:
    found = []
    for line in Path(f"/proc/{pid}/maps").read_text().splitlines():
        span, letters, _, _, _, *rest = line.split(maxsplit=5)
        start, end = (int(each, 16) for each in span.split("-"))
        name = rest[0] if rest else ""
        if name in UNREADABLE:
            continue
        rights = sum(bit for bit, each in zip((1, 2, 4), "rwx", strict=True) if each in letters)
        data = b""
        if memory is not None and rights & 1:
            data = os.pread(memory.fileno(), end - start, start)
        if name == "[stack]":
            data = bytes(STACK_BYTES - (end - start)) + data
            start = end - STACK_BYTES
        found.append(Mapping(start=start, end=end, rights=rights, name=name, data=data))
    return found


_stop = uclib.uc_emu_stop
_CODE = types.void(types.voidptr, types.uint64, types.uint32, types.voidptr)
_PAGE = types.boolean(
    types.voidptr, types.uint64, types.int32, types.CPointer(types.uint64), types.voidptr
)


@cfunc(_CODE)
def _count_down(engine, _address, _size, data):  # type: ignore[no-untyped-def]
    left = carray(data, (1,), np.int64)
    left[0] -= 1
    if left[0] == 0:
        _stop(engine)


@cfunc(_CODE)
def _count_each(_engine, address, _size, data):  # type: ignore[no-untyped-def]
    counts = carray(data, (1 << 40,), np.int64)
    counts[np.int64(address) - counts[0]] += 1


@cfunc(_PAGE)
def _enter_page(_engine, address, _access, entry, _data):  # type: ignore[no-untyped-def]
    place = carray(entry, (2,), np.uint64)
    place[0], place[1] = address, 7
    return address >> np.uint64(47) == 0


@dataclass(frozen=True, slots=True, kw_only=True)
class End:
    """How a run ended: with an exit code, killed for a reason, or not within its limit."""

    exit_code: int | None
    reason: str  # empty if it left by itself
    hangs: bool
    output: bytes
    blocks: int  # basic blocks that it has executed


class Emulation:
    """One emulated run of a program, from the first instruction of `main`."""

    def __init__(self, snapshot: Snapshot) -> None:
        self.snapshot = snapshot
        self.engine = unicorn.Uc(unicorn.UC_ARCH_X86, unicorn.UC_MODE_64)
        self._output = bytearray()
        self._exit_code: int | None = None
        self._killed = ""
        self._heap = snapshot.heap
        self._lowest = min(m.start for m in snapshot.mappings if m.start >> 44 == 7)
        self._left = np.zeros(1, np.int64)
        self._load()

    def _load(self) -> None:
        self.engine.ctl_set_tlb_mode(unicorn.UC_TLB_VIRTUAL)
        self._hook(unicorn.UC_HOOK_TLB_FILL, _enter_page)
        for mapping in self.snapshot.mappings:
            self.engine.mem_map(mapping.start, mapping.end - mapping.start, mapping.rights)
            self.engine.mem_write(mapping.start, mapping.data)
        for name, value in self.snapshot.registers.items():
            self[name] = value
        for number, value in enumerate(self.snapshot.vectors):
            self[f"xmm{number}"] = value
        self["mxcsr"] = self.snapshot.mxcsr
        syscall = unicorn.UC_HOOK_INSN
        self.engine.hook_add(syscall, self._serve, None, 1, 0, x86.UC_X86_INS_SYSCALL)

    def __getitem__(self, register: str) -> int:
        value: int = self.engine.reg_read(getattr(x86, f"UC_X86_REG_{register.upper()}"))
        return value

    def __setitem__(self, register: str, value: int) -> None:
        self.engine.reg_write(getattr(x86, f"UC_X86_REG_{register.upper()}"), value)

    def _hook(
        self, kind: int, function: Any, data: Any = None, first: int = 1, last: int = 0
    ) -> Any:
        handle = ctypes.c_size_t()
        status = uclib.uc_hook_add(
            self.engine._uch, ctypes.byref(handle), kind,
            ctypes.c_void_p(function.address),
            ctypes.c_void_p(None if data is None else data.ctypes.data),
            ctypes.c_uint64(first), ctypes.c_uint64(last),
        )  # fmt: skip
        if status != unicorn.UC_ERR_OK:
            raise unicorn.UcError(status)
        return handle

    def _go(self, count: int = 0) -> None:
        try:
            self.engine.emu_start(self["rip"], NOWHERE, 0, count)
        except unicorn.UcError as error:
            self._killed = str(error)
            invalid = error.errno == unicorn.UC_ERR_INSN_INVALID
            if invalid and self.engine.mem_read(self["rip"], 1)[0] in AVX_PREFIXES:
                self._killed = NOT_EMULATED

    @property
    def over(self) -> bool:
        """True if the program has ended."""
        return self._exit_code is not None or bool(self._killed)

    def count_executions(self, first: int, last: int) -> np.ndarray:
        """Run to the end. Return how often the instruction at each address was executed.

        The counts have shape (last - first + 1,).
        """
        counts = np.zeros(last - first + 2, np.int64)
        counts[0] = first - 1
        self._hook(unicorn.UC_HOOK_CODE, _count_each, counts, first, last)
        self._go()
        return counts[1:]

    def run_to(self, address: int, k: int) -> bool:
        """Run until an instruction is about to execute for the k-th time.

        Return False if the program ends before.
        """
        self._left[0] = k
        handle = self._hook(unicorn.UC_HOOK_CODE, _count_down, self._left, address, address)
        self._go()
        uclib.uc_hook_del(self.engine._uch, handle)
        if self.over:
            return False
        if self["rip"] != address:
            raise RuntimeError(f"the run stopped at {self['rip']:#x} instead of at {address:#x}")
        return True

    def step(self) -> None:
        """Execute one instruction. An instruction with a repeat prefix runs to its end."""
        before = self["rip"]
        self._go(1)
        while self["rip"] == before and not self.over:
            self._go(1)

    def finish(self, blocks: int) -> End:
        """Run to the end, but at most `blocks` basic blocks. Return how the run ended."""
        self._left[0] = blocks
        self._hook(unicorn.UC_HOOK_BLOCK, _count_down, self._left)
        for address, access in self.snapshot.aligned.items():
            place = self.snapshot.bias + address
            self.engine.hook_add(unicorn.UC_HOOK_CODE, self._check, access, place, place)
        self.engine.ctl_flush_tb()
        if not self.over:
            self._go()
        left = int(self._left[0])
        return End(
            exit_code=None if self._killed else self._exit_code, reason=self._killed,
            hangs=left <= 0 and not self.over, output=bytes(self._output), blocks=blocks - left,
        )  # fmt: skip

    def _check(self, _engine: Any, _address: int, _size: int, access: Access) -> None:
        place = self[access.base] + access.offset
        if access.index:
            place += self[access.index] * access.scale
        if place % 16:
            self._killed = "misaligned"
            self.engine.emu_stop()

    def _serve(self, _engine: Any, _data: Any) -> None:
        a, b, c = (self[name] for name in ("rdi", "rsi", "rdx"))
        number = self["rax"]
        try:
            result = self._answer(number, a, b, c)
        except unicorn.UcError:
            result = -14  # EFAULT
        self["rax"] = result & ((1 << 64) - 1)

    def _answer(self, number: int, a: int, b: int, c: int) -> int:
        match number:
            case 1:  # write
                return self._write(a, b, c)
            case 5:  # fstat
                return self._describe(b)
            case 262:  # newfstatat
                return self._describe(c)
            case 9:  # mmap
                return self._map(b)
            case 12:  # brk
                return self._move_heap(a)
            case 60 | 231:  # exit, exit_group
                self._exit_code = a & 0xFF
                self.engine.emu_stop()
                return 0
            case 62 | 200 | 234:  # kill, tkill, tgkill
                self._killed = "the program kills itself"
                self.engine.emu_stop()
                return 0
            case 318:  # getrandom
                self.engine.mem_write(a, bytes(b))
                return b
            case 3 | 10 | 11 | 13 | 14 | 39 | 186 | 202:
                return 0  # close, mprotect, munmap, signals, getpid, gettid, futex
            case 16:  # ioctl
                return -25  # ENOTTY
        return -38  # ENOSYS

    def _write(self, descriptor: int, address: int, size: int) -> int:
        if descriptor not in (1, 2):
            return -9  # EBADF
        data = self.engine.mem_read(address, min(size, LARGEST_BYTES))
        if descriptor == 1:
            self._output += data
        return len(data)

    def _describe(self, address: int) -> int:
        stat = bytearray(144)
        struct.pack_into("QI", stat, 16, 1, 0o100644)
        struct.pack_into("Q", stat, 56, PAGE)
        self.engine.mem_write(address, bytes(stat))
        return 0

    def _map(self, size: int) -> int:
        size = -(-size // PAGE) * PAGE
        if not 0 < size <= LARGEST_BYTES:
            return -12  # ENOMEM
        self._lowest -= size
        self.engine.mem_map(self._lowest, size, 3)
        return self._lowest

    def _move_heap(self, wanted: int) -> int:
        if self._heap < wanted < self._heap + LARGEST_BYTES:
            first, last = (-(-each // PAGE) * PAGE for each in (self._heap, wanted))
            if last > first:
                self.engine.mem_map(first, last - first, 3)
            self._heap = wanted
        return self._heap
