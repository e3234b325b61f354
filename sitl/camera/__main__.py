"""`python -m sitl.camera`: runs the depth camera for a foreign autopilot."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import click
import numpy as np

from mavfi_cli.core.errors import LinkLost
from mavfi_cli.link.codec import Signing, key_from_file
from mavfi_cli.link.transport import Transport, open_transport
from sitl.camera.component import Camera
from sitl.camera.station import PoseTracker, Station
from sitl.command_line import (
    CONTEXT,
    Place,
    Size,
    Triple,
    allow_unsigned,
    camera_heartbeat,
    exit_code,
    key_file,
    stop_on_signals,
)
from sitl.world import load_world


@click.command(context_settings=CONTEXT)
@click.option("--world", "name", default="dense", show_default=True, metavar="NAME|FILE")
@click.option("--seed", type=click.IntRange(min=0), default=3, show_default=True)
@click.option("--start", type=Place(), metavar="X,Y,Z", help="Start in the world, ENU m.")
@click.option("--goal", type=Place(), metavar="X,Y,Z", help="Goal in the world, ENU m.")
@click.option(
    "--origin",
    type=Place(),
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
@click.option("--size", type=Size(), default="64x48", show_default=True)
@click.option("--rate", "rate_hz", type=float, default=10.0, show_default=True, help="Hz.")
@click.option("--hfov", "hfov_deg", type=float, default=90.0, show_default=True, help="Degrees.")
@click.option(
    "--mount",
    type=Place(),
    default="0.1,0,0",
    show_default=True,
    metavar="F,L,U",
    help="Offset of the lens from the vehicle's position: forward, left, up in m.",
)
@camera_heartbeat
@key_file
@allow_unsigned
def _camera(
    name: str,
    seed: int,
    start: Triple | None,
    goal: Triple | None,
    origin: Triple | None,
    links: Sequence[str],
    size: tuple[int, int],
    rate_hz: float,
    hfov_deg: float,
    mount: Triple,
    camera_heartbeat_hz: float,
    key_file: Path | None,
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
        heartbeat_hz=camera_heartbeat_hz,
    )
    key = None if key_file is None else key_from_file(key_file)
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
        stopped = stop_on_signals()
        try:
            station.run(lambda: not stopped())
        except LinkLost:
            if not stopped():
                raise
        finally:
            click.echo(f"{station.frames_sent} frames sent", err=True)
    finally:
        for transport in transports:
            transport.close()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command. Return its exit code."""
    prog_name = "python -m sitl.camera"
    return exit_code(
        lambda: _camera.main(args=arguments, prog_name=prog_name, standalone_mode=False)
    )


if __name__ == "__main__":
    sys.exit(main())
