"""Waiting for one descriptor, with a time-out in seconds."""

from __future__ import annotations

import math
import select


def wait_for(descriptor: int, events: int, timeout_s: float) -> bool:
    """Whether any of the poll `events` (or an error) came within `timeout_s`; inf waits on."""
    poller = select.poll()
    poller.register(descriptor, events)
    return bool(poller.poll(None if math.isinf(timeout_s) else max(0.0, timeout_s) * 1e3))


def readable(descriptor: int, timeout_s: float) -> bool:
    """Whether there is something to read, or an error to hear of."""
    return wait_for(descriptor, select.POLLIN, timeout_s)


def writable(descriptor: int, timeout_s: float) -> bool:
    """Whether a write would get on."""
    return wait_for(descriptor, select.POLLOUT, timeout_s)
