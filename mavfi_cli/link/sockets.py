"""What transports over a descriptor share: opening, waiting and closing it."""

from __future__ import annotations

import errno
import ipaddress
import math
import select
import socket
import time
from abc import ABC, abstractmethod
from typing import Any, NoReturn

from mavfi_cli.core.errors import EndpointError, LinkLost
from mavfi_cli.link.endpoint import LISTENING, Endpoint

MAX_PEERS = 16  # of one listener
CHUNK = 1 << 16  # bytes that are received at once
SMALL_CHUNK = 2048  # bytes that a client of a listener hands over at once, a datagram at most
_CONNECT_TIMEOUT_S = 5.0


def open_socket(endpoint: Endpoint, *, beyond: bool) -> socket.socket:
    """Open the bound or connected socket of a network URL, `beyond` this machine if allowed.

    Raises:
        EndpointError: As in `open_transport`.
    """
    datagram = endpoint.scheme.startswith("udp")
    kind = socket.SOCK_DGRAM if datagram else socket.SOCK_STREAM
    try:
        found = socket.getaddrinfo(endpoint.host, endpoint.port, type=kind)
    except (OSError, UnicodeError):
        raise EndpointError(endpoint.url, f"no such host {endpoint.host!r}") from None
    found.sort(key=lambda entry: entry[0] != socket.AF_INET)  # IPv4 first
    family, address = found[0][0], str(found[0][4][0])
    if not (beyond or ipaddress.ip_address(address.partition("%")[0]).is_loopback):
        raise EndpointError(
            endpoint.url,
            f"{address} is beyond this machine, where MAVLink signing is required: give --key-file",
        )
    opened = socket.socket(family, kind)
    try:
        if endpoint.scheme in LISTENING:
            if not datagram:
                opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            opened.bind((address, endpoint.port))
            if not datagram:
                opened.listen()
        else:
            opened.settimeout(_CONNECT_TIMEOUT_S)
            opened.connect((address, endpoint.port))
            if not datagram:
                opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    except OSError as error:
        opened.close()
        raise EndpointError(endpoint.url, _refusal(error, endpoint, address)) from None
    return opened


def _refusal(error: OSError, endpoint: Endpoint, address: str) -> str:
    """Return why a socket cannot be bound or connected."""
    text = error.strerror or str(error)
    if endpoint.scheme not in LISTENING:
        refused = "connection refused, nothing listens there"
        return f"cannot connect: {refused if error.errno == errno.ECONNREFUSED else text.lower()}"
    return {
        errno.EADDRINUSE: f"port {endpoint.port} is in use",
        errno.EADDRNOTAVAIL: f"{address} is not an address of this machine",
        errno.EACCES: f"port {endpoint.port} needs privileges",
    }.get(error.errno or 0, text)


def inherited_socket(endpoint: Endpoint) -> socket.socket:
    """Return the connected stream socket that the parent process left open.

    Raises:
        EndpointError: The descriptor is not one.
    """
    try:
        connection = socket.socket(fileno=endpoint.fd)
    except OSError as error:
        problem = "not a socket" if error.errno == errno.ENOTSOCK else "not an open descriptor"
        raise EndpointError(endpoint.url, problem) from None
    problem = "" if connection.type == socket.SOCK_STREAM else "not a stream socket"
    try:
        connection.getpeername()
    except OSError:
        problem = "not a connected socket"
    if problem:
        connection.detach()
        raise EndpointError(endpoint.url, problem)
    return connection


def text_of(address: Any) -> str:
    """Return host and port of a socket's address; "" for None."""
    return "" if address is None else f"{address[0]}:{address[1]}"


class Receiver(ABC):
    """An end that waits on its descriptor while nothing can be pulled."""

    url: str
    datagram = False
    address = ""

    @property
    def rival_address(self) -> str:
        """See `Transport`."""
        return ""

    def receive(self, timeout_s: float) -> bytes:
        """See `Transport`."""
        data = self._pull()
        if data or timeout_s <= 0.0:
            return data
        deadline_s = time.monotonic() + timeout_s
        while not data and (left_s := deadline_s - time.monotonic()) > 0.0:
            if not self._await(select.POLLIN, left_s):
                break
            data = self._pull()
        return data

    @abstractmethod
    def fileno(self) -> int:
        """See `Transport`."""

    @abstractmethod
    def _pull(self) -> bytes:
        """Return waiting bytes, or b"" if there are none. Raises LinkLost."""

    def _await(self, event: int, timeout_s: float) -> bool:
        """Return True if a poll event or an error occurs within `timeout_s`; inf: without end."""
        poller = select.poll()
        poller.register(self.fileno(), event)
        return bool(poller.poll(None if math.isinf(timeout_s) else timeout_s * 1e3))

    def _lost(self, why: object) -> NoReturn:
        raise LinkLost(f"{self.url}: {why}") from None


class SocketOwner:
    """Owner of a socket that never blocks."""

    def __init__(self, opened: socket.socket, url: str) -> None:
        opened.settimeout(0.0)
        self._socket = opened
        self.url = url

    @property
    def port(self) -> int:
        """Local port. The system chooses it if the URL says 0."""
        return int(self._socket.getsockname()[1])

    def fileno(self) -> int:
        """See `Transport`."""
        return self._socket.fileno()

    def close(self) -> None:
        """See `Transport`."""
        self._socket.close()
