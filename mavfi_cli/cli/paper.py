"""`mavfi reproduce` and `mavfi report`: fly the paper's experiments, and report on its claims."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import click

from mavfi_cli.cli.grouped import GroupedCommand, given_fields, option, refuse_given, section
from mavfi_cli.cli.types import ABOVE_ZERO, COMPAT, ITEM, JOBS, OUT, RESTART, STACK, UPSETS
from mavfi_cli.core.option_types import Number, OutFile
from mavfi_cli.core.terminal import echo, echo_lines, note

_what = section("Missions")
_execution = section("Execution")
_output = section("Output")


@click.command(cls=GroupedCommand)
@click.argument("names", metavar="[ITEM...]", nargs=-1, type=ITEM)
@_what("--scale", type=Number(0.0, 1.0, min_open=True), default=1.0,
       help="Fraction of the paper's number of missions. A folder can be extended to a larger "
            "fraction.")  # fmt: skip
@_what("--stack", type=STACK, default="mavbench", metavar="NAME|FILE",
       help="Stack of the companion: the paper's, or another one (`mavfi stacks`).")  # fmt: skip
@_what("--worlds", type=click.Choice(["fixed", "many"]), default="fixed",
       help="Fly one fixed world of each environment, as the paper does, or another world for each "
            "seed.")  # fmt: skip
@_what("--restart", "node_restart_s", type=RESTART, default=1.0,
       help="Time until a node that died of a fault in an instruction works again, s; never means "
            "3600.")  # fmt: skip
@_what("--compat", type=COMPAT, metavar="INJECTOR",
       help="Choose operands and bits of faults in instructions as another injector: pinfi, "
            "pinfi-bugs, rosfi-2021.")  # fmt: skip
@_what("--settle", is_flag=True,
       help="Then fly further missions where claims are undecided, until each is decided. Tests "
            "and intervals hold at any number of looks.")  # fmt: skip
@_what("--hours", type=ABOVE_ZERO, help="With --settle: most wall time for these missions, h.")
@_execution("--jobs", type=JOBS, help="Number of parallel missions  [one per core].")
@_execution("--whole", is_flag=True,
            help="Fly every mission from its start, as in `mavfi campaign run`.")  # fmt: skip
@_output("--out", type=OUT, default=Path("reproduction"), help="Parent of one folder per stack.")
@_output("--json", "as_json", is_flag=True, help="Print the tables and their folder as JSON.")
@_output("--quiet", is_flag=True, help="No progress on stderr.")
def reproduce(names: tuple[str, ...], as_json: bool, quiet: bool, **options: Any) -> None:
    """Fly the experiments of the paper, and print our results beside the paper's.

    ITEM is fig6 fig7 fig8 fig9 fig11 fig12 fig13 fig14 fig15 fig16 table3 table4 table5; all of
    them by default. Missions that items share are flown once. The same command resumes after an
    interruption. --restart and --compat select the items with faults in instructions.
    """
    from mavfi_cli.campaigns.run import Options
    from mavfi_cli.campaigns.specification import Keep
    from mavfi_cli.cli.progress import missions_view
    from mavfi_cli.core.files import plain
    from mavfi_cli.paper.flying import opened
    from mavfi_cli.paper.flying import reproduce as run
    from mavfi_cli.paper.items import FlightsPlan
    from mavfi_cli.paper.settling import require_settleable, settle
    from mavfi_cli.paper.status import tables
    from mavfi_cli.spec.stack import load_stack

    load_stack(options["stack"])  # fail before the flights
    plan = FlightsPlan(items=(), **given_fields(FlightsPlan, stack=options["stack"]))
    plan = replace(plan, items=plan.named(names))
    if options["settle"]:
        require_settleable(plan)
    else:
        refuse_given(("hours",), "needs --settle")
    with missions_view(quiet=quiet) as view:
        flying = Options(keep=Keep.FEW, **given_fields(Options))
        run(plan, flying, view, lambda forecast: view.on_note(forecast.summary))
        settled = None
        if options["settle"]:
            with opened(plan) as ledger:
                settled = settle(plan, ledger, flying, view, options["hours"])
    if as_json:
        summary = {"folder": plan.folder, "stack": plan.stack, "scale": plan.scale,
                "items": [asdict(table) for table in tables(plan)],
                "settling": settled}  # fmt: skip
        echo(json.dumps(plain(summary), indent=2, default=str))
        return
    for table in tables(plan):
        one_line = f"{table.title}\n  {table.result}\n"
        echo(table.formatted("text") if len(plan.items) == 1 else one_line, nl=False)
    if settled is not None:
        echo_lines(["", "Claims at all looks together", *settled])
    if any(item.preset for item in plan.items):
        echo(f"\nTables and figures  mavfi campaign report {plan.folder} --item ITEM")
        echo(f"The page            mavfi report {plan.out} -o report.html")


@click.command(cls=GroupedCommand)
@click.argument("places", nargs=-1, required=True, metavar="DIR...",
                type=click.Path(path_type=Path))  # fmt: skip
@option(
    "-o",
    "--output",
    required=True,
    metavar="FILE",
    help="HTML file to write.",
    type=OutFile((".html", ".htm")),
)
@option("--upsets", type=UPSETS, default=1.0,
        help="Bit flips per hour that reach the injection sites, for the table of failures per "
             "flight hour.")  # fmt: skip
@option("--json", "as_json", is_flag=True,
        help="Print the file, its number of missions, and the verdicts with their numbers as "
             "JSON.")  # fmt: skip
def report(places: tuple[Path, ...], output: Path, upsets: float, as_json: bool) -> None:
    """Write one HTML file: the paper's claims, tables and figures beside flown missions.

    DIR is the folder of a campaign or of `mavfi kernels`, a folder of such folders, which `mavfi
    reproduce` makes, or an exported .parquet file. The page needs no network. It opens on a
    phone, and prints to PDF. Needs: pip install 'mavfi[report]'.
    """
    from mavfi_cli.report.page import render, require_page

    require_page(output)  # fail before the slow part
    from mavfi_cli.cli.progress import steps_view
    from mavfi_cli.core.files import plain, write_text
    from mavfi_cli.paper.document import document
    from mavfi_cli.paper.sources import Evidence

    with steps_view() as step:
        step("reading the missions")
        evidence = Evidence.gather(places)
        for problem in evidence.problems:
            note(f"note: {problem}")
        content = document(evidence, upsets, step)
        step("writing the page")
        page = render(content)
        write_text(output, page)
    missions, size = len(evidence.flights()), len(page.encode())
    if as_json:
        summary = {"file": str(output), "bytes": size, "missions": missions,
                   "answer": content.answer, "verdicts": content.verdicts(),
                   "claims": plain([claim.as_dict() for claim in content.claims]),
                   "problems": [*evidence.problems]}  # fmt: skip
        echo(json.dumps(summary, indent=2))
    else:
        if not content.only_companions:
            echo(content.answer)
        echo(f"{missions:,} missions in {output} ({size / 1e6:.1f} MB)")
