"""A program in an emulator: started natively, copied in front of `main`, and run on in Unicorn.

It exists to check the injector, and shares no code with it. The emulator executes SSE, but not AVX;
`ENVIRONMENT` makes the C library choose its SSE variants. Both injectors need the same environment,
so that the addresses of a run are the same.

What the emulator would let pass is caught once a fault has struck: a vector operand that must be
aligned and is not, and an address that no process has, which it would truncate. The stack may grow
to its limit, as it may natively.
"""

from __future__ import annotations

import ctypes
import os
import re
import signal
import struct
import subprocess
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import unicorn
from elftools.elf.elffile import ELFFile
from numba import carray, cfunc, types
from unicorn import x86_const as x86
from unicorn.unicorn_py3.unicorn import uclib

ENVIRONMENT = {
    "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX512F,-AVX512VL,-AVX512BW,-AVX2,-AVX,-FMA,-ERMS",
    "LD_BIND_NOW": "1",  # or the first call of a function saves the registers by an AVX instruction
    "PATH": "/usr/bin:/bin",
}
PAGE = 4096
STACK_BYTES = 8 << 20
LARGEST_BYTES = 1 << 30  # of one request for memory
NOWHERE = 0xFFFF_FFFF_FFFF_F000  # where no run ends
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
    """One mapped part of a process."""

    start: int
    end: int
    rights: int  # as Unicorn counts them: 1 read, 2 write, 4 execute
    name: str
    data: bytes


@dataclass(frozen=True, kw_only=True)
class Snapshot:
    """A process in front of the first instruction of `main`.

    Attributes:
        registers: general registers, flags, instruction pointer and base of fs, by name.
        vectors: xmm0 to xmm15.
        bias: what is added to an address of the file.
        heap: end of the heap.
    """

    program: Path
    registers: dict[str, int]
    vectors: tuple[int, ...]
    mxcsr: int
    bias: int
    heap: int
    mappings: tuple[Mapping, ...]

    @cached_property
    def aligned(self) -> np.ndarray:
        """(2^18,) a bit for each of the lowest 24 bits of an address of an aligned access."""
        bits = np.zeros(1 << 18, np.int64)
        firsts: dict[str, int] = {}
        for mapping in self.mappings:
            firsts.setdefault(mapping.name, mapping.start)
        for name, start in firsts.items():
            if not name.startswith("/"):
                continue
            base = start if _relocated(Path(name)) else 0
            for address in aligned_accesses(Path(name)):
                place = (base + address) & 0xFFFFFF
                bits[place >> 6] |= np.int64(np.uint64(1 << (place & 63)).astype(np.int64))
        return bits


def _relocated(path: Path) -> bool:
    with path.open("rb") as file:
        return ELFFile(file).header["e_type"] == "ET_DYN"


_UNALIGNED = re.compile(
    r"\s(?:mov(?:[uhl]p[sd]|dqu|[qd]|s[sd]|ddup|nti)|lddqu|\w+s[sd]|u?comis[sd]|cvt\w+"
    r"|pinsr\w|pextr\w|pmov[sz]x\w+|v\w+)\s"
)


def aligned_accesses(path: Path) -> list[int]:
    """Addresses of a file's instructions whose vector operand in memory must be aligned."""
    listing = subprocess.run(
        ["objdump", "-d", "--no-show-raw-insn", str(path)], capture_output=True, text=True,
        check=True,
    )  # fmt: skip
    return [
        int(line.split(":")[0], 16)
        for line in listing.stdout.splitlines()
        if "%xmm" in line and "(" in line and not _UNALIGNED.search(line)
    ]


def take_snapshot(program: Path, directory: Path) -> Snapshot:
    """Start a program in a folder and copy it in front of `main`."""
    with program.open("rb") as file:
        elf = ELFFile(file)
        main = elf.get_section_by_name(".symtab").get_symbol_by_name("main")[0]["st_value"]
    process = subprocess.Popen(
        ["sh", "-c", 'cd -- "$1" && exec "$2"', "sh", str(directory), str(program)],
        env=ENVIRONMENT, preexec_fn=_begin, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
    )  # fmt: skip
    pid = process.pid
    try:
        os.waitpid(pid, 0)
        while os.readlink(f"/proc/{pid}/exe") != str(program):
            _go_on(pid)
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
        raise RuntimeError(f"the program ends before main: status {status:#x}")


