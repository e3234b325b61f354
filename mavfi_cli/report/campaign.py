"""Text reports of a campaign: settings, comparisons, quality of flight, overhead and failures."""

from __future__ import annotations

import io
import json
import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Self

import pyarrow as pa

from mavfi_cli.analysis.failures import SettingFailures, setting_failures
from mavfi_cli.analysis.flights import flights, flown
from mavfi_cli.analysis.overhead import FlightOverhead, flight_overheads
from mavfi_cli.analysis.pairs import Flights
from mavfi_cli.analysis.summary import (
    INACTIVE,
    METRICS,
    CampaignSummary,
    Comparison,
    Quality,
    SettingSummary,
    UnpairedComparison,
    groups,
    qualities,
    summarise,
)
from mavfi_cli.campaigns.begin import stopped, stored_spec
from mavfi_cli.campaigns.ledger import Ledger
from mavfi_cli.campaigns.missions import Injected, Sampling, label_text
from mavfi_cli.campaigns.specification import FixedWorld
from mavfi_cli.core.errors import ConfigError
from mavfi_cli.core.files import Json
from mavfi_cli.core.types import Outcome, Stage
from mavfi_cli.mission.measures import HOST_CHECKS
from mavfi_cli.report.setting_table import BY_WEIGHT, UNPAIRED, SettingColumns, SettingRow
from mavfi_cli.report.table import number, percent, rate, spread, with_ends
from mavfi_cli.stats.paired import WorstCase
from mavfi_cli.stats.shares import Interval, Share

