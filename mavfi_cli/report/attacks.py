"""Counts, shares and intervals of a campaign, with everything that the numbers depend on."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavfi_cli.analysis.kernels import KERNELS
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


@dataclass(frozen=True, slots=True, kw_only=True)
class RunShare:
    """A share of runs with its 95 % interval; a share of nothing is None."""

    count: int
    of: int
    share: float | None
    wilson95: list[float]

    @classmethod
    def of_hits(cls, runs: TargetRuns, hits: Sequence[bool], *, of_all: bool = False) -> RunShare:
        """The share of hits in the injected runs, or in all.

        Where windows are sampled, the spread between them widens the interval.
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
        return cls(
            count=share.count,
            of=share.total,
            share=_finite(share.share),
            wilson95=[share.low, share.high],
        )

    @property
    def cell(self) -> str:
        """The share and its interval in per cent."""
        if self.share is None:
            return "-"
        low, high = (100.0 * end for end in self.wilson95)
        return f"{100.0 * self.share:.1f} % ({low:.1f} to {high:.1f})"


@dataclass(frozen=True, slots=True, kw_only=True)
class _NullRunCounts:
    """The null runs of a target.

    Attributes:
        runs, counting: how many were equal, and by which methods of counting.
        unused: methods that change the output.
        differing95: upper bound of the share that differs without a flip.
    """

    runs: int
    counting: dict[str, int]
    unused: list[str]
    differing95: float


@dataclass(frozen=True, slots=True, kw_only=True)
class TargetCounts:
    """The counts of one target; shares are those of the *injected* runs."""

    null_runs: _NullRunCounts
    outcomes: dict[str, RunShare]
    crashes: dict[str, int]
    not_injected: dict[str, int]
    activation: dict[str, int]

    @classmethod
    def of(cls, runs: TargetRuns) -> TargetCounts:
        """Count the runs of a target."""
        records, null_runs = runs.records, runs.null_runs
        reasons = (entry["not_injected_reason"] for entry in records)
        return cls(
            null_runs=_NullRunCounts(
                runs=null_runs.reached,
                counting=dict(sorted(null_runs.counting.items())),
                unused=[*null_runs.unused],
                differing95=unseen_share(null_runs.reached),
            ),
            outcomes={
                outcome.value: RunShare.of_hits(
                    runs,
                    [entry["outcome"] == outcome.value for entry in records],
                    of_all=outcome is RunOutcome.NOT_INJECTED,
                )
                for outcome in RunOutcome
            },
            crashes=_counted(_crash(entry) for entry in _with(records, RunOutcome.CRASH)),
            not_injected=_counted(filter(None, reasons)),
            activation=_counted(entry["activation"]["activation"] for entry in records),
        )

    def lines(self, indent: str) -> Iterator[str]:
        """Null runs, crashes, reasons and activations as text."""
        null_runs = self.null_runs
        yield (
            f"{indent}null runs: {null_runs.runs} equal ({_listed(null_runs.counting)}); without a "
            f"flip at most {100 * null_runs.differing95:.1f} % differ (95 % bound)"
        )
        if null_runs.unused:
            yield f"{indent}not used, because it changes the output: {', '.join(null_runs.unused)}"
        for title, counts in (
            ("crashes", self.crashes),
            ("not injected", self.not_injected),
            ("activation", self.activation),
        ):
            if counts:
                yield f"{indent}{title}: {_listed(counts)}"


@dataclass(frozen=True, slots=True, kw_only=True)
class _InputCounts:
    """One input of a kernel: how much of its run was profiled, and what became of its runs."""

    population: str
    complete: bool | None
    instructions: float | None
    instructions95: list[float | None] | None
    golden: dict[str, str | float]
    outcomes: dict[str, int]


