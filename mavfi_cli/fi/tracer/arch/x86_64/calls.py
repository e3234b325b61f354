"""System calls of Linux on x86-64: what one asks for, as far as an attack cares, and making one."""

from __future__ import annotations

from mavfi_cli.fi.tracer import linux
from mavfi_cli.fi.tracer.arch.interface import Asked
from mavfi_cli.fi.tracer.arch.x86_64.registers import Registers

_ARGUMENTS = ("rdi", "rsi", "rdx", "r10", "r8", "r9")
_HERE = -100  # AT_FDCWD
_NO_MEMORY = -12  # ENOMEM
_WRITING = 0o3 | 0o100 | 0o1000  # access mode, O_CREAT, O_TRUNC
_TERMINAL_IOCTLS = frozenset((0x5401, 0x5402, 0x5403, 0x5404, 0x5413))  # TCGETS ... TIOCGWINSZ
_IOCTL, _MAPS = 16, (9, 25)  # mmap, mremap
_NAMES = {56: "clone", 57: "fork", 58: "vfork", 59: "execve", 322: "execveat", 435: "clone3"}

# Number: arguments with the folder's descriptor (-1: none), the path, and the flags of an opening.
_PATHS = {
    2: (-1, 0, 1), 257: (0, 1, 2),  # open, openat
    437: (0, 1, -1), 85: (-1, 0, -1), 76: (-1, 0, -1),  # openat2, creat, truncate
    82: (-1, 1, -1), 264: (2, 3, -1), 316: (2, 3, -1),  # rename, renameat, renameat2
    87: (-1, 0, -1), 263: (0, 1, -1), 84: (-1, 0, -1),  # unlink, unlinkat, rmdir
    83: (-1, 0, -1), 258: (0, 1, -1), 133: (-1, 0, -1),  # mkdir, mkdirat, mknod
    86: (-1, 1, -1), 265: (2, 3, -1), 88: (-1, 1, -1), 266: (1, 2, -1),  # links
}  # fmt: skip


def asked(registers: Registers, memory: linux.Memory) -> Asked:
    """What a system call asks for; the thread is stopped at its entry."""
    number = registers.system_call
    if number == _IOCTL:
        fd, request = (registers.read(name) for name in _ARGUMENTS[:2])
        return Asked(terminal=fd <= 2 and request & 0xFFFF_FFFF in _TERMINAL_IOCTLS)
    if number not in _PATHS:
        return Asked()
    folder, path, flags = _PATHS[number]
    writes = flags < 0 or bool(registers.read(_ARGUMENTS[flags]) & _WRITING)
    name = _text(memory, registers.read(_ARGUMENTS[path]))
    from_folder = _HERE if folder < 0 else _signed(registers.read(_ARGUMENTS[folder]), 32)
    return Asked(
        path=name,
        folder=None if from_folder == _HERE else from_folder,
        writes=writes,
        terminal=name == "/dev/tty",
    )


def lacks_memory(registers: Registers) -> bool:
    """True if the system call at whose end the thread is stopped was refused memory."""
    return registers.system_call in _MAPS and _signed(registers.read("rax"), 64) == _NO_MEMORY


def call_name(registers: Registers) -> str:
    """Name of the system call in which the thread is stopped, where it starts something."""
    return _NAMES.get(registers.system_call or 0, "a system call")


def prepare_system_call(registers: Registers, number: int, *arguments: int) -> None:
    """Set the registers for a system call instruction at the instruction pointer."""
    names = ("rax", *_ARGUMENTS[: len(arguments)])
    registers.write_together(dict(zip(names, (number, *arguments), strict=True)))


def _signed(value: int, bits: int) -> int:
    value &= (1 << bits) - 1
    return value - (value >> bits - 1 << bits)


def _text(memory: linux.Memory, address: int) -> str:
    """The text at an address; empty if there is none."""
    try:
        data = memory.read(address, 4096 - address % 4096)
        if b"\0" not in data:
            data += memory.read(address + len(data), 4096)
    except (OSError, OverflowError):
        return ""
    return data.partition(b"\0")[0].decode(errors="replace")
