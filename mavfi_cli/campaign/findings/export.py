"""A campaign as one table for other programs: a row a mission that is over."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavfi_cli.campaign.findings import struck
from mavfi_cli.campaign.ledger import Ledger
from mavfi_cli.campaign.missions import canonical
from mavfi_cli.campaign.outcome import MissionResult
from mavfi_cli.core.errors import ConfigError
from mavfi_cli.core.files import write_atomically

if TYPE_CHECKING:
    import pyarrow as pa

FORMATS = (".parquet", ".csv")
_CONFIG = ("world", "seed", "world_seed", "planner", "platform", "stack", "vehicle")
_QUALITY = (
    "flight_time_s", "distance_m", "mean_speed_mps", "max_speed_mps", "min_clearance_m",
    "goal_distance_m", "energy_regression_j", "energy_propeller_j",
)  # fmt: skip
_PILOT = ("replans",)
_FAULT = ("target", "seed", "bits", "field")


def export(ledger: Ledger, path: Path) -> int:
    """Write the table to a .parquet or .csv file; how many rows.

    Raises:
        ConfigError: another kind of file.
        RecordError: it cannot be written.
    """
    if path.suffix not in FORMATS:
        raise ConfigError(
            f"expected a name that ends in {' or '.join(FORMATS)}, or - for CSV on stdout",
            path=path,
        )
    found = table(ledger)

    def write(file: Any) -> None:
        """Write the table in the format of the name."""
        if path.suffix == ".csv":
            file.write(_csv(found))
        else:
            import pyarrow.parquet as pq

            pq.write_table(found, file, compression="zstd")

    write_atomically(path, write)
    return int(found.num_rows)


def export_csv(ledger: Ledger) -> bytes:
    """The table as CSV."""
    return _csv(table(ledger))


def _csv(found: pa.Table) -> bytes:
    from pyarrow import csv

    text = io.BytesIO()
    csv.write_csv(found, text)
    return text.getvalue()


def table(ledger: Ledger) -> pa.Table:
    """One row a mission that is over, in the order of the list; the labels are columns too."""
    import pyarrow as pa

    labels = sorted({name for cell in ledger.cells() for name in cell})
    rows = [_row(result, labels) for result in ledger.results()]
    names = list(_row_names(labels))
    columns = {name: _column([row[name] for row in rows]) for name in names}
    return pa.table(columns)


def _column(values: list[Any]) -> pa.Array:
    """A column of one type: labels of mixed types become text."""
    import pyarrow as pa

    kinds = {type(value) for value in values if value is not None}
    if len(kinds) > 1 and kinds != {int, float}:
        values = [None if value is None else str(value) for value in values]
    return pa.array(values, pa.float64() if kinds == {int, float} else None)


def _row_names(labels: list[str]) -> list[str]:
    return [
        "number", "pair", *(f"label_{name}" for name in labels), *_CONFIG, "level",
        *(f"fault_{name}" for name in _FAULT), *struck.COLUMNS, "detector", "protect", "state",
        "outcome", "reason", "injected", *_QUALITY, *_PILOT, "simulated_s", "wall_s", "attempts",
        "path", "changes",
    ]  # fmt: skip


def _row(result: MissionResult, labels: list[str]) -> dict[str, Any]:
    from mavfi_cli.campaign.missions import changes_of

    config, record = result.mission.config, result.result
    asked = config.fault or config.instruction
    level, detector = None, config.detector
    if asked is not None:
        level = "source" if config.fault is not None else "instruction"
    quality: Mapping[str, Any] = record.get("quality_of_flight") or {}
    pilot: Mapping[str, Any] = record.get("pilot") or {}
    return {
        "number": result.number,
        "pair": result.mission.pair,
        **{f"label_{name}": result.mission.labels.get(name) for name in labels},
        **{name: getattr(config, name) for name in _CONFIG},
        "level": level,
        **{f"fault_{name}": None if asked is None else getattr(asked, name) for name in _FAULT},
        **struck.struck(record),
        "detector": None if detector is None else detector.name,
        "protect": None if detector is None else "+".join(detector.protect),
        "state": result.state.value,
        "outcome": result.outcome,
        "reason": result.reason,
        "injected": None if result.injected is None else result.injected.value,
        **{name: quality.get(name) for name in _QUALITY},
        **{name: pilot.get(name) for name in _PILOT},
        "simulated_s": record.get("simulated_s"),
        "wall_s": result.wall_s,
        "attempts": result.attempts,
        "path": None if result.path is None else str(result.path),
        "changes": canonical(changes_of(config)),
    }
