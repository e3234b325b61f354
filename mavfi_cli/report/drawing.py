"""What the pictures share: how they are saved, and colours."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING

from mavfi_cli.core.files import write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure

INK = "#1d232b"
NOTE = "#5b6573"
GRID = "#edf0f4"
SCHEMES = {
    "none": "#8b93a1",
    "dmr": "#f2b134",
    "tmr": "#e4572e",
    "gad": "#5b8def",
    "aad": "#1b7f4b",
}
KERNELS = {  # what they are called, and their colours
    "point_cloud": ("point cloud", "#2f7fb8"),
    "octomap": ("OctoMap", "#1b4965"),
    "collision_check": ("collision check", "#2a9d8f"),
    "planner": ("planner", "#e08a1e"),
    "control": ("control", "#7d4f9e"),
}


def write_svg(figure: Figure, path: Path) -> None:
    """Write a figure as SVG, atomically; equal figures give equal bytes.

    Raises:
        RecordError: the file could not be written.
    """
    import matplotlib as mpl

    with mpl.rc_context({"svg.hashsalt": "mavfi", "svg.fonttype": "none"}):
        buffer = io.BytesIO()
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": "mavfi"})
    write_atomically(path, lambda file: file.write(buffer.getvalue()))
