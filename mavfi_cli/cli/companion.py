"""`mavfi companion`: run mavfi's own companion as a separate program."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from mavfi_cli.cli import types
from mavfi_cli.cli.grouped import GroupedCommand, given_options, section
from mavfi_cli.core.terminal import echo

_link, _mission, _output = section("Link"), section("Mission"), section("Output")
_FILE = click.Path(path_type=Path, exists=True, dir_okay=False)


@click.command(cls=GroupedCommand)
@_link("--link", metavar="URL", default="udpin:127.0.0.1:14540",
       help="Link to the vehicle: udpin:, udpout:, tcp:, tcpin:, serial:.")  # fmt: skip
@_link("--goal", metavar="X,Y,Z", type=types.PLACE, help="Goal of a flight in real time, ENU, m.")
@_link("--lockstep", "briefing", metavar="FILE", type=_FILE,
       help="Fly in lockstep, with start, goal, bounds and camera of this briefing.")  # fmt: skip
@_mission("--config", metavar="FILE", type=_FILE,
          help="TOML file of the mission, as for `mavfi fly`. Other options override "
               "it.")  # fmt: skip
@_mission("--seed", default=3, type=types.SEED, help="Root seed of the companion's random draws.")
@_mission("--planner", type=types.PLANNER, default="rrtstar", help="Planner.")
@_mission("--platform", type=types.PLATFORM, default="x86", metavar="NAME|FILE",
          help="Computer whose kernel latencies apply.")  # fmt: skip
@_mission("--stack", type=types.STACK, default="mavbench", metavar="NAME|FILE",
          help="Structure, checks and gains of the companion.")  # fmt: skip
@_mission("--v-max", "v_max_mps", default=3.0, help="Speed limit, m/s.")
@_mission("--land/--no-land", default=False, help="Land and disarm at the goal.")
@_output("--out", type=types.OUT, help="Parent of a run folder of the companion's own  [none].")
@_output("--quiet", is_flag=True, help="No progress on stderr.")
def companion(
    link: str,
    goal: tuple[float, float, float] | None,
    briefing: Path | None,
    config: Path | None,
    out: Path | None,
    quiet: bool,
    **options: Any,
) -> None:
    """Fly a vehicle to the goal as a program of a companion, for `mavfi fly --companion`.

    It exits with code 0 at the goal, and with code 1 after any other end.
    """
    from mavfi_cli.cli.progress import progress_view
    from mavfi_cli.companion.pipeline import CompanionParts
    from mavfi_cli.core.config import load_toml
    from mavfi_cli.core.files import ScratchFolder
    from mavfi_cli.mission.run import fly_mission
    from mavfi_cli.mission.run_folder import load_run
    from mavfi_cli.mission.vehicle import StartVehicle, Vehicle
    from mavfi_cli.report.summary import outcome_line
    from mavfi_cli.spec.mission import MissionConfig

    mission = MissionConfig() if config is None else load_toml(config, MissionConfig)
    given: dict[str, Any] = {name: options[name] for name in set(options) & set(given_options())}
    given |= {"companion": None, "speed": 1.0, "realtime": False}  # settings of the vehicle's side
    mission = replace(mission, **given)
    CompanionParts.of(mission)  # rejects unknown names
    if (goal is None) == (briefing is None):
        raise click.UsageError("give exactly one of --goal X,Y,Z and --lockstep FILE")
    launch: StartVehicle = Vehicle.start
    if briefing is None:
        mission = replace(mission, link=link, goal=goal)
    else:
        launch = Vehicle.at(link, briefing)
    with contextlib.ExitStack() as undo:
        place = out or undo.enter_context(ScratchFolder("companion"))
        with progress_view(mission, quiet=quiet) as view:
            record = load_run(fly_mission(mission, place, view, launch=launch).path).record
    echo(outcome_line(record))
    if not record.succeeded:
        raise click.exceptions.Exit(1)
