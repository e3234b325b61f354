"""Byte-stream transports: TCP client, TCP server and inherited socket pair."""

from __future__ import annotations

import errno
import socket
from typing import NoReturn

from mavfi_cli.core.errors import EndpointError, LinkLost
from mavfi_cli.link.endpoint import Endpoint
from mavfi_cli.link.waiting import readable, writable

CONNECT_TIMEOUT_S = 5.0
SEND_TIMEOUT_S = 10.0  # a peer that reads nothing for this long counts as lost
_CHUNK = 1 << 16


class StreamTransport:
    """A connected stream socket with one peer.

    Args:
        connection: the socket; owned from here on.
        url: for messages to people.
        patient: wait for a slow reader. Otherwise what does not fit its buffer is dropped, whole
            sends at a time, as autopilots do to a slow telemetry link.
    """

    datagram = False

    def __init__(self, connection: socket.socket, url: str, *, patient: bool = True) -> None:
        connection.settimeout(0.0)
        self._socket = connection
        self._patient = patient
        self._unsent = b""
        self.url = url

    def send(self, data: bytes) -> None:
        """Send whole frames; see `Transport`."""
        if self._unsent:
            self._unsent = self._push(self._unsent)
            if self._unsent:
                return
        unsent = self._push(data)
        if self._patient:
            while unsent:
                if not writable(self._socket.fileno(), SEND_TIMEOUT_S):
                    self._lost(f"the peer read nothing for {SEND_TIMEOUT_S:g} s")
                unsent = self._push(unsent)
        elif len(unsent) < len(data):
            self._unsent = unsent

    def _push(self, data: bytes) -> bytes:
        """Send as much as fits and return the rest."""
        try:
            return data[self._socket.send(data) :]
        except BlockingIOError:
            return data
        except OSError as error:
            self._lost(error.strerror or str(error))

    def receive(self, timeout_s: float) -> bytes:
        """Return the next bytes, or b"" after `timeout_s`; see `Transport`."""
        data = self._pull()
        if data is None and timeout_s > 0.0 and readable(self._socket.fileno(), timeout_s):
            data = self._pull()
        return data or b""

    def _pull(self) -> bytes | None:
        try:
            data = self._socket.recv(_CHUNK)
        except BlockingIOError:
            return None
        except OSError as error:
            self._lost(error.strerror or str(error))
        if not data:
            self._lost("the peer closed the connection")
        return data

    def _lost(self, why: str) -> NoReturn:
        raise LinkLost(f"{self.url}: {why}")

    def fileno(self) -> int:
        """Return the descriptor to wait on."""
        return self._socket.fileno()

    def close(self) -> None:
        """Close it. May be called repeatedly."""
        self._socket.close()


def inherited(endpoint: Endpoint) -> StreamTransport:
    """Open the transport of a stream socket inherited from the parent process.

    Raises:
        EndpointError: The descriptor does not exist or is not a connected stream socket.
    """
    try:
        connection = socket.socket(fileno=endpoint.fd)
    except OSError as error:
        problem = "not a socket" if error.errno == errno.ENOTSOCK else "not an open descriptor"
        raise EndpointError(endpoint.url, problem) from None
    try:
        connection.getpeername()
    except OSError:
        connection.detach()
        raise EndpointError(endpoint.url, "not a connected socket") from None
    if connection.type != socket.SOCK_STREAM:
        connection.detach()
        raise EndpointError(endpoint.url, "not a stream socket")
    return StreamTransport(connection, endpoint.url)


def connected(endpoint: Endpoint, where: tuple[int, str]) -> StreamTransport:
    """Connect a TCP client to the endpoint, resolved to family and address `where`.

    Raises:
        EndpointError: Nobody listens there, or the host is unreachable.
    """
    family, address = where
    connection = socket.socket(family, socket.SOCK_STREAM)
    connection.settimeout(CONNECT_TIMEOUT_S)
    try:
        connection.connect((address, endpoint.port))
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    except OSError as error:
        connection.close()
        raise EndpointError(endpoint.url, f"cannot connect: {_reason(error)}") from None
    return StreamTransport(connection, endpoint.url)


def _reason(error: OSError) -> str:
    if error.errno == errno.ECONNREFUSED:
        return "connection refused, nothing listens there"
    return (error.strerror or str(error)).lower()


class TcpListener:
    """Accepts TCP clients. Each becomes a transport of its own.

    Raises:
        EndpointError: The port is in use, or the address is not this machine's.
    """

    def __init__(self, endpoint: Endpoint, where: tuple[int, str]) -> None:
        family, address = where
        self.url = endpoint.url
        self._socket = socket.socket(family, socket.SOCK_STREAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        bind(self._socket, endpoint, address)
        self._socket.listen()
        self._socket.settimeout(0.0)

    @property
    def port(self) -> int:
        """Bound port. The system chooses it if the URL says 0."""
        return int(self._socket.getsockname()[1])

    def accept_ready(self) -> list[StreamTransport]:
        """Return the clients since the last call. Slow readers among them lose frames."""
        return self.accept_clients(patient=False)

    def accept_clients(self, *, patient: bool) -> list[StreamTransport]:
        """Return the clients since the last call; see `StreamTransport` for `patient`."""
        clients = []
        while (connection := self._accept()) is not None:
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            clients.append(StreamTransport(connection, self.url, patient=patient))
        return clients

    def _accept(self) -> socket.socket | None:
        try:
            return self._socket.accept()[0]
        except OSError:  # no client is waiting, or it has disconnected already
            return None

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


class TcpServerEnd:
    """A listening endpoint for the first client only. Data sent before it connects is lost."""

    datagram = False

    def __init__(self, listener: TcpListener) -> None:
        self._listener = listener
        self._client: StreamTransport | None = None
        self.url = listener.url

    @property
    def port(self) -> int:
        """Bound port. The system chooses it if the URL says 0."""
        return self._listener.port

    def _serve(self) -> StreamTransport | None:
        if self._client is None:
            clients = self._listener.accept_clients(patient=True)
            self._client = clients[0] if clients else None
            for other in clients[1:]:
                other.close()
        return self._client

    def send(self, data: bytes) -> None:
        """Send whole frames; see `Transport`."""
        client = self._serve()
        if client is not None:
            client.send(data)

    def receive(self, timeout_s: float) -> bytes:
        """Return the next bytes, or b"" after `timeout_s`; see `Transport`."""
        client = self._serve()
        if client is None:
            if timeout_s > 0 and readable(self._listener.fileno(), timeout_s):
                client = self._serve()
            return client.receive(0.0) if client is not None else b""
        return client.receive(timeout_s)

    def fileno(self) -> int:
        """Return the descriptor to wait on."""
        return self._listener.fileno() if self._client is None else self._client.fileno()

    def close(self) -> None:
        """Close it. May be called repeatedly."""
        self._listener.close()
        if self._client is not None:
            self._client.close()
