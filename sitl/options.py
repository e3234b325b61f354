"""Parses the command line of `python -m sitl`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import click

from mavfi_cli.core.option_types import Coordinates, OutFolder
from sitl.autopilot.telemetry import Preset
from sitl.command_line import CONTEXT, POSITIVE, camera_options, signing, world_and_vehicle

_FIRMWARE_LINK = "udpin:127.0.0.1:14540"  # where externally started firmware sends
# Like PX4 SITL: UDP to the companion's and ground station's ports, a TCP server for any client.
_DEFAULT_LINKS = (
    "onboard=udpout:127.0.0.1:14540",
    "gcs=udpout:127.0.0.1:14550",
    "gcs=tcpin:127.0.0.1:5760",
)
# Real firmware already sends to PX4's port for companions, and the simulation listens there.
_FIRMWARE_LINKS = ("onboard=udpin:127.0.0.1:14600", *_DEFAULT_LINKS[1:])


class _Link(click.ParamType[tuple[Preset, str]]):
    """Option type for the URL of a link, with an optional preset of streams in front of it.

    Without a preset, a URL on PX4's port for ground stations, or of a TCP server, gets the preset
    `gcs`. All other URLs get `onboard`.
    """

    name = "[PRESET=]URL"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[Preset, str]:
        name, equals, url = str(value).partition("=")
        if not equals:
            is_gcs = value.endswith(":14550") or value.startswith("tcpin")
            return Preset.GCS if is_gcs else Preset.ONBOARD, value
        known = [preset.value for preset in Preset]
        if name not in known:
            self.fail(f"unknown preset {name!r}; known: {', '.join(known)}", param, ctx)
        return Preset(name), url


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleSetup:
    """The world, vehicle, camera and autopilot to simulate.

    Attributes:
        camera_size: Columns and rows of the depth image.
        depth: Unix domain socket that serves depth frames as arrays, or None for no such socket.
        firmware_kind: Name of the real firmware that flies the vehicle, or None for our autopilot.
        firmware: SITL binary of that firmware, or None if the user starts the firmware and has it
            send to `firmware_link`.
        trusted: Ids of the MAVLink systems that may send commands. If empty, all systems may.
    """

    world: str = "dense"
    seed: int = 3
    start_enu_m: Coordinates | None = None
    goal_enu_m: Coordinates | None = None
    vehicle: str = "solo"
    camera_size: tuple[int, int] = (64, 48)
    camera_rate_hz: float = 10.0
    camera_heartbeat_hz: float = 1.0
    depth: Path | None = None
    system_id: int = 1
    firmware_kind: str | None = None
    firmware: Path | None = None
    firmware_link: str = _FIRMWARE_LINK
    firmware_seed: int = 1
    trusted: Sequence[int] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class ServerOptions:
    """The parsed command line of `python -m sitl`."""

    setup: VehicleSetup
    links: Sequence[tuple[Preset, str]]
    fd: int | None
    lockstep: bool
    speed: float | None  # None: no limit, in lockstep only
    answer_limit_s: float
    truth: Path | None
    key_file: Path | None
    allow_unsigned: bool


@click.command(context_settings=CONTEXT)
@world_and_vehicle
@click.option(
    "--link", "links", type=_Link(), multiple=True,
    help="Endpoint; repeatable. Presets: onboard, gcs, lockstep.  "
    f"[default: {' '.join(_DEFAULT_LINKS)}]",
)  # fmt: skip
@click.option("--fd", type=int, help="Inherited stream socket of a companion.")
@click.option("--lockstep", is_flag=True, help="Wait for the companion on --fd at every tick.")
@click.option("--realtime", is_flag=True, help="The same as --speed 1.")
@click.option(
    "--speed", type=POSITIVE,
    help="Speed, in times real time  [1; in lockstep as fast as possible].",
)  # fmt: skip
@click.option(
    "--answer-limit", "answer_limit_s", type=POSITIVE, default=120.0,
    help="Time that the companion in lockstep may take for a tick, s.",
)  # fmt: skip
@click.option("--truth", type=OutFolder(), help="Folder for the referee's truth.")
@camera_options("camera-")
@click.option(
    "--sysid", "system_id", type=click.IntRange(1, 255), default=1, help="MAVLink system id."
)
@signing
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
    "--firmware-link", metavar="URL", default=_FIRMWARE_LINK,
    help="Endpoint to which a firmware that you start yourself sends its MAVLink.",
)  # fmt: skip
@click.option(
    "--firmware-seed", type=click.IntRange(min=0), default=1,
    help="Seed of the noise of the firmware's sensors.",
)  # fmt: skip
@click.option(
    "--trust", "trusted", type=click.IntRange(1, 255), multiple=True, metavar="SYSTEM",
    help="MAVLink system id that may command; repeatable  [all].",
)  # fmt: skip
def _sitl() -> None:
    """Run a simulated quadrotor that speaks MAVLink like PX4."""


def parse(arguments: Sequence[str]) -> ServerOptions:
    """Parse the command-line arguments of `python -m sitl`.

    Raises click.UsageError if they are invalid, and click.exceptions.Exit if they request help.
    """
    given = _sitl.make_context("mavfi sitl", list(arguments)).params
    hil, backend, realtime = (given.pop(name) for name in ("hil", "json_backend", "realtime"))
    kind, lockstep, fd = hil or backend, given["lockstep"], given["fd"]
    links, speed = given.pop("links"), given.pop("speed")
    names = [field.name for field in fields(VehicleSetup) if field.name in given]
    setup = VehicleSetup(firmware_kind=kind, **{name: given.pop(name) for name in names})
    for is_wrong, problem in (
        (hil and backend, "--hil cannot be combined with --json"),
        (setup.firmware and not kind, "--firmware needs --hil or --json"),
        (kind and setup.trusted, "--trust cannot be combined with --hil or --json"),
        (kind and lockstep, "--lockstep cannot be combined with --hil or --json"),
        (realtime and speed is not None, "--realtime cannot be combined with --speed"),
        (lockstep and fd is None, "--lockstep needs --fd"),
        (lockstep and links, "--lockstep cannot be combined with --link"),
    ):
        if is_wrong:
            raise click.UsageError(problem)
    if realtime or not lockstep:
        speed = speed or 1.0
    if not lockstep and fd is not None:
        links = [*links, (Preset.LOCKSTEP, f"fd:{fd}")]
    elif not lockstep and not links:
        urls = _FIRMWARE_LINKS if kind else _DEFAULT_LINKS
        links = [_Link().convert(url, None, None) for url in urls]
    return ServerOptions(**given, setup=setup, links=links, speed=speed)
