"""The truth log: the true state of the vehicle, one row per control tick, and its files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.errors import RecordError
from mavfi_cli.core.files import write_atomically, write_json

COLUMNS: dict[str, slice] = {
    "stamp_s": slice(0, 1),
    "position_enu_m": slice(1, 4),
    "velocity_enu_mps": slice(4, 7),
    "quaternion": slice(7, 11),  # w x y z, body FLU -> ENU
    "clearance_m": slice(11, 12),
    "power_regression_w": slice(12, 13),
    "power_propeller_w": slice(13, 14),
    "armed": slice(14, 15),
    "on_ground": slice(15, 16),
}
_FLAGS = ("armed", "on_ground")
_WIDTH = 16


class TruthLog:
    """Rows of true states in a growing array."""

    def __init__(self) -> None:
        self._rows = np.empty((1024, _WIDTH))
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def append(self, *parts: float | NDArray[np.float64]) -> None:
        """Add one row with the columns in the order of `COLUMNS`."""
        if self._count == len(self._rows):
            self._rows = np.concatenate([self._rows, np.empty_like(self._rows)])
        row = self._rows[self._count]
        for part, place in zip(parts, COLUMNS.values(), strict=True):
            row[place] = part
        self._count += 1

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the log as named arrays, (n,) or (n, 3 or 4). Flags are boolean."""
        rows = self._rows[: self._count]
        arrays: dict[str, NDArray[Any]] = {}
        for name, place in COLUMNS.items():
            column = rows[:, place]
            arrays[name] = (column[:, 0] if column.shape[1] == 1 else column).copy()
        for name in _FLAGS:
            arrays[name] = arrays[name] != 0.0
        return arrays


def save_truth(folder: Path, log: TruthLog, report: Mapping[str, Any]) -> None:
    """Write truth.npz and then truth.json into a folder, each atomically.

    Raises:
        RecordError: The folder cannot be created or written (no space, no permission).
    """
    arrays: dict[str, Any] = dict(log.arrays())
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordError(f"{folder}: cannot write the truth log: {error.strerror}") from None
    write_atomically(folder / "truth.npz", lambda file: np.savez(file, **arrays))
    write_json(folder / "truth.json", report)
