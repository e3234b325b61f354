"""Byte-stream transports: TCP client, TCP server, inherited socket pair and serial port."""

from __future__ import annotations

import errno
import socket
from typing import Any, NoReturn

from mavfi_cli.core.errors import EndpointError, LinkLost
from mavfi_cli.link.endpoint import Endpoint, SocketOwner, bind, readable, writable

CONNECT_TIMEOUT_S = 5.0
SEND_TIMEOUT_S = 10.0  # a peer that reads nothing for this long counts as lost
_CHUNK = 1 << 16


class _StreamTransport(SocketOwner):
    """A connected stream socket with one peer.

    Args:
        connection: the socket; owned from here on.
        url: for messages to people.
        patient: wait for a slow reader. Otherwise what does not fit its buffer is dropped, whole
            sends at a time, as autopilots do to a slow telemetry link.
    """

    datagram = False

    def __init__(self, connection: socket.socket, url: str, *, patient: bool = True) -> None:
        super().__init__(connection, url)
        self._patient = patient
        self._unsent = b""

    def send(self, data: bytes) -> None:
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


def inherited(endpoint: Endpoint) -> _StreamTransport:
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
    return _StreamTransport(connection, endpoint.url)


def connected(endpoint: Endpoint, where: tuple[int, str]) -> _StreamTransport:
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
    return _StreamTransport(connection, endpoint.url)


def _reason(error: OSError) -> str:
    if error.errno == errno.ECONNREFUSED:
        return "connection refused, nothing listens there"
    return (error.strerror or str(error)).lower()


class TcpListener(SocketOwner):
    """Accepts TCP clients. Each becomes a transport of its own.

    Raises:
        EndpointError: The port is in use, or the address is not this machine's.
    """

    def __init__(self, endpoint: Endpoint, where: tuple[int, str]) -> None:
        family, address = where
        listening = socket.socket(family, socket.SOCK_STREAM)
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        bind(listening, endpoint, address)
        listening.listen()
        super().__init__(listening, endpoint.url)

    def accept_ready(self) -> list[_StreamTransport]:
        """Return the clients since the last call. Slow readers among them lose frames."""
        return self.accept_clients(patient=False)

    def accept_clients(self, *, patient: bool) -> list[_StreamTransport]:
        """Return the clients since the last call; see `_StreamTransport` for `patient`."""
        clients = []
        while (connection := self._accept()) is not None:
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            clients.append(_StreamTransport(connection, self.url, patient=patient))
        return clients

    def _accept(self) -> socket.socket | None:
        try:
            return self._socket.accept()[0]
        except OSError:  # no client is waiting, or it has disconnected already
            return None


class TcpServerEnd:
    """A listening endpoint for the first client only. Data sent before it connects is lost."""

    datagram = False

    def __init__(self, listener: TcpListener) -> None:
        self._listener = listener
        self._client: _StreamTransport | None = None
        self.url = listener.url

    @property
    def port(self) -> int:
        """Bound port. The system chooses it if the URL says 0."""
        return self._listener.port

    def _serve(self) -> _StreamTransport | None:
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
        if client is None and timeout_s > 0 and readable(self._listener.fileno(), timeout_s):
            client, timeout_s = self._serve(), 0.0
        return b"" if client is None else client.receive(timeout_s)

    def fileno(self) -> int:
        """Return the descriptor to wait on."""
        return self._listener.fileno() if self._client is None else self._client.fileno()

    def close(self) -> None:
        """Close it. May be called repeatedly."""
        self._listener.close()
        if self._client is not None:
            self._client.close()


class SerialPort:
    """A serial line to one peer, 8N1 without flow control.

    Raises:
        EndpointError: The device does not exist, may not be opened, or is in use.
    """

    datagram = False

    def __init__(self, endpoint: Endpoint) -> None:
        import serial

        self.url = endpoint.url
        self._failures: tuple[type[Exception], ...] = (serial.SerialException, OSError)
        try:
            self._port: Any = serial.Serial(
                endpoint.device,
                endpoint.baud,
                timeout=0,
                write_timeout=SEND_TIMEOUT_S,
                exclusive=True,
            )
        except (serial.SerialException, OSError, ValueError) as error:
            raise EndpointError(endpoint.url, _serial_reason(error, endpoint)) from None

    def send(self, data: bytes) -> None:
        """Send whole frames; see `Transport`."""
        try:
            self._port.write(data)
        except self._failures as error:
            self._lost(error)

    def receive(self, timeout_s: float) -> bytes:
        """Return the next bytes, or b"" after `timeout_s`; see `Transport`."""
        try:
            if not readable(self._port.fileno(), timeout_s):
                return b""
            return bytes(self._port.read(_CHUNK))
        except self._failures as error:
            self._lost(error)

    def _lost(self, error: Exception) -> NoReturn:
        raise LinkLost(f"{self.url}: the serial device failed: {error}") from None

    def fileno(self) -> int:
        """Return the descriptor to wait on."""
        return int(self._port.fileno())

    def close(self) -> None:
        """Close it. May be called repeatedly."""
        self._port.close()


def _serial_reason(error: Exception, endpoint: Endpoint) -> str:
    number = getattr(error, "errno", None)
    if number in (errno.ENOENT, errno.ENXIO, errno.ENODEV):
        return f"no such device {endpoint.device}"
    if number == errno.EACCES:
        return f"no permission to open {endpoint.device}"
    if number in (errno.EBUSY, errno.EAGAIN) or "lock" in str(error):
        return f"{endpoint.device} is in use"
    if number == errno.ENOTTY:
        return f"{endpoint.device} is not a serial device"
    return str(error)
