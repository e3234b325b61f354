"""Option types, options and signal handling shared by the programs on the vehicle's side."""

from __future__ import annotations

import functools
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from mavfi_cli.core.option_types import Number, Place

CONTEXT = {"help_option_names": ["-h", "--help"], "show_default": True}


class _Size(click.ParamType[tuple[int, int]]):
    """Option type for the columns and rows of an image, such as 64x48."""

    name = "COLSxROWS"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[int, int]:
        if isinstance(value, tuple):
            return value
        columns, _, rows = str(value).partition("x")
        if not (columns.isdecimal() and rows.isdecimal() and int(columns) and int(rows)):
            self.fail(f"must be columns x rows, such as 64x48, got {value!r}", param, ctx)
        return int(columns), int(rows)


POSITIVE = Number(1.0e-6, 1.0e6)
Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]


def _options(*options: Decorator) -> Decorator:
    """Return one decorator that adds several options in the given order."""
    return lambda command: functools.reduce(lambda f, option: option(f), options[::-1], command)


def complete_world(_ctx: click.Context, _param: click.Parameter, incomplete: str) -> list[str]:
    """Return the world names that start with `incomplete`, for shell completion."""
    from sitl.world.world import named_worlds

    return [name for name in named_worlds() if name.startswith(incomplete)]


places = _options(
    click.option("--seed", type=click.IntRange(min=0), default=3, help="Seed of the world."),
    click.option("--start", "start_enu_m", type=Place(), help="Start, ENU m. See --goal."),
    click.option(
        "--goal", "goal_enu_m", type=Place(),
        help="Goal, ENU m. A generated world is built around start and goal: other positions move "
        "its bounds, and towers within 3 m of them are left out.",
    ),
)  # fmt: skip
world_and_vehicle = _options(
    click.option(
        "--world", default="dense", metavar="NAME|FILE",
        help="World: a name of `mavfi world list`, gen:density,size or a TOML file.",
    ),
    places,
    click.option(
        "--vehicle", default="solo", metavar="NAME|FILE", help="Vehicle: a name or a TOML file."
    ),
)  # fmt: skip


def camera_options(prefix: str = "") -> Decorator:
    """Return a decorator that adds the depth camera's options to a command.

    `prefix` is put in front of the option names `size` and `rate`.
    """
    return _options(
        click.option(
            f"--{prefix}size", "camera_size", type=_Size(), default="64x48",
            help="Size of the depth image, pixels.",
        ),
        click.option(
            f"--{prefix}rate", "camera_rate_hz", type=POSITIVE, default=10.0,
            help="Frame rate for clients that request no interval, Hz.",
        ),
        click.option(
            "--camera-heartbeat", "camera_heartbeat_hz", type=click.FloatRange(0.0, 50.0),
            default=1.0,
            help="Rate of the camera's heartbeats, Hz. 0 turns them off for MAVProxy, which "
            "mistakes the camera for a second vehicle.",
        ),
        click.option(
            "--depth", type=click.Path(path_type=Path), metavar="SOCKET",
            help="Unix domain socket to make, which sends depth frames as arrays to every reader.",
        ),
    )  # fmt: skip


signing = _options(
    click.option(
        "--key-file", type=click.Path(path_type=Path), metavar="FILE",
        help="File with the signing passphrase.",
    ),
    click.option(
        "--allow-unsigned", is_flag=True, help="Allow unsigned links beyond this machine."
    ),
)  # fmt: skip


def stop_on_signals() -> Callable[[], bool]:
    """Catch SIGINT and SIGTERM instead of ending the process.

    Return a function that returns True once either signal has arrived.
    """
    received: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda signum, _frame: received.append(signum))
    return lambda: bool(received)
