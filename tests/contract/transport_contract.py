"""The contract of transports: the tests that each of them passes."""

from __future__ import annotations

import pytest

from mavfi_cli.core.errors import LinkLost
from mavfi_cli.link.codec import Codec, dialect
from mavfi_cli.link.transport import Transport

Pair = tuple[Transport, Transport]
WAIT_S = 5.0


class TransportContract:
    """The tests that every transport must pass. Subclass it to test a transport.

    The subclass needs a fixture `pair` that yields the two ends of a connection and closes them
    afterwards. The second end is the one that opens the connection.
    """

    @staticmethod
    def message(number: int) -> object:
        """Return a MAVLink message that contains `number`, so that its receiver can identify it."""
        return dialect.MAVLink_local_position_ned_message(number, 1.0, 2.0, 3.0, 0.0, 0.0, 0.0)

    @staticmethod
    def send(transport: Transport, codec: Codec, numbers: range) -> None:
        """Encode one message per number, and send all of them in one batch."""
        messages = map(TransportContract.message, numbers)
        transport.send(b"".join(map(codec.encode, messages)))

    @staticmethod
    def receive(transport: Transport, count: int) -> list[int]:
        """Receive messages until at least `count` have arrived, and return their numbers."""
        codec = Codec(7, 7)
        numbers: list[int] = []
        while len(numbers) < count:
            data = transport.receive(WAIT_S)
            assert data, f"only {numbers} arrived"
            numbers += [m.time_boot_ms for m in codec.decode(data, datagram=transport.datagram)]
        assert codec.bad_bytes == 0
        return numbers

    @staticmethod
    def introduce(near: Transport, far: Transport) -> None:
        """Send a message from the second end to the first, so that the first learns its address."""
        TransportContract.send(far, Codec(2, 2), range(1))
        assert TransportContract.receive(near, 1) == [0]

    def test_messages_arrive_in_both_directions_whole_and_in_order(self, pair: Pair) -> None:
        near, far = pair
        self.introduce(near, far)
        self.send(near, Codec(1, 1), range(5))
        assert self.receive(far, 5) == list(range(5))
        self.send(far, Codec(2, 2), range(5, 10))
        assert self.receive(near, 5) == list(range(5, 10))

    def test_a_batch_larger_than_a_packet_arrives_whole(self, pair: Pair) -> None:
        near, far = pair
        self.introduce(near, far)
        self.send(near, Codec(1, 1), range(80))  # 3200 bytes, more than two Ethernet packets
        assert self.receive(far, 80) == list(range(80))

    def test_nothing_to_receive_gives_no_bytes(self, pair: Pair) -> None:
        near, far = pair
        self.introduce(near, far)
        for timeout_s in (0.0, 0.01):
            assert near.receive(timeout_s) == b""
            assert far.receive(timeout_s) == b""

    def test_closing_twice_is_harmless(self, pair: Pair) -> None:
        for transport in pair:
            transport.close()
            transport.close()


class StreamTransportContract(TransportContract):
    """The tests for transports in which an end notices that the other has closed, such as TCP."""

    def test_a_closed_stream_is_a_lost_link_at_the_other_end(self, pair: Pair) -> None:
        near, far = pair
        self.introduce(near, far)
        self.send(far, Codec(2, 2), range(3))
        far.close()
        assert self.receive(near, 3) == [0, 1, 2]  # data sent before the close still arrives
        with pytest.raises(LinkLost):
            near.receive(WAIT_S)
