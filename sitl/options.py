"""The command line of `python -m sitl`."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from sitl.autopilot.telemetry import Preset
from sitl.command_line import (
    CONTEXT,
    Place,
    Size,
    Triple,
    allow_unsigned,
    camera_heartbeat,
    key_file,
)

_FIRMWARE_LINK = "udpin:127.0.0.1:14540"  # where a firmware that somebody else starts sends
# As a PX4 SITL: to the companion's port, to the ground station's, and TCP for whoever calls.
_DEFAULT_LINKS = (
    "onboard=udpout:127.0.0.1:14540",
    "gcs=udpout:127.0.0.1:14550",
    "gcs=tcpin:127.0.0.1:5760",
)
# Real firmware already sends to PX4's port for companions, and the simulation listens there.
_FIRMWARE_LINKS = ("onboard=udpin:127.0.0.1:14600", *_DEFAULT_LINKS[1:])


class _Link(click.ParamType[tuple[Preset, str]]):
    """A preset, named or derived from PX4's port numbers, and a URL."""

    name = "[PRESET=]URL"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[Preset, str]:
        """Return the preset and the URL, or fail with a usage error."""
        name, equals, url = str(value).partition("=")
        if not equals:
            is_gcs = value.endswith(":14550") or value.startswith("tcpin")
            return Preset.GCS if is_gcs else Preset.ONBOARD, value
        known = [preset.value for preset in Preset]
        if name not in known:
            self.fail(f"unknown preset {name!r}; known: {', '.join(known)}", param, ctx)
        return Preset(name), url


class _Positive(click.ParamType[float]):
    """A finite number above 0."""

    name = "X"

    def convert(self, value: Any, param: Any, ctx: Any) -> float:
        """Return the number, or fail with a usage error."""
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        if not 0.0 < number < math.inf:
            self.fail(f"{value!r} is not a number above 0", param, ctx)
        return number


@dataclass(frozen=True, slots=True, kw_only=True)
class ServerOptions:
    """The parsed options of the user."""

    world: str
    seed: int
    vehicle: str
    start_enu_m: Triple | None
    goal_enu_m: Triple | None
    links: Sequence[tuple[Preset, str]]
    fd: int | None
    lockstep: bool
    realtime: bool
    speed: float | None  # None: no limit, in lockstep only
    answer_limit_s: float
    truth: Path | None
    camera_size: tuple[int, int]  # columns, rows
    camera_rate_hz: float
    camera_heartbeat_hz: float
    system_id: int
    key_file: Path | None
    allow_unsigned: bool
    firmware_kind: str | None  # None: our own autopilot flies
    firmware: Path | None
    firmware_link: str
    firmware_seed: int
    trusted: Sequence[int]


