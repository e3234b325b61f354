"""Summaries of attack campaigns on kernels or on a program: outcome counts, shares, intervals."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from mavfi_cli.analysis.kernels import KERNELS, OUTCOMES
from mavfi_cli.attack.campaign import Plan, TargetRuns
from mavfi_cli.attack.kernels import catalogue
from mavfi_cli.attack.kernels.catalogue import Kernel
from mavfi_cli.attack.kernels.target import KernelTarget
from mavfi_cli.attack.null_runs import NullRuns
from mavfi_cli.attack.target import RunOutcome, signal_name
from mavfi_cli.core.files import Json, write_json, write_text
from mavfi_cli.fi.tracer.record_fields import FaultRecord
from mavfi_cli.report.drawing import write_figure
from mavfi_cli.report.paper import PaperCell, PaperColumn, PaperRow, PaperTable, draw_stack
from mavfi_cli.report.table import WIDTH, Table, folded, percent, rate
from mavfi_cli.stats.shares import Cluster, Share, clustered_share, unseen_share

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


def _share(runs: TargetRuns, hits: Iterable[bool], *, of_all: bool = False) -> Share:
    """Return the share of hits among the runs of a target in which the fault was injected.

    If windows of executed instructions are sampled, the spread between them widens the interval.

    Args:
        hits: whether each run is a hit.
        of_all: also count the runs in which the fault was not injected.
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
    return clustered_share(chosen, windows, sampled)


