"""Counts, shares and intervals of a campaign, with everything that the numbers depend on."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavfi_cli.analysis.failures import KERNELS
from mavfi_cli.attack.campaign import Plan, TargetRuns
from mavfi_cli.attack.kernels import catalogue
from mavfi_cli.attack.kernels.target import KernelTarget
from mavfi_cli.attack.target import RunOutcome, signal_name
from mavfi_cli.core.files import write_json, write_text
from mavfi_cli.fi.tracer.record_fields import FaultRecord
from mavfi_cli.report.drawing import INK, NOTE, new_figure, open_frame, write_figure
from mavfi_cli.report.table import WIDTH, Table
from mavfi_cli.stats.shares import Cluster, clustered_share, unseen_share

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SCHEMA = 2
_OF_EVERY_RUN = (
    "object offset symbol instruction k site role operand bits before after activation "
    "not_injected_reason stop_s run_s output_sha256"
)
KERNEL_COLUMNS = (
    "kernel run input outcome signal error relative absolute unit text noticeable "
    "within_tolerance " + _OF_EVERY_RUN
).split()
PROGRAM_COLUMNS = f"run outcome signal exit_code magnitude {_OF_EVERY_RUN}".split()
_SHOWN = tuple(RunOutcome)


def _counts(runs: TargetRuns) -> dict[str, Any]:
    """The counts of one target; shares are those of the *injected* runs."""
    records = runs.records
    null_runs = runs.null_runs
    return {
        "null_runs": {
            "runs": null_runs.reached,
            "counting": dict(sorted(null_runs.counting.items())),
            "unused": list(null_runs.unused),
            "differing95": unseen_share(null_runs.reached),
        },
        "outcomes": {
            outcome.value: _share(
                runs,
                [entry["outcome"] == outcome.value for entry in records],
                of_all=outcome is RunOutcome.NOT_INJECTED,
            )
            for outcome in RunOutcome
        },
        "crashes": _counted(_crash(entry) for entry in _with(records, RunOutcome.CRASH)),
        "not_injected": _counted(
            entry["not_injected_reason"] for entry in records if entry["not_injected_reason"]
        ),
        "activation": _counted(entry["activation"]["activation"] for entry in records),
    }


def _share(runs: TargetRuns, hits: Sequence[bool], *, of_all: bool = False) -> dict[str, Any]:
    """The share of hits in the injected runs, or in all, with its 95 % interval.

    Where windows are sampled, the spread between them widens the interval. A share of nothing is
    null.
    """
    chosen: list[bool] = []
    windows: list[Cluster | None] = []
    for run, (hit, entry) in enumerate(zip(hits, runs.records, strict=True)):
        if of_all or entry["outcome"] != RunOutcome.NOT_INJECTED.value:
            number = runs.input_of(run)
            profile = runs.profiles[number]
            window = None if profile is None else profile.window_of(entry)
            windows.append(window and ((number, window[0]), window[1]))
            chosen.append(hit)
    sampled = {
        (number, stratum): count
        for number, profile in enumerate(runs.profiles)
        if profile is not None
        for stratum, count in profile.sampled.items()
    }
    share = clustered_share(chosen, windows, sampled)
    return {
        "count": share.count,
        "of": share.total,
        "share": None if math.isnan(share.share) else share.share,
        "wilson95": [share.low, share.high],
    }


def _counted(names: Iterable[str]) -> dict[str, int]:
    """Count each name, the most frequent first."""
    counts = Counter(names)
    return {name: counts[name] for name in sorted(counts, key=lambda n: (-counts[n], n))}


def _with(records: Iterable[FaultRecord], outcome: RunOutcome) -> Iterator[FaultRecord]:
    return (entry for entry in records if entry["outcome"] == outcome.value)


def _crash(entry: FaultRecord) -> str:
    if entry["signal"]:
        return signal_name(entry["signal"])
    if "exit_code" in entry:
        return f"exit {entry['exit_code']}"
    return str(entry["error"]).partition(":")[0] or "exit"


def _count_lines(counts: Mapping[str, Any], indent: str) -> Iterator[str]:
    null_runs = counts["null_runs"]
    methods = ", ".join(f"{name} {count}" for name, count in null_runs["counting"].items())
    yield (
        f"{indent}null runs: {null_runs['runs']} equal ({methods}); without a flip at most "
        f"{100 * null_runs['differing95']:.1f} % differ (95 % bound)"
    )
    if null_runs["unused"]:
        yield f"{indent}not used, because it changes the output: {', '.join(null_runs['unused'])}"
    for title in ("crashes", "not_injected", "activation"):
        if counts[title]:
            parts = ", ".join(f"{name} {count}" for name, count in counts[title].items())
            yield f"{indent}{title.replace('_', ' ')}: {parts}"


def summarise(plan: Plan, campaign: Sequence[TargetRuns]) -> dict[str, Any]:
    """Summarise a campaign on kernels or on a program as plain values."""
    if isinstance(campaign[0].target, KernelTarget):
        return _kernels(plan, campaign)
    return _program(plan, campaign[0])


def table(summary: Mapping[str, Any]) -> str:
    """Format a summary: one row a kernel, or one row an outcome of a program."""
    return _kernel_table(summary) if "kernels" in summary else _program_table(summary)


# -- kernels


def _kernels(plan: Plan, campaign: Sequence[TargetRuns]) -> dict[str, Any]:
    return {
        "schema": SCHEMA,
        "plan": plan.to_json(campaign[0].target),
        "sampling": plan.strategy().name,
        "kernels": [_kernel(runs) for runs in campaign],
    }


def _kernel(runs: TargetRuns) -> dict[str, Any]:
    target, records = runs.target, runs.records
    assert isinstance(target, KernelTarget)
    kernel = catalogue.find(target.kernel)
    sizes = [entry["magnitude"]["relative"] for entry in _with(records, RunOutcome.SDC)]
    finite = sorted(size for size in sizes if size is not None)
    run_s = sum(entry["run_s"] for entry in records)
    return {
        "kernel": target.name,
        "title": kernel.title,
        "runs": len(records),
        "scope": runs.context["scope"],
        "inputs": [_input(runs, number) for number in range(len(runs.goldens))],
        **_counts(runs),
        "sdc_relative": {
            "median": finite[len(finite) // 2] if finite else None,
            "largest": finite[-1] if finite else None,
            "incomparable": len(sizes) - len(finite),
        },
        "sdc_noticeable": {"tolerance": kernel.tolerance, **_noticeable(runs)},
        "sdc_parts": _parts(records),
        "within_tolerance": sum(bool(entry["within_tolerance"]) for entry in records),
        "prepare_s": runs.prepare_s,
        "wall_s": runs.wall_s,
        "injections_per_core_hour": 3600.0 * len(records) / run_s if run_s else None,
    }


def _input(runs: TargetRuns, number: int) -> dict[str, Any]:
    """One input of a kernel: how much of its run was profiled, and what became of its runs."""
    records, profile = runs.records_of(number), runs.profiles[number]
    golden = runs.goldens[number]
    length = None if profile is None else profile.instructions
    return {
        "population": "moments of one call" if profile is None else profile.in_words(),
        "complete": None if profile is None else profile.complete,
        "instructions": None if length is None else length.value,
        "instructions95": None if length is None else [length.low, _finite(length.high)],
        "golden": {"sha256": golden.sha256, "cpu_s": golden.cpu_s, "wall_s": golden.wall_s},
        "outcomes": _counted(entry["outcome"] for entry in records),
    }


def _finite(number: float) -> float | None:
    return number if math.isfinite(number) else None


def _noticeable(runs: TargetRuns) -> dict[str, Any]:
    """The share of runs with a silent corruption beyond the kernel's own tolerance."""
    sdc = RunOutcome.SDC.value
    return _share(
        runs, [e["outcome"] == sdc and e["magnitude"]["noticeable"] for e in runs.records]
    )


