"""`python -m sitl.world`, which `mavfi world` runs."""

from __future__ import annotations

import functools
import json
import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import click

from mavfi_cli.core.files import require_output, write_atomically, write_text
from mavfi_cli.core.option_types import Coordinates, OutFile
from mavfi_cli.core.terminal import echo, exit_code
from sitl.command_line import CONTEXT, complete_world, places
from sitl.world.plan import DEFAULT_CLEARANCE_M, check_world, world_svg
from sitl.world.world import World, format_place, load_world, named_worlds

_WORLD_HELP = "WORLD is a name from `mavfi world list`, gen:density,size, or a TOML file."


def _on_world(command: Callable[..., None]) -> Callable[..., Any]:
    @click.argument("name", metavar="WORLD", shell_complete=complete_world)
    @places
    @click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
    @functools.wraps(command)
    def with_world(
        *,
        name: str,
        seed: int,
        start_enu_m: Coordinates | None,
        goal_enu_m: Coordinates | None,
        **given: Any,
    ) -> None:
        world = load_world(name, seed=seed, start_enu_m=start_enu_m, goal_enu_m=goal_enu_m)
        command(world, **given)

    return with_world


@click.group(context_settings=CONTEXT)
def _world() -> None:
    """List, make, check and draw worlds: boxes on flat ground, a start and a goal.

    Each cell of 10 x 10 m of a generated world contains a square tower of unlimited height with a
    given probability. A fixed scene is always the same, and the seed chooses start and goal. The
    same seed always gives the same world.
    """


@_world.command(name="list")
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
def _list(as_json: bool) -> None:
    """List all named worlds."""
    if as_json:
        rows = [{"name": name, "description": text} for name, text in named_worlds().items()]
        echo(json.dumps(rows, indent=1))
        return
    for name, description in named_worlds().items():
        echo(f"{name:<14}{description}")
    echo("\nAlso gen:density,size (such as gen:0.1,4) and the path of a TOML file.")


@_world.command(name="make", epilog=_WORLD_HELP, short_help="Write a world as a TOML file.")
@_on_world
@click.option("-o", "--output", type=OutFile(), help="TOML file  [stdout].")
def _make(made: World, as_json: bool, output: Path | None) -> None:
    """Write a world as a TOML file of boxes, which every --world option accepts."""
    text = made.toml()
    if output is not None:
        write_text(output, text)
    if as_json:
        echo(json.dumps({**made.as_dict(), "file": output and str(output)}, indent=1))
    elif output is None:
        echo(text, nl=False)
    else:
        echo(f"{output}: {_boxes(made)}")


@_world.command(name="check", epilog=_WORLD_HELP, short_help="Check that a world can be flown.")
@_on_world
@click.option(
    "--clearance",
    type=click.FloatRange(min=0.0),
    default=DEFAULT_CLEARANCE_M,
    help="Clearance of the path from every box, m.",
)
@click.option("--expect", type=click.Choice(["path"]), help="Exit with code 1 if there is no path.")
def _check(made: World, as_json: bool, clearance: float, expect: str | None) -> None:
    """Check that start and goal are clear and that a path with the clearance exists.

    The path is searched on a grid of 0.5 m at the goal's height. Paths over or under an obstacle
    are ignored.
    """
    check = check_world(made, clearance_m=clearance)
    if as_json:
        echo(json.dumps({**made.as_dict(), "check": check.as_dict()}, indent=1))
    else:
        echo(_boxes(made))
        for what, place, gap_m in (
            ("start", made.start_enu_m, check.start_clearance_m),
            ("goal ", made.goal_enu_m, check.goal_clearance_m),
        ):
            nearest = f"{gap_m:.1f} m away" if math.isfinite(gap_m) else "none"
            echo(f"{what}  {format_place(place)}, nearest obstacle {nearest}")
        path = "none" if check.path_m is None else f"{check.path_m:.1f} m"
        clearance_text = f"{check.clearance_m:g} m clearance"
        echo(f"path   {path} with {clearance_text}; straight {check.straight_m:.1f} m")
    if expect == "path" and not check.path_exists:
        sys.exit(1)


@_world.command(name="draw", epilog=_WORLD_HELP)
@_on_world
@click.option("-o", "--output", type=OutFile((".svg",)), help="SVG file  [WORLD-SEED.svg].")
@click.option("--path", "with_path", is_flag=True, help="Also draw the path that `check` finds.")
def _draw(made: World, as_json: bool, output: Path | None, with_path: bool) -> None:
    """Draw a world from above, as SVG."""
    file = output or Path(f"{made.name.replace(':', '-').replace('/', '-')}-{made.seed}.svg")
    require_output(file, [".svg"])
    path = check_world(made).path_enu_m if with_path else None
    picture = world_svg(made, path)
    write_atomically(file, lambda opened: opened.write(picture))
    if as_json:
        echo(json.dumps({**made.as_dict(), "file": str(file)}, indent=1))
    else:
        echo(f"{file}: {_boxes(made)}")


def _boxes(made: World) -> str:
    count = len(made.boxes_enu_m)
    return f"{made.name}, seed {made.seed}, {count} box{'' if count == 1 else 'es'}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `mavfi world` with the arguments, or with those of this process. Return the exit code."""
    return exit_code(
        lambda: _world.main(args=arguments, prog_name="mavfi world", standalone_mode=False)
    )


if __name__ == "__main__":
    sys.exit(main())
