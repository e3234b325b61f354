"""The command line of `python -m sitl`."""

from __future__ import annotations

import argparse
import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sitl.autopilot.streams import Preset

# As a PX4 SITL: to the companion's port, to the ground station's, and TCP for whoever calls.
_DEFAULT_LINKS = (
    "onboard=udpout:127.0.0.1:14540",
    "gcs=udpout:127.0.0.1:14550",
    "gcs=tcpin:127.0.0.1:5760",
)
_Triple = tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class ServerOptions:
    """The parsed options of the user."""

    world: str
    seed: int
    vehicle: str
    start_enu_m: _Triple | None
    goal_enu_m: _Triple | None
    links: list[tuple[Preset, str]]
    fd: int | None
    lockstep: bool
    speed: float | None  # None: no limit, in lockstep only
    answer_limit_s: float
    truth: Path | None
    camera_size: tuple[int, int]  # columns, rows
    camera_rate_hz: float
    system_id: int
    key_file: Path | None
    allow_unsigned: bool


def parse(arguments: Sequence[str]) -> ServerOptions:
    """Parse a command line; exit with code 2 if it is not valid."""
    parser = _parser()
    options = ServerOptions(**vars(parser.parse_args(arguments)))
    links, speed = options.links, options.speed
    if options.lockstep:
        if options.fd is None:
            parser.error("--lockstep needs --fd")
        if links:
            parser.error("--lockstep serves the companion on --fd only, without --link")
    elif options.fd is not None:
        links = [*links, (Preset.LOCKSTEP, f"fd:{options.fd}")]
    elif not links:
        links = [_link(link) for link in _DEFAULT_LINKS]
    if speed is None and not options.lockstep:
        speed = 1.0
    return dataclasses.replace(options, links=links, speed=speed)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="mavfi sitl",
        description="A simulated quadrotor that speaks MAVLink as a PX4 does.",
        allow_abbrev=False,
    )
    add = parser.add_argument
    add("--world", default="dense", help="name, gen:density,size or TOML file (default: dense)")
    add("--seed", type=int, default=3, help="of the world (default: 3)")
    add("--vehicle", default="solo", help="profile name or TOML file (default: solo)")
    add(
        "--start",
        dest="start_enu_m",
        type=_triple,
        metavar="X,Y,Z",
        help="start, east,north,up in m; see --goal",
    )
    add(
        "--goal", dest="goal_enu_m", type=_triple, metavar="X,Y,Z",
        help="goal, east,north,up in m; a generated world is made round start and goal: another "
        "place moves its bounds, and towers within 3 m of it are left out",
    )  # fmt: skip
    add(
        "--link", dest="links", type=_link, action="append", default=[], metavar="[PRESET=]URL",
        help="endpoint, repeatable; presets: onboard, gcs, lockstep "
        f"(default: {' '.join(_DEFAULT_LINKS)})",
    )  # fmt: skip
    add("--fd", type=int, metavar="N", help="inherited stream socket of a companion")
    add("--lockstep", action="store_true", help="wait for the companion on --fd at every tick")
    pace = parser.add_mutually_exclusive_group()
    pace.add_argument(
        "--realtime", dest="speed", action="store_const", const=1.0, help="as --speed 1"
    )
    pace.add_argument(
        "--speed", type=_positive, metavar="X",
        help="times real time (default: 1; in lockstep as fast as it goes)",
    )  # fmt: skip
    add(
        "--answer-limit", dest="answer_limit_s", type=_positive, default=120.0, metavar="S",
        help="in lockstep, how long the companion may think (default: 120)",
    )  # fmt: skip
    add("--truth", type=Path, metavar="DIR", help="save the referee's truth here at the end")
    add("--camera-size", type=_size, default=(64, 48), metavar="WxH", help="default: 64x48")
    add(
        "--camera-rate", dest="camera_rate_hz", type=_positive, default=10.0, metavar="HZ",
        help="default: 10",
    )  # fmt: skip
    add(
        "--sysid", dest="system_id", type=_system_id, default=1, metavar="SYSID",
        help="MAVLink system id (default: 1)",
    )  # fmt: skip
    add("--key-file", type=Path, metavar="FILE", help="file with the signing passphrase")
    add(
        "--allow-unsigned", action="store_true",
        help="let unsigned links reach beyond this machine",
    )  # fmt: skip
    return parser


def _triple(text: str) -> _Triple:
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        x = y = z = math.nan
    if not all(map(math.isfinite, (x, y, z))):
        raise argparse.ArgumentTypeError(f"{text!r} is not X,Y,Z in m")
    return x, y, z


def _size(text: str) -> tuple[int, int]:
    try:
        columns, rows = (int(part) for part in text.split("x"))
    except ValueError:
        columns = rows = 0
    if columns < 1 or rows < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not WIDTHxHEIGHT in pixels")
    return columns, rows


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above 0")
    return value


def _system_id(text: str) -> int:
    value = int(text) if text.isdecimal() else 0
    if not 1 <= value <= 255:
        raise argparse.ArgumentTypeError(f"{text!r} is not a system id from 1 to 255")
    return value


def _link(text: str) -> tuple[Preset, str]:
    """A preset, named or derived from PX4's port numbers, and a URL."""
    name, equals, url = text.partition("=")
    if equals:
        names = [preset.value for preset in Preset]
        if name not in names:
            known = ", ".join(names)
            raise argparse.ArgumentTypeError(f"unknown preset {name!r}; known: {known}")
        return Preset(name), url
    is_gcs = text.endswith(":14550") or text.startswith("tcpin")
    return Preset.GCS if is_gcs else Preset.ONBOARD, text
