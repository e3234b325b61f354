"""The place of the one autopilot at an endpoint."""

import pytest

from mavfi_cli.link.endpoint import SILENCE_S, SenderSlot


@pytest.fixture
def now_s():
    return [0.0]


@pytest.fixture
def slot(now_s):
    slot = SenderSlot(lambda: now_s[0])
    slot.take("first")
    return slot


def test_only_the_holder_is_heard_until_it_has_been_silent(slot, now_s):
    now_s[0] = SILENCE_S - 0.1
    assert not slot.is_free
    assert not slot.refresh("second")
    assert slot.refresh("first")
    now_s[0] = 2 * SILENCE_S - 0.1
    assert slot.is_free
    slot.take("second")
    assert slot.refresh("second")
    assert not slot.refresh("first")


def test_a_rival_is_a_sender_whom_the_holder_outlives(slot):
    slot.challenge("second")
    assert slot.rival is None
    slot.refresh("first")
    assert slot.rival == "second"


def test_a_sender_that_has_taken_the_place_is_no_rival(slot, now_s):
    slot.challenge("second")
    now_s[0] = SILENCE_S
    slot.take("second")
    slot.refresh("second")
    assert slot.rival is None


def test_a_holder_that_leaves_frees_its_place_only(slot):
    slot.leave("second")
    assert not slot.is_free
    slot.leave("first")
    assert slot.is_free
