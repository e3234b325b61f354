"""A campaign's table of flights for other programs: a .parquet or .csv file."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import pyarrow as pa

from mavfi_cli.analysis.flights import CONFIG, FAULT, flights
from mavfi_cli.campaign.ledger import Ledger
from mavfi_cli.core.errors import ConfigError
from mavfi_cli.core.files import write_atomically
from mavfi_cli.mission.record.measures import QUALITY, STRUCK

FORMATS = (".parquet", ".csv")


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
    whole = flights(ledger)
    return whole.select(
        [
            "number", "pair", *(name for name in whole.column_names if name.startswith("label_")),
            *CONFIG, "level", *(f"fault_{name}" for name in FAULT), *STRUCK, "detector", "protect",
            "state", "outcome", "reason", "injected", *QUALITY, "replans", "simulated_s", "wall_s",
            "attempts", "path", "changes",
        ]
    )  # fmt: skip