@dataclass(frozen=True, slots=True, kw_only=True)
class KernelCounts:
    """The runs of a kernel.

    Attributes:
        counts: its counts; they have no level of their own in JSON.
        sdc_relative: median and largest relative size of silent corruptions, and the number of
            those without a size.
        noticeable, tolerance: the share of runs with a silent corruption beyond the kernel's own
            tolerance.
        sdc_parts: of each part of silent corruptions the number of runs that have it, and its
            median and largest size.
        within_tolerance: benign runs with another output.
    """

    kernel: str
    title: str
    runs: int
    scope: list[str]
    inputs: list[_InputCounts]
    counts: TargetCounts
    sdc_relative: dict[str, float | None]
    noticeable: RunShare
    tolerance: str
    sdc_parts: dict[str, dict[str, float | None]]
    within_tolerance: int
    prepare_s: float
    wall_s: float
    injections_per_core_hour: float | None

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as in `kernels.json`."""
        values = asdict(self)
        noticeable = {"tolerance": values.pop("tolerance"), **values.pop("noticeable")}
        return {**values.pop("counts"), **values, "sdc_noticeable": noticeable}


@dataclass(frozen=True, slots=True, kw_only=True)
class KernelsSummary:
    """A campaign on kernels.

    Attributes:
        plan: everything that the results depend on.
    """

    plan: dict[str, Any]
    sampling: str
    kernels: list[KernelCounts]

    def as_dict(self) -> dict[str, Any]:
        """Plain values, the contents of `kernels.json`."""
        kernels = [kernel.as_dict() for kernel in self.kernels]
        return {"schema": SCHEMA, "plan": self.plan, "sampling": self.sampling, "kernels": kernels}

    def text(self) -> str:
        """A table with one row per kernel, and notes."""
        head = ["kernel", "runs", *(outcome.title for outcome in RunOutcome)]
        rows = [
            [kernel.title, str(kernel.runs),
             *(kernel.counts.outcomes[outcome.value].cell for outcome in RunOutcome)]
            for kernel in self.kernels
        ]  # fmt: skip
        lines = [
            *Table([head, *rows], labels=1).lines(WIDTH),
            "",
            f"sampling: {self.sampling}; one fault a run; share of injected runs, 95 % Wilson "
            "interval,",
            "widened by the spread between windows where windows are sampled",
            f"inputs: {self.plan['flight']}; tolerance {self.plan['tolerance']:g}",
        ]
        for kernel in self.kernels:
            lines += _notes(kernel)
        return "\n".join(lines)


@dataclass(frozen=True, slots=True, kw_only=True)
class ProgramSummary:
    """A campaign on a program.

    Attributes:
        target: entries of every record about the program, such as its `scope`.
        counts: its counts; neither has a level of its own in JSON.
    """

    target: Mapping[str, Any]
    sampling: str
    seed: int
    runs: int
    executed_in_scope: int | None
    profile_complete: bool | None
    windows: str | None
    counted: bool
    not_reached: float | None
    profile_s: float | None
    golden_wall_s: float
    wall_s: float
    counts: TargetCounts

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as `--json` prints them."""
        values = asdict(self)
        return {**values.pop("target"), **values.pop("counts"), **values}

    def text(self) -> str:
        """A table with one row per outcome, and notes."""
        lines = [f"{'outcome':<14}{'runs':>7}{'share':>9}   95 % interval"]
        for name, row in self.counts.outcomes.items():
            share = "-" if row.share is None else f"{100 * row.share:.1f} %"
            low, high = (100 * end for end in row.wilson95)
            title = RunOutcome(name).title
            lines.append(f"{title:<14}{row.count:>7}{share:>9}   {low:.1f} to {high:.1f} %")
            if name == RunOutcome.SDC.value:
                bound = 100 * self.counts.null_runs.differing95
                lines[-1] += f"   (without a flip: 0.0 to {bound:.1f} %)"
        lines.append(f"sampling: {self.sampling}; scope: {', '.join(self.target['scope'])}")
        if self.executed_in_scope is not None:
            how = f"windows stepped: {self.windows}"
            if self.counted and self.not_reached is not None:
                missed = 100 * self.not_reached
                how = f"counted by callgrind; {missed:.2g} % of the executions are not reached"
            lines.append(f"{self.executed_in_scope} executed instructions in scope, {how}")
        return "\n".join([*lines, *self.counts.lines("")])


def summarise(plan: Plan, campaign: Sequence[TargetRuns]) -> KernelsSummary | ProgramSummary:
    """Summarise a campaign on kernels or on a program."""
    if isinstance(campaign[0].target, KernelTarget):
        return KernelsSummary(
            plan=plan.to_json(campaign[0].target),
            sampling=plan.strategy().name,
            kernels=[_kernel(runs) for runs in campaign],
        )
    runs = campaign[0]
    profile = runs.profile
    return ProgramSummary(
        target=runs.context,
        sampling=plan.strategy().name,
        seed=plan.seed,
        runs=len(runs.records),
        executed_in_scope=None if profile is None else profile.executed,
        profile_complete=None if profile is None else profile.complete,
        windows=None if profile is None else profile.windows,
        counted=profile is not None and profile.counted is not None,
        not_reached=None if profile is None else profile.not_reached,
        profile_s=None if profile is None else profile.cost_s,
        golden_wall_s=runs.golden.wall_s,
        wall_s=runs.wall_s,
        counts=TargetCounts.of(runs),
    )


