"""Opens transports by URL, which carry bytes to and from one peer, and listeners for several."""

from __future__ import annotations

import errno
import math
import os
import select
import socket
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn, Protocol

from mavfi_cli.core.errors import ConfigError, LinkError, LinkLost, RecordError
from mavfi_cli.core.files import read_bounded
from mavfi_cli.link.codec import (
    Codec,
    Signing,
    begins_with_frame,
    dialect,
    frame_length,
    key_from_passphrase,
)
from mavfi_cli.link.endpoint import LISTENING, Endpoint, SenderSlot, parse_endpoint

MAX_PEERS = 16  # per listener
_CHUNK = 1 << 16  # largest read, bytes
_SMALL_CHUNK = 2048  # largest read from a client of a listener, bytes; one datagram at most
_SEND_TIMEOUT_S = 10.0  # time without reading after which a peer counts as lost
_BACKLOG = 1 << 16  # buffer for a slow client of a listener, bytes
_MAX_WAITING = 128  # maximum unread datagrams per peer; the oldest are dropped first
_JUDGED = 16  # maximum datagrams from unknown senders that one pass examines; others are lost
_PUMPED = 1000  # maximum datagrams that one pass reads
_LONGEST_KEY = 1 << 16  # largest file of a passphrase, bytes
_MTU_PAYLOAD = 1400  # maximum bytes per datagram when frames are combined


class Transport(ABC):
    """Carries bytes to and from one peer."""

    url: str  # endpoint URL, for error messages
    datagram = False  # True if `receive` returns whole frames; an argument of `Codec.decode`
    address = ""  # network peer's address, for error messages; "" if unknown

    @property
    def rival_address(self) -> str:
        """Address of a second autopilot that sends to this end, or "" if there is none."""
        return ""

    @abstractmethod
    def send(self, data: bytes) -> None:
        """Send whole frames. Datagrams may be lost. Raises LinkLost if the connection is lost.

        With empty `data`, an unfinished earlier send to a slow client of a listener continues.
        """

    def receive(self, timeout_s: float) -> bytes:
        """Return the next bytes to arrive, or b"" if none arrive within `timeout_s` seconds.

        With an infinite timeout, wait without a limit. Raises LinkLost if the peer closed the
        connection, or the device was removed.
        """
        data = self._pull()
        if data or timeout_s <= 0.0:
            return data
        deadline_s = time.monotonic() + timeout_s
        while not data and (left_s := deadline_s - time.monotonic()) > 0.0:
            if not self._await(select.POLLIN, left_s):
                break
            data = self._pull()
        return data

    def await_peer(self, timeout_s: float) -> bool:
        """Wait at most `timeout_s` seconds for a peer to connect. Return True if there is one."""
        return timeout_s >= 0.0

    @abstractmethod
    def fileno(self) -> int:
        """Return the file descriptor that becomes readable when data arrives, or -1 without one."""

    @abstractmethod
    def close(self) -> None:
        """Release the socket or device. Safe to call more than once."""

    @abstractmethod
    def _pull(self) -> bytes:
        """Return the bytes that have arrived, without waiting, or b"" if none have.

        Raises LinkLost as `receive` does.
        """

    def _await(self, event: int, timeout_s: float) -> bool:
        """Wait at most `timeout_s` seconds for a poll event. Return True if it occurs.

        An error of the descriptor also counts. With an infinite timeout, wait without a limit.
        """
        poller = select.poll()
        poller.register(self.fileno(), event)
        return bool(poller.poll(None if math.isinf(timeout_s) else timeout_s * 1e3))

    def _lost(self, why: object) -> NoReturn:
        raise LinkLost(f"{self.url}: {why}") from None


class Listener(Protocol):
    """Accepts the peers of one URL: every client if the URL listens, otherwise its only peer."""

    def accept_ready(self) -> Sequence[Transport]:
        """Return the peers that have connected since the last call, without waiting."""

    def fileno(self) -> int:
        """Return the file descriptor that becomes readable when `accept_ready` may return peers."""

    def close(self) -> None:
        """Stop listening. This also closes UDP peers, because they share the socket."""


