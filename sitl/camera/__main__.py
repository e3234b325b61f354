"""`python -m sitl.camera`: runs the depth camera for a foreign autopilot."""

from __future__ import annotations

import contextlib
import math
import sys
from collections.abc import Sequence
from pathlib import Path

import click
import numpy as np

from mavfi_cli.core.errors import LinkLost
from mavfi_cli.core.option_types import Coordinates, OutFolder, Place
from mavfi_cli.core.terminal import exit_code, note
from mavfi_cli.link.transport import signing_from_file
from sitl.camera.component import Camera
from sitl.camera.station import PoseTracker, Station, Witness
from sitl.camera.stream import DepthStream
from sitl.command_line import (
    CONTEXT,
    camera_options,
    signing,
    stop_on_signals,
    world_and_vehicle,
)
from sitl.vehicle.profile import load_profile
from sitl.world import load_world


@click.command(context_settings=CONTEXT)
@world_and_vehicle
@click.option(
    "--origin", type=Place(), metavar="X,Y,Z",
    help="Position of the autopilot's local origin in the world, ENU m  [the world's start; with "
    "mavfi sitl, the world's origin].",
)  # fmt: skip
@click.option(
    "--link", "links", multiple=True, default=["udpin:127.0.0.1:14540"], metavar="URL",
    help="Endpoint of an autopilot or client; repeatable. Messages of MAVLink's common set are "
    "forwarded between all links.",
)  # fmt: skip
@camera_options()
@click.option(
    "--hfov", "hfov_deg", type=float, default=90.0, help="Horizontal field of view, degrees."
)
@click.option(
    "--mount", type=Place(), metavar="F,L,U",
    help="Offset of the lens from the vehicle's position: forward, left, up in m  [--vehicle's].",
)  # fmt: skip
@click.option(
    "--truth", type=OutFolder(), metavar="DIR",
    help="Folder for the briefing and, at the end, the referee's log and verdict.",
)  # fmt: skip
@signing
def _camera(
    *,
    origin: Coordinates | None,
    links: Sequence[str],
    camera_size: tuple[int, int],
    camera_rate_hz: float,
    camera_heartbeat_hz: float,
    hfov_deg: float,
    mount: Coordinates | None,
    vehicle: str,
    truth: Path | None,
    depth: Path | None,
    key_file: Path | None,
    allow_unsigned: bool,
    world: str,
    seed: int,
    start_enu_m: Coordinates | None,
    goal_enu_m: Coordinates | None,
) -> None:
    """Run depth camera and referee for an autopilot without a world, such as PX4 or ArduPilot SITL.

    The camera reads the vehicle's pose from ATTITUDE_QUATERNION (or ATTITUDE) and
    LOCAL_POSITION_NED, and requests these messages if they do not arrive. It sends frames as a
    MAVLink camera (component 100) on all links once a client has sent IMAGE_START_CAPTURE. The
    referee judges the same pose, and reports a collision in a STATUSTEXT.
    """
    scene = load_world(world, seed=seed, start_enu_m=start_enu_m, goal_enu_m=goal_enu_m)
    profile = load_profile(vehicle)
    forward, left, up = profile.camera_mount_flu_m if mount is None else mount
    witness = Witness(scene, profile, logs=truth is not None)
    if truth is not None:
        scene.write_briefing((forward, left, up), truth)
    stopped = stop_on_signals()
    tracker = PoseTracker(scene.start_enu_m if origin is None else np.array(origin))
    with DepthStream.opened(depth, camera_size) as stream:
        camera = Camera(
            scene.boxes_enu_m, columns=camera_size[0], rows=camera_size[1], rate_hz=camera_rate_hz,
            hfov_rad=math.radians(hfov_deg), mount_offset_flu_m=(forward, left, up),
            heartbeat_hz=camera_heartbeat_hz, depth=stream,
        )  # fmt: skip
        station = Station(
            camera, tracker, links, witness=witness, origin_given=origin is not None,
            signing=signing_from_file(key_file), allow_unsigned=allow_unsigned,
        )  # fmt: skip
        with contextlib.closing(station):
            note(f"depth camera in {scene.name}, seed {scene.seed}, on {', '.join(links)}")
            try:
                station.run(lambda: not stopped())
            except LinkLost:
                if not stopped():
                    raise
            finally:
                note(f"{station.frames_sent} frames sent")
                if truth is not None:
                    witness.save(truth)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `python -m sitl.camera`. Return its exit code."""
    prog_name = "python -m sitl.camera"
    return exit_code(
        lambda: _camera.main(args=arguments, prog_name=prog_name, standalone_mode=False)
    )


if __name__ == "__main__":
    sys.exit(main())
