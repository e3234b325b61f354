"""The place of the one autopilot at an endpoint."""

import pytest

from mavfi_cli.link.seat import SILENCE_S, Seat


@pytest.fixture
def now_s():
    return [0.0]


@pytest.fixture
def seat(now_s):
    seat = Seat(lambda: now_s[0])
    seat.take("first")
    return seat


def test_only_the_holder_is_heard_until_it_has_been_silent(seat, now_s):
    now_s[0] = SILENCE_S - 0.1
    assert not seat.is_free
    assert not seat.hears("second")
    assert seat.hears("first")
    now_s[0] = 2 * SILENCE_S - 0.1
    assert seat.is_free
    seat.take("second")
    assert seat.hears("second")
    assert not seat.hears("first")


def test_a_rival_is_a_sender_whom_the_holder_outlives(seat):
    seat.challenge("second")
    assert seat.rival is None
    seat.hears("first")
    assert seat.rival == "second"


def test_a_sender_that_has_taken_the_place_is_no_rival(seat, now_s):
    seat.challenge("second")
    now_s[0] = SILENCE_S
    seat.take("second")
    seat.hears("second")
    assert seat.rival is None


def test_a_holder_that_leaves_frees_its_place_only(seat):
    seat.leave("second")
    assert not seat.is_free
    seat.leave("first")
    assert seat.is_free