def open_transport(
    url: str,
    *,
    signed: bool = False,
    allow_unsigned: bool = False,
    admits: Callable[[bytes], bool] = begins_with_frame,
    patient: bool = True,
) -> Transport:
    """Open the end of a link that `url` describes.

    Args:
        url: `udpin:[host]:port`, `udpout:host:port`, `tcp:host:port`, `tcpin:[host]:port`,
            `serial:device[:baud]` or `fd:number`; without a host it listens on loopback.
        signed: The caller signs this link, so its address need not be a loopback address.
        allow_unsigned: Allow addresses other than loopback without signing.
        admits: Returns True if the sender of this datagram may become the peer of `udpin`.
        patient: Wait for a slow reader. Otherwise the link buffers data for it, and drops the
            oldest first.

    Raises:
        LinkError: The URL is malformed, its scheme is unknown, its port is in use, no peer listens,
            the device cannot be opened, or the address of an unsigned link is not loopback.
    """
    endpoint = parse_endpoint(url)
    if endpoint.scheme == "serial":
        return _SerialPort(endpoint, patient=patient)
    if endpoint.scheme == "fd":
        return _Stream(endpoint.inherited_socket(), url, patient=patient)
    opened = endpoint.open_socket(beyond=signed or allow_unsigned)
    if opened.type == socket.SOCK_DGRAM:
        return _Udp(opened, url, admits if endpoint.scheme == "udpin" else None)
    if endpoint.scheme == "tcp":
        return _Stream(opened, url, patient=patient)
    return _FirstClient(_StreamListener(opened, url))


def open_listener(
    url: str | Transport | socket.socket,
    *,
    signed: bool = False,
    allow_unsigned: bool = False,
    admits: Callable[[bytes], bool] = begins_with_frame,
    buffer: int = _BACKLOG,
) -> Listener:
    """Open an endpoint that accepts several peers, none of which waits for a slow reader.

    Raises the same errors as `open_transport`.

    Args:
        url, signed, allow_unsigned: As in `open_transport`. `url` may also be an open transport,
            which is then the single peer, or a listening stream socket.
        admits: Returns True if the sender of this first datagram may become a peer.
        buffer: Bytes to buffer for each slow client, if `url` is a listening stream socket.
    """
    if isinstance(url, Transport):
        return _OnePeer(url)
    if isinstance(url, socket.socket):
        return _StreamListener(url, str(url.getsockname()), buffer)
    endpoint = parse_endpoint(url)
    if endpoint.scheme not in LISTENING:
        single = open_transport(
            url, signed=signed, allow_unsigned=allow_unsigned, patient=False
        )  # fmt: skip
        return _OnePeer(single)
    opened = endpoint.open_socket(beyond=signed or allow_unsigned)
    if endpoint.scheme == "udpin":
        return _UdpListener(opened, url, admits)
    return _StreamListener(opened, url)


class _OnePeer:
    """Listener for an endpoint with exactly one peer, which exists from the start."""

    def __init__(self, transport: Transport) -> None:
        self._fresh = [transport]
        self.fileno, self.close = transport.fileno, transport.close

    def accept_ready(self) -> list[Transport]:
        fresh, self._fresh = self._fresh, []
        return fresh


class _SocketOwner:
    """Owns a non-blocking socket."""

    def __init__(self, opened: socket.socket, url: str) -> None:
        opened.settimeout(0.0)
        self._socket = opened
        self.url = url

    @property
    def port(self) -> int:
        """Local port. The system chooses it if the URL has port 0."""
        return int(self._socket.getsockname()[1])

    def fileno(self) -> int:
        return self._socket.fileno()

    def close(self) -> None:
        self._socket.close()


def _text_of(address: Any) -> str:
    """Return an address as "host:port", or "" for None or an unnamed Unix domain socket."""
    return f"{address[0]}:{address[1]}" if address else ""


# Streams ------------------------------------------------------------------------------------------


class _Backlog:
    """Batches that wait for a slow reader: up to `most` bytes, of which the oldest go first.

    Args:
        push: Sends as many bytes as the reader accepts, and returns the rest.
    """

    def __init__(self, push: Callable[[bytes], bytes], most: int) -> None:
        self._push, self._most = push, most
        self._begun = b""  # rest of a partly sent batch
        self._waiting: deque[bytes] = deque()

    def send(self, data: bytes) -> None:
        """Send a batch, and those that wait, as far as the reader accepts them."""
        if data:
            self._waiting.append(data)
        while self._begun or self._waiting:
            self._begun = self._push(self._begun or self._waiting.popleft())
            if self._begun:
                break
        while sum(map(len, self._waiting)) > self._most:
            self._waiting.popleft()