@click.command(context_settings=CONTEXT)
@click.option(
    "--world",
    default="dense",
    show_default=True,
    help="World: a name, gen:density,size or a TOML file.",
)
@click.option("--seed", type=int, default=3, show_default=True, help="Seed of the world.")
@click.option(
    "--vehicle", default="solo", show_default=True, help="Vehicle: a name or a TOML file."
)
@click.option("--start", "start_enu_m", type=Place(), help="Start, ENU m. See --goal.")
@click.option(
    "--goal", "goal_enu_m", type=Place(),
    help="Goal, ENU m. A generated world is built around start and goal: other positions move its "
    "bounds, and towers within 3 m of them are left out.",
)  # fmt: skip
@click.option(
    "--link", "links", type=_Link(), multiple=True,
    help="Endpoint; repeatable. Presets: onboard, gcs, lockstep.  "
    f"[default: {' '.join(_DEFAULT_LINKS)}]",
)  # fmt: skip
@click.option("--fd", type=int, help="Inherited stream socket of a companion.")
@click.option("--lockstep", is_flag=True, help="Wait for the companion on --fd at every tick.")
@click.option("--realtime", is_flag=True, help="The same as --speed 1.")
@click.option(
    "--speed",
    type=_Positive(),
    help="Speed, in times real time  [1; in lockstep as fast as possible].",
)
@click.option(
    "--answer-limit", "answer_limit_s", type=_Positive(), default=120.0, show_default=True,
    help="Time that the companion in lockstep may take for a tick, s.",
)  # fmt: skip
@click.option("--truth", type=click.Path(path_type=Path), help="Folder for the referee's truth.")
@click.option(
    "--camera-size", type=Size(), default="64x48", show_default=True, help="Depth image, pixels."
)
@click.option(
    "--camera-rate", "camera_rate_hz", type=_Positive(), default=10.0, show_default=True,
    help="Frame rate for clients that ask for no interval, Hz.",
)  # fmt: skip
@camera_heartbeat
@click.option(
    "--sysid", "system_id", type=click.IntRange(1, 255), default=1, show_default=True,
    help="MAVLink system id.",
)  # fmt: skip
@key_file
@allow_unsigned
@click.option("--hil", type=click.Choice(["px4"]), help="PX4 flies, on its simulator link (TCP).")
@click.option(
    "--json", "json_backend", type=click.Choice(["ardupilot"]),
    help="ArduPilot flies, on its JSON backend (UDP).",
)  # fmt: skip
@click.option(
    "--firmware", type=click.Path(path_type=Path),
    help="SITL binary to start  [none: you start it yourself].",
)  # fmt: skip
@click.option(
    "--firmware-link", metavar="URL", default=_FIRMWARE_LINK, show_default=True,
    help="Endpoint to which a firmware that you start yourself sends its MAVLink.",
)  # fmt: skip
@click.option(
    "--firmware-seed", type=click.IntRange(min=0), default=1, show_default=True,
    help="Seed of the noise of the firmware's sensors.",
)  # fmt: skip
@click.option(
    "--trust", "trusted", type=click.IntRange(1, 255), multiple=True, metavar="SYSTEM",
    help="MAVLink system id that may command; repeatable  [all].",
)  # fmt: skip
def _sitl() -> None:
    """Run a simulated quadrotor that speaks MAVLink as a PX4 does."""


def parse(arguments: Sequence[str]) -> ServerOptions:
    """Parse a command line.

    Raises:
        click.UsageError: It is not valid.
        click.exceptions.Exit: It asks for help, which is printed.
    """
    given = _sitl.make_context("mavfi sitl", list(arguments)).params
    kind = _firmware_kind(given)
    options = ServerOptions(**given, firmware_kind=kind)
    links, speed = options.links, 1.0 if options.realtime else options.speed
    if options.realtime and options.speed is not None:
        raise click.UsageError("--realtime and --speed exclude each other")
    if options.lockstep:
        if options.fd is None:
            raise click.UsageError("--lockstep needs --fd")
        if links:
            raise click.UsageError("--lockstep serves the companion on --fd only, without --link")
    elif options.fd is not None:
        links = [*links, (Preset.LOCKSTEP, f"fd:{options.fd}")]
    elif not links:
        urls = _DEFAULT_LINKS if options.firmware_kind is None else _FIRMWARE_LINKS
        links = [_Link().convert(url, None, None) for url in urls]
    if speed is None and not options.lockstep:
        speed = 1.0
    return dataclasses.replace(options, links=links, speed=speed)


def _firmware_kind(given: dict[str, Any]) -> str | None:
    """Return the firmware that flies, and remove its two options.

    Raises:
        click.UsageError: The options contradict each other.
    """
    named = [name for name in (given.pop("hil"), given.pop("json_backend")) if name is not None]
    if len(named) > 1:
        raise click.UsageError("--hil and --json exclude each other")
    if not named and given["firmware"] is not None:
        raise click.UsageError("--firmware needs --hil or --json")
    if named and given["trusted"]:
        raise click.UsageError("--trust is for our own autopilot")
    if named and given["lockstep"]:
        raise click.UsageError("--lockstep is for our own autopilot")
    return named[0] if named else None
