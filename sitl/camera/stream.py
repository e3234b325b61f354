"""Sends depth frames over a Unix domain socket, as arrays in metres.

Programs on this machine can read them instead of assembling MAVLink images. A frame is a header and
the depth of every pixel, row by row from the top left, as float32; infinity means that nothing is
in range. All numbers are little-endian. Readers send nothing.
"""

from __future__ import annotations

import contextlib
import errno
import math
import socket
import struct
from pathlib import Path

import numpy as np

from mavfi_cli.core.errors import LinkError, LinkLost
from mavfi_cli.core.frames import Vector
from mavfi_cli.link.transport import Transport, open_listener
from sitl.camera.depth import LEVELS_PER_M, NOTHING, Image

# Magic with version, stamp in us, columns, rows, horizontal field of view in rad, position of the
# lens in the world (ENU, m), and its attitude (quaternion w x y z, forward-left-up to ENU).
_HEADER = struct.Struct("<8sQIIf3f4f")
_MAGIC = b"MAVFI-D1"
_DEPTH_M = np.array([*(level / LEVELS_PER_M for level in range(NOTHING)), math.inf], "<f4")


class DepthStream:
    """Sends depth frames to every reader of a socket. Readers send nothing.

    It never blocks. A slow reader misses whole frames, because only a few are queued for it. There
    are at most `MAX_PEERS` readers.

    Args:
        path: Socket to create. Closing removes it.
        size: Columns and rows of the frames.

    Raises:
        LinkError: The socket cannot be created, for example because the file exists.
    """

    def __init__(self, path: Path, size: tuple[int, int]) -> None:
        self._path = path
        opened = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            opened.bind(str(path))
            opened.listen()
        except OSError as error:  # a path that is too long has no strerror
            opened.close()
            reason = error.strerror or error
            if error.errno == errno.EADDRINUSE:
                reason = "exists; remove it unless another process sends depth frames there"
            raise LinkError(f"{path}: {reason}") from None
        self._listener = open_listener(opened, buffer=_HEADER.size + 4 * size[0] * size[1])
        self._readers: list[Transport] = []

    @staticmethod
    def opened(
        path: Path | None, size: tuple[int, int]
    ) -> contextlib.AbstractContextManager[DepthStream | None]:
        """Return a context manager that gives an open stream, or None if `path` is None."""
        if path is None:
            return contextlib.nullcontext()
        return contextlib.closing(DepthStream(path, size))

    def serve(self) -> bool:
        """Accept new readers, and go on sending queued frames. Return True if readers remain."""
        self._readers += self._listener.accept_ready()
        self._send(b"")
        return bool(self._readers)

    def send(
        self,
        pixels: Image,
        stamp_s: float,
        position_enu_m: Vector,
        quaternion_flu_enu: Vector,
        hfov_rad: float,
    ) -> None:
        """Send a frame to every reader.

        For a slow reader, the frame replaces a frame that still waits to be sent.

        Args:
            pixels: Image (rows, columns) of `render_depth`.
            stamp_s: Boot clock of the vehicle, s.
            position_enu_m: Optical centre (3,) in the world.
            quaternion_flu_enu: Attitude (4,) of the camera.
            hfov_rad: Horizontal field of view.
        """
        rows, columns = pixels.shape
        header = _HEADER.pack(
            _MAGIC, round(stamp_s * 1e6), columns, rows, hfov_rad, *position_enu_m.tolist(),
            *quaternion_flu_enu.tolist(),
        )  # fmt: skip
        self._send(header + _DEPTH_M.take(pixels).tobytes())

    def _send(self, data: bytes) -> None:
        for reader in list(self._readers):
            try:
                reader.receive(0.0)  # raises LinkLost if the reader has left
                reader.send(data)
            except LinkLost:
                reader.close()
                self._readers.remove(reader)

    def close(self) -> None:
        """Disconnect all readers, and close and remove the socket."""
        for reader in self._readers:
            reader.close()
        self._listener.close()
        with contextlib.suppress(OSError):
            self._path.unlink()
