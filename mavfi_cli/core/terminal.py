"""Prints the output of commands, and converts errors to messages and exit codes.

Printed text cannot control the terminal.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterable
from typing import NoReturn

import click

from mavfi_cli.core.errors import Interrupted, MavfiError, described, nearest, printable


def cleaned(text: str) -> str:
    """Return a copy of `text` in which every control character except a newline is replaced."""
    return "\n".join(map(printable, text.split("\n")))


def echo(text: str, *, nl: bool = True) -> None:
    """Print text to stdout, without characters that could control the terminal.

    Raises:
        OSError: Stdout cannot be written.
    """
    click.echo(cleaned(text), nl=nl)


def echo_lines(lines: Iterable[str]) -> None:
    """Print lines to stdout, without characters that could control the terminal.

    A newline within a line is replaced, too.

    Raises:
        OSError: Stdout cannot be written.
    """
    click.echo("\n".join(map(printable, lines)))


def note(text: str) -> None:
    """Print text to stderr, without characters that could control the terminal."""
    click.echo(cleaned(text), err=True)


def exit_code(program: Callable[[], object]) -> int:
    """Run `program` and return the exit code for this process.

    Known errors, usage errors (code 2) and failures to write output are each printed in one line.
    Ctrl-C gives the code 130.

    Args:
        program: Calls click's `main` in non-standalone mode and returns its result.
    """
    gc.set_threshold(100_000)  # imports leave few cycles, so frequent collections waste time
    try:
        code = program()
    except click.exceptions.Exit as left:
        return left.exit_code
    except click.exceptions.NoArgsIsHelpError as error:
        note(error.format_message())
        return error.exit_code
    except click.ClickException as error:
        unknown = isinstance(error, click.NoSuchOption) and _no_such_option(error)
        note_error(unknown or error.format_message())
        return error.exit_code
    except (Interrupted, KeyboardInterrupt, click.Abort) as error:
        note(str(error) or "interrupted")
        return 128 + signal.SIGINT
    except MavfiError as error:
        note_error(error)
        return error.exit_code
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # or flushing stdout at exit would fail again
        if not isinstance(error, BrokenPipeError):
            place = "" if error.filename is None else f"{error.filename}: "
            note_error(f"{place}{error.strerror or described(error)}")
        return 1
    return code if isinstance(code, int) else 0


def leave(code: int) -> NoReturn:
    """End this process with an exit code, as `sys.exit` does, but without freeing all objects.

    Freeing them takes about a second.
    """
    threading._shutdown()  # type: ignore[attr-defined]
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError):
            stream.flush()
    os._exit(code)


def _no_such_option(error: click.NoSuchOption) -> str:
    params = error.ctx.command.params if error.ctx is not None else []
    known = [name.lstrip("-") for param in params for name in param.opts]
    match = nearest(error.option_name.lstrip("-"), known)
    hint = f"; did you mean '--{match}'?" if match else ""
    return f"no such option {error.option_name!r}{hint}"


def note_error(problem: object) -> None:
    """Print `error: ` and the text of `problem` to stderr, in one line."""
    note("error: " + " ".join(str(problem).splitlines()))
