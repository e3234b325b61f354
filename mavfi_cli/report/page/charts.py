"""Charts of the page: SVG by matplotlib, small enough for a phone, each with its data as CSV.

The SVG stands in the page itself, so it takes font and colours from the page: light, dark, print.
No library of interactive charts: plotly alone is 5 MB in each page, and a page without script has
nothing that can fail.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from mavfi_cli.report.drawing import DETECTORS, GRID, INK, NONE, NOTE, svg
from mavfi_cli.report.paper_figures import (
    PALETTE,
    SMALLEST,
    print_axes,
    print_figure,
)
from mavfi_cli.report.tables.columns import csv_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LOST = "#b2182b"
_THEME = {INK: "var(--ink)", NOTE: "var(--note)", GRID: "var(--rule)", "#ffffff": "none",
          PALETTE[0]: "var(--deep)"}  # fmt: skip
_OWN_ID = re.compile(r' id="[a-z]+[a-z0-9]*_[0-9_]+"')  # figure_1, text_3: not unique in a page
_FONT = re.compile(r"font: (?:[a-z0-9]+ )*?([0-9.]+px)[^;\"]*")


@dataclass(frozen=True, slots=True, kw_only=True)
class Chart:
    """A picture in the page.

    Attributes:
        name: of its CSV file, without suffix.
        title: what it shows, in words, also for those who cannot see it.
        csv: its numbers.
    """

    name: str
    title: str
    figure: Figure
    csv: str

    @property
    def markup(self) -> str:
        """An SVG element in the page's font and colours."""
        text = svg(self.figure)
        markup = _OWN_ID.sub("", text[text.index("<svg") :])
        markup = _FONT.sub(r"font-size: \1", markup)
        for colour, variable in _THEME.items():
            markup = markup.replace(colour, variable)
        return markup.strip()


# Arms, kernels ------------------------------------------------------------------------------------


def arm_chart(campaign: str, arms: Sequence[Any]) -> Chart:
    """Lost missions of each arm with their intervals."""
    figure = print_figure("one", 0.6 + 0.17 * len(arms))
    axes = figure.add_subplot()
    print_axes(axes)
    for place, arm in enumerate(arms):
        telling = arm.corrected_p is not None and arm.corrected_p < 0.05
        colour = _LOST if arm.corrected_p is None else DETECTORS["gad"] if telling else NONE
        axes.hlines(place, 100 * arm.lost.low, 100 * arm.lost.high, color=colour, linewidth=1.4)
        axes.plot(100 * arm.lost.share, place, "o", color=colour, markersize=4)
    axes.set_yticks(range(len(arms)), [each.name for each in arms], fontsize=SMALLEST)
    axes.set_ylim(len(arms) - 0.4, -0.6)
    axes.set_xlim(left=0.0)
    axes.set_xlabel("missions lost, % (95 % interval)", fontsize=SMALLEST)
    rows = [
        {"arm": each.name, "lost": each.lost.count, "of": each.lost.total, "low": each.lost.low,
         "high": each.lost.high, "p": "" if each.corrected_p is None else each.corrected_p}
        for each in arms
    ]  # fmt: skip
    title = f"Lost missions of each arm of {campaign}"
    return Chart(name=f"arms-{campaign}", title=title, figure=figure, csv=csv_text(rows))


_FATES = {"never read": "#dfe5ec", "same flight": "#b9c6d4", "changed flight": "#6a4fb3",
          "crashed": "#e4572e", "hung": "#f2b134"}  # fmt: skip


def flow_chart(stack: str, flows: Sequence[Any]) -> Chart:
    """What struck kernels did, a bar a kernel."""
    figure = print_figure("one", 0.9 + 0.26 * len(flows))
    axes = figure.add_subplot()
    print_axes(axes)
    for place, flow in enumerate(flows):
        total, left = sum(each.total for each in flow.fates.values()), 0.0
        for fate, share in flow.fates.items():
            part = 100.0 * share.total / total
            label = fate.value if not place else None
            axes.barh(place, part, left=left, height=0.66, color=_FATES[fate.value], label=label)
            left += part
    names = [each.kernel.replace("_", " ") for each in flows]
    axes.set_yticks(range(len(flows)), names, fontsize=SMALLEST)
    axes.set_ylim(len(flows) - 0.5, -0.5)
    axes.set_xlim(0.0, 100.0)
    axes.set_xlabel("share of struck kernels, %", fontsize=SMALLEST)
    figure.legend(
        loc="outside upper center", ncols=3, frameon=False, fontsize=SMALLEST, handlelength=1.0,
        columnspacing=1.0, labelcolor=INK,
    )  # fmt: skip
    rows = [
        {"kernel": each.kernel, "fate": fate.value, "missions": share.total, "lost": share.count}
        for each in flows for fate, share in each.fates.items()
    ]  # fmt: skip
    title = f"What struck kernels did, {stack}"
    return Chart(name=f"kernels-{stack}", title=title, figure=figure, csv=csv_text(rows))
