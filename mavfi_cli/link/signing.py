"""MAVLink 2 packet signing with a clock supplied by the caller.

Source: https://mavlink.io/en/guide/message_signing.html. A signature block is a link id (1 byte),
a timestamp (6 bytes, 10 us units since 2015-01-01 UTC) and the first 6 bytes of
SHA-256(key + frame + link id + timestamp).
"""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Callable

SIGNATURE_LENGTH = 13  # bytes: link id, timestamp, truncated digest
EPOCH_UNIX_S = 1_420_070_400  # 2015-01-01 UTC, start of signing time
UNITS_PER_S = 100_000  # one unit is 10 us
NEW_STREAM_SLACK = 60 * UNITS_PER_S  # maximum lag of a new stream's timestamp

_TIMESTAMP_END = 2**48
_RADIO_STATUS = 109  # sent by telemetry radios, which hold no key; the guide says to accept it


def key_from_passphrase(passphrase: str) -> bytes:
    """Return the 32-byte key of a passphrase, its SHA-256, as ground stations compute it."""
    return hashlib.sha256(passphrase.encode()).digest()


class Signing:
    """Key, outgoing timestamp, and the newest timestamp of every received stream.

    Args:
        key: 32 secret bytes, see `key_from_passphrase`.
        clock: Function of seconds since 1970 (`time.time`, or a fixed epoch plus simulated time).
        link_id: Id of this channel among those of the sender, 0..255.
        accept_unsigned: Accept frames without a signature. Wrong signatures are always rejected.

    Raises:
        ValueError: The key does not have 32 bytes, or the link id is out of range.
    """

    def __init__(
        self,
        key: bytes,
        clock: Callable[[], float],
        *,
        link_id: int = 0,
        accept_unsigned: bool = False,
    ) -> None:
        if len(key) != 32:
            raise ValueError(f"a signing key has 32 bytes, not {len(key)}")
        if not 0 <= link_id <= 255:
            raise ValueError(f"a signing link id lies in 0..255, not {link_id}")
        self._key = key
        self._clock = clock
        self._link_id = link_id
        self._accept_unsigned = accept_unsigned
        self._next_timestamp = 0
        self._streams: dict[tuple[int, int, int], int] = {}

    def sign(self, frame: bytes) -> bytes:
        """Return the 13-byte signature block of a frame (header to CRC, signed flag set)."""
        timestamp = max(self._now(), self._next_timestamp) % _TIMESTAMP_END
        self._next_timestamp = timestamp + 1
        block = bytes([self._link_id]) + timestamp.to_bytes(6, "little")
        return block + self._digest(frame + block)

    def accept_plain(self, message_id: int) -> bool:
        """Return True if a frame without signature is accepted."""
        return self._accept_unsigned or message_id == _RADIO_STATUS

    def accept(self, frame: bytes, system: int, component: int) -> bool:
        """Return True if a signed frame is authentic and not a replay.

        Only authentic frames update the timestamps, so an attacker cannot block a stream.
        """
        if not hmac.compare_digest(self._digest(frame[:-6]), frame[-6:]):
            return False
        timestamp = int.from_bytes(frame[-12:-6], "little")
        stream = (frame[-13], system, component)
        newest = self._streams.get(stream)
        if newest is None:
            if timestamp + NEW_STREAM_SLACK < max(self._now(), self._next_timestamp):
                return False
        elif timestamp <= newest:
            return False
        self._streams[stream] = timestamp
        self._next_timestamp = max(self._next_timestamp, timestamp)
        return True

    def _now(self) -> int:
        return max(0, int((self._clock() - EPOCH_UNIX_S) * UNITS_PER_S))

    def _digest(self, data: bytes) -> bytes:
        return hashlib.sha256(self._key + data).digest()[:6]
