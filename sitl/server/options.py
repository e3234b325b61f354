"""The command line of `python -m sitl`."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sitl.autopilot.streams import Preset

DEFAULT_LINKS = (
    "onboard=udpout:127.0.0.1:14540",
    "gcs=udpout:127.0.0.1:14550",
    "gcs=tcpin:127.0.0.1:5760",
)
"""As a PX4 SITL: to the companion's port, to the ground station's, and TCP for whoever calls."""

Triple = tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """The parsed options of the user."""

    world: str
    seed: int
    vehicle: str
    start_enu_m: Triple | None
    goal_enu_m: Triple | None
    links: tuple[tuple[Preset, str], ...]
    lockstep_fd: int | None
    speed: float | None  # None: no limit, in lockstep only
    answer_limit_s: float
    truth: Path | None
    camera_columns: int
    camera_rows: int
    camera_rate_hz: float
    system_id: int
    key_file: Path | None
    allow_unsigned: bool


def parse(arguments: Sequence[str]) -> Options:
    """Parse a command line; exit with code 2 if it is not valid."""
    parser = _parser()
    given = parser.parse_args(arguments)
    if given.lockstep and given.fd is None:
        parser.error("--lockstep needs --fd")
    columns, rows = given.camera_size
    links = list(given.link or ([] if given.fd is not None else map(_link, DEFAULT_LINKS)))
    if given.lockstep and links:
        parser.error("--lockstep serves the companion on --fd only, without --link")
    if given.fd is not None and not given.lockstep:
        links.append((Preset.LOCKSTEP, f"fd:{given.fd}"))
    speed = 1.0 if given.realtime else given.speed
    return Options(
        world=given.world, seed=given.seed, vehicle=given.vehicle,
        start_enu_m=given.start, goal_enu_m=given.goal, links=tuple(links),
        lockstep_fd=given.fd if given.lockstep else None,
        speed=speed if speed is not None or given.lockstep else 1.0,
        answer_limit_s=given.answer_limit, truth=given.truth,
        camera_columns=columns, camera_rows=rows, camera_rate_hz=given.camera_rate,
        system_id=given.sysid, key_file=given.key_file, allow_unsigned=given.allow_unsigned,
    )  # fmt: skip


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
    add("--start", type=_triple, metavar="X,Y,Z", help="start, east,north,up in m; see --goal")
    add(
        "--goal", type=_triple, metavar="X,Y,Z",
        help="goal, east,north,up in m; a generated world is made round start and goal: another "
        "place moves its bounds, and towers within 3 m of it are left out",
    )  # fmt: skip
    add(
        "--link", type=_link, action="append", metavar="[PRESET=]URL",
        help="endpoint, repeatable; presets: onboard, gcs, lockstep "
        f"(default: {' '.join(DEFAULT_LINKS)})",
    )  # fmt: skip
    add("--fd", type=int, metavar="N", help="inherited stream socket of a companion")
    add("--lockstep", action="store_true", help="wait for the companion on --fd at every tick")
    pace = parser.add_mutually_exclusive_group()
    pace.add_argument("--realtime", action="store_true", help="as --speed 1")
    pace.add_argument(
        "--speed", type=_positive, metavar="X",
        help="times real time (default: 1; in lockstep as fast as it goes)",
    )  # fmt: skip
    add(
        "--answer-limit", type=_positive, default=120.0, metavar="S",
        help="in lockstep, how long the companion may think (default: 120)",
    )  # fmt: skip
    add("--truth", type=Path, metavar="DIR", help="save the referee's truth here at the end")
    add("--camera-size", type=_size, default=(64, 48), metavar="WxH", help="default: 64x48")
    add("--camera-rate", type=_positive, default=10.0, metavar="HZ", help="default: 10")
    add("--sysid", type=_system_id, default=1, help="MAVLink system id (default: 1)")
    add("--key-file", type=Path, metavar="FILE", help="file with the signing passphrase")
    add(
        "--allow-unsigned", action="store_true",
        help="let unsigned links reach beyond this machine",
    )  # fmt: skip
    return parser


def _triple(text: str) -> Triple:
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
