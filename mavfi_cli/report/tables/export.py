"""The table of a campaign's flights as a file."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import pyarrow as pa

from mavfi_cli.core.errors import ConfigError
from mavfi_cli.core.files import write_atomically

_FORMATS = (".parquet", ".csv")


def write_flights(table: pa.Table, path: Path) -> int:
    """Write an exported table to a .parquet or .csv file; return the number of rows.

    Raises:
        ConfigError: the file has another suffix.
        RecordError: it cannot be written.
    """
    if path.suffix not in _FORMATS:
        raise ConfigError(
            f"expected a name that ends in {' or '.join(_FORMATS)}, or - for CSV on stdout",
            path=path,
        )

    def write(file: Any) -> None:
        """Write the table in the format of the name."""
        from pyarrow import csv, parquet

        if path.suffix == ".csv":
            csv.write_csv(table, file)
        else:
            parquet.write_table(table, file, compression="zstd")

    write_atomically(path, write)
    return int(table.num_rows)


def flights_csv(table: pa.Table) -> bytes:
    """Return an exported table as CSV."""
    from pyarrow import csv

    text = io.BytesIO()
    csv.write_csv(table, text)
    return text.getvalue()