def _counted(names: Iterable[str]) -> dict[str, int]:
    """Count each name, the most frequent first."""
    counts = Counter(names)
    return {name: counts[name] for name in sorted(counts, key=lambda n: (-counts[n], n))}


def _listed(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counts.items())


def _with(records: Iterable[FaultRecord], outcome: RunOutcome) -> Iterator[FaultRecord]:
    return (entry for entry in records if entry["outcome"] == outcome.value)


def _crash(entry: FaultRecord) -> str:
    if entry["signal"]:
        return signal_name(entry["signal"])
    if "exit_code" in entry:
        return f"exit {entry['exit_code']}"
    return str(entry["error"]).partition(":")[0] or "exit"


def _finite(number: float) -> float | None:
    return number if math.isfinite(number) else None


def _kernel(runs: TargetRuns) -> KernelCounts:
    target, records = runs.target, runs.records
    assert isinstance(target, KernelTarget)
    kernel = catalogue.find(target.kernel)
    sizes = [entry["magnitude"]["relative"] for entry in _with(records, RunOutcome.SDC)]
    finite = [size for size in sizes if size is not None]
    run_s = sum(entry["run_s"] for entry in records)
    sdc = RunOutcome.SDC.value
    noticeable = [e["outcome"] == sdc and e["magnitude"]["noticeable"] for e in records]
    return KernelCounts(
        kernel=target.name,
        title=kernel.title,
        runs=len(records),
        scope=runs.context["scope"],
        inputs=[_input(runs, number) for number in range(len(runs.goldens))],
        counts=TargetCounts.of(runs),
        sdc_relative={**_sizes(finite), "incomparable": len(sizes) - len(finite)},
        noticeable=RunShare.of_hits(runs, noticeable),
        tolerance=kernel.tolerance,
        sdc_parts=_parts(records),
        within_tolerance=sum(bool(entry["within_tolerance"]) for entry in records),
        prepare_s=runs.prepare_s,
        wall_s=runs.wall_s,
        injections_per_core_hour=3600.0 * len(records) / run_s if run_s else None,
    )


def _input(runs: TargetRuns, number: int) -> _InputCounts:
    profile, golden = runs.profiles[number], runs.goldens[number]
    length = None if profile is None else profile.instructions
    return _InputCounts(
        population="moments of one call" if profile is None else profile.describe(),
        complete=None if profile is None else profile.complete,
        instructions=None if length is None else length.value,
        instructions95=None if length is None else [length.low, _finite(length.high)],
        golden={"sha256": golden.sha256, "cpu_s": golden.cpu_s, "wall_s": golden.wall_s},
        outcomes=_counted(entry["outcome"] for entry in runs.records_of(number)),
    )


