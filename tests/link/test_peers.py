"""Peers at endpoints: by turns, within a budget, and forgotten after silence."""

import contextlib
import select

import pytest

from mavfi_cli.core.errors import LinkLost
from mavfi_cli.link.codec import Codec, dialect
from mavfi_cli.link.peers import Peer, Peers
from mavfi_cli.link.transport import MAX_PEERS, open_transport

FRAME = Codec(9, 190).encode(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3))


class Heard(Peer):
    """Keeps what it is given; valid is what begins as a frame."""

    def __init__(self, transport):
        super().__init__(transport)
        self.taken = []

    def take(self, data):
        self.taken.append(data)
        return [data] if data[:1] == b"\xfd" else []


@pytest.fixture
def scene():
    """Peers on a UDP port, a function that makes callers, and the clock."""
    now = [0.0]
    with contextlib.ExitStack() as stack:
        peers = stack.enter_context(contextlib.closing(Peers(clock=lambda: now[0])))
        peers.open("udpin:127.0.0.1:0", Heard)
        url = f"udpout:127.0.0.1:{peers._endpoints[0][1].port}"

        def call():
            return stack.enter_context(contextlib.closing(open_transport(url)))

        yield peers, call, now


def say(caller, data=FRAME):
    caller.send(data)
    caller.send(b"")  # an empty datagram is nothing that anybody handles


def test_a_udp_peer_without_a_valid_frame_is_forgotten(scene):
    peers, call, now = scene
    talker, silent = call(), call()
    for caller in (talker, silent):
        say(caller)
    peers.serve(1.0)
    assert len(list(peers)) == 2
    for now[0] in (20.0, 31.0):
        say(talker)
        say(silent, b"no frame")
        peers.serve(now[0] + 1.0)
    assert [peer.taken[-1] for peer in peers] == [FRAME]


def test_peers_are_heard_by_turns_and_no_longer_than_the_budget(scene):
    peers, call, now = scene
    flooder, other = call(), call()
    for caller in (flooder, other):
        say(caller)
    peers.serve(1.0)
    for _ in range(100):
        flooder.send(FRAME)
    other.send(FRAME)
    order = []

    def taking(name):
        def take(data):
            order.append(name)
            now[0] += 0.1  # handling takes time
            return [data]

        return take

    for name, peer in zip(("flooder", "other"), peers, strict=True):
        peer.take = taking(name)
    peers.serve(now[0] + 1.0)
    assert order[:3].count("other") == 1
    assert 9 <= len(order) <= 11


def send_for(peers, now, duration_s, times):
    """Send to all at 50 Hz from now on; adds the times at which each peer was sent to."""
    begun_s = now[0]
    for tick in range(round(duration_s * 50)):
        now[0] = begun_s + tick / 50
        peers.serve(now[0])
        peers.send_in_turn(lambda peer: times.setdefault(peer, []).append(now[0]))


def test_a_sender_whose_address_may_be_false_is_sent_little(scene):
    peers, call, now = scene
    say(call())
    peers.serve(1.0)
    sent = {}
    send_for(peers, now, 40.0, sent)
    ((newcomer, times),) = sent.items()
    later = [time_s for time_s in times if time_s > 0.21]
    assert len(times) - len(later) == 11
    assert later == pytest.approx([0.4, 0.8, 1.6, 3.2, 6.4, 12.8, 25.6], abs=0.5)
    assert newcomer not in list(peers)


def test_a_peer_that_goes_on_speaking_is_sent_everything(scene):
    peers, call, now = scene
    talker, sent = call(), {}
    for _ in range(6):
        say(talker)
        peers.serve(now[0] + 1.0)
        send_for(peers, now, 3.0, sent)
    (times,) = sent.values()
    assert len(times) > 5 * 150


def test_peers_are_sent_to_in_turn_and_no_longer_than_the_budget(scene):
    peers, call, now = scene
    for _ in range(5):
        say(call())
    peers.serve(1.0)
    order = []

    def sending(peer):
        order.append(peer)
        now[0] += 0.01

    for _ in range(5):
        peers.send_in_turn(sending, now[0] + 0.015)
    assert len(order) == 10
    assert {order.count(peer) for peer in peers} == {2}


def test_a_turn_in_which_there_was_nothing_to_send_is_none(scene):
    peers, call, now = scene
    say(call())
    peers.serve(1.0)
    now[0] = 10.0
    calls = []
    for _ in range(3):
        peers.send_in_turn(lambda peer: calls.append(peer) or False)
    assert len(calls) == 3


def test_an_endpoint_bounds_its_peers(scene):
    peers, call, _ = scene
    for _ in range(MAX_PEERS + 4):
        say(call())
        peers.serve(1.0)
    assert len(list(peers)) == MAX_PEERS


@pytest.mark.parametrize("scheme", ["tcpin", "tcp"])
def test_a_lost_peer_leaves_and_only_that_of_a_calling_endpoint_is_reported(scheme):
    with contextlib.ExitStack() as stack:
        peers = stack.enter_context(contextlib.closing(Peers()))
        if scheme == "tcp":
            far = stack.enter_context(contextlib.closing(open_transport("tcpin:127.0.0.1:0")))
            peers.open(f"tcp:127.0.0.1:{far.port}", Heard)
        else:
            peers.open("tcpin:127.0.0.1:0", Heard)
            port = peers._endpoints[0][1].port
            far = stack.enter_context(contextlib.closing(open_transport(f"tcp:127.0.0.1:{port}")))
            assert select.select([peers._endpoints[0][1].fileno()], [], [], 5.0)[0]
        peers.serve(float("inf"))
        far.send(FRAME)
        assert len(list(peers)) == 1
        far.receive(0.0)
        far.close()
        peers.wait(5.0)
        for _ in range(3):
            peers.serve(float("inf"))
        assert list(peers) == []
        assert isinstance(peers.lost, LinkLost) == (scheme == "tcp")
        assert not peers.over
