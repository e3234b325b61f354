"""Parses and opens endpoint URLs, such as `udpin:127.0.0.1:14540`, and chooses between senders."""

from __future__ import annotations

import errno
import ipaddress
import re
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from mavfi_cli.core.errors import LinkError

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
    """A parsed endpoint URL. Fields that its scheme does not use keep their defaults."""

    url: str
    scheme: str  # the word before the first colon, one of the known schemes
    host: str = ""
    port: int = 0
    device: str = ""
    baud: int = _DEFAULT_BAUD
    fd: int = -1

    def open_socket(self, *, beyond: bool) -> socket.socket:
        """Open a socket for a network URL, bound if the scheme listens and otherwise connected.

        Raises LinkError as `open_transport` does.

        Args:
            beyond: Allow addresses beyond loopback.
        """
        datagram = self.scheme.startswith("udp")
        kind = socket.SOCK_DGRAM if datagram else socket.SOCK_STREAM
        try:
            entries = socket.getaddrinfo(self.host, self.port, type=kind)
        except (OSError, UnicodeError):
            raise LinkError(f"{self.url}: no such host {self.host!r}") from None
        entries.sort(key=lambda entry: entry[0] != socket.AF_INET)  # IPv4 first
        family, address = entries[0][0], str(entries[0][4][0])
        if not (beyond or ipaddress.ip_address(address.partition("%")[0]).is_loopback):
            raise LinkError(
                f"{self.url}: {address} is not a loopback address, so the link must be signed: "
                "give --key-file"
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
            raise LinkError(f"{self.url}: {self._refusal(error, address)}") from None
        return opened

    def _refusal(self, error: OSError, address: str) -> str:
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
        """Return the connected stream socket inherited from the parent process.

        Raises LinkError if the descriptor is not such a socket.
        """
        try:
            connection = socket.socket(fileno=self.fd)
        except OSError as error:
            problem = "not a socket" if error.errno == errno.ENOTSOCK else "not an open descriptor"
            raise LinkError(f"{self.url}: {problem}") from None
        problem = "" if connection.type == socket.SOCK_STREAM else "not a stream socket"
        try:
            connection.getpeername()
        except OSError:
            problem = "not a connected socket"
        if problem:
            connection.detach()
            raise LinkError(f"{self.url}: {problem}")
        return connection


def parse_endpoint(url: str) -> Endpoint:
    """Parse a URL of the form `scheme:rest` or `scheme://rest`.

    Raises LinkError if the scheme is unknown (the message lists the known ones), or the rest is
    malformed or out of range.
    """

    def invalid(problem: str) -> LinkError:
        return LinkError(f"{url}: {problem}").as_usage()

    word, _, rest = url.partition(":")
    rest = rest.removeprefix("//")
    scheme = _ALIASES.get(word, word)
    if scheme not in _FORMS:
        raise invalid(f"unknown kind of endpoint; known: {', '.join(_FORMS.values())}")
    malformed = invalid(f"not of the form {_FORMS[scheme]}")

    def number(text: str, largest: int) -> int:
        if not re.fullmatch(r"[0-9]{1,10}", text, re.ASCII):
            raise malformed
        if int(text) > largest:
            raise invalid(f"the number must be at most {largest}, got {text}")
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
        raise invalid("the port must be at least 1, got 0")
    return Endpoint(url=url, scheme=scheme, host=host or _LOOPBACK, port=port)


Sender = TypeVar("Sender")
SILENCE_S = 5.0  # silence after which another sender may take the slot
TWO_AUTOPILOTS = "two autopilots send here"


class SenderSlot(Generic[Sender]):
    """Selects the one sender to which an endpoint listens.

    After 5 s of silence another sender may take its place.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self.holder: Sender | None = None  # the current sender
        # Another sender, which sent while the slot was taken. The holder has sent since, so the
        # rival is not the holder itself, restarted on another port.
        self.rival: Sender | None = None
        self._challenger: Sender | None = None
        self._silent_from_s = 0.0  # when the holder will have been silent for too long

    @property
    def is_free(self) -> bool:
        """True if no sender holds the slot, or if the holder has been silent for too long."""
        return self.holder is None or self._clock() >= self._silent_from_s

    def take(self, sender: Sender) -> None:
        """Give the slot to a sender."""
        self.holder, self._challenger = sender, None
        self.refresh(sender)

    def leave(self, sender: Sender) -> None:
        """Free the slot if `sender` holds it."""
        if sender == self.holder:
            self.holder = None

    def refresh(self, sender: Sender) -> bool:
        """Record that a sender has sent data. Return True if that sender holds the slot."""
        if sender != self.holder:
            return False
        if self._challenger is not None:
            self.rival, self._challenger = self._challenger, None
        self._silent_from_s = self._clock() + SILENCE_S
        return True

    def challenge(self, sender: Sender) -> None:
        """Record that another sender has sent data while the slot is taken."""
        self._challenger = sender
