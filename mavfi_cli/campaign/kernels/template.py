"""A warm process with one kernel loaded and fed, that forks itself for every run.

    python -m mavfi_cli.campaign.kernels.template KERNEL INPUTS CONTROL OUTPUT

Protocol on the CONTROL socket: first comes one byte, when all is loaded. `ASK_SCOPE` is answered
by the kernel's scope, as a pickle with its length (8 bytes, little endian) before it. For every
`RUN` a child is forked; it sends its process id (4 bytes), waits for a byte, calls the kernel once,
writes OUTPUT and ends. The next request must not come before the child has ended. OUTPUT holds CPU
seconds and duration of the call (two float64), then the packed output, or the error's text where
the exit code is `RAISED`.

Every run starts from the same memory: no address randomisation, no garbage collection, and
nothing is kept here from one fork to the next.
"""

from __future__ import annotations

import gc
import os
import pickle
import resource
import signal
import struct
import sys
import time
from collections.abc import Callable
from pathlib import Path

from mavfi_cli.campaign.kernels import catalogue
from mavfi_cli.campaign.kernels.catalogue import Call
from mavfi_cli.campaign.kernels.difference import pack
from mavfi_cli.campaign.kernels.inputs import load_inputs

RAISED = 3  # exit code of a child whose kernel raised an error
TIMES = struct.Struct("<dd")
PID_BYTES, LENGTH_BYTES = 4, 8
RUN, ASK_SCOPE = b"r", b"s"
_EXTRA_MEMORY = 2 << 30  # a corrupted size must not take the machine down
_LARGEST_FILE = 1 << 28


def main(arguments: list[str]) -> None:
    """Get warm, then fork until the other end closes."""
    name, inputs_path, control, output = arguments
    serve(catalogue.find(name), Path(inputs_path), int(control), int(output))


def serve(kernel: catalogue.Kernel, inputs_path: Path, control: int, output: int) -> None:
    """The template's whole life."""
    call = kernel.prepare(load_inputs(inputs_path)[0])
    for _ in range(2 if kernel.repeatable else 0):
        pack(call())
    _limit()
    gc.collect()
    gc.freeze()
    gc.disable()
    os.write(control, RUN)
    while request := os.read(control, 1):
        if request == ASK_SCOPE:
            _in_child(lambda: _tell_scope(kernel, call, control))
        else:
            _in_child(lambda: _run(call, control, output))


def _in_child(work: Callable[[], int]) -> None:
    """Do work in a fork of this process, and wait for its end."""
    child = os.fork()
    if child:
        os.waitpid(child, 0)
        return
    code = 1
    try:
        code = work()
    finally:
        os._exit(code)


def _limit() -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + _EXTRA_MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_FSIZE, (_LARGEST_FILE, _LARGEST_FILE))


def _tell_scope(kernel: catalogue.Kernel, call: Call, control: int) -> int:
    """Look up where the kernel's code is; in a child, as that leaves much in the memory."""
    call()
    data = pickle.dumps(kernel.scope())
    data = len(data).to_bytes(LENGTH_BYTES, "little") + data
    while data:
        data = data[os.write(control, data) :]
    return 0


def _run(call: Call, control: int, output: int) -> int:
    """One run of the kernel; the exit code."""
    os.write(control, os.getpid().to_bytes(PID_BYTES, "little"))
    if not os.read(control, 1):
        return 0
    cpu_s, wall_s, code = time.process_time(), time.perf_counter(), 0
    try:
        data = pack(call())
    except Exception as error:  # whatever the corrupted kernel raises is a result
        data, code = f"{type(error).__name__}: {error}".encode(), RAISED
    times = TIMES.pack(time.process_time() - cpu_s, time.perf_counter() - wall_s)
    os.pwrite(output, times + data, 0)
    return code


if __name__ == "__main__":
    main(sys.argv[1:])
