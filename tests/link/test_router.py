"""The router: frames pass unchanged, known or not, and an owner may replace them."""

import contextlib
import socket
import time

import pytest

from mavfi_cli.core.errors import LinkLost
from mavfi_cli.link.codec import Codec, Signing, dialect, frame_of
from mavfi_cli.link.router import Router, Side
from mavfi_cli.link.transport import open_transport

VEHICLE, PROGRAM = Codec(1, 1), Codec(245, 190)
HEARTBEAT = dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3)


def unlisted(codec):
    """The frame of a message with an id that the dialect lacks."""
    frame = bytearray(codec.encode(HEARTBEAT))
    frame[7:10] = (60_123).to_bytes(3, "little")
    frame[-2:] = dialect.mcrf4xx(bytes(frame[1:-2]) + b"\x2a").to_bytes(2, "little")
    return bytes(frame)


@pytest.fixture
def scene():
    """A function that opens a router; it returns router, the autopilot's end, and callers."""
    with contextlib.ExitStack() as stack:

        def open_router(programs=1, **options):
            ours, theirs = socket.socketpair()
            autopilot = stack.enter_context(
                contextlib.closing(open_transport(f"fd:{theirs.detach()}"))
            )
            router = Router(f"fd:{ours.detach()}", "udpin:127.0.0.1:0", **options)
            stack.callback(router.close)
            url = f"udpout:127.0.0.1:{router.port}"
            callers = [
                stack.enter_context(contextlib.closing(open_transport(url)))
                for _ in range(programs)
            ]
            return router, autopilot, callers

        yield open_router


def run(router, turns=4):
    for _ in range(turns):
        router.turn(0.05, time.monotonic() + 0.05)


def test_frames_of_either_side_reach_the_other_unchanged(scene):
    router, autopilot, (program,) = scene()
    sent = PROGRAM.encode(HEARTBEAT) + unlisted(PROGRAM)
    program.send(sent)
    run(router)
    assert autopilot.receive(1.0) == sent
    answer = unlisted(VEHICLE) + VEHICLE.encode(HEARTBEAT)
    autopilot.send(answer)
    run(router)
    received = program.receive(1.0)
    received += program.receive(1.0) if len(received) < len(answer) else b""
    assert received == answer


def test_programs_of_a_companion_hear_each_other_but_not_themselves(scene):
    router, _, (one, other) = scene(programs=2)
    for program in (one, other):
        program.send(PROGRAM.encode(HEARTBEAT))
        run(router, 2)
    one.receive(0.0)
    other.receive(0.0)
    frame = PROGRAM.encode(HEARTBEAT)
    one.send(frame)
    run(router)
    assert other.receive(1.0) == frame
    assert one.receive(0.0) == b""


def test_a_message_that_was_held_back_does_not_return_to_its_sender(scene):
    held = []
    router, autopilot, (one, other) = scene(
        programs=2, passes=lambda message, _: held.append(message) or ()
    )
    for program, codec in ((one, PROGRAM), (other, Codec(246, 190))):
        program.send(codec.encode(HEARTBEAT))
        run(router, 2)
    late = held[0]
    router.send_late(frame_of(late), Side.COMPANION, late)
    assert other.receive(1.0) == autopilot.receive(1.0) == frame_of(late)
    assert one.receive(0.0) == b""


def test_the_owner_decides_what_goes_on(scene):
    seen = []

    def passes(message, side):
        seen.append((message.get_type(), side))
        return [] if side is Side.COMPANION else [frame_of(message)] * 2

    router, autopilot, (program,) = scene(passes=passes)
    program.send(PROGRAM.encode(HEARTBEAT))
    run(router)
    assert autopilot.receive(0.0) == b""
    frame = VEHICLE.encode(HEARTBEAT)
    autopilot.send(frame)
    run(router)
    assert program.receive(1.0) + program.receive(1.0) == 2 * frame
    assert seen == [("HEARTBEAT", Side.COMPANION), ("HEARTBEAT", Side.AUTOPILOT)]


def test_the_owner_tells_programs_with_the_same_ids_apart(scene):
    senders = []
    router, _, programs = scene(programs=2, passes=lambda *_: senders.append(router.sender) or ())
    for program in (*programs, *programs):
        program.send(PROGRAM.encode(HEARTBEAT))
        run(router, 2)
    one, other = senders[:2]
    assert one is not other
    assert senders == [one, other, one, other]
    assert router.sender is None


def test_a_closed_autopilot_ends_the_router(scene):
    router, autopilot, _ = scene()
    run(router, 1)
    autopilot.close()
    with pytest.raises(LinkLost):
        run(router)


def test_a_frame_that_the_dialect_lacks_still_needs_its_signature():
    key = b"k" * 32
    signed = Codec(0, 0, signing=Signing(key, lambda: 1.6e9), keeps_unknown=True)
    assert signed.decode(unlisted(PROGRAM), datagram=True) == []
    assert signed.refused == 1
    frame = unlisted(PROGRAM)
    (message,) = Codec(0, 0, keeps_unknown=True).decode(frame, datagram=True)
    assert frame_of(message) == frame
    assert (message.get_srcSystem(), message.get_type()) == (245, "UNKNOWN_60123")
    assert Codec(0, 0).decode(frame, datagram=True) == []
