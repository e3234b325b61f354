"""Run a command where perf_event_open is refused, as many containers refuse it.

    python tests/without_perf.py COMMAND [ARGUMENT ...]

A seccomp filter (seccomp(2)) that the command and its children inherit.
"""

import ctypes
import os
import struct
import sys

PR_SET_NO_NEW_PRIVS, PR_SET_SECCOMP, SECCOMP_MODE_FILTER = 38, 22, 2
LOAD_WORD, JUMP_IF_EQUAL, RETURN = 0x20, 0x15, 0x06  # BPF
ALLOW, REFUSE = 0x7FFF_0000, 0x0005_0000 | 13  # EACCES
PERF_EVENT_OPEN = 298  # x86-64


def refuse(system_call):
    """From now on this process gets EACCES from one system call."""
    steps = [(LOAD_WORD, 0, 0, 0), (JUMP_IF_EQUAL, 0, 1, system_call), (RETURN, 0, 0, REFUSE),
             (RETURN, 0, 0, ALLOW)]  # fmt: skip
    code = ctypes.create_string_buffer(b"".join(struct.pack("<HBBI", *step) for step in steps))
    program = struct.pack("<H6xQ", len(steps), ctypes.addressof(code))
    libc = ctypes.CDLL(None, use_errno=True)
    for arguments in (
        (PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0),
        (PR_SET_SECCOMP, SECCOMP_MODE_FILTER, program, 0, 0),
    ):
        if libc.prctl(*arguments):
            raise OSError(ctypes.get_errno(), "prctl")


if __name__ == "__main__":
    refuse(PERF_EVENT_OPEN)
    os.execv(sys.argv[1], sys.argv[1:])
