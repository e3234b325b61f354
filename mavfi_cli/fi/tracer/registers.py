"""Registers of a stopped x86-64 thread: general, flags, x87, MMX, XMM, YMM, ZMM, opmask.

Layouts: `user_regs_struct` of `<sys/user.h>`; FXSAVE and XSAVE areas of Intel SDM volume 1,
sections 10.5 and 13.4. The XSAVE offsets differ between processors, so a few bytes of machine code
read them from CPUID leaf 0xD (section 13.5).
"""

from __future__ import annotations

import ctypes
import functools
import mmap
import re
from collections.abc import Mapping
from dataclasses import dataclass

from mavfi_cli.fi.tracer import linux
from mavfi_cli.fi.tracer.decode import FLAG_BITS

# void f(uint32_t leaf /*edi*/, uint32_t subleaf /*esi*/, uint32_t *out /*rdx*/)
_CODE = bytes.fromhex(
    "53"  # push rbx
    "4989d0"  # mov r8, rdx
    "89f8"  # mov eax, edi
    "89f1"  # mov ecx, esi
    "0fa2"  # cpuid
    "418900"  # mov [r8], eax
    "41895804"  # mov [r8+4], ebx
    "41894808"  # mov [r8+8], ecx
    "4189500c"  # mov [r8+12], edx
    "5b"  # pop rbx
    "c3"  # ret
)


def _cpuid(leaf: int, subleaf: int) -> tuple[int, int, int, int]:
    """Return the values of EAX, EBX, ECX and EDX after CPUID with this leaf and subleaf."""
    page = mmap.mmap(-1, 4096, prot=mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC)
    page.write(_CODE)
    start = ctypes.addressof(ctypes.c_char.from_buffer(page))
    out = (ctypes.c_uint32 * 4)()
    ctypes.CFUNCTYPE(None, ctypes.c_uint32, ctypes.c_uint32, ctypes.c_void_p)(start)(
        leaf, subleaf, ctypes.addressof(out)
    )
    return out[0], out[1], out[2], out[3]


@functools.lru_cache(maxsize=1)
def _xsave_offsets() -> dict[int, int]:
    """Return the byte offset of each XSAVE component that the processor has, keyed by its number.

    The offsets are those of the standard format. Components 0 and 1 are left out.
    """
    low, _, _, high = _cpuid(0xD, 0)
    enabled = low | high << 32
    return {n: _cpuid(0xD, n)[1] for n in range(2, 63) if enabled >> n & 1}


NT_PRSTATUS, NT_X86_XSTATE = 1, 0x202
XSTATE_BV = 512
X87, SSE, AVX, OPMASK, ZMM_HIGH, ZMM_UPPER = 0, 1, 2, 5, 6, 7

_USER_REGS = (
    "r15 r14 r13 r12 rbp rbx r11 r10 r9 r8 rax rcx rdx rsi rdi orig_rax rip cs rflags rsp ss "
    "fs_base gs_base ds es fs gs"
)
_SLOT = {name: index for index, name in enumerate(_USER_REGS.split())}
_VECTOR = re.compile(r"(xmm|ymm|zmm)(\d+)$")
_X87 = re.compile(r"(st|mm|k)(\d)$")
FLAGS = sum(1 << bit for bit in FLAG_BITS.values())  # flags that instructions read and write
TRAP_FLAG, _RESUME_FLAG = 1 << 8, 1 << 16
VECTOR_BITS = 512  # width of the widest vector register
CALL_ARGUMENTS = ("rdi", "rsi", "rdx", "r10", "r8", "r9")  # of a system call


@functools.lru_cache(maxsize=1)
def widest_vector() -> str:
    """Return the prefix of this processor's widest vector registers: zmm, ymm or xmm."""
    offsets = _xsave_offsets()
    return "zmm" if ZMM_HIGH in offsets else "ymm" if AVX in offsets else "xmm"


@dataclass(frozen=True, slots=True)
class _Span:
    """Bytes of the XSAVE area that hold part of a register, and the number of their component."""

    component: int
    offset: int
    size: int


def width_of(name: str) -> int:
    """Return the width of a full register in bits.

    Raises:
        KeyError: the register does not exist.
    """
    if name in _SLOT:
        return 64
    if match := _VECTOR.match(name):
        return {"xmm": 128, "ymm": 256, "zmm": 512}[match[1]]
    if match := _X87.match(name):
        return 80 if match[1] == "st" else 64
    raise KeyError(name)


