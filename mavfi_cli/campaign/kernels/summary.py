"""Counts, shares and intervals of isolated runs, with all that the numbers depend on."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from mavfi_cli.campaign.kernels import catalogue
from mavfi_cli.campaign.kernels.profile import in_words
from mavfi_cli.campaign.kernels.runs import KernelRuns, Plan
from mavfi_cli.core.columns import blocks
from mavfi_cli.fi.isolated.outcome import Outcome, counted, shares, shares_to_json, signal_name
from mavfi_cli.fi.isolated.runs import csv_table

SCHEMA = 1
_COLUMNS = (
    "kernel run outcome signal error relative absolute unit text within_tolerance object offset "
    "symbol instruction k site role operand bits before after activation not_injected_reason "
    "stop_s run_s output_sha256"
)
CSV_COLUMNS = _COLUMNS.split()
_SHOWN = (Outcome.BENIGN, Outcome.CRASH, Outcome.HANG, Outcome.SDC, Outcome.NOT_INJECTED)


def summarise(plan: Plan, campaign: Sequence[KernelRuns]) -> dict[str, Any]:
    """The whole campaign as plain values."""
    return {
        "schema": SCHEMA,
        "plan": plan.to_json(),
        "sampling": plan.strategy().name,
        "kernels": [_kernel(runs) for runs in campaign],
    }


def _kernel(runs: KernelRuns) -> dict[str, Any]:
    prepared, records = runs.prepared, runs.records
    profile = prepared.profile
    outcomes = [Outcome(entry["outcome"]) for entry in records]
    windows = [] if profile is None else [profile.window_of(entry) for entry in records]
    sizes = [entry["magnitude"]["relative"] for entry in _with(records, Outcome.SDC)]
    finite = sorted(size for size in sizes if size is not None)
    run_s = sum(entry["run_s"] for entry in records)
    return {
        "kernel": prepared.kernel,
        "title": catalogue.find(prepared.kernel).title,
        "runs": len(records),
        "population": "moments of one call" if profile is None else in_words(profile),
        "complete": None if profile is None else profile.complete,
        "instructions": None if profile is None else profile.instructions,
        "scope": list(prepared.layout.scope.objects),
        "golden": {
            "sha256": prepared.golden.sha256,
            "cpu_s": prepared.golden.cpu_s,
            "wall_s": prepared.golden.wall_s,
        },
        "outcomes": shares_to_json(shares(outcomes, windows)),
        "crashes": counted(_crash(entry) for entry in _with(records, Outcome.CRASH)),
        "not_injected": counted(
            entry["not_injected_reason"] for entry in _with(records, Outcome.NOT_INJECTED)
        ),
        "activation": counted(entry["activation"]["activation"] for entry in records),
        "sdc_relative": {
            "median": finite[len(finite) // 2] if finite else None,
            "largest": finite[-1] if finite else None,
            "incomparable": len(sizes) - len(finite),
        },
        "within_tolerance": sum(bool(entry["within_tolerance"]) for entry in records),
        "prepare_s": prepared.prepare_s,
        "wall_s": runs.wall_s,
        "injections_per_core_hour": 3600.0 * len(records) / run_s if run_s else None,
    }


def _with(records: Iterable[dict[str, Any]], outcome: Outcome) -> Iterator[dict[str, Any]]:
    return (entry for entry in records if entry["outcome"] == outcome.value)


def _crash(entry: Mapping[str, Any]) -> str:
    if entry["signal"]:
        return signal_name(entry["signal"])
    return str(entry["error"]).partition(":")[0] or "exit"


def table(summary: Mapping[str, Any]) -> str:
    """The summary as text: one row a kernel, shares of injected runs with 95 % intervals."""
    head = ["kernel", "runs", *(outcome.title for outcome in _SHOWN)]
    rows = [
        [each["title"], str(each["runs"]), *(_cell(each["outcomes"][o.value]) for o in _SHOWN)]
        for each in summary["kernels"]
    ]
    lines = blocks([head, *rows], labels=1)
    lines.append("")
    lines.append(
        f"sampling: {summary['sampling']}; one fault a run; share of injected runs, "
        "95 % Wilson interval,"
    )
    lines.append("widened by the likeness of faults in a window where windows are sampled")
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
    lines = [
        f"{kernel['title']}: {kernel['population']}; scope {', '.join(kernel['scope'])}",
    ]
    for title in ("crashes", "not_injected", "activation"):
        if kernel[title]:
            parts = ", ".join(f"{name} {count}" for name, count in kernel[title].items())
            lines.append(f"  {title.replace('_', ' ')}: {parts}")
    sdc = kernel["sdc_relative"]
    if sdc["median"] is not None:
        lines.append(
            f"  SDC, relative size: median {sdc['median']:.2g}, largest {sdc['largest']:.2g}; "
            f"{sdc['incomparable']} of another shape or not a number"
        )
    return lines


def csv_rows(campaign: Iterable[KernelRuns]) -> Iterator[list[str]]:
    """Header and one row a run."""
    return csv_table(CSV_COLUMNS, (entry for runs in campaign for entry in runs.records))
