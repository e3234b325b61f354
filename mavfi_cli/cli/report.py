"""`mavfi report`: one page about what flown campaigns say of the paper's claims."""

from __future__ import annotations

from pathlib import Path

import click


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
    from mavfi_cli.report.page.render import render, require_page

    require_page(output)  # before what takes long, and before what needs scipy
    from mavfi_cli.claims.document import document
    from mavfi_cli.claims.sources import gather
    from mavfi_cli.core.files import write_text

    evidence = gather(places)
    for problem in evidence.problems:
        click.echo(f"note: {problem}", err=True)
    page = render(document(evidence, upsets))
    write_text(output, page)
    missions = evidence.flights().num_rows
    click.echo(f"{missions:,} missions in {output} ({len(page.encode()) / 1e6:.1f} MB)")