def _vector_spans(kind: str, index: int) -> list[_Span]:
    """Return the spans of the XSAVE area that hold a vector register.

    Parts that this processor lacks are left out.
    """
    parts = {"xmm": 1, "ymm": 2, "zmm": 3}[kind]
    offsets = _xsave_offsets()
    if index >= 16:
        base = offsets[ZMM_UPPER] + 64 * index - 1024
        return [_Span(ZMM_UPPER, base, {"xmm": 16, "ymm": 32, "zmm": 64}[kind])]
    spans = [_Span(SSE, 160 + 16 * index, 16)]
    if parts > 1 and AVX in offsets:
        spans.append(_Span(AVX, offsets[AVX] + 16 * index, 16))
    if parts > 2 and ZMM_HIGH in offsets:
        spans.append(_Span(ZMM_HIGH, offsets[ZMM_HIGH] + 32 * index, 32))
    return spans


class Registers:
    """All registers of one stopped thread. They are read on first use and written at once."""

    __slots__ = ("_extended", "_general", "tid")

    def __init__(self, tid: int) -> None:
        self.tid = tid
        self._general: list[int] | None = None
        self._extended: bytes | None = None

    def forget(self) -> None:
        """Drop the cached values, which are out of date once the thread has run."""
        self._general = None
        self._extended = None

    def general(self) -> list[int]:
        """Return the general registers: `user_regs_struct`, as 27 integers."""
        if self._general is None:
            buffer = ctypes.create_string_buffer(216)
            linux.get_registers(self.tid, NT_PRSTATUS, buffer)
            words = (ctypes.c_uint64 * 27).from_buffer(buffer)
            self._general = list(words)
        return self._general

    def extended(self) -> bytes:
        """Return the thread's XSAVE area in the standard format."""
        if self._extended is None:
            buffer = ctypes.create_string_buffer(16384)
            size = linux.get_registers(self.tid, NT_X86_XSTATE, buffer)
            self._extended = buffer.raw[:size]
        return self._extended

    def read(self, name: str) -> int:
        """Return the value of a full register.

        Raises:
            KeyError: this processor has no such register.
        """
        if name in _SLOT:
            return self.general()[_SLOT[name]]
        area = self.extended()
        parts = [area[span.offset : span.offset + span.size] for span in self._spans(name)]
        return int.from_bytes(b"".join(parts), "little")

    def write(self, name: str, value: int) -> None:
        """Write a full register. Read it back to see which value the kernel stored.

        Raises:
            OSError: the kernel refuses the value.
        """
        if name in _SLOT:
            self.write_together({name: value})
            return
        area = bytearray(self.extended())
        data = value.to_bytes(width_of(name) // 8, "little")
        present = int.from_bytes(area[XSTATE_BV : XSTATE_BV + 8], "little")
        for span in self._spans(name):
            area[span.offset : span.offset + span.size] = data[: span.size]
            data = data[span.size :]
            # A component in its initial state is ignored by the kernel unless its bit is set.
            present |= 1 << span.component
        area[XSTATE_BV : XSTATE_BV + 8] = present.to_bytes(8, "little")
        self.forget()
        linux.set_registers(self.tid, NT_X86_XSTATE, bytes(area))

    def write_together(self, values: Mapping[str, int]) -> None:
        """Write several general registers at once, given their values by register name.

        Raises:
            OSError: the kernel refuses a value.
        """
        words = list(self.general())
        for name, value in values.items():
            words[_SLOT[name]] = value
        self.write_general(words)

    def write_general(self, words: list[int]) -> None:
        """Write the general registers: `user_regs_struct`, as 27 integers."""
        data = bytes((ctypes.c_uint64 * 27)(*words))
        self.forget()
        linux.set_registers(self.tid, NT_PRSTATUS, data)

    def _spans(self, name: str) -> list[_Span]:
        if match := _VECTOR.match(name):
            return _vector_spans(match[1], int(match[2]))
        match = _X87.match(name)
        if match is None:
            raise KeyError(name)
        index = int(match[2])
        if match[1] == "st":  # FXSAVE stores the stack top-relative
            return [_Span(X87, 32 + 16 * index, 10)]
        if match[1] == "mm":  # MMX names physical registers
            top = self.extended()[3] >> 3 & 7
            return [_Span(X87, 32 + 16 * ((index - top) & 7), 8)]
        return [_Span(OPMASK, _xsave_offsets()[OPMASK] + 8 * index, 8)]

    def rearm(self) -> None:
        """Clear the resume flag, so that a breakpoint on the next instruction takes effect.

        A stop at an instruction breakpoint leaves this flag set, and the flag suppresses the
        breakpoint for the next instruction (Intel SDM volume 3, section 18.3.1.1).
        """
        flags = self.read("rflags")
        if flags & _RESUME_FLAG:
            self.write("rflags", flags & ~_RESUME_FLAG)

    @property
    def ip(self) -> int:
        """The instruction pointer."""
        return self.read("rip")

    @property
    def sp(self) -> int:
        """The stack pointer."""
        return self.read("rsp")

    @property
    def system_call(self) -> int | None:
        """Number of the system call that this stop interrupted, or None outside a system call."""
        number = self.read("orig_rax")
        return None if number >> 63 else number
