from __future__ import annotations

import struct
import subprocess
import sys

import pytest

from mavfi_cli.link.codec import Codec, dialect


def test_the_sequence_counts_up_and_wraps() -> None:
    codec = Codec(1, 191)
    ping = dialect.MAVLink_ping_message(0, 0, 0, 0)
    numbers = [codec.encode(ping)[4] for _ in range(258)]
    assert numbers == [*range(256), 0, 1]


def test_encoding_leaves_the_message_alone() -> None:
    message = dialect.MAVLink_statustext_message(6, b"hello")
    before = dict(vars(message))
    assert Codec(1, 1).encode(message) != Codec(2, 1).encode(message)
    assert vars(message) == before


def test_a_value_that_does_not_fit_is_the_senders_error() -> None:
    with pytest.raises(struct.error):
        Codec(1, 1).encode(dialect.MAVLink_ping_message(-1, 0, 0, 0))


def test_a_message_of_another_dialect_is_the_senders_error() -> None:
    class Foreign:
        id = 77_777

    with pytest.raises(ValueError, match="Foreign is not a message"):
        Codec(1, 1).encode(Foreign())


def test_a_frame_with_unknown_flags_is_not_taken() -> None:
    frame = bytearray(Codec(1, 1).encode(dialect.MAVLink_ping_message(1, 0, 0, 0)))
    frame[2] = 0x02
    codec = Codec(1, 1)
    assert codec.decode(bytes(frame), datagram=True) == []
    assert codec.bad_bytes == len(frame)


def test_importing_the_link_pulls_in_nothing_heavy() -> None:
    program = (
        "import sys, mavfi_cli.link.transport, mavfi_cli.link.codec\n"
        "heavy = {'numpy', 'numba', 'serial', 'pymavlink.mavutil', 'lxml'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout.strip() == "[]", done.stderr
