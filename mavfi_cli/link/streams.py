"""Transports over streams: connected sockets, TCP clients of a port, and serial lines."""

from __future__ import annotations

import errno
import select
import socket
from collections import deque
from typing import Any

from mavfi_cli.core.errors import EndpointError
from mavfi_cli.link.endpoint import (
    CHUNK,
    MAX_PEERS,
    SMALL_CHUNK,
    Endpoint,
    Receiver,
    SocketOwner,
    text_of,
)

_SEND_TIMEOUT_S = 10.0  # a peer that reads nothing for this long counts as lost
_BACKLOG = 1 << 16  # bytes that wait for a slow client of a listener


class StreamTransport(SocketOwner, Receiver):
    """A connected stream socket with one peer.

    A patient one waits for a slow reader. Any other keeps what the reader's buffer does not take,
    64 KiB at most, and drops the oldest sends first, so that what arrives is recent.
    """

    def __init__(
        self, connection: socket.socket, url: str, *, patient: bool = True, address: str = ""
    ) -> None:
        super().__init__(connection, url)
        self.address = address
        self._patient = patient
        self._chunk = CHUNK if patient else SMALL_CHUNK
        self._begun = b""  # rest of a send of which the peer has a part
        self._waiting: deque[bytes] = deque()

    def send(self, data: bytes) -> None:
        """See `Transport`."""
        if self._patient:
            self._send_all(data)
            return
        self._waiting.append(data)
        while self._begun or self._waiting:
            self._begun = self._push(self._begun or self._waiting.popleft())
            if self._begun:
                break
        while sum(map(len, self._waiting)) > _BACKLOG:
            self._waiting.popleft()

    def _send_all(self, unsent: bytes) -> None:
        while unsent := self._push(unsent):
            if not self._await(select.POLLOUT, _SEND_TIMEOUT_S):
                self._lost(f"the peer read nothing for {_SEND_TIMEOUT_S:g} s")

    def _push(self, data: bytes) -> bytes:
        """Send as much as fits and return the rest."""
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


class TcpListener(SocketOwner):
    """A port on which every TCP client becomes a peer. Slow readers among them lose frames.

    There are at most MAX_PEERS. The connection of a further client is closed.
    """

    def __init__(self, opened: socket.socket, url: str) -> None:
        super().__init__(opened, url)
        self._peers: list[StreamTransport] = []

    def accept_ready(self, *, patient: bool = False) -> list[StreamTransport]:
        """See `Listener`; see `StreamTransport` for `patient`."""
        clients: list[StreamTransport] = []
        while True:
            try:
                connection, address = self._socket.accept()
            except OSError:  # no client is waiting, or it has disconnected already
                return clients
            self._peers = [peer for peer in self._peers if peer.fileno() >= 0]
            if len(self._peers) >= MAX_PEERS:
                connection.close()
                continue
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if not patient:  # the system's buffers would hold telemetry of half a minute
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BACKLOG)
            self._peers.append(
                StreamTransport(connection, self.url, patient=patient, address=text_of(address))
            )
            clients.append(self._peers[-1])


class FirstClient(Receiver):
    """The first client of a TCP port. Data sent before it connects is lost."""

    def __init__(self, listener: TcpListener) -> None:
        self._listener = listener
        self._client: StreamTransport | None = None
        self.url, self.port = listener.url, listener.port

    def _serve(self) -> StreamTransport | None:
        if self._client is None:
            for client in self._listener.accept_ready(patient=True):
                if self._client is None:
                    self._client = client
                else:
                    client.close()
        return self._client

    def send(self, data: bytes) -> None:
        """See `Transport`."""
        client = self._serve()
        if client is not None:
            client.send(data)

    def _pull(self) -> bytes:
        client = self._serve()
        return b"" if client is None else client._pull()

    def fileno(self) -> int:
        """See `Transport`."""
        return (self._client or self._listener).fileno()

    def close(self) -> None:
        """See `Transport`."""
        self._listener.close()
        if self._client is not None:
            self._client.close()


class SerialPort(Receiver):
    """A serial line to one peer, 8N1 without flow control."""

    def __init__(self, endpoint: Endpoint) -> None:
        import serial

        self.url = endpoint.url
        self._failures: tuple[type[Exception], ...] = (serial.SerialException, OSError)
        try:
            self._port: Any = serial.Serial(
                endpoint.device, endpoint.baud, timeout=0, write_timeout=_SEND_TIMEOUT_S,
                exclusive=True,
            )  # fmt: skip
        except (*self._failures, ValueError) as error:
            raise EndpointError(endpoint.url, _serial_reason(error, endpoint.device)) from None

    def send(self, data: bytes) -> None:
        """See `Transport`."""
        try:
            self._port.write(data)
        except self._failures as error:
            self._lost(f"the serial device failed: {error}")

    def _pull(self) -> bytes:
        try:
            return bytes(self._port.read(CHUNK))
        except self._failures as error:
            self._lost(f"the serial device failed: {error}")

    def fileno(self) -> int:
        """See `Transport`."""
        return int(self._port.fileno())

    def close(self) -> None:
        """See `Transport`."""
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