class _Stream(_SocketOwner, Transport):
    """A connected stream socket with one peer.

    A patient stream waits for a slow reader. Any other stream buffers up to `buffer` bytes for it
    and drops the oldest batches first, so that the reader gets recent data.
    """

    def __init__(
        self,
        connection: socket.socket,
        url: str,
        *,
        patient: bool = True,
        address: str = "",
        buffer: int = _BACKLOG,
    ) -> None:
        super().__init__(connection, url)
        self.address = address
        self._chunk = _CHUNK if patient else _SMALL_CHUNK
        self._backlog = None if patient else _Backlog(self._push, buffer)

    def send(self, data: bytes) -> None:
        if self._backlog is not None:
            self._backlog.send(data)
            return
        while data := self._push(data):
            if not self._await(select.POLLOUT, _SEND_TIMEOUT_S):
                self._lost(f"the peer read nothing for {_SEND_TIMEOUT_S:g} s")

    def _push(self, data: bytes) -> bytes:
        """Send as many bytes as the socket accepts, and return the rest."""
        try:
            return data[self._socket.send(data) :]
        except BlockingIOError:
            return data
        except OSError as error:
            self._lost(error.strerror or error)

    def _pull(self) -> bytes:
        try:
            data = self._socket.recv(self._chunk)
        except BlockingIOError:
            return b""
        except OSError as error:
            self._lost(error.strerror or error)
        if not data:
            self._lost("the peer closed the connection")
        return data


class _StreamListener(_SocketOwner):
    """A listening stream socket. Every client becomes a peer, and slow readers lose frames.

    There are at most MAX_PEERS peers. Further connections are closed.
    """

    def __init__(self, opened: socket.socket, url: str, buffer: int = _BACKLOG) -> None:
        super().__init__(opened, url)
        self._buffer = buffer
        self._peers: list[_Stream] = []

    def accept_ready(self, *, patient: bool = False) -> list[_Stream]:
        """Return the clients that have connected since the last call.

        If `patient` is true, their streams wait for a slow reader. Otherwise they drop data.
        """
        clients: list[_Stream] = []
        while True:
            try:
                connection, address = self._socket.accept()
            except OSError:  # no client is waiting, or it has disconnected
                return clients
            self._peers = [peer for peer in self._peers if peer.fileno() >= 0]
            if len(self._peers) >= MAX_PEERS:
                connection.close()
                continue
            if connection.family != socket.AF_UNIX:
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if not patient:  # the default buffers hold half a minute of telemetry
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, self._buffer)
            clients.append(
                _Stream(
                    connection, self.url, patient=patient, address=_text_of(address),
                    buffer=self._buffer,
                )
            )  # fmt: skip
            self._peers.append(clients[-1])


class _FirstClient(Transport):
    """The first client of a TCP port. Data sent before it connects is lost."""

    def __init__(self, listener: _StreamListener) -> None:
        self._listener = listener
        self._client: _Stream | None = None
        self.url, self.port = listener.url, listener.port

    def _serve(self) -> _Stream | None:
        if self._client is None and (clients := self._listener.accept_ready(patient=True)):
            self._client, *others = clients
            for client in others:
                client.close()
        return self._client

    def await_peer(self, timeout_s: float) -> bool:
        if self._client is None:
            self._await(select.POLLIN, timeout_s)
        return self._serve() is not None

    def send(self, data: bytes) -> None:
        if (client := self._serve()) is not None:
            client.send(data)

    def _pull(self) -> bytes:
        client = self._serve()
        return b"" if client is None else client._pull()

    def fileno(self) -> int:
        return (self._client or self._listener).fileno()

    def close(self) -> None:
        self._listener.close()
        if self._client is not None:
            self._client.close()


class _SerialPort(Transport):
    """A serial line to one peer, 8N1 without flow control."""

    def __init__(self, endpoint: Endpoint, *, patient: bool = True) -> None:
        import serial

        self.url = endpoint.url
        self._failures: tuple[type[Exception], ...] = (serial.SerialException, OSError)
        try:
            self._port: Any = serial.Serial(
                endpoint.device, endpoint.baud, timeout=0, write_timeout=_SEND_TIMEOUT_S,
                exclusive=True,
            )  # fmt: skip
        except (*self._failures, ValueError) as error:
            raise LinkError(f"{endpoint.url}: {_serial_reason(error, endpoint.device)}") from None
        self._backlog = None if patient else _Backlog(self._push, _BACKLOG)

    def send(self, data: bytes) -> None:
        if self._backlog is not None:
            self._backlog.send(data)
            return
        try:
            self._port.write(data)
        except self._failures as error:
            self._lost(f"the serial device failed: {error}")

    def _push(self, data: bytes) -> bytes:
        try:
            return data[os.write(self._port.fileno(), data) :]
        except BlockingIOError:
            return data
        except OSError as error:
            self._lost(f"the serial device failed: {error}")

    def _pull(self) -> bytes:
        try:
            return bytes(self._port.read(_CHUNK))
        except self._failures as error:
            self._lost(f"the serial device failed: {error}")

    def fileno(self) -> int:
        return int(self._port.fileno())

    def close(self) -> None:
        self._port.close()


