"""Assembles a server from its options, runs it, and shuts it down."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from mavfi_cli.core.errors import RecordError
from mavfi_cli.core.files import write_json
from mavfi_cli.link.codec import Signing, key_from_file
from mavfi_cli.link.transport import open_listener, open_transport
from sitl.autopilot.streams import Preset
from sitl.command_line import exit_code, stop_on_signals
from sitl.server.client import Client
from sitl.server.loops import Door, EmbeddedVehicle, Realtime, run_lockstep
from sitl.server.options import ServerOptions, parse
from sitl.server.simulation import Simulation
from sitl.vehicle.profile import load_profile
from sitl.world import load_world


def _write_briefing(simulation: Simulation, folder: Path) -> None:
    """Write goal, bounds and camera mounting to `folder`, before the first message is sent.

    Raises:
        RecordError: the file cannot be written.
    """
    world = simulation.referee.world
    briefing = {
        "start_enu_m": world.start_enu_m.tolist(),
        "goal_enu_m": world.goal_enu_m.tolist(),
        "bounds_enu_m": world.bounds_enu_m.tolist(),
        "camera_offset_flu_m": [float(c) for c in simulation.camera.optics.mount_offset_flu_m],
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordError(f"{folder}: {error.strerror or error}") from None
    write_json(folder / "briefing.json", briefing)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `python -m sitl`. Return its exit code."""
    given = sys.argv[1:] if arguments is None else arguments
    return exit_code(lambda: _serve(parse(given)))


def _serve(options: ServerOptions) -> None:
    """Run until the peer closes or SIGINT or SIGTERM arrives; save the truth in any case."""
    stopped = stop_on_signals()
    simulation = _simulation(options)
    if options.truth is not None:
        _write_briefing(simulation, options.truth)
    run = _lockstep if options.lockstep else _realtime
    try:
        run(options, simulation, stopped)
    finally:
        if options.truth is not None:
            simulation.save_truth(options.truth)


def embedded(arguments: Sequence[str], truth_folder: Path) -> EmbeddedVehicle:
    """The vehicle of `python -m sitl --lockstep` in this process, ready to fly.

    Args:
        arguments: command line without the companion's descriptor.
        truth_folder: folder for the briefing and, at the end, the truth.

    Raises:
        MavfiError: the world, the vehicle, the start or the goal cannot be used.
    """
    simulation = _simulation(parse(arguments))
    _write_briefing(simulation, truth_folder)
    return EmbeddedVehicle(simulation, truth_folder)


def warm_up() -> None:
    """Load and compile the code of a flight, which is the same for every world."""
    simulation = Simulation(load_world("dense", seed=1), load_profile("solo"))
    for _ in range(2):
        simulation.advance()


def _simulation(options: ServerOptions) -> Simulation:
    world = load_world(
        options.world,
        seed=options.seed,
        start_enu_m=options.start_enu_m,
        goal_enu_m=options.goal_enu_m,
    )
    columns, rows = options.camera_size
    return Simulation(
        world,
        load_profile(options.vehicle),
        system_id=options.system_id,
        camera_columns=columns,
        camera_rows=rows,
        camera_rate_hz=options.camera_rate_hz,
    )


def _lockstep(options: ServerOptions, simulation: Simulation, stopped: Callable[[], bool]) -> None:
    transport = open_transport(f"fd:{options.fd}")
    client = Client(simulation, transport, Preset.LOCKSTEP)
    try:
        run_lockstep(
            simulation,
            client,
            speed=options.speed,
            limit_s=options.answer_limit_s,
            stopped=stopped,
        )
    finally:
        client.close()


def _realtime(options: ServerOptions, simulation: Simulation, stopped: Callable[[], bool]) -> None:
    key = None if options.key_file is None else key_from_file(options.key_file)
    doors: list[Door] = []
    server = Realtime(simulation, doors, speed=options.speed or 1.0)
    try:
        for preset, url in options.links:
            inherited = url.startswith("fd:")
            listener = open_listener(
                url, signed=key is not None, allow_unsigned=options.allow_unsigned
            )
            signing = _signing_maker(None if inherited else key)
            doors.append(
                Door(listener=listener, preset=preset, signing=signing, ends_with_peer=inherited)
            )
        _announce(options, simulation)
        server.run(stopped)
    finally:
        server.close()


def _signing_maker(key: bytes | None) -> Callable[[], Signing | None]:
    return lambda: None if key is None else Signing(key, clock=time.time)


def _announce(options: ServerOptions, simulation: Simulation) -> None:
    world = simulation.referee.world
    links = []
    for preset, url in options.links:
        first, *rest = _how(url) or [""]
        links += [f"  {preset.value:9} {url:32} {first}", *(f"{'':45}{each}" for each in rest)]
    lines = [
        f"world {world.name} seed {world.seed}, vehicle {simulation.referee.vehicle}, "
        f"system {options.system_id}, {options.speed:g} x real time",
        *(line.rstrip() for line in links),
        "Ctrl-C ends it.",
    ]
    print("\n".join(lines), file=sys.stderr, flush=True)  # noqa: T201 - for who starts it by hand


def _how(url: str) -> list[str]:
    """How clients reach an endpoint, one line each."""
    scheme, _, place = url.partition(":")
    port = place.rpartition(":")[2]
    mavsdk, mavproxy = {
        "udpout": ("udpin", "udpin"), "udpin": ("udpout", "udpout"), "tcpin": ("tcpout", "tcp"),
    }.get(scheme, ("", ""))  # fmt: skip
    if not mavsdk:
        return []
    alone = ["QGroundControl by itself"] if (scheme, port) == ("udpout", "14550") else []
    return [f"MAVSDK    {mavsdk}://{place}", f"MAVProxy  --master={mavproxy}:{place}", *alone]
