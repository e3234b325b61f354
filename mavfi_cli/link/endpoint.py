"""Parses endpoint URLs, checks which of them need signing, and waits for descriptors."""

from __future__ import annotations

import errno
import ipaddress
import math
import re
import select
import socket
from dataclasses import dataclass
from enum import Enum

from mavfi_cli.core.errors import EndpointError

LOOPBACK = "127.0.0.1"
DEFAULT_BAUD = 57_600


class UrlScheme(Enum):
    """Scheme of an endpoint URL: the word before the first colon."""

    UDP_IN = "udpin"
    UDP_OUT = "udpout"
    TCP = "tcp"
    TCP_IN = "tcpin"
    SERIAL = "serial"
    FD = "fd"


_FORMS = {
    UrlScheme.UDP_IN: "udpin:[host]:port",
    UrlScheme.UDP_OUT: "udpout:host:port",
    UrlScheme.TCP: "tcp:host:port",
    UrlScheme.TCP_IN: "tcpin:[host]:port",
    UrlScheme.SERIAL: "serial:device[:baud]",
    UrlScheme.FD: "fd:number",
}
# `udp` listens, as in pymavlink and MAVSDK. `tcpout` is MAVSDK's name for tcp.
_ALIASES = {"udp": UrlScheme.UDP_IN, "tcpout": UrlScheme.TCP}
_LISTENING = (UrlScheme.UDP_IN, UrlScheme.TCP_IN)
_HOST_PORT = re.compile(r"(?:(?P<host>\[[^\]]*\]|[^:\[\]]*):)?(?P<port>[0-9]+)", re.ASCII)


@dataclass(frozen=True, slots=True, kw_only=True)
class Endpoint:
    """A parsed endpoint URL. Fields that its scheme does not use have no meaning."""

    url: str
    scheme: UrlScheme
    host: str = ""
    port: int = 0
    device: str = ""
    baud: int = DEFAULT_BAUD
    fd: int = -1


def parse_endpoint(url: str) -> Endpoint:
    """Parse a URL of the form `scheme:rest` or `scheme://rest`.

    Raises:
        EndpointError: The scheme is unknown (lists the known ones), or the rest does not fit it.
    """
    word, _, rest = url.partition(":")
    rest = rest.removeprefix("//")
    scheme = _ALIASES.get(word) or next((s for s in UrlScheme if s.value == word), None)
    if scheme is None:
        raise EndpointError(url, f"unknown kind of endpoint; known: {', '.join(_FORMS.values())}")
    if scheme is UrlScheme.FD:
        return Endpoint(url=url, scheme=scheme, fd=_number(url, scheme, rest, 2**31 - 1))
    if scheme is UrlScheme.SERIAL:
        return _serial(url, rest)
    match = _HOST_PORT.fullmatch(rest)
    host = (match["host"] or "").strip("[]") if match else ""
    if not match or not (host or scheme in _LISTENING):
        raise EndpointError(url, f"not of the form {_FORMS[scheme]}")
    port = _number(url, scheme, match["port"], 65_535)
    if port == 0 and scheme not in _LISTENING:
        raise EndpointError(url, "port 0 cannot be called")
    return Endpoint(url=url, scheme=scheme, host=host or LOOPBACK, port=port)


def _number(url: str, scheme: UrlScheme, text: str, largest: int) -> int:
    if not re.fullmatch(r"[0-9]{1,10}", text, re.ASCII):
        raise EndpointError(url, f"not of the form {_FORMS[scheme]}")
    if int(text) > largest:
        raise EndpointError(url, f"{text} is more than {largest}")
    return int(text)


def _serial(url: str, rest: str) -> Endpoint:
    device, colon, baud = rest.rpartition(":")
    if not colon:
        device, baud = rest, str(DEFAULT_BAUD)
    if not device:
        raise EndpointError(url, f"not of the form {_FORMS[UrlScheme.SERIAL]}")
    number = _number(url, UrlScheme.SERIAL, baud, 12_500_000)
    return Endpoint(url=url, scheme=UrlScheme.SERIAL, device=device, baud=number)


def resolve(endpoint: Endpoint, kind: socket.SocketKind) -> tuple[socket.AddressFamily, str]:
    """Resolve the endpoint's host to address family and numeric address, IPv4 first.

    Raises:
        EndpointError: The host does not exist.
    """
    try:
        found = socket.getaddrinfo(endpoint.host, endpoint.port, type=kind)
    except (OSError, UnicodeError):
        raise EndpointError(endpoint.url, f"no such host {endpoint.host!r}") from None
    found.sort(key=lambda entry: entry[0] != socket.AF_INET)
    family, _, _, _, address = found[0]
    return family, str(address[0])


def check_reach(endpoint: Endpoint, address: str, *, signed: bool, allow_unsigned: bool) -> None:
    """Reject an unsigned link that reaches beyond this machine.

    Raises:
        EndpointError: `address` is not a loopback address, and neither flag is set.
    """
    if signed or allow_unsigned or ipaddress.ip_address(address.partition("%")[0]).is_loopback:
        return
    raise EndpointError(
        endpoint.url,
        f"{address} is beyond this machine, where MAVLink signing is required: "
        "give a signing passphrase, or allow unsigned links by name",
    )


def _wait_for(descriptor: int, events: int, timeout_s: float) -> bool:
    """Return True if a poll event or an error occurs within `timeout_s`; inf never times out."""
    poller = select.poll()
    poller.register(descriptor, events)
    return bool(poller.poll(None if math.isinf(timeout_s) else max(0.0, timeout_s) * 1e3))


def readable(descriptor: int, timeout_s: float) -> bool:
    """Return True if there are bytes or an error to read within `timeout_s`."""
    return _wait_for(descriptor, select.POLLIN, timeout_s)


def writable(descriptor: int, timeout_s: float) -> bool:
    """Return True if a write can make progress within `timeout_s`."""
    return _wait_for(descriptor, select.POLLOUT, timeout_s)


class SocketOwner:
    """Owner of a socket that never blocks.

    Attributes:
        url: URL of the endpoint, for messages to people.
    """

    def __init__(self, opened: socket.socket, url: str) -> None:
        opened.settimeout(0.0)
        self._socket = opened
        self.url = url

    @property
    def port(self) -> int:
        """Local port. The system chooses it if the URL says 0."""
        return int(self._socket.getsockname()[1])

    def fileno(self) -> int:
        """Return the descriptor to wait on."""
        return self._socket.fileno()

    def close(self) -> None:
        """Close it. May be called repeatedly."""
        self._socket.close()


def bind(listening: socket.socket, endpoint: Endpoint, address: str) -> None:
    """Bind the socket, or close it and raise EndpointError."""
    try:
        listening.bind((address, endpoint.port))
    except OSError as error:
        listening.close()
        reason = {
            errno.EADDRINUSE: f"port {endpoint.port} is in use",
            errno.EADDRNOTAVAIL: f"{address} is not an address of this machine",
            errno.EACCES: f"port {endpoint.port} needs privileges",
        }.get(error.errno or 0, error.strerror or str(error))
        raise EndpointError(endpoint.url, reason) from None
