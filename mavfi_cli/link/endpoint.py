"""Parses endpoint URLs, such as `udpin:127.0.0.1:14540`."""

from __future__ import annotations

import re
from dataclasses import dataclass

from mavfi_cli.core.errors import EndpointError

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
