"""A vehicle on the ground, and a firmware's end of a stream socket."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import numpy as np
import pytest

from mavfi_cli.link.transport import Transport, open_transport
from sitl.vehicle.truth import T_QUATERNION, TRUTH_SIZE, Truth


@pytest.fixture
def resting() -> Truth:
    flat = np.zeros(TRUTH_SIZE)
    flat[T_QUATERNION] = 1.0
    return Truth(flat)


@pytest.fixture
def wire() -> Iterator[tuple[Transport, socket.socket]]:
    """The simulation's end of a connection as a transport, and the firmware's as a socket."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
    theirs.settimeout(0.0)
    transport = open_transport(f"fd:{ours.detach()}")
    with theirs:
        yield transport, theirs
    transport.close()
