import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavfi_cli.link.codec import Codec, dialect, text_messages
from mavfi_cli.link.telemetry import Telemetry

printable = st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=200)


@given(printable)
def test_chunks_put_together_are_the_text_and_a_tab(text):
    sender, receiver = Codec(1, 1), Codec(2, 2)
    messages = [
        receiver.decode(sender.encode(m))[0] for m in text_messages(4, text.encode() + b"\t", 7)
    ]
    assert "".join(m.text for m in messages) == text + "\t"
    assert [m.chunk_seq for m in messages] == list(range(len(messages)))
    assert {m.id for m in messages} == ({0} if len(messages) == 1 else {7})
    assert all(len(m.text) == 50 for m in messages[:-1])
    assert len(messages) == 1 or len(messages[-1].text) < 50


@pytest.mark.parametrize("length", [48, 49, 50, 99, 100])
def test_around_the_chunk_length(length):
    messages = list(text_messages(6, b"x" * length + b"\t", 1))
    assert len(messages) == (1 if length + 1 <= 50 else (length + 1) // 50 + 1)


def collected(numbers: list[int], length: int = 50) -> str:
    """The text that chunks with these numbers become a second later."""
    texts, sender, receiver = Telemetry().texts, Codec(1, 1), Codec(2, 2)
    for number in numbers:
        chunk = dialect.MAVLink_statustext_message(4, b"x" * length, 7, number)
        texts.add(receiver.decode(sender.encode(chunk))[0], 0.0)
    (text,) = texts.expire(1.0)
    return text.text


def test_missing_chunks_leave_one_gap():
    assert collected([1, 255], length=2) == "[...]xx[...]xx"


def test_a_text_is_bounded():
    assert len(collected([*range(256)])) == 1000
