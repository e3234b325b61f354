"""`mavfi compare`: fly the same missions on several platforms."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from mavfi_cli.cli import results, types
from mavfi_cli.cli.grouped import GroupedCommand, given_fields, section

_missions = section("Missions")
_settings = section("Faults and detectors")
_output = section("Output")


@click.command(cls=GroupedCommand)
@_missions("--platform", "platforms", multiple=True, type=types.PLATFORM, metavar="NAME|FILE",
           help="Platform; may be repeated. The others are compared with the first  [x86, "
                "tx2].")  # fmt: skip
@_missions("--stack", type=types.STACK, default="mavbench", metavar="NAME|FILE",
           help="Stack on all platforms; `mavfi stacks` lists them.")  # fmt: skip
@_missions("--world", type=types.WORLD, default="sparse", metavar="NAME|FILE",
           help="World of the missions.")  # fmt: skip
@_missions("--missions", default=100, type=types.MISSIONS,
           help="Missions per platform, setting and target.")  # fmt: skip
@_missions("--first-seed", default=1, type=types.FIRST_SEED,
           help="Seed of the first mission; each further mission adds 1.")  # fmt: skip
@_missions("--jobs", type=types.JOBS, help="Number of parallel missions  [one per core].")
@_settings("--inject", type=types.TARGETS, metavar="TARGET,TARGET",
           help="Stages, states or groups to corrupt, one per mission; none flies only "
                "golden runs  [perception,planning,control].")  # fmt: skip
@_settings("--field", type=types.FIELD, help="Field of the bits: sign, exponent, mantissa  [any].")
@_settings("--seed", default=1, type=types.SEED, help="Seed of the faults.")
@_settings("--detector", "detectors", type=types.DETECTORS, metavar="NAME,NAME",
           help="Detectors; none, the flight without detector, is always included  "
                "[none,gad,aad].")  # fmt: skip
@_output("--out", type=types.OUT, default=Path("comparison"),
         help="Folder of flights, tables and pictures. Recorded missions are not flown "
              "again.")  # fmt: skip
@_output("--json", "as_json", is_flag=True, help="Print the comparison as JSON.")
@_output("--csv", "as_csv", is_flag=True, help="Print the comparison as CSV, one number per row.")
@_output("--quiet", is_flag=True, help="No progress on stderr.")
def compare(out: Path, as_json: bool, as_csv: bool, quiet: bool, **_options: Any) -> None:
    """Fly the same missions on each platform: golden, with faults, and with detectors.

    World, start, noise and faults are the same on all platforms. The same command resumes an
    interrupted comparison. Writes compare.json, compare.csv, compare.svg and timeline.svg.
    """
    from mavfi_cli.campaigns.run import Options
    from mavfi_cli.cli.progress import missions_view
    from mavfi_cli.core.errors import ConfigError
    from mavfi_cli.core.files import plain
    from mavfi_cli.report.compare_plot import PICTURES
    from mavfi_cli.report.platforms import platform_csv, platform_lines
    from mavfi_cli.studies.compare import ComparePlan
    from mavfi_cli.studies.compare import compare as run

    given = given_fields(ComparePlan)
    if given.get("inject") == ():
        raise ConfigError("must name at least one target or be `none`, got ''", key="inject")
    if given.get("inject") == ("none",):
        given["inject"] = ()
    plan = ComparePlan(**given)
    with missions_view(quiet=quiet) as view:
        comparison = run(plan, out, Options(**given_fields(Options)), view)
    contents, table = plain(asdict(comparison)), platform_csv(comparison)
    pictures = {name: draw(comparison) for name, draw in PICTURES.items()}
    names = results.save(out, {"compare.json": contents}, {"compare.csv": table}, pictures)
    files = f"Files  {out}: {', '.join(names)}, timeline/"
    lines = [*platform_lines(comparison), "", files]
    results.show(contents, table, lines, as_json=as_json, as_csv=as_csv)