def _copy(pid: int, memory: BinaryIO, program: Path, bias: int, main: int) -> Snapshot:
    raw = ctypes.create_string_buffer(27 * 8)
    _ptrace(GETREGS, pid, raw)
    words = struct.unpack("27Q", raw.raw)
    if words[16] != bias + main + 1:
        raise RuntimeError(f"stopped at {words[16]:#x} instead of main")
    registers = dict(zip(GENERAL, words, strict=False))
    registers |= {"rip": bias + main, "eflags": words[18], "rsp": words[19], "fs_base": words[21]}
    area = ctypes.create_string_buffer(512)
    _ptrace(GETFPREGS, pid, area)
    heap = int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[44])
    mappings = tuple(_mappings(pid, memory))
    return Snapshot(
        program=program, registers=registers, bias=bias, mappings=mappings,
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


# The state that the hooks share with us: words in front of the bits of aligned accesses.
LEFT, NEXT_ALIGNED, WRONG, FIRST_BIT = 0, 1, 2, 4
WORDS = FIRST_BIT + (1 << 18)
_stop = uclib.uc_emu_stop


@cfunc(types.void(types.voidptr, types.uint64, types.uint32, types.voidptr))
def _count_down(engine, _address, _size, data):  # type: ignore[no-untyped-def]
    state = carray(data, (WORDS,), np.int64)
    state[LEFT] -= 1
    if state[LEFT] == 0:
        _stop(engine)


@cfunc(types.void(types.voidptr, types.uint64, types.uint32, types.voidptr))
def _count_each(_engine, address, _size, data):  # type: ignore[no-untyped-def]
    counts = carray(data, (1 << 40,), np.int64)
    counts[np.int64(address) - counts[0]] += 1


@cfunc(types.void(types.voidptr, types.uint64, types.uint32, types.voidptr))
def _watch_instruction(engine, address, _size, data):  # type: ignore[no-untyped-def]
    state = carray(data, (WORDS,), np.int64)
    state[LEFT] -= 1
    if address >> np.uint64(47) != 0:
        state[WRONG] = 1
        _stop(engine)
    if state[LEFT] == 0:
        _stop(engine)
    place = np.int64(address) & 0xFFFFFF
    state[NEXT_ALIGNED] = (state[FIRST_BIT + (place >> 6)] >> (place & 63)) & 1


@cfunc(
    types.void(types.voidptr, types.int32, types.uint64, types.int32, types.int64, types.voidptr)
)
def _watch_memory(engine, _kind, address, _size, _value, data):  # type: ignore[no-untyped-def]
    state = carray(data, (WORDS,), np.int64)
    if address >> np.uint64(47) != 0 or (state[NEXT_ALIGNED] != 0 and address & np.uint64(15)):
        state[WRONG] = 1
        _stop(engine)
    state[NEXT_ALIGNED] = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class End:
    """How a run ended: by an exit code, by what a process is killed for, or not at all."""

    exit_code: int | None
    reason: str  # empty if it left by itself
    hangs: bool
    output: bytes
    instructions: int


class Emulation:
    """One run, from `main` on."""

    def __init__(self, snapshot: Snapshot) -> None:
        self.snapshot = snapshot
        self.engine = unicorn.Uc(unicorn.UC_ARCH_X86, unicorn.UC_MODE_64)
        self._output = bytearray()
        self._exit_code: int | None = None
        self._killed = ""
        self._heap = snapshot.heap
        self._lowest = min(m.start for m in snapshot.mappings if m.start >> 44 == 7)
        self._state = np.zeros(WORDS, np.int64)
        self._load()

    def _load(self) -> None:
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

    def _hook(self, kinds: int, function: Any, data: np.ndarray, first: int, last: int) -> Any:
        handle = ctypes.c_size_t()
        status = uclib.uc_hook_add(
            self.engine._uch, ctypes.byref(handle), kinds,
            ctypes.c_void_p(function.address), ctypes.c_void_p(data.ctypes.data),
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

    @property
    def over(self) -> bool:
        """Whether the program has ended."""
        return self._exit_code is not None or bool(self._killed)

    def count_executions(self, first: int, last: int) -> np.ndarray:
        """Run to the end; executions (last - first + 1,) of the instruction at each address."""
        counts = np.zeros(last - first + 2, np.int64)
        counts[0] = first - 1
        self._hook(unicorn.UC_HOOK_CODE, _count_each, counts, first, last)
        self._go()
        return counts[1:]

    def run_to(self, address: int, k: int) -> bool:
        """Run until an instruction is about to execute for the k-th time; False if it never is."""
        self._state[LEFT] = k
        handle = self._hook(unicorn.UC_HOOK_CODE, _count_down, self._state, address, address)
        self._go()
        uclib.uc_hook_del(self.engine._uch, handle)
        if self.over:
            return False
        if self["rip"] != address:
            raise RuntimeError(f"stopped at {self['rip']:#x} instead of {address:#x}")
        return True

    def step(self) -> None:
        """Execute one instruction, a repeated one as often as it repeats."""
        before = self["rip"]
        self._go(1)
        while self["rip"] == before and not self.over:
            self._go(1)

    def finish(self, budget: int) -> End:
        """Run to the end, at most `budget` instructions, with the watch for wrong addresses."""
        self._state[:FIRST_BIT] = budget, 0, 0, 0
        self._state[FIRST_BIT:] = self.snapshot.aligned
        self._hook(unicorn.UC_HOOK_CODE, _watch_instruction, self._state, 1, 0)
        accesses = unicorn.UC_HOOK_MEM_READ | unicorn.UC_HOOK_MEM_WRITE
        self._hook(accesses, _watch_memory, self._state, 1, 0)
        self.engine.ctl_flush_tb()
        if not self.over:
            self._go()
        if self._state[WRONG]:
            self._killed, self._exit_code = "misaligned or impossible address", None
        left = int(self._state[LEFT])
        return End(
            exit_code=self._exit_code, reason=self._killed, hangs=left <= 0 and not self.over,
            output=bytes(self._output), instructions=budget - left,
        )  # fmt: skip

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
