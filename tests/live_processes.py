"""Find processes, and await their end though they may be no children of ours."""

import contextlib
import os
import select
from pathlib import Path

LONG_S = 60.0


def children(pid):
    """Process ids of the direct children."""
    listed = Path(f"/proc/{pid}/task/{pid}/children").read_text()
    return [int(child) for child in listed.split()]


def family(pid):
    """A process and all of its descendants."""
    found = [pid]
    for number in found:
        with contextlib.suppress(OSError):
            for own in Path(f"/proc/{number}/task").glob("*/children"):
                found += map(int, own.read_text().split())
    return found


def await_end(descriptor):
    """Wait for the end of a process by its pidfd."""
    poller = select.poll()
    poller.register(descriptor, select.POLLIN)
    assert poller.poll(LONG_S * 1e3), "the process did not end"


def gone(pid):
    """Whether a process is over, once it is; fails if it goes on."""
    try:
        descriptor = os.pidfd_open(int(pid))
    except ProcessLookupError:
        return True
    try:
        await_end(descriptor)
    finally:
        os.close(descriptor)
    return True


def none_left(find):
    """Whether a function finds no process, once those that it finds are over; fails if one goes on.

    Args:
        find: gives lists of process ids by kind.
    """
    while found := find():
        assert all(gone(pid) for pids in found.values() for pid in pids)
    return True
