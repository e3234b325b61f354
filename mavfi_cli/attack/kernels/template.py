"""A warm process with one kernel and its inputs loaded, which forks itself for every run.

The first message holds the kernel's name and its inputs; the reply holds the number of inputs and
`newest_cache_ns`. Later requests are bytes on the same socket. The reply to `ASK_SCOPE` is the
kernel's scope. On `RUN`, followed by the number of an input, this process forks a child. The child
sends its process id (4 bytes), waits for `GO`, calls the kernel once, writes the output to standard
output, which is a file, and ends. The next request must not come before the child has ended. The
file holds the CPU time and the duration of the call (two float64, s), then the packed output, or
the text of the error if the exit code is `RAISED`.

Every run starts from the same memory: garbage collection is off, and this process keeps no state
between forks.
"""

from __future__ import annotations

import gc
import os
import resource
import signal
import socket
import struct
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NoReturn

from mavfi_cli.attack.kernels import catalogue
from mavfi_cli.attack.kernels.catalogue import Call, pack
from mavfi_cli.attack.kernels.inputs import inputs_of_bytes
from mavfi_cli.attack.served import CHANNEL, newest_cache_ns
from mavfi_cli.core.processes import fork, receive, send

RAISED = 3  # exit code of a child whose kernel raised an error
TIMES = struct.Struct("<dd")
PID_BYTES = 4
RUN, GO, ASK_SCOPE = b"r", b"g", b"s"
OUTPUT = 1
_LARGEST_FILE = 1 << 28


def main() -> None:
    """Load and warm up the kernel, then serve requests until the other end closes."""
    connection = socket.socket(fileno=CHANNEL)
    name, inputs = receive(connection)
    kernel = catalogue.find(name)
    calls = [kernel.prepare(part) for part in inputs_of_bytes(inputs)]
    for call in calls * (2 if kernel.repeatable else 0):
        pack(call())
    _limit(kernel.memory_mb)
    send(connection, (len(calls), newest_cache_ns()))
    sys.dont_write_bytecode = True  # the second run must not load what the first compiled
    gc.collect()
    gc.freeze()
    gc.disable()
    while request := connection.recv(1):
        if request == ASK_SCOPE:
            status = _in_child(lambda: _send_scope(connection, kernel, calls[0]))
            if os.WIFSIGNALED(status):
                _give_up(f"fails without a fault: signal {os.WTERMSIG(status)}")
            elif status:
                os._exit(1)
        elif request == RUN:  # not the GO of a child that was killed before reading it
            call = calls[connection.recv(1)[0]]
            _in_child(partial(_run, connection, call))


def _give_up(why: str) -> NoReturn:
    """Print the reason and exit, without the libraries' own final messages, which would hide it."""
    os.write(2, f"{why}\n".encode())
    os._exit(1)


def _in_child(work: Callable[[], int]) -> int:
    """Call `work` in a fork of this process, wait for the fork, and return its wait status."""
    return os.waitpid(fork(work, exact=True), 0)[1]


def _limit(extra_mb: int) -> None:
    """Ignore SIGINT and SIGTERM, and limit the size of memory and files.

    The limits, such as `extra_mb` of additional memory, matter if a fault corrupts a size.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + (extra_mb << 20)
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_FSIZE, (_LARGEST_FILE, _LARGEST_FILE))


def _send_scope(connection: socket.socket, kernel: catalogue.Kernel, call: Call) -> int:
    """Send the kernel's scope, and return 0.

    This runs in a child process, because finding the scope alters memory.
    """
    try:
        call()
        send(connection, kernel.scope())
    except Exception as error:  # the user's kernel may raise anything
        _give_up(f"fails without a fault: {_describe(error)}")
    return 0


def _describe(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"


def _run(connection: socket.socket, call: Call) -> int:
    """Wait for `GO`, call the kernel once, write its output, and return the exit code."""
    connection.send(os.getpid().to_bytes(PID_BYTES, "little"))
    if not connection.recv(1):
        return 0
    cpu_s, wall_s, code = time.process_time(), time.perf_counter(), 0
    try:
        output = call()
        times = TIMES.pack(time.process_time() - cpu_s, time.perf_counter() - wall_s)
        data = pack(output)
    except Exception as error:  # any error of the corrupted kernel is a result
        times = TIMES.pack(time.process_time() - cpu_s, time.perf_counter() - wall_s)
        data, code = _describe(error).encode(), RAISED
    os.pwrite(OUTPUT, times + data, 0)
    return code


if __name__ == "__main__":
    main()