def _sizes(sizes: Sequence[float]) -> dict[str, float | None]:
    """The median and the largest of some sizes."""
    median = sorted(sizes)[len(sizes) // 2] if sizes else None
    return {"median": median, "largest": max(sizes, default=None)}


def _parts(records: Sequence[FaultRecord]) -> dict[str, dict[str, float | None]]:
    """The parts of silent corruptions: the number of runs that have one, and its size."""
    sizes: dict[str, list[float]] = {}
    for entry in _with(records, RunOutcome.SDC):
        for name, size in entry["magnitude"]["parts"].items():
            sizes.setdefault(name, [])
            sizes[name] += [abs(size)] if size else []
    return {name: {"runs": len(own), **_sizes(own)} for name, own in sizes.items()}


def _notes(kernel: KernelCounts) -> Iterator[str]:
    yield f"{kernel.title}: scope {', '.join(kernel.scope)}"
    yield from (f"  input {n}: {own.population}" for n, own in enumerate(kernel.inputs))
    yield from kernel.counts.lines("  ")
    sdc = kernel.sdc_relative
    if sdc["median"] is not None:
        yield (
            f"  SDC, relative size: median {sdc['median']:.2g}, largest {sdc['largest']:.2g}; "
            f"{sdc['incomparable']} of another shape or not a number"
        )
    if kernel.counts.outcomes[RunOutcome.SDC.value].count:
        yield f"  SDC beyond {kernel.tolerance}: {kernel.noticeable.cell}"
    if kernel.sdc_parts:
        parts = ", ".join(
            f"{name} in {part['runs']}"
            + (f" (median {part['median']:.2g})" if part["runs"] else "")
            for name, part in kernel.sdc_parts.items()
        )
        yield f"  SDC by part: {parts}"


# Files --------------------------------------------------------------------------------------------


def save_runs(
    folder: Path, summary: KernelsSummary | ProgramSummary, campaign: Sequence[TargetRuns]
) -> Sequence[str]:
    """Write kernels.csv, a line a run, and kernels.json, the summary; of kernels a picture too.

    Entries without a value are empty. The JSON of a program has its golden run and all runs.

    Returns:
        The names of the files.

    Raises:
        RecordError: a file cannot be written.
    """
    contents, columns = summary.as_dict(), KERNEL_COLUMNS
    if isinstance(summary, ProgramSummary):
        (runs,) = campaign
        golden = {name: getattr(runs.golden, name) for name in ("exit_code", "cpu_s", "wall_s")}
        contents = {"summary": contents, "golden": golden, "runs": list(runs.records)}
        columns = PROGRAM_COLUMNS
    rows = (_cells(entry, columns) for runs in campaign for entry in runs.records)
    write_text(folder / "kernels.csv", Table.of_records(rows, columns).csv())
    write_json(folder / KERNELS, contents)
    if isinstance(summary, ProgramSummary):
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


def _kernel_figure(summary: KernelsSummary) -> Figure:
    """Draw a figure with one bar per kernel and the shares of its injected runs in per cent."""
    kernels = summary.kernels
    figure = new_figure(max(5.2, 1.8 + 1.05 * len(kernels)), 4.4)
    axes = figure.add_subplot()
    for place, kernel in enumerate(kernels):
        _bar(axes, place, kernel.counts.outcomes)
    axes.set_xticks(range(len(kernels)), [_tick(kernel) for kernel in kernels], fontsize=8)
    axes.set_ylim(0.0, 100.0)
    axes.set_xlim(-0.6, len(kernels) - 0.4)
    axes.set_ylabel("share of injected runs, %")
    open_frame(axes)
    handles = [axes.bar(0, 0, color=colour, label=_LABELS[n]) for n, colour in _COLOURS.items()]
    figure.legend(handles=handles, loc="outside upper center", ncols=4, frameon=False)
    figure.supxlabel(_caption(summary), fontsize=7, color=NOTE)
    return figure


def _bar(axes: Axes, place: int, outcomes: Mapping[str, RunShare]) -> None:
    """Stack the segments from below. All but the last have an interval at their upper edge."""
    base, below = 0.0, -_LINE / 2  # keeps numbers off the axis
    for number, (name, colour) in enumerate(_COLOURS.items()):
        row = outcomes[name]
        share = 100.0 * (row.share or 0.0)
        axes.bar(place, share, bottom=base, width=_WIDTH, color=colour)
        if share >= _ROOM:
            axes.text(
                place - 0.16, base + share / 2, f"{share:.0f}", color=INK, fontsize=8.5,
                ha="center", va="center",
            )  # fmt: skip
        elif row.count:
            below = max(base + share / 2, below + _LINE)
            axes.text(
                place + _WIDTH / 2 + 0.03, below, _small(share), color=_DARKER[name],
                fontsize=7.5, ha="left", va="center",
            )  # fmt: skip
        low, high = (100.0 * edge for edge in row.wilson95)
        if row.count and name != "benign" and high - low >= _VISIBLE:
            axes.errorbar(
                place + 0.03 + 0.1 * number, base + share, [[share - low], [high - share]],
                color=INK, elinewidth=0.9, capsize=2.0,
            )  # fmt: skip
        base += share


def _small(share: float) -> str:
    return f"{share:.1f}" if share >= 0.05 else "< 0.1"


def _tick(kernel: KernelCounts) -> str:
    injected = kernel.counts.outcomes["benign"].of
    return f"{kernel.title}\nn = {injected}"


def _caption(summary: KernelsSummary) -> str:
    bits = summary.plan["model"]["bits"]
    return (
        f"{'one bit' if bits == 1 else f'{bits} bits'} flipped a run; sampling: "
        f"{summary.sampling}\n"
        "whiskers: 95 % Wilson interval of a segment's share, at its upper edge; benign is the rest"
    )
