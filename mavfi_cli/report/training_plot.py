"""Plot of the autoencoder's training loss over the epochs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from mavfi_cli.report.drawing import write_svg

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write_loss_curve(curve: Sequence[Sequence[float]], path: Path) -> None:
    """Write the loss curve as SVG, atomically. Equal curves give equal bytes.

    Raises:
        RecordError: The file could not be written.
    """
    write_svg(draw_loss_curve(curve), path)


def draw_loss_curve(curve: Sequence[Sequence[float]]) -> Figure:
    """Draw a figure of the mean squared errors of scaled deltas, logarithmic, over the epochs.

    Args:
        curve: Rows of epoch, mean training error and largest validation error.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.2, 3.2), layout="constrained")
    axes = figure.add_subplot()
    epochs, training, validation = zip(*curve, strict=True)
    axes.plot(epochs, training, color="#1b4965", linewidth=1.4, label="training, mean")
    axes.plot(epochs, validation, color="#e4572e", linewidth=1.4, label="validation, largest")
    axes.set_yscale("log")
    axes.set_xlabel("epoch")
    axes.set_ylabel("mean squared error of scaled deltas")
    axes.grid(visible=True, color="#edf0f4", linewidth=0.6)
    axes.legend(frameon=False, fontsize=8)
    return figure