def _serial_reason(error: Exception, device: str) -> str:
    in_use = f"{device} is in use"
    known = {
        **dict.fromkeys((errno.ENOENT, errno.ENXIO, errno.ENODEV), f"no such device {device}"),
        errno.EACCES: f"no permission to open {device}",
        **dict.fromkeys((errno.EBUSY, errno.EAGAIN), in_use),
        errno.ENOTTY: f"{device} is not a serial device",
    }
    return known.get(
        getattr(error, "errno", None) or 0, in_use if "lock" in str(error) else str(error)
    )


# Datagrams ----------------------------------------------------------------------------------------


class _Udp(_SocketOwner, Transport):
    """A UDP socket with one peer.

    A connected socket receives from its peer only. Any other socket takes the first admitted sender
    as its peer. After 5 s of silence another sender may take its place. Data sent before the first
    peer appears is lost.

    Args:
        admits: Returns True if the sender of this datagram may become the peer. None for a
            connected socket.
    """

    datagram = True

    def __init__(
        self, opened: socket.socket, url: str, admits: Callable[[bytes], bool] | None
    ) -> None:
        super().__init__(opened, url)
        self._admits = admits
        self._slot: SenderSlot[Any] = SenderSlot()

    @property
    def rival_address(self) -> str:
        return _text_of(self._slot.rival)

    def send(self, data: bytes) -> None:
        if self._slot.holder is not None or self._admits is None:
            _send_datagrams(self._socket, data, self._slot.holder)

    def _pull(self) -> bytes:
        for _ in range(_PUMPED):
            data, sender = _receive_datagram(self._socket, _CHUNK)
            if sender is None or self._admits is None or self._is_peer(data, sender, self._admits):
                return data
        return b""

    def _is_peer(self, data: bytes, sender: Any, admits: Callable[[bytes], bool]) -> bool:
        if self._slot.refresh(sender):
            return True
        if not admits(data):
            return False
        if self._slot.is_free:
            self._slot.take(sender)
            self.address = _text_of(sender)
            return True
        messages = Codec(0, 0).decode(data, datagram=True)
        if any(m.get_srcComponent() == dialect.MAV_COMP_ID_AUTOPILOT1 for m in messages):
            self._slot.challenge(sender)
        return False


def _receive_datagram(opened: socket.socket, limit: int) -> tuple[bytes, Any]:
    """Return a datagram of up to `limit` bytes and its sender, or b"" and None if none has arrived.

    ECONNREFUSED means that no process listens at the other end of a connected socket. It is not an
    error for UDP, because the peer may start later.
    """
    try:
        return opened.recvfrom(limit)
    except OSError:
        return b"", None


def _send_datagrams(opened: socket.socket, data: bytes, peer: Any) -> None:
    """Send frames to `peer`, or to the connected address if `peer` is None.

    Data that cannot be sent is lost.
    """
    for datagram in _split_frames(data):
        for _attempt in range(2):  # the first may report the refusal of an earlier datagram
            try:
                if peer is None:
                    opened.send(datagram)
                else:
                    opened.sendto(datagram, peer)
                break
            except OSError:
                continue


def _split_frames(data: bytes) -> list[bytes]:
    """Split well-formed frames into datagrams, each small enough for one Ethernet packet."""
    if len(data) <= _MTU_PAYLOAD:
        return [data]
    datagrams, start, position = [], 0, 0
    while position < len(data):
        length = frame_length(data, position, len(data))
        if position > start and position + length - start > _MTU_PAYLOAD:
            datagrams.append(data[start:position])
            start = position
        position += length
    datagrams.append(data[start:])
    return datagrams


