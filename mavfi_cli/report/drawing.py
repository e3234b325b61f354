"""Colours, frames and legends that all pictures share, and functions to save pictures."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavfi_cli.core.files import require_output, write_atomically
from mavfi_cli.core.terminal import cleaned

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from mavfi_cli.core.types import FloatArray

PICTURES = (".svg", ".pdf", ".png")
_STAMPS: dict[str, dict[str, str | None]] = {  # metadata that does not depend on the time
    "svg": {"Date": None, "Creator": "mavfi"},
    "pdf": {"CreationDate": None, "Creator": "mavfi", "Producer": "mavfi"},
    "png": {"Software": "mavfi"},
}
_DPI = 300
_TURN = 0.6180339887498949  # inverse of the golden ratio

Look = Mapping[str, Any]  # keywords of matplotlib
DASHED = (0, (5, 3))  # style of reference lines
INK = "#1d232b"
NOTE = "#5b6573"
GRID = "#edf0f4"
# The same thing has the same colour in all pictures.
OBSTACLE = "#c9ced6"
PLAN = "#7a8699"
GOAL = "#1b7f4b"
FAULT = "#c22f2f"
ALARM = "#5b8def"
# Flights of one mission, in the order of their names: golden and faulty flights are blue and
# orange, as in the paper. Protected flights have their detector's colour.
FLIGHTS = ("#3a7bd5", "#e8751a", "#b8860b", "#00838f", "#c2185b", "#5d4037")
NONE = "#8b93a1"  # no protection
DETECTORS = {"gad": "#6a4fb3", "aad": "#1b7f4b", "range": "#a3a032", "l2": "#c77fae"}
_PLUG_INS = ("#7f5539", "#4a6d8c", "#5d7052", "#a67c52")  # plug-in detectors, cyclically
REDUNDANCY = {"dmr": "#f2b134", "tmr": "#e4572e"}
SCHEMES = {"none": NONE, **REDUNDANCY, **DETECTORS}
PLATFORMS = ("#00838f", "#c2185b", "#2b4c7e", "#7b2d26", "#5c6b1f", "#5aa9e6")  # by position
KERNELS = {  # labels and colours
    "point_cloud": ("point cloud", "#2f7fb8"),
    "octomap": ("OctoMap", "#1b4965"),
    "collision_check": ("collision check", "#2a9d8f"),
    "planner": ("planner", "#e08a1e"),
    "control": ("control", "#7d4f9e"),
}


def detector_colours(names: Sequence[str]) -> dict[str, str]:
    """Return the colours of `names`, which are detectors or `none`, keyed by name.

    Plug-in detectors share a cycle of colours.
    """
    known = {"none": NONE, **DETECTORS}
    others = [name for name in names if name not in known]
    return {
        name: known.get(name) or _PLUG_INS[others.index(name) % len(_PLUG_INS)] for name in names
    }


def new_figure(width_in: float, height_in: float) -> Figure:
    """Return an empty figure whose layout makes room for its labels."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width_in, height_in), layout="constrained")


def open_frame(axes: Axes, title: str = "", grid: str = "", **title_look: Any) -> None:
    """Hide the top and right edges of a frame, and add a title and a grid if they are given.

    Args:
        grid: axis of the grid, `x`, `y` or `both`; empty means no grid.
        title_look: text properties of the title that replace the defaults.
    """
    axes.spines[["top", "right"]].set_visible(False)
    if grid:
        axes.grid(visible=True, axis=grid, color=GRID, linewidth=0.6)  # type: ignore[arg-type]
        axes.set_axisbelow(True)
    if title:
        axes.set_title(title, **{"fontsize": 9.5, "color": INK, **title_look})


def legend_above(figure: Figure, *what: Any, **look: Any) -> None:
    """Draw a legend above a figure, by default for all its labelled artists."""
    shape = {"loc": "outside upper center", "ncols": 4, "frameon": False, "fontsize": 8}
    figure.legend(*what, **{**shape, **look})


def scattered(count: int) -> FloatArray:
    """Return `count` offsets between -0.5 and 0.5 that spread overlapping dots evenly.

    The array has shape (count,), and is the same in every call.
    """
    import numpy as np  # here, because the commands load this module

    return (0.5 + np.arange(count, dtype=np.float64) * _TURN) % 1.0 - 0.5


def whisker(axes: Axes, x: float, value: float, ends: tuple[float, float], **look: Any) -> None:
    """Draw the interval `ends` around a value as an error bar, unless one of the numbers is NaN."""
    if math.isfinite(value) and not any(map(math.isnan, ends)):
        low, high = (abs(end - value) for end in ends)
        shape = {"fmt": "none", "ecolor": INK, "elinewidth": 1.1, "capsize": 3.0}
        axes.errorbar(x, value, [[low], [high]], **{**shape, **look})


def note_at(axes: Axes, text: str, place: tuple[float, float], up: float, **look: Any) -> None:
    """Write `text` at the position `place`, raised by `up` points."""
    shape = {"ha": "center", "fontsize": 8.5, "color": INK}
    offset = {"xytext": (0, up), "textcoords": "offset points"}
    axes.annotate(text, place, **{**shape, **offset, **look})


def write_figure(figure: Figure, path: Path) -> None:
    """Write a figure as SVG, PDF or PNG, atomically. Equal figures give equal bytes.

    Raises:
        RecordError: The suffix is not one of PICTURES, or the file could not be written.
    """
    require_output(path, PICTURES)
    data = _drawn(figure, path.suffix.lower()[1:])
    write_atomically(path, lambda file: file.write(data))


def svg(figure: Figure) -> str:
    """Return a figure as SVG text. Equal figures give equal texts."""
    return _drawn(figure, "svg").decode()


def _drawn(figure: Figure, form: str) -> bytes:
    import matplotlib as mpl
    from matplotlib.text import Text

    for text in figure.findobj(Text):
        text.set_text(cleaned(text.get_text()))  # it may come from a foreign record
    with mpl.rc_context(
        {"svg.hashsalt": "mavfi", "svg.fonttype": "none", "pdf.fonttype": 42}  # text stays text
    ):
        buffer = io.BytesIO()
        dpi = None if form == "svg" else _DPI
        figure.savefig(buffer, format=form, dpi=dpi, metadata=_STAMPS[form])
    return buffer.getvalue()
