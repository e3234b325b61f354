"""Plot of kernel campaign outcomes: stacked bars with confidence intervals."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from mavfi_cli.report.drawing import INK, NOTE, new_figure, open_frame

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLOURS = {"sdc": "#8e5aa3", "crash": "#e4572e", "hang": "#f2b134", "benign": "#c3d4e6"}
_DARKER = {"sdc": "#6d3f84", "crash": "#b23a17", "hang": "#a06c00", "benign": "#4f6a88"}
_WIDTH = 0.6
_ROOM = 5.0  # per cent; minimum share for a number inside its bar segment
_LINE = 3.2  # per cent; height of a line of numbers
_VISIBLE = 0.5  # per cent; minimum width of a drawn interval
_LABELS = {"benign": "benign", "crash": "crash", "hang": "hang", "sdc": "SDC"}


def draw_kernel_plot(summary: Mapping[str, Any]) -> Figure:
    """Draw a figure with one bar per kernel and the shares of its injected runs in per cent."""
    kernels = summary["kernels"]
    figure = new_figure(max(5.2, 1.8 + 1.05 * len(kernels)), 4.4)
    axes = figure.add_subplot()
    for place, kernel in enumerate(kernels):
        _bar(axes, place, kernel["outcomes"])
    axes.set_xticks(range(len(kernels)), [_tick(kernel) for kernel in kernels], fontsize=8)
    axes.set_ylim(0.0, 100.0)
    axes.set_xlim(-0.6, len(kernels) - 0.4)
    axes.set_ylabel("share of injected runs, %")
    open_frame(axes)
    handles = [axes.bar(0, 0, color=colour, label=_LABELS[n]) for n, colour in _COLOURS.items()]
    figure.legend(handles=handles, loc="outside upper center", ncols=4, frameon=False)
    figure.supxlabel(_caption(summary), fontsize=7, color=NOTE)
    return figure


def _bar(axes: Axes, place: int, outcomes: Mapping[str, Any]) -> None:
    """Stack the segments from below. All but the last have an interval at their upper edge."""
    base, below = 0.0, -_LINE / 2  # keeps numbers off the axis
    for number, (name, colour) in enumerate(_COLOURS.items()):
        row = outcomes[name]
        share = 100.0 * (row["share"] or 0.0)
        axes.bar(place, share, bottom=base, width=_WIDTH, color=colour)
        if share >= _ROOM:
            axes.text(
                place - 0.16, base + share / 2, f"{share:.0f}", color=INK, fontsize=8.5,
                ha="center", va="center",
            )  # fmt: skip
        elif row["count"]:
            below = max(base + share / 2, below + _LINE)
            axes.text(
                place + _WIDTH / 2 + 0.03, below, _small(share), color=_DARKER[name],
                fontsize=7.5, ha="left", va="center",
            )  # fmt: skip
        low, high = (100.0 * edge for edge in row["wilson95"])
        if row["count"] and name != "benign" and high - low >= _VISIBLE:
            axes.errorbar(
                place + 0.03 + 0.1 * number, base + share, [[share - low], [high - share]],
                color=INK, elinewidth=0.9, capsize=2.0,
            )  # fmt: skip
        base += share


def _small(share: float) -> str:
    return f"{share:.1f}" if share >= 0.05 else "< 0.1"


def _tick(kernel: Mapping[str, Any]) -> str:
    injected = kernel["outcomes"]["benign"]["of"]
    return f"{kernel['title']}\nn = {injected}"


def _caption(summary: Mapping[str, Any]) -> str:
    bits = summary["plan"]["model"]["bits"]
    return (
        f"{'one bit' if bits == 1 else f'{bits} bits'} flipped a run; sampling: "
        f"{summary['sampling']}\n"
        "whiskers: 95 % Wilson interval of a segment's share, at its upper edge; benign is the rest"
    )
