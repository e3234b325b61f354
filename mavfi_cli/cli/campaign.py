"""`mavfi campaign`: plan, run, summarise and export thousands of missions."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mavfi_cli.cli import grouped, types
from mavfi_cli.cli.grouped import given_options, option, refuse_given, section
from mavfi_cli.core.option_types import Number, OutFile
from mavfi_cli.core.terminal import echo, echo_lines, note
from mavfi_cli.report.drawing import PICTURES
from mavfi_cli.report.table import FORMATS

if TYPE_CHECKING:
    from mavfi_cli.campaigns.ledger import Ledger
    from mavfi_cli.campaigns.missions import Sampling

_FOLDER = click.Path(path_type=Path, file_okay=False)
_what = section("Missions")
_execution = section("Execution")
_size = section("Sample size")
_output = section("Output")
_SET = _what("--set", "changes", multiple=True, metavar="KEY=VALUE[,VALUE]",
             help="Replace a factor of the preset or file, as in world=dense. May be repeated. "
                  "Quote a value that contains a comma, or write all values as a TOML list. The "
                  "change becomes part of the folder name.")  # fmt: skip
_SAMPLING = _what("--sampling", type=click.Choice(["uniform", "stratified"]),
                  help="How faults are drawn: each by itself, or in rounds, with more of them "
                       "where outcomes have varied, and weights  [as specified].")  # fmt: skip
_WORLDS = _what("--worlds", type=click.Choice(["fixed", "many"]),
                help="Worlds of a campaign that has fixed ones: these, or another one for each "
                     "seed  [fixed].")  # fmt: skip
_KEEP = ("none", "few", "failures", "sampled", "all")
# Options of `status` that imply --full.
_FULL = {"by", "confidence", "quality", "overhead", "failures"}
_OPEN_CLUSTER = (
    "warning: {} has no TLS: anyone who can connect to it, including every user of its host, can "
    "run programs as you there, on the workers and on this machine (docs/how-to/cluster.md)"
)


@click.group(cls=grouped.GroupOfCommands)
def campaign() -> None:
    """Plan, fly and evaluate thousands of paired missions.

    WHAT is a preset (fig7 fig8 fig9 fig11 fig13 fig14 fig16 table3 table4 speeds hardening
    ablation protections), a campaign.toml, or the folder of an existing campaign. Presets and
    files fly into campaigns/NAME, where the other commands look for them. Write ./NAME for a
    folder with the name of a preset.
    """


@campaign.command(cls=grouped.GroupedCommand)
@click.argument("what", metavar="WHAT", type=types.CAMPAIGN)
@_what("--scale", type=types.SCALE, help="Fraction of the repetitions to run: 0.1 runs a tenth.")
@_SET
@_SAMPLING
@_WORLDS
@_what("--missing-only", is_flag=True,
       help="Resume a campaign; fail if there is none in the folder.")  # fmt: skip
@_what("--append", is_flag=True, help="Add the missions that are not yet on the folder's list.")
@_what("--retry-errors", "errors", is_flag=True, help="Repeat the missions that could not begin.")
@_execution("--jobs", type=types.JOBS, help="Number of parallel missions  [one per core].")
@_execution("--cluster", metavar="URL",
            help="Fly on a dask.distributed scheduler, such as tls://host:8786.")  # fmt: skip
@_execution("--cluster-key", type=_FOLDER, metavar="DIR",
            help="Keys of the cluster, made by `mavfi campaign keys`.")  # fmt: skip
@_execution("--firmware", metavar="PATH",
            help="SITL binary to trust. A binary that the missions of a folder name is executed "
                 "only if it is this one or that of PX4_SITL or ARDUCOPTER_SITL.")  # fmt: skip
@_execution("--companion", metavar="FILE|CMD",
            help="User's companion to trust: the missions of a folder execute no other "
                 "one.")  # fmt: skip
@_execution("--limit", "limit_s", type=types.ABOVE_ZERO,
            help="Wall time limit of a mission, s; missions that exceed it are recorded as `hang`  "
                 "[900, and in real time the mission's time limit in addition].")  # fmt: skip
@_execution("--whole", is_flag=True,
            help="Fly every mission from its start. By default missions that differ only in their "
                 "fault are forked from one flight; their records are the same.")  # fmt: skip
@_output("--out", type=types.OUT, help="Folder of the campaign  [campaigns/NAME].")
@_output("--keep", type=click.Choice(_KEEP), help="Run folders to keep  [the campaign's choice].")
@_output("--json", "as_json", is_flag=True, help="Print the summary as JSON.")
@_output("--quiet", is_flag=True, help="No progress on stderr.")
def run(what: str, as_json: bool, quiet: bool, **options: Any) -> None:
    """Fly all missions of a campaign that have no result yet.

    Ctrl-C waits for the missions in flight; a second one kills them. The next run resumes the
    campaign in either case.
    """
    from mavfi_cli.campaigns.begin import begin, chosen, rounds_of
    from mavfi_cli.campaigns.run import Options, fly_missing
    from mavfi_cli.campaigns.specification import Keep
    from mavfi_cli.cli.progress import missions_view

    trusted = (options["firmware"], options["companion"])
    spec, folder = chosen(
        what, options["out"], options["scale"], options["changes"], programs=trusted,
        sampling=_sampling(options["sampling"]), worlds=options["worlds"],
    )  # fmt: skip
    flying = Options(
        **grouped.given_fields(
            Options,
            keep=spec.keep if options["keep"] is None else Keep(options["keep"]),
            programs=spec.programs(),
        )
    )
    if flying.cluster is not None and flying.cluster_key is None:
        note(_OPEN_CLUSTER.format(flying.cluster))
    with (
        missions_view(quiet=quiet) as view,
        begin(
            spec, folder, append=options["append"], missing_only=options["missing_only"],
            options=flying, spectator=view,
        ) as ledger,
    ):  # fmt: skip
        view.on_note(f"{ledger.meta('name')} in {ledger.folder}")
        fly_missing(ledger, flying, view, spec.stop, rounds_of(spec, ledger))
        _show(ledger, as_json=as_json)


def _sampling(value: str | None) -> Sampling | None:
    from mavfi_cli.campaigns.missions import Sampling

    return None if value is None else Sampling(value)


@campaign.command()
@click.argument("what", metavar="WHAT", type=types.CAMPAIGN)
@option("--by", metavar="LABEL,LABEL", help="Group settings by these labels  [all].")
@option("--confidence", default=0.95, type=types.CONFIDENCE,
        help="Confidence level of the intervals.")  # fmt: skip
@option("--quality", is_flag=True,
        help="Add intervals and extremes of time, distance, energy and replans.")  # fmt: skip
@option("--overhead", is_flag=True,
        help="Add the share of flight time that detection and recovery take, by "
             "stage.")  # fmt: skip
@option("--failures", is_flag=True,
        help="Add the share of faults that fail otherwise successful missions.")  # fmt: skip
@option("--kernels", type=_FOLDER,
        help="With --failures: folder of `mavfi kernels --out`. Adds the probability of failure "
             "given an SDC of a kernel.")  # fmt: skip
@option("--upsets", type=types.UPSETS,
        help="With --failures: bit flips per hour that reach the injection sites. Adds failures "
             "per flight hour.")  # fmt: skip
@option("--full", is_flag=True,
        help="Print all settings and comparisons instead of one screen. --by, --confidence, "
             "--quality, --overhead and --failures imply it.")  # fmt: skip
@option("--json", "as_json", is_flag=True, help="Print the whole summary as JSON.")
def status(
    what: str, by: str | None, confidence: float, as_json: bool, full: bool, **parts: Any
) -> None:
    """Show the progress, the time left and one table, even while the campaign runs.

    The table is the paper's if the campaign is a preset of the paper; otherwise it lists the
    settings.
    `mavfi campaign report` prints it in other formats and draws it.
    """
    from mavfi_cli.campaigns.begin import opened

    if not parts["failures"] and (parts["kernels"] or parts["upsets"] is not None):
        raise click.UsageError("--kernels and --upsets need --failures")
    full = full or bool(given_options().keys() & _FULL)
    with opened(what) as ledger:
        _show(ledger, grouped.names_in(by or ""), confidence, as_json=as_json, full=full, **parts)


@campaign.command()
@click.argument("what", metavar="WHAT", type=types.CAMPAIGN)
@option("--item", type=types.ITEM, metavar="ITEM",
        help="Figure or table of the paper, such as fig12 for flights of table4. Required in the "
             "folder of `mavfi reproduce`  [that of the preset].")  # fmt: skip
@option("--format", "form", type=click.Choice([*FORMATS]), default="text",
        help="Format of the table.")  # fmt: skip
@option("--output", metavar="FILE", type=OutFile(PICTURES),
        help="Draw the figure into this .svg, .pdf or .png file.")  # fmt: skip
@option("--columns", type=click.Choice(["one", "two"]), default="one",
        help="Width of the figure in columns of a printed page.")  # fmt: skip
def report(what: str, item: str | None, form: str, output: Path | None, columns: str) -> None:
    """Print the table, or the numbers of the figure, with our values beside the paper's.

    For a campaign that is not in the paper, print the table of its settings.
    """
    from mavfi_cli.campaigns.begin import opened
    from mavfi_cli.paper.figures import draw
    from mavfi_cli.paper.status import shown
    from mavfi_cli.report.drawing import write_figure

    with opened(what) as ledger:
        table, flights = shown(ledger, item)
        echo(table.formatted(form), nl=False)
        if output is not None:
            write_figure(draw(table, flights, columns), output)
            note(f"figure: {output}")


@campaign.command()
@click.argument("what", metavar="WHAT", type=types.CAMPAIGN)
@click.argument("path", type=OutFile((".parquet", ".csv"), allow_dash=True))
@option("--json", "as_json", is_flag=True,
        help="Print the file and the number of its missions as JSON.")  # fmt: skip
def export(what: str, path: Path, as_json: bool) -> None:
    """Write one row per mission to PATH: a .parquet or .csv file, or - for CSV on stdout."""
    from mavfi_cli import library
    from mavfi_cli.core.files import write_atomically
    from mavfi_cli.report.campaign import flights_file

    if as_json and path == Path("-"):
        raise click.UsageError("--json needs a file, because - writes the CSV to stdout")
    table = library.campaign(what).table
    content = flights_file(table, path)
    if path == Path("-"):
        echo(content.decode(), nl=False)
    else:
        write_atomically(path, lambda file: file.write(content))
        summary = {"file": str(path), "missions": table.num_rows, "columns": table.column_names}
        text = f"{table.num_rows} missions in {path}"
        echo(json.dumps(summary, indent=2) if as_json else text)


@campaign.command()
@click.argument("what", metavar="WHAT", type=types.CAMPAIGN)
@option("--pair", "number", type=types.NUMBER, metavar="NUMBER",
        help="Draw the pair of this mission. The number is the first part of the run folder's "
             "name  [the pair whose flight time a fault increases most].")  # fmt: skip
@option("--output", metavar="FILE", type=OutFile(PICTURES), required=True,
        help="The .svg, .pdf or .png file to write.")  # fmt: skip
@option("--json", "as_json", is_flag=True, help="Print what was drawn as JSON.")
def draw(what: str, number: int | None, output: Path, as_json: bool) -> None:
    """Draw the golden, faulty and protected flights of one pair from above.

    Needs the run folders of all settings of the pair. Each fault gets its own panel.
    """
    from dataclasses import asdict

    from mavfi_cli.analysis.trajectories import pair
    from mavfi_cli.campaigns.begin import opened
    from mavfi_cli.core.files import plain
    from mavfi_cli.report.drawing import write_figure
    from mavfi_cli.report.top_view import Trajectories

    with opened(what) as ledger:
        chosen = pair(ledger, number)
        flown = Trajectories.of(chosen)
        write_figure(flown.draw(), output)
    if as_json:
        summary = {**asdict(chosen), "picture": output}
        echo(json.dumps(plain(summary), indent=2, default=str))
    else:
        absent = [f"not in the picture: {text}" for text in chosen.absent]
        echo_lines([*flown.lines(), *absent, f"Picture  {output}"])


@campaign.command(cls=grouped.GroupedCommand)
@click.argument("what", metavar="[WHAT]", required=False, type=types.CAMPAIGN)
@_what("--scale", type=types.SCALE, help="Fraction of the repetitions to run.")
@_SET
@_WORLDS
@_size("--margin", type=Number(1.0e-6, 0.5, max_open=True),
       help="Print the number of missions per setting for a confidence interval of this "
            "half-width.")  # fmt: skip
@_size("--expect", "expected", default=0.5, type=types.SHARE,
       help="With --margin: expected success rate.")  # fmt: skip
@_size("--difference", type=Number(-1.0, 1.0),
       help="Print the number of pairs that detects this difference of success rates.")  # fmt: skip
@_size("--discordant", default=0.2, type=types.SHARE,
       help="With --difference: expected share of pairs whose outcomes differ.")  # fmt: skip
@_size("--power", default=0.8, type=types.CONFIDENCE,
       help="With --difference: probability of detecting it.")  # fmt: skip
@_size("--confidence", default=0.95, type=types.CONFIDENCE, help="Confidence level.")
@_output("--json", "as_json", is_flag=True, help="Print as JSON.")
def plan(what: str | None, scale: float | None, as_json: bool, **options: Any) -> None:
    """List the missions of a campaign without flying, or compute a sample size.

    Rejects whatever `run` would reject.
    """
    from mavfi_cli.stats.shares import missions_for_margin, pairs_for_difference

    needs = {"margin": ("expected",), "difference": ("discordant", "power")}
    for name, others in needs.items():
        if options[name] is None:
            refuse_given(others, f"needs --{name}")
    if options["margin"] is options["difference"] is None:
        refuse_given(("confidence",), "needs --margin or --difference")
    if what is None:
        refuse_given(("scale", "changes", "worlds"), "needs a campaign")
    answer: dict[str, Any] = {}
    lines: list[str] = []
    names = ("margin", "expected", "difference", "discordant", "power", "confidence")
    margin, expected, difference, discordant, power, confidence = (options[n] for n in names)
    sure = f"{100 * confidence:g} % confidence"
    if margin is not None:
        count = missions_for_margin(margin, expected=expected, confidence=confidence)
        answer["missions"] = count
        lines.append(
            f"{count} missions per setting: Wilson interval of +-{margin:g} at a rate of "
            f"{expected:g}, {sure}"
        )
    if difference is not None:
        count = pairs_for_difference(difference, discordant, confidence=confidence, power=power)
        answer["pairs"] = count
        lines.append(
            f"{count} pairs: a difference of {difference:g} detected with {100 * power:g} % power, "
            f"{sure}, where {100 * discordant:g} % of the pairs end differently "
            f"(--discordant {discordant:g})"
        )
    if what is not None:
        answer["campaign"], more = _planned(what, scale, options["changes"], options["worlds"])
        lines += more
    if not answer:
        raise click.UsageError("name a campaign, or give --margin or --difference")
    echo_lines(json.dumps(answer, indent=2).split("\n") if as_json else lines)


@campaign.command()
@click.argument("folder", metavar="DIR", type=types.OUT)
def keys(folder: Path) -> None:
    """Make the keys of a cluster in DIR, for `mavfi campaign run --cluster tls://...`.

    Whoever can read the keys can run programs as you on the cluster. Existing keys are not
    replaced.
    """
    from mavfi_cli.campaigns.cluster_keys import CERTIFICATE, KEY, make_keys

    make_keys(folder)
    echo(f"{folder / CERTIFICATE} and {folder / KEY}: only you can read them")


def _planned(
    what: str, scale: float | None, changes: Sequence[str], worlds: str | None
) -> tuple[dict[str, Any], list[str]]:
    """Describe the missions that a campaign would fly. Return a dictionary, and lines of text."""
    from collections import Counter

    from mavfi_cli.campaigns.begin import chosen_spec, flyable
    from mavfi_cli.campaigns.missions import label_text

    spec = chosen_spec(what, scale, changes, worlds=worlds)
    missions = flyable(spec)
    settings = Counter(label_text(mission.labels) for mission in missions)
    rule = spec.describe_worlds() or None
    pairs = len({mission.pair for mission in missions})
    summary = {
        "name": spec.name, "about": spec.about, "fixed_world": rule, "missions": len(missions),
        "pairs": pairs, "settings": dict(settings),
    }  # fmt: skip
    return summary, [
        f"{spec.name}: {spec.about}" if spec.about else spec.name,
        *([rule] if rule else []),
        *(f"{count:>7}  {labels}" for labels, count in settings.items()),
        f"{len(missions):>7}  missions of {pairs} pair{'s' if pairs != 1 else ''}",
    ]


def _show(
    ledger: Ledger,
    by: Sequence[str] = (),
    confidence: float = 0.95,
    *,
    as_json: bool,
    full: bool = False,
    **parts: Any,
) -> None:
    from mavfi_cli.core.files import plain
    from mavfi_cli.paper.status import progress_lines, short, shown
    from mavfi_cli.report.campaign import CampaignReport, state_lines

    if as_json:
        report = CampaignReport.of(ledger, by, confidence, **parts)
        echo(json.dumps(plain(report.as_dict()), indent=2))
        return
    lines = [*progress_lines(ledger), *state_lines(ledger)]
    if full:
        lines += CampaignReport.of(ledger, by, confidence, **parts).lines()
    else:
        table, _ = shown(ledger)
        lines = [line for line in lines if line not in table.notes]
        lines += ["", *short(table).formatted("text").rstrip().split("\n")]
    echo_lines(lines)