class _UdpListener(_SocketOwner):
    """A UDP port on which every admitted sender becomes a peer. All peers share one socket.

    There are at most MAX_PEERS peers, and an open peer is never replaced.
    """

    def __init__(self, opened: socket.socket, url: str, admits: Callable[[bytes], bool]) -> None:
        super().__init__(opened, url)
        self._admits = admits
        self.peers: dict[Any, _UdpPeer] = {}  # by address
        self._fresh: list[_UdpPeer] = []

    def accept_ready(self) -> list[_UdpPeer]:
        self.pump()
        fresh, self._fresh = [peer for peer in self._fresh if not peer.lost], []
        return fresh

    def pump(self) -> None:
        """Give each waiting datagram to its sender's peer. Admitted new senders become peers."""
        judged = 0
        for _ in range(_MAX_WAITING):
            data, sender = _receive_datagram(self._socket, _SMALL_CHUNK)
            if sender is None:
                return
            peer = self.peers.get(sender)
            if peer is None:
                if judged == _JUDGED or len(self.peers) >= MAX_PEERS:
                    continue
                judged += 1
                if not self._admits(data):
                    continue
                peer = self.peers[sender] = _UdpPeer(self, sender)
                self._fresh.append(peer)
            peer.waiting.append(data)

    def send_to(self, data: bytes, address: Any) -> None:
        """Send whole frames to one peer."""
        _send_datagrams(self._socket, data, address)

    def close(self) -> None:
        for peer in self.peers.values():
            peer.lost = True
        super().close()


class _UdpPeer(Transport):
    datagram = True

    def __init__(self, listener: _UdpListener, address: Any) -> None:
        self._listener = listener
        self._address = address
        self.address = _text_of(address)
        self.url = listener.url
        self.waiting: deque[bytes] = deque(maxlen=_MAX_WAITING)
        self.lost = False

    def send(self, data: bytes) -> None:
        if self.lost:
            self._lost("this peer was dropped")
        self._listener.send_to(data, self._address)

    def _pull(self) -> bytes:
        if not self.waiting:
            if self.lost:
                self._lost("this peer was dropped")
            self._listener.pump()
        return self.waiting.popleft() if self.waiting else b""

    def fileno(self) -> int:
        return self._listener.fileno()

    def close(self) -> None:
        self.lost = True
        self._listener.peers.pop(self._address, None)


# In memory ----------------------------------------------------------------------------------------


def memory_pair(url: str) -> tuple[_MemoryTransport, _MemoryTransport]:
    """Return both ends of a new in-memory link. `url` appears in error messages only."""
    ours, theirs = _MemoryTransport(url), _MemoryTransport(url)
    ours._peer, theirs._peer = theirs, ours
    return ours, theirs


class _MemoryTransport(Transport):
    """One end of an in-memory link. `memory_pair` makes both ends.

    Both ends run in one thread, so an end that has nothing to receive does not sleep. Instead it
    calls its `on_wait`, in which the other end can act.
    """

    def __init__(self, url: str) -> None:
        self.url = url
        self.on_wait: Callable[[], None] = lambda: None
        self._peer: _MemoryTransport | None = None  # None once either end has closed
        self._arrived: list[bytes] = []

    def send(self, data: bytes) -> None:
        if self._peer is None:
            self._lost("the peer closed the connection")
        self._peer._arrived.append(data)

    def receive(self, timeout_s: float) -> bytes:
        if not self._arrived and self._peer is not None:
            self.on_wait()
        return self._pull()

    def _pull(self) -> bytes:
        if not self._arrived and self._peer is None:
            self._lost("the peer closed the connection")
        data = b"".join(self._arrived)
        self._arrived.clear()
        return data

    def fileno(self) -> int:
        return -1

    def close(self) -> None:
        if self._peer is not None:
            self._peer._peer = None
            self._peer = None


def signing_from_file(path: str | Path | None) -> Signing | None:
    """Set up signing with the passphrase stored in `path`, using the host clock.

    Return None if `path` is None. White space around the passphrase is ignored. Raises ConfigError
    if the file cannot be read or is empty.
    """
    if path is None:
        return None
    try:
        # The user named it, so a link is followed, but a device or a pipe is not read.
        passphrase = read_bounded(Path(path).resolve(), _LONGEST_KEY).decode().strip()
    except (RecordError, UnicodeDecodeError) as error:
        raise ConfigError(f"cannot read the passphrase: {error}", path=Path(path)) from None
    if not passphrase:
        raise ConfigError("must contain a passphrase, but is empty", path=Path(path))
    return Signing(key_from_passphrase(passphrase), clock=time.time)
