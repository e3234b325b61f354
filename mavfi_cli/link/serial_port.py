"""Serial transport, with pyserial."""

from __future__ import annotations

import errno
from typing import Any, NoReturn

from mavfi_cli.core.errors import EndpointError, LinkLost
from mavfi_cli.link.endpoint import Endpoint
from mavfi_cli.link.waiting import readable

WRITE_TIMEOUT_S = 10.0
_CHUNK = 4096


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
                write_timeout=WRITE_TIMEOUT_S,
                exclusive=True,
            )
        except (serial.SerialException, OSError, ValueError) as error:
            raise EndpointError(endpoint.url, _reason(error, endpoint)) from None

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


def _reason(error: Exception, endpoint: Endpoint) -> str:
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
