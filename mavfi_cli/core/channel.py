"""Sends values as pickles over a socket between two of our own processes."""

from __future__ import annotations

import pickle
import socket
from typing import Any

_LENGTH = 8


def send(connection: socket.socket, value: Any) -> None:
    """Send one value."""
    data = pickle.dumps(value, protocol=pickle.HIGHEST_PROTOCOL)
    connection.sendall(len(data).to_bytes(_LENGTH, "little") + data)


def receive(connection: socket.socket) -> Any:
    """Receive one value.

    Raises:
        EOFError: The other end has closed.
    """
    size = int.from_bytes(_exactly(connection, _LENGTH), "little")
    return pickle.loads(_exactly(connection, size))


def _exactly(connection: socket.socket, size: int) -> bytearray:
    """Receive into a single buffer, so that a node's memory is the same in every run."""
    data = bytearray(size)
    view, filled = memoryview(data), 0
    while filled < size:
        count = connection.recv_into(view[filled:])
        if not count:
            raise EOFError
        filled += count
    view.release()
    return data
