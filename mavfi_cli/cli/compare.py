"""`mavfi compare`: the same missions on several computers, side by side."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click


@click.command()
@click.option("--platform", "platforms", multiple=True, metavar="NAME|FILE",
              help="A computer; repeat it. The others are held against the first  "
                   "[x86, tx2].")  # fmt: skip
@click.option("--stack", default="mavbench", show_default=True, metavar="NAME|FILE",
              help="How the companion is wired; the same on all platforms.")  # fmt: skip
@click.option("--world", default="sparse", show_default=True, metavar="NAME|FILE",
              help="Where to fly.")  # fmt: skip
@click.option("--inject", metavar="TARGET,TARGET",
              help="Stages, states or groups that a fault strikes, one a flight; none for golden "
                   "flights only  [perception,planning,control].")  # fmt: skip
@click.option("--field", help="Bit field that is struck: sign, exponent, mantissa  [any].")
@click.option("--detector", "detectors", metavar="NAME,NAME",
              help="What protects; none, no protection, is always flown  "
                   "[none,gad,aad].")  # fmt: skip
@click.option("--missions", default=100, show_default=True,
              help="Of each platform, setting and target.")  # fmt: skip
@click.option("--first-seed", default=1, show_default=True,
              help="Of the missions; seeds count up from here.")  # fmt: skip
@click.option("--seed", default=1, show_default=True, help="Of the faults.")
@click.option("--jobs", type=click.IntRange(min=1),
              help="Missions at the same time  [one a core].")  # fmt: skip
@click.option("--out", type=click.Path(path_type=Path, file_okay=False),
              default=Path("comparison"), show_default=True,
              help="Folder of flights, tables and pictures; what it has is not flown "
                   "again.")  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print the comparison as JSON.")
@click.option("--csv", "as_csv", is_flag=True, help="Print a row a number as CSV.")
@click.option("--quiet", is_flag=True, help="No progress on stderr.")
def compare(out: Path, as_json: bool, as_csv: bool, quiet: bool, **options: Any) -> None:
    """Fly the same missions on each platform: golden, with faults, and with detectors.

    World, start, noise and faults are the same on all of them; only the computer differs.
    Interrupted, it goes on where it stopped when it is called again. Writes compare.json,
    compare.csv, compare.svg and timeline.svg.
    """
    from mavfi_cli.campaign.run import Options
    from mavfi_cli.cli.missions_view import missions_view
    from mavfi_cli.core.files import plain, write_json, write_text
    from mavfi_cli.report.compare_plot import write_compare_plot
    from mavfi_cli.report.tables.platforms import platform_csv, platform_lines
    from mavfi_cli.report.timeline import write_timeline
    from mavfi_cli.studies.compare import compare as run

    if as_json and as_csv:
        raise click.UsageError("--json or --csv, not both")
    plan = _plan(options)
    with missions_view(quiet=quiet) as view:
        told = run(plan, out, Options(jobs=options["jobs"] or 0), view)
    write_json(out / "compare.json", told)
    write_text(out / "compare.csv", platform_csv(told))
    write_compare_plot(told, out / "compare.svg")
    write_timeline(told, out / "timeline.svg")
    if as_json:
        click.echo(json.dumps(plain(told), indent=2, sort_keys=True))
    elif as_csv:
        click.echo(platform_csv(told), nl=False)
    else:
        files = "compare.json, compare.csv, compare.svg, timeline.svg, timeline/"
        click.echo("\n".join([*platform_lines(told), "", f"Files  {out}: {files}"]))


def _plan(options: dict[str, Any]) -> Any:
    from mavfi_cli.core.errors import ConfigError
    from mavfi_cli.studies.compare_plan import ComparePlan

    names = ("world", "field", "missions", "first_seed", "seed", "stack")
    chosen: dict[str, Any] = {name: options[name] for name in names}
    if options["platforms"]:
        chosen["platforms"] = options["platforms"]
    if options["inject"] is not None:
        targets = _names(options["inject"])
        if not targets:
            raise ConfigError("name at least one, or none", key="inject")
        chosen["inject"] = () if targets == ("none",) else targets
    if options["detectors"] is not None:
        chosen["detectors"] = _names(options["detectors"])
    return ComparePlan(**chosen)


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())