_STAGES = tuple(stage.value for stage in Stage)
_UNPAIRED_HEAD = ("flights", "success, points", "p", "time, s", "golden")
_TITLES = {
    "flight_time_s": ("flight time, s", 1.0),
    "distance_m": ("distance, m", 1.0),
    "energy_regression_j": ("energy (paper's regression), kJ", 1e-3),
    "replans": ("replans", 1.0),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class CampaignReport:
    """Everything that `mavfi campaign status` reports about a campaign.

    Attributes:
        stopped: settings that the stopping rule has ended early.
        fixed_world: the fixed world of all missions; None if there is none.
        lost_worlds: a line for each fixed world in which no golden flight succeeds; None if there
            is none.
        quality, overhead, failures: the optional parts of the report; None unless requested.
    """

    summary: CampaignSummary
    stopped: Sequence[str] = ()
    fixed_world: FixedWorld | None = None
    lost_worlds: Sequence[str] | None = None
    quality: Sequence[Quality] | None = None
    overhead: Sequence[FlightOverhead] | None = None
    failures: Sequence[SettingFailures] | None = None

    @classmethod
    def of(
        cls,
        ledger: Ledger,
        by: Sequence[str] = (),
        confidence: float = 0.95,
        *,
        quality: bool = False,
        overhead: bool = False,
        failures: bool = False,
        kernels: Path | None = None,
        upsets: float | None = None,
    ) -> Self:
        """Analyse the results in a campaign's ledger.

        Args:
            by: labels by which missions are grouped into settings; empty means all labels.
            confidence: confidence level of all intervals.
            quality, overhead, failures: whether to add these parts.
            kernels, upsets: arguments of `analysis.failures.setting_failures`.

        Raises:
            UnknownName: no setting has such a label.
            MavfiError: as `flight_overheads` and `setting_failures`.
        """
        spec, settings = stored_spec(ledger), groups(ledger, by)
        return cls(
            summary=summarise(ledger, settings, confidence),
            stopped=stopped(ledger),
            fixed_world=None if spec is None else spec.fixed_world,
            lost_worlds=_lost_worlds(ledger) or None,
            quality=qualities(settings, confidence) if quality else None,
            overhead=flight_overheads(ledger, settings, confidence) if overhead else None,
            failures=setting_failures(ledger, settings, kernels, upsets, confidence)
            if failures
            else None,
        )

    def as_dict(self) -> Json:
        """Return the values that `--json` prints: the summary and the requested parts."""
        parts = {name: part for name, part in asdict(self).items() if part is not None}
        return {**parts.pop("summary"), **parts}

    def lines(self) -> list[str]:
        """Return the report as lines of text, without those of `state_lines`."""
        confidence, lines = self.summary.confidence, _summary_lines(self.summary)
        if self.quality:
            lines += quality_lines(self.quality, confidence)
        if self.overhead is not None:
            lines += overhead_lines(self.overhead, confidence)
        if self.failures is not None:
            lines += failure_lines(self.failures)
        return lines


def state_lines(ledger: Ledger) -> list[str]:
    """Return lines on a campaign's worlds, and on settings that the stopping rule has ended early.

    The former name the fixed worlds, or those of an export, and the fixed worlds in which no golden
    flight has succeeded.
    """
    spec = stored_spec(ledger)
    worlds = spec.describe_worlds() if spec else ""
    if ledger.export is not None:
        table = flown(flights(ledger))
        places = (table[name].to_pylist() for name in ("world", "world_seed"))
        worlds = Flights.population_of(zip(*places, strict=True))
    return [
        *filter(None, [worlds]),
        *_lost_worlds(ledger),
        *(f"stopped early, because known well enough: {name}" for name in stopped(ledger)),
    ]


def _lost_worlds(ledger: Ledger) -> list[str]:
    """Return a line for each fixed world that has golden flights, none of which succeeded."""
    golden = {
        number: outcome == Outcome.SUCCESS.value
        for number, (outcome, fate) in sorted(ledger.fates(errors=False))
        if fate == Injected.GOLDEN.value
    }
    won: dict[tuple[str, int], list[bool]] = defaultdict(list)
    for success, config in zip(golden.values(), ledger.configs([*golden]), strict=True):
        if config.world_seed is not None:
            won[config.world, config.world_seed].append(success)
    return [
        f"world {world}, seed {seed}: no golden flight succeeded ({len(own)} flown), so faults "
        "there show nothing"
        for (world, seed), own in won.items()
        if not any(own)
    ]


# Settings and comparisons ---------------------------------------------------------------------


def _summary_lines(summary: CampaignSummary) -> list[str]:
    settings = SettingColumns.of([setting.labels for setting in summary.cells])
    fates = [SettingRow(row.labels, row.name, _fate_cells(row)) for row in summary.cells]
    means = [SettingRow(row.labels, row.name, _mean_cells(row)) for row in summary.cells]
    otherwise = ["ended otherwise"] if any(row.cells[-1] for row in fates) else []
    head = ["over", "success", _sure(summary.confidence), "of all", "inactive", *otherwise]
    stratified = summary.sampling == Sampling.STRATIFIED.value
    if stratified:
        head[2:2] = ["rate", "effective n"]
        fates = [
            row._replace(cells=[*row.cells[:2], *_weighted_cells(setting.success), *row.cells[2:]])
            for setting, row in zip(summary.cells, fates, strict=True)
        ]
    lines = [
        *settings.notes,
        *([BY_WEIGHT] if stratified else []),
        *settings.lines(head, fates),
        "",
        *settings.lines(["mean time", "mean distance", "mean energy", "mean replans"], means),
    ]
    compared = [*summary.faults, *summary.unpaired_faults]
    if not compared and any(setting.faulty for setting in summary.cells):
        lines += ["", "nothing to compare: no mission with a fault has a golden flight"]
    for title, comparisons in (
        ("against the golden flights of the same missions:", summary.faults),
        ("against the same faults without protection:", summary.protection),
    ):
        if comparisons:
            lines += ["", title, *_comparison_lines(settings, comparisons)]
    unpaired = (
        ("against golden flights:", summary.unpaired_faults),
        ("against the same faults without protection:", summary.unpaired_protection),
    )
    lines += ["", UNPAIRED] if any(rows for _, rows in unpaired) else []
    for title, rows in unpaired:
        if rows:
            cells = [SettingRow(row.second, row.name, _unpaired_cells(row)) for row in rows]
            lines += [title, *settings.lines(_UNPAIRED_HEAD, cells)]
    return lines


def _unpaired_cells(row: UnpairedComparison) -> list[str]:
    own = row.difference
    deviation = number(row.golden_deviation["flight_time_s"], ".2f", unit=" s")
    return [
        f"{row.second_success.total}, {row.first_success.total}",
        with_ends((own.value, own.low, own.high), "+.1f", "+.0f", scale=100.0),
        f"{row.corrected_p:.3g}",
        spread(row.differences["flight_time_s"], 2, sign="+"),
        f"{rate(row.golden, 0)}, SD {deviation}",
    ]


def _weighted_cells(share: Share) -> list[str]:
    return [percent(share.share), str(share.effective)]


def _sure(confidence: float) -> str:
    return f"{100 * confidence:g} % interval"


def _fate_cells(setting: SettingSummary) -> list[str]:
    over = sum(setting.outcomes.values()) + setting.errors
    share = setting.success
    ends = f"{100 * share.low:.1f} to {100 * share.high:.1f} %" if share.total else "-"
    other = [f"{name} {count}" for name, count in setting.outcomes.items() if name != "success"]
    other += [f"{name.replace('_', ' ')} {count}"
              for name, count in setting.injected.items() if name in INACTIVE]  # fmt: skip
    other += [f"could not begin {setting.errors}"] if setting.errors else []
    return [f"{over}/{setting.planned}", f"{share.count}/{share.total}", ends,
            percent(setting.every.share), str(setting.inactive.total),
            ", ".join(other)]  # fmt: skip


def _mean_cells(setting: SettingSummary) -> list[str]:
    units = zip(METRICS, (1.0, 1.0, 1e-3, 1.0), (" s", " m", " kJ", ""), strict=True)
    means = setting.metrics
    return [number(means[name].value, ".1f", scale, unit) for name, scale, unit in units]


def _comparison_lines(settings: SettingColumns, comparisons: Sequence[Comparison]) -> list[str]:
    head = ["pairs", "success, points", "p", "time, s", "worst over own golden",
            "worst over mean golden"]  # fmt: skip
    cells = [_comparison_cells(row) for row in comparisons]
    used = [place for place, column in enumerate(zip(*cells, strict=True)) if any(column)]
    rows = [
        SettingRow(row.second, row.name, [own[place] for place in used])
        for row, own in zip(comparisons, cells, strict=True)
    ]
    return settings.lines([head[place] for place in used], rows)


def _comparison_cells(row: Comparison) -> list[str]:
    """Return the cells of a comparison in the table.

    The last cell is empty if the recovered share of the increase over the mean golden flight is
    undefined.
    """
    time = row.differences["flight_time_s"]
    return [
        f"{row.success.pairs}",
        f"{100 * row.success.difference:+.1f}",
        f"{row.corrected_p:.3g}",
        "" if math.isnan(time.low) else spread(time, 2, sign="+"),
        _worst(row.over_own),
        "" if math.isnan(row.over_mean.recovered_share) else _worst(row.over_mean),
    ]


def _worst(worst: WorstCase) -> str:
    if math.isnan(worst.increase):
        return ""
    increase = percent(worst.increase, "+.1f")
    if math.isnan(worst.recovered_share):
        return increase
    points = number(worst.recovered, ".1f", 100.0, " points")
    return f"{increase}, recovered {points}, {percent(worst.recovered_share)}"


# Quality of flight ----------------------------------------------------------------------------


def quality_lines(quality: Sequence[Quality], confidence: float = 0.95) -> list[str]:
    """Return a table per metric as lines: mean, extremes, and difference from golden flights."""
    settings = SettingColumns.of([row.labels for row in quality if row.metric == METRICS[0]])
    head = ["flights", f"mean ({_sure(confidence)})", "least", "median", "most", "to golden"]
    lines = []
    for metric, (title, scale) in _TITLES.items():
        rows = [
            SettingRow(row.labels, row.name, _quality_cells(row, scale))
            for row in quality
            if row.metric == metric
        ]
        lines += ["", title, *settings.lines(head, rows)]
    return lines


def _quality_cells(row: Quality, scale: float) -> list[str]:
    return [
        f"{row.mean.count}",
        spread(row.mean, 2, scale),
        *(number(value, ".2f", scale) for value in (row.least, row.median, row.most)),
        "" if row.difference is None else spread(row.difference, 2, scale, "+"),
    ]


# Overhead -------------------------------------------------------------------------------------


def overhead_lines(overhead: Sequence[FlightOverhead], confidence: float = 0.95) -> list[str]:
    """Return two tables on detectors as lines: the cost of checks, and that of recomputations."""
    if not overhead:
        return ["", "overhead: no flight with a detector"]
    settings = SettingColumns.of([row.labels for row in overhead])
    sure = f"({_sure(confidence)})"
    return [
        "", "detection: checks, host time", *settings.notes,
        *settings.lines(
            ["flights", "a second", f"us each {sure}", f"% of time {sure}"],
            [_overhead_row(row, _detection_cells(row)) for row in overhead],
        ),
        f"({HOST_CHECKS})",
        "", "recovery: % of flight time, simulated",
        *settings.lines(
            ["times", *_STAGES, f"in all {sure}", f"+ checks {sure}"],
            [_overhead_row(row, _recovery_cells(row)) for row in overhead],
        ),
    ]  # fmt: skip


def _overhead_row(row: FlightOverhead, cells: Sequence[str]) -> SettingRow:
    return SettingRow(row.labels, label_text(row.labels), cells)


def _detection_cells(row: FlightOverhead) -> list[str]:
    return [
        f"{row.flights}",
        f"{row.checks_per_s.value:.1f}",
        spread(row.check_host_s, 2, 1e6),
        _overhead_percent(row.detection_host_share),
    ]


def _recovery_cells(row: FlightOverhead) -> list[str]:
    return [
        f"{round(math.fsum(row.recomputations.values()))}",
        *(_overhead_percent(row.recovery_share[stage], ends=False) for stage in _STAGES),
        _overhead_percent(row.recovery_share_in_all),
        _overhead_percent(row.share_in_all),
    ]


def _overhead_percent(share: Interval, *, ends: bool = True) -> str:
    """Format a share in per cent with four decimals, as in the paper's table.

    Positive values that would round to zero become `<0.0001`.

    Args:
        ends: whether to add the ends of the interval.
    """
    value, *between = spread(share, 4, 100.0).split(" ", 1)
    value = "<0.0001" if 0.0 < share.value < 0.5e-6 else value
    return " ".join([value, *between]) if ends else value


# Failures -------------------------------------------------------------------------------------


def failure_lines(failures: Sequence[SettingFailures]) -> list[str]:
    """Return a paragraph per setting on how often its injected faults fail missions."""
    paired = any(row.golden is None for row in failures) or not failures
    which = " whose golden flights succeed" if paired else ""
    lines = ["", f"injected faults that fail missions{which}:"]
    if not failures:
        lines.append("  none: no setting has injected faults and golden flights of their missions")
    for row in failures:
        lines += [f"  {row.name}", *(f"    {part}" for part in _failure_parts(row))]
    return lines


def _failure_parts(row: SettingFailures) -> list[str]:
    failure, layers = row.failure, row.layers
    share = rate(failure, ends=1)
    parts = [f"{failure.count} of {failure.total} faults fail the mission, {share}"]
    if row.golden is not None:
        failed = f"{row.golden.count} of {row.golden.total} golden flights fail"
        parts.append(f"{failed}, {rate(row.golden, ends=1)}")
    if layers is not None:
        parts.append(f"{row.kernel} corrupted by {rate(layers.corruption, ends=1)} of its faults")
        given = layers.failure_given_corruption
        if given is None:
            parts.append("failure given corruption unknown: more fail than are corrupted")
        else:
            parts.append("failure given corruption {:.3g} ({:.3g} to {:.3g})".format(*given))
    if row.per_hour is not None:
        parts.append("{:.3g} failures a flight hour ({:.3g} to {:.3g})".format(*row.per_hour))
    return parts


# Export ---------------------------------------------------------------------------------------


def flights_file(table: pa.Table, path: Path) -> bytes:
    """Return an exported table of flights as the content of the file `path`.

    The suffix selects the format, Parquet or CSV. The path `-` means CSV.

    Raises:
        ConfigError: the suffix is neither .parquet nor .csv.
    """
    from pyarrow import csv, parquet

    content = io.BytesIO()
    if path.suffix == ".parquet":
        parquet.write_table(table, content, compression="zstd")
    elif path.suffix == ".csv" or path == Path("-"):
        csv.write_csv(_flat(table), content)
    else:
        problem = f"must end in .parquet or .csv, or be - for CSV on stdout, got {path.name!r}"
        raise ConfigError(problem, path=path)
    return content.getvalue()


def _flat(table: pa.Table) -> pa.Table:
    """Return the table with lists converted to JSON text, because CSV has no lists."""
    for place, field in enumerate(table.schema):
        if pa.types.is_list(field.type):
            texts = [
                None if values is None else json.dumps(values)
                for values in table[place].to_pylist()
            ]
            table = table.set_column(place, field.name, pa.array(texts, pa.string()))
    return table