def _share_entry(share: Share) -> Json:
    """Return a share as an entry of `kernels.json`. Its value is None if there are no runs."""
    return {
        "count": share.count, "of": share.total, "share": _finite(share.share),
        "wilson95": [share.low, share.high],
    }  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class _TargetCounts:
    """How often the runs of one target ended in each outcome, with the details of these runs.

    Shares are relative to the *injected* runs. Only the share of runs in which the fault was not
    injected is relative to all runs.
    """

    null_runs: NullRuns
    outcomes: dict[str, Share]
    crashes: dict[str, int]
    not_injected: dict[str, int]
    activation: dict[str, int]

    @classmethod
    def of(cls, runs: TargetRuns) -> _TargetCounts:
        """Count the outcomes of the runs of a target."""
        records = runs.records
        reasons = (entry["not_injected_reason"] for entry in records)
        return cls(
            null_runs=runs.null_runs,
            outcomes={
                outcome.value: _share(
                    runs,
                    (entry["outcome"] == outcome.value for entry in records),
                    of_all=outcome is RunOutcome.NOT_INJECTED,
                )
                for outcome in RunOutcome
            },
            crashes=_counted(_crash(entry) for entry in _with(records, RunOutcome.CRASH)),
            not_injected=_counted(filter(None, reasons)),
            activation=_counted(entry["activation"]["activation"] for entry in records),
        )

    @property
    def differing(self) -> float:
        """Upper 95 % confidence bound on the share of runs whose output differs without a flip."""
        return unseen_share(self.null_runs.reached)

    def as_dict(self) -> Json:
        """Return the counts as plain values, as in `kernels.json`."""
        null_runs = self.null_runs
        return {
            "null_runs": {
                "runs": null_runs.reached, "counting": dict(sorted(null_runs.counting.items())),
                "unused": [*null_runs.unused], "differing95": self.differing,
            },
            "outcomes": {name: _share_entry(share) for name, share in self.outcomes.items()},
            "crashes": self.crashes,
            "not_injected": self.not_injected,
            "activation": self.activation,
        }  # fmt: skip

    def lines(self, indent: str) -> Iterator[str]:
        """Yield lines on null runs, crashes, activations, and why faults were not injected."""
        null_runs = self.null_runs
        counting = _listed(dict(sorted(null_runs.counting.items())))
        yield (
            f"{indent}null runs: {null_runs.reached} equal ({counting}); without a "
            f"flip at most {100 * self.differing:.1f} % differ (95 % bound)"
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
class _KernelCounts:
    """The runs of a kernel, the counts of their outcomes, and the sizes of silent corruptions.

    Attributes:
        noticeable: the share of runs with a silent corruption beyond the kernel's own tolerance.
        sdc: relative size of each silent corruption; None if it has no relative size.
        parts: sizes of silent corruptions by part of the output, in ascending order.
    """

    kernel: Kernel
    runs: TargetRuns
    counts: _TargetCounts
    noticeable: Share
    sdc: list[float | None]
    parts: dict[str, list[float]]

    @classmethod
    def of(cls, runs: TargetRuns) -> _KernelCounts:
        """Count the outcomes of a kernel's runs, and collect the sizes of silent corruptions."""
        assert isinstance(runs.target, KernelTarget)
        sizes = [entry["magnitude"] for entry in _with(runs.records, RunOutcome.SDC)]
        parts: dict[str, list[float]] = {}
        for magnitude in sizes:
            for name, size in magnitude["parts"].items():
                parts.setdefault(name, []).extend([abs(size)] if size else [])
        sdc = RunOutcome.SDC.value
        noticeable = (e["outcome"] == sdc and e["magnitude"]["noticeable"] for e in runs.records)
        return cls(
            kernel=catalogue.find(runs.target.kernel),
            runs=runs,
            counts=_TargetCounts.of(runs),
            noticeable=_share(runs, noticeable),
            sdc=[magnitude["relative"] for magnitude in sizes],
            parts={name: sorted(own) for name, own in parts.items()},
        )

    @property
    def comparable(self) -> list[float]:
        """Relative sizes of silent corruptions in ascending order, without those that have none."""
        return sorted(size for size in self.sdc if size is not None)

    def as_dict(self) -> Json:
        """Return the kernel's results as plain values, as in `kernels.json`."""
        runs, records = self.runs, self.runs.records
        run_s = sum(entry["run_s"] for entry in records)
        return {
            **self.counts.as_dict(),
            "kernel": runs.target.name,
            "title": self.kernel.title,
            "runs": len(records),
            "scope": runs.context["scope"],
            "inputs": [_input(runs, number) for number in range(len(runs.goldens))],
            "sdc_relative": {
                **_sizes(self.comparable), "incomparable": self.sdc.count(None)
            },
            "sdc_parts": {
                name: {"runs": len(part), **_sizes(part)} for name, part in self.parts.items()
            },
            "within_tolerance": sum(bool(entry["within_tolerance"]) for entry in records),
            "prepare_s": runs.prepare_s,
            "wall_s": runs.wall_s,
            "injections_per_core_hour": 3600.0 * len(records) / run_s if run_s else None,
            "sdc_noticeable": {
                "tolerance": self.kernel.tolerance, **_share_entry(self.noticeable)
            },
        }  # fmt: skip

    def lines(self) -> Iterator[str]:
        """Yield lines on the kernel's scope, inputs, runs and silent corruptions."""
        yield f"{self.kernel.title}: scope {', '.join(self.runs.context['scope'])}"
        for number in range(len(self.runs.goldens)):
            yield f"  input {number}: {_population(self.runs, number)}"
        yield from self.counts.lines("  ")
        if sizes := self.comparable:
            yield (
                f"  SDC, relative size: median {_median(sizes):.2g}, largest {sizes[-1]:.2g}; "
                f"{self.sdc.count(None)} of another shape or not a number"
            )
        if self.counts.outcomes[RunOutcome.SDC.value].count:
            yield f"  SDC beyond {self.kernel.tolerance}: {rate(self.noticeable, ends=1)}"
        if self.parts:
            parts = (
                f"{name} in {len(part)}" + (f" (median {_median(part):.2g})" if part else "")
                for name, part in self.parts.items()
            )
            yield f"  SDC by part: {', '.join(parts)}"


@dataclass(frozen=True, slots=True, kw_only=True)
class _KernelsSummary:
    """The results of an attack campaign on isolated kernels.

    Attributes:
        plan: everything that the results depend on.
    """

    plan: Json
    sampling: str
    kernels: list[_KernelCounts]

    def as_dict(self) -> Json:
        """Return the summary as plain values, which are the contents of `kernels.json`."""
        kernels = [kernel.as_dict() for kernel in self.kernels]
        return {"schema": SCHEMA, "plan": self.plan, "sampling": self.sampling, "kernels": kernels}

    def text(self) -> str:
        """Return a table of outcomes with one row per kernel, followed by notes, as text."""
        head = ["kernel", "runs", *(outcome.title for outcome in RunOutcome)]
        rows = [
            [kernel.kernel.title, str(len(kernel.runs.records)),
             *(rate(kernel.counts.outcomes[outcome.value], ends=1) for outcome in RunOutcome)]
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
        notes = (line for kernel in self.kernels for line in kernel.lines())
        return "\n".join([*lines, *(part for note in notes for part in folded(note, "    "))])


@dataclass(frozen=True, slots=True, kw_only=True)
class _ProgramSummary:
    """The results of an attack campaign on one program."""

    runs: TargetRuns
    sampling: str
    seed: int
    counts: _TargetCounts

    def as_dict(self) -> Json:
        """Return the summary as plain values, as `--json` prints them."""
        runs, profile = self.runs, self.runs.profile
        part = partial(getattr, profile) if profile is not None else lambda _name: None
        return {
            **runs.context,
            **self.counts.as_dict(),
            "sampling": self.sampling,
            "seed": self.seed,
            "runs": len(runs.records),
            "executed_in_scope": part("executed"),
            "profile_complete": part("complete"),
            "windows": part("windows"),
            "counted": part("counted") is not None,
            "not_reached": part("not_reached"),
            "profile_s": part("cost_s"),
            "golden_wall_s": runs.golden.wall_s,
            "wall_s": runs.wall_s,
        }

    def text(self) -> str:
        """Return a table with one row per outcome, followed by notes, as text."""
        lines = [f"{'outcome':<14}{'runs':>7}{'share':>9}   95 % interval"]
        for name, share in self.counts.outcomes.items():
            lines.append(
                f"{RunOutcome(name).title:<14}{share.count:>7}{percent(share.share):>9}   "
                f"{100 * share.low:.1f} to {100 * share.high:.1f} %"
            )
            if name == RunOutcome.SDC.value:
                lines[-1] += f"   (without a flip: 0.0 to {100 * self.counts.differing:.1f} %)"
        lines.append(f"sampling: {self.sampling}; scope: {', '.join(self.runs.context['scope'])}")
        if (profile := self.runs.profile) is not None:
            how = f"windows stepped: {profile.windows}"
            if profile.counted is not None and profile.not_reached is not None:
                missed = 100 * profile.not_reached
                how = f"counted by callgrind; {missed:.2g} % of the executions are not reached"
            lines.append(f"{profile.executed} executed instructions in scope, {how}")
        notes = self.counts.lines("")
        return "\n".join([*lines, *(part for note in notes for part in folded(note, "  "))])


def summarise(plan: Plan, campaign: Sequence[TargetRuns]) -> _KernelsSummary | _ProgramSummary:
    """Summarise the runs of an attack campaign on kernels or on a program."""
    sampling, first = plan.strategy().name, campaign[0]
    if isinstance(first.target, KernelTarget):
        kernels = [_KernelCounts.of(runs) for runs in campaign]
        return _KernelsSummary(plan=plan.to_json(first.target), sampling=sampling, kernels=kernels)
    return _ProgramSummary(
        runs=first, sampling=sampling, seed=plan.seed, counts=_TargetCounts.of(first)
    )


def _counted(names: Iterable[str]) -> dict[str, int]:
    """Return how often each name occurs, with the most frequent name first."""
    return dict(sorted(Counter(names).items(), key=lambda item: (-item[1], item[0])))


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


def _median(sizes: Sequence[float]) -> float:
    return sizes[len(sizes) // 2]


def _sizes(sizes: Sequence[float]) -> dict[str, float | None]:
    """Return the median and the largest of `sizes`, which are in ascending order."""
    largest = sizes[-1] if sizes else None
    return {"median": _median(sizes) if sizes else None, "largest": largest}


def _population(runs: TargetRuns, number: int) -> str:
    """Describe the population from which the faults of an input are drawn."""
    profile = runs.profiles[number]
    return "moments of one call" if profile is None else profile.describe()


def _input(runs: TargetRuns, number: int) -> Json:
    """Return the profile, the golden run and the outcomes of one input as plain values."""
    profile, golden = runs.profiles[number], runs.goldens[number]
    length = None if profile is None else profile.instructions
    return {
        "population": _population(runs, number),
        "complete": None if profile is None else profile.complete,
        "instructions": None if length is None else length.value,
        "instructions95": None if length is None else [length.low, _finite(length.high)],
        "golden": {"sha256": golden.sha256, "cpu_s": golden.cpu_s, "wall_s": golden.wall_s},
        "outcomes": _counted(entry["outcome"] for entry in runs.records_of(number)),
    }


# Files --------------------------------------------------------------------------------------------


def save_runs(
    folder: Path, summary: _KernelsSummary | _ProgramSummary, campaign: Sequence[TargetRuns]
) -> Sequence[str]:
    """Write the results of a campaign to a folder: CSV, JSON and, for kernels, a picture.

    The files are kernels.csv, kernels.json and, for a campaign on kernels, kernels.svg. The CSV
    file has one line per run; cells without a value are empty. The JSON file of a program also
    contains its golden run and all other runs.

    Returns:
        The names of the written files.

    Raises:
        RecordError: a file cannot be written.
    """
    contents, columns = summary.as_dict(), KERNEL_COLUMNS
    if isinstance(summary, _ProgramSummary):
        (runs,) = campaign
        golden = {name: getattr(runs.golden, name) for name in ("exit_code", "cpu_s", "wall_s")}
        contents = {"summary": contents, "golden": golden, "runs": list(runs.records)}
        columns = PROGRAM_COLUMNS
    rows = (_cells(entry, columns) for runs in campaign for entry in runs.records)
    write_text(folder / "kernels.csv", Table.of_records(rows, columns).csv())
    write_json(folder / KERNELS, contents)
    if isinstance(summary, _ProgramSummary):
        return KERNELS, "kernels.csv"
    write_figure(draw_stack(_as_table(summary), "two"), folder / "kernels.svg")
    return KERNELS, "kernels.csv", "kernels.svg"


def _cells(entry: FaultRecord, columns: Sequence[str]) -> dict[str, str]:
    flat = {**entry, **(entry.get("corruption") or {}), **entry["injection"]}
    if isinstance(entry["magnitude"], Mapping):
        flat.update(entry["magnitude"])
    flat["activation"] = entry["activation"]["activation"]
    flat["bits"] = " ".join(str(bit) for bit in flat.get("bits", ()))
    return {name: "" if flat.get(name) is None else str(flat[name]) for name in columns}


def _as_table(summary: _KernelsSummary) -> PaperTable:
    """Return the shares of the outcomes of each kernel's injected runs, as in Fig. 6."""
    rows = []
    for kernel in summary.kernels:
        shares = [kernel.counts.outcomes[name] for name in OUTCOMES]
        label = f"{kernel.kernel.title}, n = {shares[0].total}"
        rows.append(PaperRow(labels=(label,), cells=tuple(map(PaperCell.of_share, shares))))
    titles = (RunOutcome(name).title for name in OUTCOMES)
    return PaperTable(
        name="kernels", title="Outcomes of isolated kernels", labels=("kernel",),
        columns=tuple(PaperColumn(title=title) for title in titles), rows=tuple(rows),
    )  # fmt: skip
