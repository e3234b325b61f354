"""What commands print, and how they end."""

import click
import pytest

from mavfi_cli.core.errors import Interrupted, RecordError
from mavfi_cli.core.terminal import echo, echo_lines, exit_code, note, note_error


@pytest.mark.parametrize(
    ("given", "printed"),
    [
        ("one\ntwo", "one\ntwo\n"),
        ("a\x1b[2Jb\r\x85\u2028c", "a\ufffd[2Jb\ufffd\ufffd\ufffdc\n"),
        ("caf\udce9", "caf\ufffd\n"),
    ],
)
def test_control_characters_are_replaced(capfd, given, printed):
    echo(given)
    note(given)
    assert capfd.readouterr() == (printed, printed)


def test_a_newline_within_a_line_is_replaced(capfd):
    echo_lines(["one", "two\nthree"])
    assert capfd.readouterr().out == "one\ntwo\ufffdthree\n"


def test_an_error_is_one_line(capfd):
    note_error("one\ntwo\u2028three")
    assert capfd.readouterr().err == "error: one two three\n"


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (click.exceptions.Exit(7), 7, ""),
        (click.UsageError("what"), 2, "error: what\n"),
        (RecordError("what"), 1, "error: what\n"),
        (Interrupted("what"), 130, "what\n"),
        (KeyboardInterrupt(), 130, "interrupted\n"),
        (click.Abort(), 130, "interrupted\n"),
    ],
)
def test_the_end_of_a_command(capfd, error, code, said):
    def program():
        raise error

    assert exit_code(program) == code
    assert capfd.readouterr().err == said
