"""Waits for one descriptor with a time-out in seconds."""

from __future__ import annotations

import math
import select


def wait_for(descriptor: int, events: int, timeout_s: float) -> bool:
    """Return True if a poll event or an error occurs within `timeout_s`; inf never times out."""
    poller = select.poll()
    poller.register(descriptor, events)
    return bool(poller.poll(None if math.isinf(timeout_s) else max(0.0, timeout_s) * 1e3))


def readable(descriptor: int, timeout_s: float) -> bool:
    """Return True if there are bytes or an error to read within `timeout_s`."""
    return wait_for(descriptor, select.POLLIN, timeout_s)


def writable(descriptor: int, timeout_s: float) -> bool:
    """Return True if a write can make progress within `timeout_s`."""
    return wait_for(descriptor, select.POLLOUT, timeout_s)
