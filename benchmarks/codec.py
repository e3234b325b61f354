"""Measures the time to encode and decode the messages of a tick, by our codec and pymavlink's.

Run: python benchmarks/codec.py
"""

from __future__ import annotations

import timeit
from collections.abc import Callable

from mavfi_cli.link.codec import Codec, Message, dialect

REPEATS = 2000


def _messages() -> list[Message]:
    return [
        dialect.MAVLink_local_position_ned_message(20, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0),
        dialect.MAVLink_attitude_quaternion_message(20, 1.0, 0.0, 0.0, 0.0, 0.1, 0.1, 0.1),
        dialect.MAVLink_set_position_target_local_ned_message(
            20, 1, 1, 1, 2055, 0, 0, 0, 1.0, 2.0, 3.0, 0.1, 0.2, 0.3, 0.4, 0.0
        ),
        dialect.MAVLink_encapsulated_data_message(3, [(7 * i + 1) % 256 for i in range(253)]),
    ]


def _microseconds(call: Callable[[], object]) -> float:
    return min(timeit.repeat(call, number=REPEATS, repeat=5)) / REPEATS * 1e6


def main() -> None:
    """Print one line per message, with the four times in microseconds."""
    print(f"{'us per message':<32}{'encode':>9}{'decode':>9}{'pymavlink':>11}{'pymavlink':>11}")
    for message in _messages():
        ours, theirs = Codec(1, 1), dialect.MAVLink(None, 1, 1)
        frame = ours.encode(message)
        row = [
            _microseconds(lambda o=ours, m=message: o.encode(m)),
            _microseconds(lambda o=ours, f=frame: o.decode(f)),
            _microseconds(lambda t=theirs, m=message: m.pack(t)),
            _microseconds(lambda t=theirs, f=frame: t.parse_buffer(f)),
        ]
        cells = "".join(f"{value:>{9 if i < 2 else 11}.2f}" for i, value in enumerate(row))
        print(f"{message.get_type():<32}{cells}")


if __name__ == "__main__":
    main()
