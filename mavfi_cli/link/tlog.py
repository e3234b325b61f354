"""Writes and reads the .tlog of a flight: all frames in both directions, as ground stations do.

A record is the time in microseconds since 1970 (8 bytes, big endian) and the unchanged frame.
Received frames of messages that the `common` dialect lacks are omitted.

In simulation the time is EPOCH_UNIX_S plus the stamp, so the same flight gives the same bytes. For
a foreign autopilot it is this computer's UTC, as in the logs of ground stations, because the
SYSTEM_TIME of a simulated autopilot may be any date.
"""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from mavfi_cli.core.errors import RecordError
from mavfi_cli.core.files import read_bounded
from mavfi_cli.link.codec import Codec, Message, Signing, dialect, frame_length, frame_of
from mavfi_cli.link.endpoint import TWO_AUTOPILOTS
from mavfi_cli.link.transport import Transport

EPOCH_UNIX_S = 1_577_836_800  # 2020-01-01 UTC is stamp 0
_FLUSH_BYTES = 1 << 16
_LARGEST = 1 << 30  # largest log that is written or read, bytes
_FLUSH_INTERVAL_S = 1.0  # difference of stamps between writes


def unix_time_of_stamp_0(path: Path) -> float:
    """Return the Unix time, in seconds, at which the clock of the autopilot in a tlog was 0.

    The time follows from the first vehicle state in the tlog of a foreign autopilot. Without a
    state, it is EPOCH_UNIX_S. Raises RecordError if the file cannot be read.
    """
    for unix_s, message in tlog_messages(path):
        if isinstance(message, dialect.MAVLink_local_position_ned_message):
            return unix_s - int(message.time_boot_ms) / 1e3
    return EPOCH_UNIX_S


def tlog_messages(path: Path) -> Iterator[tuple[float, Message]]:
    """Yield the Unix time, in seconds, and the message of each record of a tlog.

    Reading ends at the first damaged record.

    Raises:
        RecordError: The file cannot be read.
    """
    data = read_bounded(path, _LARGEST)
    codec, start = Codec(0, 0), 0
    while (length := frame_length(data, start + 8, len(data))) > 0:
        unix_s = int.from_bytes(data[start : start + 8], "big") / 1e6
        frame = data[start + 8 : start + 8 + length]
        yield from ((unix_s, message) for message in codec.decode(frame, datagram=True))
        if codec.bad_bytes:
            return
        start += 8 + length


class TlogWriter:
    """Writes a .tlog file, which contains MAVLink frames and their times.

    If the process is killed, the file contains only whole records, and at most the last second or
    64 KiB is missing. Records written before `open` are buffered. Records beyond 1 GiB are dropped.
    Every method may raise RecordError.

    Args:
        epoch_unix_s: Unix time of stamp 0.
    """

    def __init__(self, epoch_unix_s: int) -> None:
        self._epoch_us = epoch_unix_s * 1_000_000
        self._pending: list[bytes] = []
        self._pending_bytes = 0
        self._whole = 0  # length of the whole records in the file, bytes
        self._is_full = False
        self._flushed_s = 0.0
        self._descriptor: int | None = None

    def open(self, path: Path) -> None:
        """Open the file for the records. If it exists, it is overwritten."""
        self._path = path
        try:
            self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
        except OSError as error:
            raise self._error(error) from None

    def continue_in(self, path: Path) -> None:
        """Copy the file to `path`, and write further records there.

        For a fork of the process that opened the file.
        """
        try:
            shutil.copyfile(self._path, path)
            if self._descriptor is not None:
                os.close(self._descriptor)
                self._descriptor = os.open(path, os.O_WRONLY | os.O_APPEND)
        except OSError as error:
            raise self._error(error) from None
        self._path = path

    def write(self, stamp_s: float, *frames: bytes) -> None:
        """Record frames at a stamp. At most 1 s or 64 KiB of records wait to be written."""
        time_us = self._epoch_us + round(stamp_s * 1e6)
        records = time_us.to_bytes(8, "big").join([b"", *frames])
        self._pending.append(records)
        self._pending_bytes += len(records)
        overdue = abs(stamp_s - self._flushed_s) >= _FLUSH_INTERVAL_S
        if overdue or self._pending_bytes >= _FLUSH_BYTES:
            self._flushed_s = stamp_s
            self.flush()

    def flush(self) -> None:
        """Write the pending records to the file. Every record is written whole or not at all."""
        if self._descriptor is None:
            return
        data, written = memoryview(b"".join(self._pending)), 0
        self._pending, self._pending_bytes = [], 0
        self._is_full = self._is_full or self._whole + len(data) > _LARGEST
        if self._is_full:
            return
        try:
            while written < len(data):
                written += os.write(self._descriptor, data[written:])
        except OSError as error:
            descriptor, self._descriptor = self._descriptor, None
            with contextlib.suppress(OSError):  # a pipe or device cannot be truncated
                os.ftruncate(descriptor, self._whole)  # a record did not fit on the disk
            os.close(descriptor)
            raise self._error(error) from None
        self._whole += written

    def close(self) -> None:
        """Write the pending records and close the file."""
        self.flush()
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None

    def _error(self, error: OSError) -> RecordError:
        return RecordError(f"{self._path}: cannot write: {error.strerror or error}")


