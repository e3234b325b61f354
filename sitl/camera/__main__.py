"""`python -m sitl.camera`: runs the depth camera for a foreign autopilot."""

from __future__ import annotations

import math
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np

from mavfi_cli.core.errors import LinkLost, MavfiError
from mavfi_cli.link.codec import Signing, key_from_file
from mavfi_cli.link.transport import Transport, open_transport
from sitl.camera.component import Camera
from sitl.camera.station import PoseTracker, Station
from sitl.world import load_world

_Triple = tuple[float, ...]


def _triple(_ctx: click.Context, _param: click.Parameter, value: str | None) -> _Triple | None:
    if value is None:
        return None
    try:
        numbers = tuple(float(part) for part in value.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != 3 or not all(math.isfinite(number) for number in numbers):
        raise click.BadParameter(f"{value!r}: expected three numbers, such as 30,40,5")
    return numbers


def _size(_ctx: click.Context, _param: click.Parameter, value: str) -> tuple[int, int]:
    columns, _, rows = value.partition("x")
    if not (columns.isdecimal() and rows.isdecimal()):
        raise click.BadParameter(f"{value!r}: expected columns x rows, such as 64x48")
    return int(columns), int(rows)


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@click.option("--world", "name", default="dense", show_default=True, metavar="NAME|FILE")
@click.option("--seed", type=click.IntRange(min=0), default=3, show_default=True)
@click.option("--start", callback=_triple, metavar="X,Y,Z", help="Start in the world, ENU m.")
@click.option("--goal", callback=_triple, metavar="X,Y,Z", help="Goal in the world, ENU m.")
@click.option(
    "--origin",
    callback=_triple,
    metavar="X,Y,Z",
    help="Position of the autopilot's local origin in the world, ENU m  [the world's start].",
)
@click.option(
    "--link",
    "links",
    multiple=True,
    default=["udpin:127.0.0.1:14540"],
    show_default=True,
    metavar="URL",
    help="Endpoint of an autopilot or client; repeatable. Frames are forwarded between all links.",
)
@click.option("--size", callback=_size, default="64x48", show_default=True, metavar="COLSxROWS")
@click.option("--rate", "rate_hz", type=float, default=10.0, show_default=True, help="Hz.")
@click.option("--hfov", "hfov_deg", type=float, default=90.0, show_default=True, help="Degrees.")
@click.option(
    "--mount",
    callback=_triple,
    default="0.1,0,0",
    show_default=True,
    metavar="F,L,U",
    help="Offset of the lens from the vehicle's position: forward, left, up in m.",
)
@click.option(
    "--passphrase-file", type=click.Path(path_type=Path), help="File with the signing passphrase."
)
@click.option("--allow-unsigned", is_flag=True, help="Allow unsigned links beyond loopback.")
def _camera(
    name: str,
    seed: int,
    start: _Triple | None,
    goal: _Triple | None,
    origin: _Triple | None,
    links: Sequence[str],
    size: tuple[int, int],
    rate_hz: float,
    hfov_deg: float,
    mount: _Triple,
    passphrase_file: Path | None,
    allow_unsigned: bool,
) -> None:
    """Run a depth camera for an autopilot without a world, such as PX4 or ArduPilot SITL.

    The camera reads the vehicle's pose from ATTITUDE_QUATERNION (or ATTITUDE) and
    LOCAL_POSITION_NED, and requests these messages if they do not arrive. It sends frames as a
    MAVLink camera (component 100) on all links once a client has sent IMAGE_START_CAPTURE.
    """
    world = load_world(name, seed=seed, start_enu_m=start, goal_enu_m=goal)
    forward, left, up = mount
    made = Camera(
        world.boxes_enu_m,
        columns=size[0],
        rows=size[1],
        hfov_rad=math.radians(hfov_deg),
        mount_offset_flu_m=(forward, left, up),
        rate_hz=rate_hz,
    )
    key = None if passphrase_file is None else key_from_file(passphrase_file)
    transports: list[Transport] = []
    try:
        for url in links:
            signed = key is not None
            transports.append(open_transport(url, signed=signed, allow_unsigned=allow_unsigned))
        station = Station(
            made,
            PoseTracker(world.start_enu_m if origin is None else np.array(origin)),
            transports,
            signing=lambda: None if key is None else Signing(key, time.time),
        )
        click.echo(f"depth camera in {world.name}, seed {seed}, on {', '.join(links)}", err=True)
        _run_until_stopped(station)
    finally:
        for transport in transports:
            transport.close()


def _run_until_stopped(station: Station) -> None:
    stopped: list[int] = []

    def stop(number: int, _frame: Any) -> None:
        """Note the signal. The loop ends after its present iteration."""
        stopped.append(number)

    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        station.run(lambda: not stopped)
    except LinkLost:
        if not stopped:
            raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        click.echo(f"{station.frames_sent} frames sent", err=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command. Return 0 if stopped by the user, 1 for a known error, 2 for wrong usage."""
    try:
        _camera.main(args=arguments, prog_name="python -m sitl.camera", standalone_mode=False)
    except click.ClickException as error:
        error.show()
        return error.exit_code
    except MavfiError as error:
        click.echo(f"error: {error}", err=True)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
