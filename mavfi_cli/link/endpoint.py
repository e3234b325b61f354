"""Endpoint URLs, such as `udpin:127.0.0.1:14540`: parses them, opens sockets, waits on them."""

from __future__ import annotations

import errno
import ipaddress
import math
import re
import select
import socket
import time
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, NoReturn

from mavfi_cli.core.errors import EndpointError, LinkLost

MAX_PEERS = 16  # of one listener
CHUNK = 1 << 16  # bytes that are received at once
SMALL_CHUNK = 2048  # bytes that a client of a listener hands over at once, a datagram at most
_CONNECT_TIMEOUT_S = 5.0

LISTENING = ("udpin", "tcpin")
_LOOPBACK = "127.0.0.1"
_DEFAULT_BAUD = 57_600
_FORMS = {
    "udpin": "udpin:[host]:port",
    "udpout": "udpout:host:port",
    "tcp": "tcp:host:port",
    "tcpin": "tcpin:[host]:port",
    "serial": "serial:device[:baud]",
    "fd": "fd:number",
}
# `udp` listens, as in pymavlink and MAVSDK. `tcpout` is MAVSDK's name for tcp.
_ALIASES = {"udp": "udpin", "tcpout": "tcp"}
_HOST_PORT = re.compile(r"(?:(?P<host>\[[^\]]*\]|[^:\[\]]*):)?(?P<port>[0-9]+)", re.ASCII)


@dataclass(frozen=True, slots=True, kw_only=True)
class Endpoint:
    """A parsed endpoint URL. Fields that its scheme does not use have no meaning."""

    url: str
    scheme: str  # the word before the first colon, one of the known schemes
    host: str = ""
    port: int = 0
    device: str = ""
    baud: int = _DEFAULT_BAUD
    fd: int = -1

    def open_socket(self, *, beyond: bool) -> socket.socket:
        """Open the bound or connected socket of a network URL, `beyond` this machine if allowed.

        Raises:
            EndpointError: As in `open_transport`.
        """
        datagram = self.scheme.startswith("udp")
        kind = socket.SOCK_DGRAM if datagram else socket.SOCK_STREAM
        try:
            found = socket.getaddrinfo(self.host, self.port, type=kind)
        except (OSError, UnicodeError):
            raise EndpointError(self.url, f"no such host {self.host!r}") from None
        found.sort(key=lambda entry: entry[0] != socket.AF_INET)  # IPv4 first
        family, address = found[0][0], str(found[0][4][0])
        if not (beyond or ipaddress.ip_address(address.partition("%")[0]).is_loopback):
            raise EndpointError(
                self.url,
                f"{address} is beyond this machine, where MAVLink signing is required: "
                "give --key-file",
            )
        opened = socket.socket(family, kind)
        try:
            if self.scheme in LISTENING:
                if not datagram:
                    opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                opened.bind((address, self.port))
                if not datagram:
                    opened.listen()
            else:
                opened.settimeout(_CONNECT_TIMEOUT_S)
                opened.connect((address, self.port))
                if not datagram:
                    opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        except OSError as error:
            opened.close()
            raise EndpointError(self.url, self._refusal(error, address)) from None
        return opened

    def _refusal(self, error: OSError, address: str) -> str:
        """Return why a socket cannot be bound or connected."""
        text = error.strerror or str(error)
        if self.scheme not in LISTENING:
            refused = "connection refused, nothing listens there"
            why = refused if error.errno == errno.ECONNREFUSED else text.lower()
            return f"cannot connect: {why}"
        return {
            errno.EADDRINUSE: f"port {self.port} is in use",
            errno.EADDRNOTAVAIL: f"{address} is not an address of this machine",
            errno.EACCES: f"port {self.port} needs privileges",
        }.get(error.errno or 0, text)

    def inherited_socket(self) -> socket.socket:
        """Return the connected stream socket that the parent process left open.

        Raises:
            EndpointError: The descriptor is not one.
        """
        try:
            connection = socket.socket(fileno=self.fd)
        except OSError as error:
            problem = "not a socket" if error.errno == errno.ENOTSOCK else "not an open descriptor"
            raise EndpointError(self.url, problem) from None
        problem = "" if connection.type == socket.SOCK_STREAM else "not a stream socket"
        try:
            connection.getpeername()
        except OSError:
            problem = "not a connected socket"
        if problem:
            connection.detach()
            raise EndpointError(self.url, problem)
        return connection


def parse_endpoint(url: str) -> Endpoint:
    """Parse a URL of the form `scheme:rest` or `scheme://rest`.

    Raises:
        EndpointError: The scheme is unknown (lists the known ones), or the rest does not fit it.
    """
    word, _, rest = url.partition(":")
    rest = rest.removeprefix("//")
    scheme = _ALIASES.get(word, word)
    if scheme not in _FORMS:
        raise EndpointError(url, f"unknown kind of endpoint; known: {', '.join(_FORMS.values())}")
    malformed = EndpointError(url, f"not of the form {_FORMS[scheme]}")

    def number(text: str, largest: int) -> int:
        if not re.fullmatch(r"[0-9]{1,10}", text, re.ASCII):
            raise malformed
        if int(text) > largest:
            raise EndpointError(url, f"{text} is more than {largest}")
        return int(text)

    if scheme == "fd":
        return Endpoint(url=url, scheme=scheme, fd=number(rest, 2**31 - 1))
    if scheme == "serial":
        device, colon, baud = rest.rpartition(":")
        if not colon:
            device, baud = rest, str(_DEFAULT_BAUD)
        if not device:
            raise malformed
        return Endpoint(url=url, scheme=scheme, device=device, baud=number(baud, 12_500_000))
    match = _HOST_PORT.fullmatch(rest)
    host = (match["host"] or "").strip("[]") if match else ""
    if not match or not (host or scheme in LISTENING):
        raise malformed
    port = number(match["port"], 65_535)
    if port == 0 and scheme not in LISTENING:
        raise EndpointError(url, "port 0 cannot be called")
    return Endpoint(url=url, scheme=scheme, host=host or _LOOPBACK, port=port)


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