class RecordedLink:
    """One end of a link, which records its traffic in a tlog.

    Traffic before `recording` is buffered and written first.

    Args:
        transport: Open transport. The caller closes it.
        signing: Signs sent frames and rejects received ones without a valid signature.
        clock: Returns the Unix time, in seconds, to record in place of the stamps.
    """

    def __init__(
        self,
        transport: Transport,
        system: int,
        component: int,
        *,
        signing: Signing | None = None,
        clock: Callable[[], float] | None = None,
    ) -> None:
        self._transport = transport
        self._clock = clock
        self._codec = Codec(system, component, signing=signing)
        self._tlog = TlogWriter(EPOCH_UNIX_S if clock is None else 0)

    @contextlib.contextmanager
    def recording(self, path: Path) -> Iterator[None]:
        """Write the tlog to `path` until the context ends.

        Raises RecordError if the file cannot be written, now or at any later message.
        """
        self._tlog.open(path)
        with contextlib.closing(self._tlog):
            yield

    def continue_in(self, path: Path) -> None:
        """Copy the tlog to `path`, and write further records there. For a fork of the process.

        Raises RecordError as `recording` does.
        """
        self._tlog.continue_in(path)

    @property
    def rivals(self) -> str:
        """Error text that names two autopilots that send to this end, or "" if only one does."""
        rival = self._transport.rival_address
        return f"{TWO_AUTOPILOTS}, {self._transport.address} and {rival}" if rival else ""

    def receive(self, timeout_s: float) -> bytes:
        """Return the next bytes to arrive, or b"" if none arrive within `timeout_s` seconds.

        Raises LinkLost if the other end closed the connection.
        """
        return self._transport.receive(timeout_s)

    def messages(self, data: bytes, stamp_s: float) -> list[Message]:
        """Decode received bytes, record their frames at the stamp, and return their messages."""
        messages = self._codec.decode(data, datagram=self._transport.datagram)
        self._record(stamp_s, list(map(frame_of, messages)))
        return messages

    def send(self, messages: Sequence[Message], stamp_s: float) -> None:
        """Send the messages in order and record them at the stamp.

        Raises LinkLost if the other end closed the connection.
        """
        frames = [self._codec.encode(message) for message in messages]
        self._record(stamp_s, frames)
        if self._transport.datagram:
            for frame in frames:
                self._transport.send(frame)
        elif frames:
            self._transport.send(b"".join(frames))

    def _record(self, stamp_s: float, frames: list[bytes]) -> None:
        self._tlog.write(stamp_s if self._clock is None else self._clock(), *frames)
