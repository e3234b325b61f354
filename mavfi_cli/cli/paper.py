"""`mavfi reproduce` and `mavfi report`: the paper's experiments, and a page about its claims."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import click

from mavfi_cli.cli.grouped import GroupedCommand, GroupedOption

_what = partial(click.option, cls=GroupedOption, group="Missions")
_execution = partial(click.option, cls=GroupedOption, group="Execution")
_output = partial(click.option, cls=GroupedOption, group="Output")


@click.command(cls=GroupedCommand)
@click.argument("names", metavar="[ITEM...]", nargs=-1)
@_what("--scale", type=click.FloatRange(min=0.0, min_open=True, max=1.0), default=1.0,
       show_default=True,
       help="Fraction of the paper's number of missions. A folder may grow to a larger "
            "one.")  # fmt: skip
@_what("--stack", default="mavbench", show_default=True, metavar="NAME|FILE",
       help="Stack of the companion: the paper's, or another one (`mavfi stacks`).")  # fmt: skip
@_execution("--jobs", type=click.IntRange(min=1),
            help="Number of parallel missions  [one per core].")  # fmt: skip
@_output("--out", type=click.Path(path_type=Path, file_okay=False), default=Path("reproduction"),
         show_default=True, help="Folder in which each stack has a folder.")  # fmt: skip
@_output("--quiet", is_flag=True, help="No progress on stderr.")
def reproduce(names: tuple[str, ...], quiet: bool, **options: Any) -> None:
    """Fly the experiments of the paper, and print the results beside the paper's.

    ITEM is fig6 fig7 fig8 fig9 fig11 fig12 fig13 fig14 fig15 fig16 table3 table4 table5; all of
    them by default. Missions that items share are flown once. The same command resumes after an
    interruption.
    """
    from mavfi_cli.campaigns.run import Options
    from mavfi_cli.cli.progress import missions_view
    from mavfi_cli.paper.flying import reproduce as run
    from mavfi_cli.paper.items import FlightsPlan, items_named
    from mavfi_cli.paper.status import tables

    plan = FlightsPlan(
        items=items_named(names), stack=options["stack"], scale=options["scale"], out=options["out"]
    )
    with missions_view(quiet=quiet) as view:
        run(
            plan,
            Options(jobs=options["jobs"] or 0),
            view,
            lambda forecast: view.on_note(forecast.told),
        )
    for table in tables(plan):
        one_line = f"{table.title}\n  {table.result}\n"
        click.echo(table.text() if len(plan.items) == 1 else one_line, nl=False)
    if any(item.preset for item in plan.items):
        click.echo(f"\nTables and figures  mavfi campaign report {plan.folder} --item ITEM")
        click.echo(f"The page            mavfi report {plan.out} -o report.html")


@click.command()
@click.argument("places", nargs=-1, required=True, metavar="DIR...",
                type=click.Path(path_type=Path))  # fmt: skip
@click.option("-o", "--output", required=True, metavar="FILE", help="HTML file to write.",
              type=click.Path(path_type=Path, dir_okay=False))  # fmt: skip
@click.option("--upsets", type=click.FloatRange(min=0.0), default=1.0, show_default=True,
              help="Bit flips per hour that reach the injection sites, for the table of "
                   "failures per flight hour.")  # fmt: skip
def report(places: tuple[Path, ...], output: Path, upsets: float) -> None:
    """Write one HTML file: the paper's claims, tables and figures beside flown missions.

    DIR is the folder of a campaign or of `mavfi kernels`, a folder of such folders, as `mavfi
    reproduce` makes it, or an exported .parquet file. The page needs no network. It opens on a
    phone, and prints to PDF. Needs: pip install 'mavfi[report]'.
    """
    from mavfi_cli.report.page import render, require_page

    require_page(output)  # before what takes long, and before what needs scipy
    from mavfi_cli.core.files import write_text
    from mavfi_cli.paper.document import document
    from mavfi_cli.paper.sources import Evidence

    evidence = Evidence.gather(places)
    for problem in evidence.problems:
        click.echo(f"note: {problem}", err=True)
    page = render(document(evidence, upsets))
    write_text(output, page)
    missions = len(evidence.flights())
    click.echo(f"{missions:,} missions in {output} ({len(page.encode()) / 1e6:.1f} MB)")