def _parts(records: Sequence[FaultRecord]) -> dict[str, Any]:
    """The parts of silent corruptions: the number of runs that have one, and its size."""
    found: dict[str, list[float]] = {}
    for entry in _with(records, RunOutcome.SDC):
        for name, size in entry["magnitude"]["parts"].items():
            found.setdefault(name, [])
            found[name] += [abs(size)] if size else []
    return {
        name: {
            "runs": len(sizes),
            "median": sorted(sizes)[len(sizes) // 2] if sizes else None,
            "largest": max(sizes, default=None),
        }
        for name, sizes in found.items()
    }


def _kernel_table(summary: Mapping[str, Any]) -> str:
    head = ["kernel", "runs", *(outcome.title for outcome in _SHOWN)]
    rows = [
        [each["title"], str(each["runs"]), *(_cell(each["outcomes"][o.value]) for o in _SHOWN)]
        for each in summary["kernels"]
    ]
    lines = Table([head, *rows], labels=1).lines(WIDTH)
    lines.append("")
    lines.append(
        f"sampling: {summary['sampling']}; one fault a run; share of injected runs, "
        "95 % Wilson interval,"
    )
    lines.append("widened by the spread between windows where windows are sampled")
    lines.append(f"inputs: {summary['plan']['flight']}; tolerance {summary['plan']['tolerance']:g}")
    for kernel in summary["kernels"]:
        lines += _notes(kernel)
    return "\n".join(lines)


def _cell(row: Mapping[str, Any]) -> str:
    if row["share"] is None:
        return "-"
    low, high = (100.0 * edge for edge in row["wilson95"])
    return f"{100.0 * row['share']:.1f} % ({low:.1f} to {high:.1f})"


def _notes(kernel: Mapping[str, Any]) -> list[str]:
    lines = [f"{kernel['title']}: scope {', '.join(kernel['scope'])}"]
    lines += [f"  input {n}: {each['population']}" for n, each in enumerate(kernel["inputs"])]
    lines += _count_lines(kernel, "  ")
    sdc, noticeable = kernel["sdc_relative"], kernel["sdc_noticeable"]
    if sdc["median"] is not None:
        lines.append(
            f"  SDC, relative size: median {sdc['median']:.2g}, largest {sdc['largest']:.2g}; "
            f"{sdc['incomparable']} of another shape or not a number"
        )
    if kernel["outcomes"][RunOutcome.SDC.value]["count"]:
        lines.append(f"  SDC beyond {noticeable['tolerance']}: {_cell(noticeable)}")
    if kernel["sdc_parts"]:
        parts = ", ".join(
            f"{name} in {part['runs']}"
            + (f" (median {part['median']:.2g})" if part["runs"] else "")
            for name, part in kernel["sdc_parts"].items()
        )
        lines.append(f"  SDC by part: {parts}")
    return lines


# -- a program


def _program(plan: Plan, runs: TargetRuns) -> dict[str, Any]:
    profile = runs.profile
    return {
        **runs.context,
        "sampling": plan.strategy().name,
        "seed": plan.seed,
        "runs": len(runs.records),
        "executed_in_scope": None if profile is None else profile.executed,
        "profile_complete": None if profile is None else profile.complete,
        "windows": None if profile is None else profile.windows,
        "counted": profile is not None and profile.counted is not None,
        "not_reached": None if profile is None else profile.not_reached,
        "profile_s": None if profile is None else profile.cost_s,
        "golden_wall_s": runs.golden.wall_s,
        "wall_s": runs.wall_s,
        **_counts(runs),
    }


def _program_table(summary: Mapping[str, Any]) -> str:
    lines = [f"{'outcome':<14}{'runs':>7}{'share':>9}   95 % interval"]
    for name, row in summary["outcomes"].items():
        share = "-" if row["share"] is None else f"{100 * row['share']:.1f} %"
        low, high = (100 * edge for edge in row["wilson95"])
        lines.append(
            f"{RunOutcome(name).title:<14}{row['count']:>7}{share:>9}   {low:.1f} to {high:.1f} %"
        )
        if name == RunOutcome.SDC.value:
            bound = 100 * summary["null_runs"]["differing95"]
            lines[-1] += f"   (without a flip: 0.0 to {bound:.1f} %)"
    lines.append(f"sampling: {summary['sampling']}; scope: {', '.join(summary['scope'])}")
    if summary["executed_in_scope"] is not None:
        lines.append(
            f"{summary['executed_in_scope']} executed instructions in scope, {_how(summary)}"
        )
    return "\n".join([*lines, *_count_lines(summary, "")])


def _how(summary: Mapping[str, Any]) -> str:
    if not summary["counted"]:
        return f"windows stepped: {summary['windows']}"
    missed = 100 * summary["not_reached"]
    return f"counted by callgrind; {missed:.2g} % of the executions are not reached"


# -- both


def save_runs(
    folder: Path, summary: Mapping[str, Any], campaign: Sequence[TargetRuns]
) -> Sequence[str]:
    """Write kernels.csv, a line a run, and kernels.json, the summary; of kernels a picture too.

    Entries without a value are empty. The JSON of a program has its golden run and all runs.

    Returns:
        The names of the files.

    Raises:
        RecordError: a file cannot be written.
    """
    told, columns = summary, KERNEL_COLUMNS
    if "kernels" not in summary:
        (runs,) = campaign
        golden = {name: getattr(runs.golden, name) for name in ("exit_code", "cpu_s", "wall_s")}
        told = {"summary": summary, "golden": golden, "runs": list(runs.records)}
        columns = PROGRAM_COLUMNS
    rows = (_cells(entry, columns) for runs in campaign for entry in runs.records)
    write_text(folder / "kernels.csv", Table.of_records(rows, columns).csv())
    write_json(folder / KERNELS, told)
    if "kernels" not in summary:
        return KERNELS, "kernels.csv"
    write_figure(_kernel_figure(summary), folder / "kernels.svg")
    return KERNELS, "kernels.csv", "kernels.svg"


def _cells(entry: FaultRecord, columns: Sequence[str]) -> dict[str, str]:
    flat = {**entry, **(entry.get("corruption") or {}), **entry["injection"]}
    if isinstance(entry["magnitude"], Mapping):
        flat.update(entry["magnitude"])
    flat["activation"] = entry["activation"]["activation"]
    flat["bits"] = " ".join(str(bit) for bit in flat.get("bits", ()))
    return {name: "" if flat.get(name) is None else str(flat[name]) for name in columns}


# -- the picture of a campaign on kernels: stacked bars with confidence intervals

_COLOURS = {"sdc": "#8e5aa3", "crash": "#e4572e", "hang": "#f2b134", "benign": "#c3d4e6"}
_DARKER = {"sdc": "#6d3f84", "crash": "#b23a17", "hang": "#a06c00", "benign": "#4f6a88"}
_WIDTH = 0.6
_ROOM = 5.0  # per cent; minimum share for a number inside its bar segment
_LINE = 3.2  # per cent; height of a line of numbers
_VISIBLE = 0.5  # per cent; minimum width of a drawn interval
_LABELS = {"benign": "benign", "crash": "crash", "hang": "hang", "sdc": "SDC"}


def _kernel_figure(summary: Mapping[str, Any]) -> Figure:
    """Draw a figure with one bar per kernel and the shares of its injected runs in per cent."""
    kernels = summary["kernels"]
    figure = new_figure(max(5.2, 1.8 + 1.05 * len(kernels)), 4.4)
    axes = figure.add_subplot()
    for place, kernel in enumerate(kernels):
        _bar(axes, place, kernel["outcomes"])
    axes.set_xticks(range(len(kernels)), [_tick(kernel) for kernel in kernels], fontsize=8)
    axes.set_ylim(0.0, 100.0)
    axes.set_xlim(-0.6, len(kernels) - 0.4)
    axes.set_ylabel("share of injected runs, %")
    open_frame(axes)
    handles = [axes.bar(0, 0, color=colour, label=_LABELS[n]) for n, colour in _COLOURS.items()]
    figure.legend(handles=handles, loc="outside upper center", ncols=4, frameon=False)
    figure.supxlabel(_caption(summary), fontsize=7, color=NOTE)
    return figure


def _bar(axes: Axes, place: int, outcomes: Mapping[str, Any]) -> None:
    """Stack the segments from below. All but the last have an interval at their upper edge."""
    base, below = 0.0, -_LINE / 2  # keeps numbers off the axis
    for number, (name, colour) in enumerate(_COLOURS.items()):
        row = outcomes[name]
        share = 100.0 * (row["share"] or 0.0)
        axes.bar(place, share, bottom=base, width=_WIDTH, color=colour)
        if share >= _ROOM:
            axes.text(
                place - 0.16, base + share / 2, f"{share:.0f}", color=INK, fontsize=8.5,
                ha="center", va="center",
            )  # fmt: skip
        elif row["count"]:
            below = max(base + share / 2, below + _LINE)
            axes.text(
                place + _WIDTH / 2 + 0.03, below, _small(share), color=_DARKER[name],
                fontsize=7.5, ha="left", va="center",
            )  # fmt: skip
        low, high = (100.0 * edge for edge in row["wilson95"])
        if row["count"] and name != "benign" and high - low >= _VISIBLE:
            axes.errorbar(
                place + 0.03 + 0.1 * number, base + share, [[share - low], [high - share]],
                color=INK, elinewidth=0.9, capsize=2.0,
            )  # fmt: skip
        base += share


def _small(share: float) -> str:
    return f"{share:.1f}" if share >= 0.05 else "< 0.1"


def _tick(kernel: Mapping[str, Any]) -> str:
    injected = kernel["outcomes"]["benign"]["of"]
    return f"{kernel['title']}\nn = {injected}"


def _caption(summary: Mapping[str, Any]) -> str:
    bits = summary["plan"]["model"]["bits"]
    return (
        f"{'one bit' if bits == 1 else f'{bits} bits'} flipped a run; sampling: "
        f"{summary['sampling']}\n"
        "whiskers: 95 % Wilson interval of a segment's share, at its upper edge; benign is the rest"
    )
