"""What every transport must do: a pair of connected ends carries MAVLink both ways."""

from __future__ import annotations

import pytest

from mavfi_cli.core.errors import LinkLost
from mavfi_cli.link.codec import Codec, dialect
from mavfi_cli.link.transport import Transport

Pair = tuple[Transport, Transport]
WAIT_S = 5.0


def message(number: int) -> object:
    """Return a MAVLink message that carries a number."""
    return dialect.MAVLink_local_position_ned_message(number, 1.0, 2.0, 3.0, 0.0, 0.0, 0.0)


def send(transport: Transport, codec: Codec, numbers: range) -> None:
    """Send one message per number in one batch."""
    transport.send(b"".join(codec.encode(message(number)) for number in numbers))


def receive(transport: Transport, count: int) -> list[int]:
    """Receive messages until there are `count`; return their numbers."""
    codec = Codec(7, 7)
    numbers: list[int] = []
    while len(numbers) < count:
        data = transport.receive(WAIT_S)
        assert data, f"only {numbers} came"
        numbers += [m.time_boot_ms for m in codec.decode(data, datagram=transport.datagram)]
    assert codec.bad_bytes == 0
    return numbers


def introduce(near: Transport, far: Transport) -> None:
    """Let the caller speak first, so that a listening end knows it."""
    send(far, Codec(2, 2), range(1))
    assert receive(near, 1) == [0]


class TransportContract:
    """The suite that every transport passes.

    A subclass has a fixture `pair` that yields two connected ends and closes them afterwards. The
    second end is the one that calls.
    """

    def test_messages_arrive_in_both_directions_whole_and_in_order(self, pair: Pair) -> None:
        near, far = pair
        introduce(near, far)
        send(near, Codec(1, 1), range(5))
        assert receive(far, 5) == list(range(5))
        send(far, Codec(2, 2), range(5, 10))
        assert receive(near, 5) == list(range(5, 10))

    def test_a_batch_larger_than_a_packet_arrives_whole(self, pair: Pair) -> None:
        near, far = pair
        introduce(near, far)
        send(near, Codec(1, 1), range(80))  # 3200 bytes, more than two Ethernet packets
        assert receive(far, 80) == list(range(80))

    def test_nothing_to_receive_gives_no_bytes(self, pair: Pair) -> None:
        near, far = pair
        introduce(near, far)
        for timeout_s in (0.0, 0.01):
            assert near.receive(timeout_s) == b""
            assert far.receive(timeout_s) == b""

    def test_closing_twice_is_harmless(self, pair: Pair) -> None:
        for transport in pair:
            transport.close()
            transport.close()


class StreamTransportContract(TransportContract):
    """The suite that every transport passes whose other end learns that it was closed, as TCP."""

    def test_a_closed_stream_is_a_lost_link_at_the_other_end(self, pair: Pair) -> None:
        near, far = pair
        introduce(near, far)
        send(far, Codec(2, 2), range(3))
        far.close()
        assert receive(near, 3) == [0, 1, 2]  # what was sent before still arrives
        with pytest.raises(LinkLost):
            near.receive(WAIT_S)
