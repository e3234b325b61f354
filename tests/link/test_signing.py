"""Signing, against pymavlink's own implementation in both directions."""

from __future__ import annotations

import hashlib
from typing import Any

from mavfi_cli.link.codec import (
    EPOCH_UNIX_S,
    UNITS_PER_S,
    Codec,
    Signing,
    dialect,
    key_from_passphrase,
)

KEY = key_from_passphrase("open sesame")
NOW_S = EPOCH_UNIX_S + 3600.0
NOW = 3600 * UNITS_PER_S
PING = dialect.MAVLink_ping_message(1, 2, 3, 4)


class Clock:
    def __init__(self, now_s: float = NOW_S) -> None:
        self.now_s = now_s

    def __call__(self) -> float:
        return self.now_s


def _codec(key: bytes = KEY, clock: Clock | None = None) -> Codec:
    return Codec(1, 1, signing=Signing(key, clock or Clock()))


def _pymavlink(key: bytes = KEY, timestamp: int = NOW, link_id: int = 0) -> Any:
    mav = dialect.MAVLink(None, 7, 9)
    mav.robust_parsing = True
    mav.signing.secret_key = key
    mav.signing.sign_outgoing = True
    mav.signing.timestamp = timestamp
    mav.signing.link_id = link_id
    return mav


def test_the_key_is_the_digest_of_the_passphrase() -> None:
    assert hashlib.sha256(b"open sesame").digest() == KEY


def test_our_frames_are_byte_for_byte_pymavlinks() -> None:
    theirs = _pymavlink()
    theirs.srcSystem = theirs.srcComponent = 1
    ours = _codec()
    for sequence in range(3):
        theirs.seq = sequence
        assert ours.encode(PING) == PING.pack(theirs)


def test_pymavlink_accepts_what_we_sign() -> None:
    ours, theirs = _codec(), _pymavlink()
    for _ in range(3):
        (message,) = theirs.parse_buffer(ours.encode(PING))
        assert message.get_type() == "PING"
        assert message.get_signed()
        assert message.get_link_id() == 0
    assert theirs.signing.goodsig_count == 3


def test_we_accept_what_pymavlink_signs() -> None:
    ours, theirs = _codec(), _pymavlink(link_id=3)
    for _ in range(3):
        (message,) = ours.decode(PING.pack(theirs))
        assert message.get_signed()
        assert message.get_link_id() == 3
    assert ours.refused == 0


def test_another_key_is_refused() -> None:
    ours = _codec()
    assert ours.decode(PING.pack(_pymavlink(key=key_from_passphrase("other")))) == []
    assert ours.refused == 1


def test_a_tampered_signature_is_refused_and_costs_no_other_frame() -> None:
    ours, theirs = _codec(), _pymavlink()
    bad, good = bytearray(PING.pack(theirs)), PING.pack(theirs)
    bad[-1] ^= 1
    assert len(ours.decode(bytes(bad) + good)) == 1
    assert (ours.refused, ours.bad_bytes) == (1, 0)


def test_a_replayed_frame_is_refused() -> None:
    ours, theirs = _codec(), _pymavlink()
    first, second = PING.pack(theirs), PING.pack(theirs)
    assert len(ours.decode(first + second)) == 2
    assert ours.decode(first + second) == []
    assert ours.refused == 2


def test_streams_of_other_senders_have_timestamps_of_their_own() -> None:
    ours, one, other = _codec(), _pymavlink(timestamp=NOW + 50), _pymavlink(timestamp=NOW)
    other.srcComponent = 10
    assert len(ours.decode(PING.pack(one) + PING.pack(other))) == 2


def test_a_new_stream_may_be_a_minute_behind_and_no_more() -> None:
    minute = 60 * UNITS_PER_S
    assert len(_codec().decode(PING.pack(_pymavlink(timestamp=NOW - minute)))) == 1
    assert _codec().decode(PING.pack(_pymavlink(timestamp=NOW - minute - 1))) == []


def test_a_forger_cannot_silence_a_stream() -> None:
    """A wrong signature with a far timestamp must not move what counts as newest."""
    ours = _codec()
    forged = PING.pack(_pymavlink(key=key_from_passphrase("other"), timestamp=2**47))
    assert ours.decode(forged) == []
    assert len(ours.decode(PING.pack(_pymavlink()))) == 1


def test_unsigned_frames_are_refused() -> None:
    plain = Codec(7, 9).encode(PING)
    ours = _codec()
    assert ours.decode(plain) == []
    assert ours.refused == 1


def test_a_radio_has_no_key_and_may_report() -> None:
    report = dialect.MAVLink_radio_status_message(1, 2, 3, 4, 5, 6, 7)
    assert len(_codec().decode(Codec(51, 68).encode(report))) == 1


def test_version_1_frames_carry_no_signature() -> None:
    frame = PING.pack(dialect.MAVLink(None, 7, 9), force_mavlink1=True)
    assert _codec().decode(frame) == []


def test_a_link_without_a_key_hears_signed_frames() -> None:
    (message,) = Codec(1, 1).decode(PING.pack(_pymavlink()))
    assert message.time_usec == 1


def _timestamp(frame: bytes) -> int:
    return int.from_bytes(frame[-12:-6], "little")


def test_timestamps_follow_the_clock_and_never_stand_still() -> None:
    clock = Clock()
    ours = _codec(clock=clock)
    stamps = [_timestamp(ours.encode(PING)) for _ in range(3)]
    clock.now_s += 1.0
    stamps.append(_timestamp(ours.encode(PING)))
    clock.now_s -= 100.0
    stamps.append(_timestamp(ours.encode(PING)))
    later = NOW + UNITS_PER_S
    assert stamps == [NOW, NOW + 1, NOW + 2, later, later + 1]


def test_a_clock_behind_the_peers_catches_up() -> None:
    ours = _codec(clock=Clock(NOW_S - 30.0))
    ours.decode(PING.pack(_pymavlink()))
    assert _timestamp(ours.encode(PING)) >= NOW


def test_a_clock_before_the_epoch_counts_as_the_epoch() -> None:
    assert _timestamp(_codec(clock=Clock(0.0)).encode(PING)) == 0


def test_a_signature_is_vouched_for_without_being_used_up() -> None:
    ours = Signing(KEY, Clock())
    frame = PING.pack(_pymavlink())
    assert ours.authenticates(frame)
    assert ours.authenticates(frame)
    assert len(Codec(1, 1, signing=ours).decode(frame)) == 1
    assert not ours.authenticates(frame)  # a replay
    tampered = bytearray(PING.pack(_pymavlink(timestamp=NOW + 9)))
    tampered[12] ^= 1
    for data in (
        b"", b"\xfd", frame[:-1], bytes(tampered), Codec(1, 1).encode(PING),
        PING.pack(_pymavlink(key=key_from_passphrase("other"))),
    ):  # fmt: skip
        assert not ours.authenticates(data)
