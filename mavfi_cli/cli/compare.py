"""`mavfi compare`: fly the same missions on several platforms."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mavfi_cli.cli.grouped import GroupedCommand, GroupedOption, names_in
from mavfi_cli.cli.parameters import (
    DETECTORS,
    FIELD,
    FIRST_SEED,
    JOBS,
    MISSIONS,
    OUT,
    PLATFORM,
    SEED,
    STACK,
    TARGETS,
    WORLD,
)
from mavfi_cli.core.terminal import echo, echo_lines

if TYPE_CHECKING:
    from mavfi_cli.studies.compare import ComparePlan

_missions = partial(click.option, cls=GroupedOption, group="Missions")
_settings = partial(click.option, cls=GroupedOption, group="Faults and detectors")
_output = partial(click.option, cls=GroupedOption, group="Output")


@click.command(cls=GroupedCommand)
@_missions("--platform", "platforms", multiple=True, type=PLATFORM, metavar="NAME|FILE",
           help="Platform; may be repeated. The others are compared with the first  "
                "[x86, tx2].")  # fmt: skip
@_missions("--stack", type=STACK, default="mavbench", show_default=True, metavar="NAME|FILE",
           help="Stack on all platforms; `mavfi stacks` lists them.")  # fmt: skip
@_missions("--world", type=WORLD, default="sparse", show_default=True, metavar="NAME|FILE",
           help="World of the missions.")  # fmt: skip
@_missions("--missions", default=100, show_default=True, type=MISSIONS,
           help="Missions per platform, setting and target.")  # fmt: skip
@_missions("--first-seed", default=1, show_default=True, type=FIRST_SEED,
           help="Seed of the first mission; each further mission adds 1.")  # fmt: skip
@_missions("--jobs", type=JOBS,
           help="Number of parallel missions  [one per core].")  # fmt: skip
@_settings("--inject", type=TARGETS, metavar="TARGET,TARGET",
           help="Stages, states or groups to corrupt, one per mission; none flies golden runs "
                "only  [perception,planning,control].")  # fmt: skip
@_settings("--field", type=FIELD, help="Field of the bits: sign, exponent, mantissa  [any].")
@_settings("--seed", default=1, show_default=True, type=SEED,
           help="Seed of the faults.")  # fmt: skip
@_settings("--detector", "detectors", type=DETECTORS, metavar="NAME,NAME",
           help="Detectors; none, the flight without detector, is always included  "
                "[none,gad,aad].")  # fmt: skip
@_output("--out", type=OUT, default=Path("comparison"), show_default=True,
         help="Folder of flights, tables and pictures. Recorded missions are not flown "
              "again.")  # fmt: skip
@_output("--json", "as_json", is_flag=True, help="Print the comparison as JSON.")
@_output("--csv", "as_csv", is_flag=True, help="Print the comparison as CSV, one number per row.")
@_output("--quiet", is_flag=True, help="No progress on stderr.")
def compare(
    out: Path, as_json: bool, as_csv: bool, quiet: bool, jobs: int | None, **options: Any
) -> None:
    """Fly the same missions on each platform: golden, with faults, and with detectors.

    World, start, noise and faults are the same on all platforms. The same command resumes an
    interrupted comparison. Writes compare.json, compare.csv, compare.svg and timeline.svg.
    """
    from mavfi_cli.campaigns.run import Options
    from mavfi_cli.cli.progress import missions_view
    from mavfi_cli.core.files import plain, write_json, write_text
    from mavfi_cli.report.compare_plot import PICTURES
    from mavfi_cli.report.drawing import write_figure
    from mavfi_cli.report.platforms import platform_csv, platform_lines
    from mavfi_cli.studies.compare import compare as run

    if as_json and as_csv:
        raise click.UsageError("--json cannot be combined with --csv")
    plan = _plan(**options)
    with missions_view(quiet=quiet) as view:
        comparison = run(plan, out, Options(jobs=jobs or 0), view)
    contents = plain(asdict(comparison))
    write_json(out / "compare.json", contents)
    write_text(out / "compare.csv", platform_csv(comparison))
    for name, draw in PICTURES.items():
        write_figure(draw(comparison), out / name)
    if as_json:
        echo(json.dumps(contents, indent=2, sort_keys=True))
    elif as_csv:
        echo(platform_csv(comparison), nl=False)
    else:
        files = "compare.json, compare.csv, compare.svg, timeline.svg, timeline/"
        echo_lines([*platform_lines(comparison), "", f"Files  {out}: {files}"])


def _plan(
    *, platforms: tuple[str, ...], inject: str | None, detectors: str | None, **same: Any
) -> ComparePlan:
    from mavfi_cli.core.errors import ConfigError
    from mavfi_cli.studies.compare import ComparePlan

    plan = ComparePlan(**same)
    if platforms:
        plan = replace(plan, platforms=platforms)
    if inject is not None:
        targets = names_in(inject)
        if not targets:
            problem = f"must name at least one target, or be none, got {inject!r}"
            raise ConfigError(problem, key="inject")
        plan = replace(plan, inject=() if targets == ("none",) else targets)
    return plan if detectors is None else replace(plan, detectors=names_in(detectors))
