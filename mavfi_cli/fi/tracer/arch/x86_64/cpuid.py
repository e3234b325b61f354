"""CPUID of this machine, through a few bytes of machine code in an executable page.

The layout of the extended state differs between processors. Leaf 0xD gives size and offset of each
XSAVE component: Intel SDM volume 1, section 13.5.
"""

from __future__ import annotations

import ctypes
import functools
import mmap
from dataclasses import dataclass

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


@dataclass(frozen=True, slots=True)
class Component:
    """Offset and size of one XSAVE component in the standard (not compacted) format, bytes."""

    offset: int
    size: int


def cpuid(leaf: int, subleaf: int) -> tuple[int, int, int, int]:
    """EAX, EBX, ECX, EDX of one CPUID leaf.

    Raises:
        OSError: the system forbids executable pages.
    """
    page = mmap.mmap(-1, 4096, prot=mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC)
    page.write(_CODE)
    start = ctypes.addressof(ctypes.c_char.from_buffer(page))
    out = (ctypes.c_uint32 * 4)()
    ctypes.CFUNCTYPE(None, ctypes.c_uint32, ctypes.c_uint32, ctypes.c_void_p)(start)(
        leaf, subleaf, ctypes.addressof(out)
    )
    return out[0], out[1], out[2], out[3]


@functools.lru_cache(maxsize=1)
def xsave_components() -> dict[int, Component]:
    """The user components from 2 on (AVX 2, opmask 5, ZMM_Hi256 6, Hi16_ZMM 7, PKRU 9)."""
    low, _, _, high = cpuid(0xD, 0)
    enabled = low | high << 32
    found: dict[int, Component] = {}
    for number in range(2, 63):
        if enabled >> number & 1:
            size, offset, _, _ = cpuid(0xD, number)
            found[number] = Component(offset, size)
    return found
