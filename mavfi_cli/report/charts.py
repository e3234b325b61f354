"""Charts of the HTML report: SVG in the page's own font and colours, each with its data as CSV."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from mavfi_cli.core.types import FloatArray
from mavfi_cli.report.drawing import DETECTORS, GRID, INK, NONE, NOTE, legend_above, new_figure, svg
from mavfi_cli.report.paper import PALETTE, SMALLEST, WIDTHS_IN, print_axes
from mavfi_cli.stats.shares import Interval, Share

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LOST, _BAND = "#b2182b", "#d8dee6"
_VERDICTS = {"reproduced": "#1b6b42", "contradicted": "#a3262f", "undecided": "#7a5b01"}
_THEME = {INK: "var(--ink)", NOTE: "var(--note)", GRID: "var(--rule)", "#ffffff": "none",
          PALETTE[0]: "var(--deep)", _BAND: "var(--band)",
          **{colour: f"var(--{name})" for name, colour in _VERDICTS.items()}}  # fmt: skip
_OWN_ID = re.compile(r' id="[a-z]+[a-z0-9]*_[0-9_]+"')  # figure_1, text_3: not unique in a page
_FONT = re.compile(r"font: (?:[a-z0-9]+ )*?([0-9.]+px)[^;\"]*")


Curve = tuple[str, str, FloatArray]  # label, detector, sorted added seconds (infinite if lost)


@dataclass(frozen=True, slots=True, kw_only=True)
class Picture:
    """A chart of the HTML report, with its numbers.

    Attributes:
        name: name of the CSV file, without suffix.
        title: caption and alt text.
        markup: the chart as an SVG element.
        csv: the numbers in the chart.
        narrow: SVG element for narrow screens; empty if `markup` serves all screens.
    """

    name: str
    title: str
    markup: str
    csv: str
    narrow: str = ""

    @classmethod
    def of(
        cls, name: str, title: str, figure: Figure, csv: str, narrow: Figure | None = None
    ) -> Picture:
        """Convert a figure, with an optional variant for narrow screens, to a report chart."""
        wide, small = (_markup(part) if part else "" for part in (figure, narrow))
        return cls(name=name, title=title, markup=wide, csv=csv, narrow=small)


def _markup(figure: Figure) -> str:
    """Return a figure as an SVG element in the page's font and colours."""
    text = svg(figure)
    markup = _OWN_ID.sub("", text[text.index("<svg") :])
    markup = _FONT.sub(r"font-size: \1", markup)
    for colour, variable in _THEME.items():
        markup = markup.replace(colour, variable)
    return markup.strip()


# Effects and claimed ranges -----------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class ForestRow:
    """A row of the forest plot: the range of one claim, and the effects measured for it.

    Attributes:
        low, high: ends of the claimed range; infinite where it is open.
        number: whether the effect is a plain number; otherwise it is a share.
        effects: one effect per place; None if the place was not flown or gives no effect.
        verdict: verdict on the claim at the first place.
    """

    label: str
    low: float
    high: float
    number: bool
    effects: Sequence[Interval | None]
    verdict: str


_FOREST_IN = {"one": 2.9, "two": 4.3}
_MARKS = (("o", 3.2), ("D", 2.0), ("s", 2.0), ("^", 2.2), ("v", 2.2), ("p", 2.2))  # mark, size
_GAPS = {"one": "\n", "two": " "}  # between the halves of an axis label


def draw_forest(rows: Sequence[ForestRow], places: Sequence[str], columns: str = "two") -> Figure:
    """Draw a row per claim: the claimed range as a band, and the effects at the places on it.

    Args:
        places: names of up to six stacks, or stacks in one kind of worlds.
        columns: `one` on a narrow screen, otherwise `two`.
    """
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

    gap = _GAPS[columns]
    parts = [part for kind in (False, True) if (part := [x for x in rows if x.number is kind])]
    heights = [len(part) + 1 for part in parts]
    row_in = 0.117 + 0.02 * max(0, len(places) - 3)
    figure = new_figure(_FOREST_IN[columns], 0.7 + row_in * sum(heights))
    grid = figure.subplots(len(parts), 1, height_ratios=heights, squeeze=False)
    for axes, part in zip(grid[:, 0], parts, strict=True):
        numbers = part[0].number
        scale, ends = (1.0, (-1.2, 1.2)) if numbers else (100.0, (-100.0, 130.0))
        print_axes(axes)
        axes.tick_params(labelsize=6.2, labeltop=True, top=False)
        if not numbers:
            axes.set_xscale("symlog", linthresh=1.0, linscale=0.6)
            ticks = [-100, -1, 0, 1, 100] if columns == "one" else [-100, -10, -1, 0, 1, 10, 100]
            axes.xaxis.set_major_locator(FixedLocator(ticks))
            axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
            axes.xaxis.set_minor_locator(NullLocator())
        axes.set_xlim(*ends)
        axes.axvline(0.0, color=NOTE, linewidth=0.6)
        for y, row in enumerate(part):
            low, high = (min(max(scale * end, ends[0]), ends[1]) for end in (row.low, row.high))
            axes.barh(y, high - low, left=low, height=0.86, color=_BAND, linewidth=0)
            for place, effect in enumerate(row.effects):
                if effect is not None:
                    down = (
                        -0.2 if not place else 0.12 + 0.24 * (place - 1) / max(1, len(places) - 2)
                    )
                    _effect(axes, y + down, effect, scale, place, row.verdict)
        axes.set_yticks(range(len(part)), [row.label for row in part], fontsize=6.2)
        axes.set_ylim(len(part) - 0.4, -0.6)
        shares = ("points or per cent", "(logarithmic beyond 1)")
        axes.set_xlabel("a number" if numbers else gap.join(shares),
                        fontsize=6.2, labelpad=1)  # fmt: skip
    marks: list[Patch | Line2D] = [Patch(color=_BAND, label="the paper's range")]
    marks += [
        Line2D([], [], marker=mark, markersize=size, color=NOTE, linewidth=0.9, label=name,
               markerfacecolor=NOTE if not place else "none")
        for place, (name, (mark, size)) in enumerate(zip(places, _MARKS, strict=False))
        if any(any(row.effects[place : place + 1]) for row in rows)
    ]  # fmt: skip
    wide = 3 if len(marks) <= 3 else 2
    legend_above(figure, handles=marks, ncols=wide, fontsize=6.2, handlelength=1.4,
                 columnspacing=1.0)  # fmt: skip
    return figure


def _effect(axes: Axes, y: float, effect: Interval, scale: float, place: int, verdict: str) -> None:
    """Draw the effect at place number `place` with its interval at height `y`.

    The effect at the first place has the colour of the verdict.
    """
    colour = _VERDICTS.get(verdict, NOTE) if not place else NOTE
    mark, size = _MARKS[place]
    low, high = scale * effect.low, scale * effect.high
    axes.hlines(y, low, high, color=colour, linewidth=0.6 if place else 1.3)
    axes.plot(scale * effect.value, y, mark, color=colour,
              markersize=size, markerfacecolor=colour if not place else "none",
              markeredgewidth=0.6)  # fmt: skip


# Added time ---------------------------------------------------------------------------------------


def draw_delays(
    panels: Mapping[str, Sequence[Curve]], golden_s: Sequence[float], columns: str = "two"
) -> Figure:
    """Draw the share of flights that are delayed by more than a time, as a function of that time.

    The time is shown in seconds, and in per cent of the mean golden flight time.

    Args:
        panels: curves of each panel, by its title.
        golden_s: mean flight time of the golden flights of each panel, in seconds.
        columns: `one` on a narrow screen, otherwise `two`.
    """
    from matplotlib.ticker import FuncFormatter, NullFormatter

    across = min(2, len(panels)) if columns == "two" else 1
    down = math.ceil(len(panels) / across)
    figure = new_figure(WIDTHS_IN[columns], 0.45 + 1.75 * down)
    grid = figure.subplots(down, across, squeeze=False)
    for axes in grid.flat[len(panels) :]:
        axes.set_visible(False)
    for axes, (title, curves), mean_s in zip(grid.flat, panels.items(), golden_s, strict=False):
        print_axes(axes, title)
        for (label, detector, added_s), style in zip(curves, ("-", "--", ":"), strict=False):
            count = len(added_s)
            seconds = np.geomspace(0.02, 200.0, 400)
            share = 100.0 * (1.0 - np.searchsorted(added_s, seconds, "right") / count)
            colour = NOTE if detector == "none" else DETECTORS[detector]
            axes.step(seconds, share, style, where="post", color=colour, linewidth=1.5,
                      label=label)  # fmt: skip
        axes.set_xscale("log")
        axes.set_xlim(0.02, 200.0)
        axes.set_ylim(bottom=0.0)
        axes.axvline(0.1 * mean_s, color=INK, linewidth=0.6, linestyle=(0, (2, 2)))
        rates = axes.secondary_xaxis("top", functions=_per_cent_of(mean_s))
        rates.set_xticks([0.1, 1, 10, 100], ["0.1 %", "1 %", "10 %", "100 % of golden"])
        rates.minorticks_off()
        rates.tick_params(labelsize=SMALLEST - 0.5, color=GRID, length=2.5, pad=1)
        axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_ylabel("flights, %", fontsize=SMALLEST)
    words = ("longer than golden by more than, s;", "a lost mission is longer than any")
    figure.supxlabel(_GAPS[columns].join(words),
                     fontsize=SMALLEST + 0.5, color=INK)  # fmt: skip
    most = max(panels.values(), key=len)
    axes = grid.flat[[*panels.values()].index(most)]
    legend_above(figure, *axes.get_legend_handles_labels(), fontsize=SMALLEST)
    return figure


def _per_cent_of(
    mean_s: float,
) -> tuple[Callable[[FloatArray], FloatArray], Callable[[FloatArray], FloatArray]]:
    """Return functions that convert seconds to per cent of a mean time, and back."""
    return lambda added_s: 100.0 * added_s / mean_s, lambda rate: rate * mean_s / 100.0


# Arms and kernels ---------------------------------------------------------------------------------


def draw_arms(arms: Sequence[tuple[str, Share, float | None]]) -> Figure:
    """Draw the share of lost missions in each arm of an experiment, with its 95 % interval.

    Args:
        arms: name, share of lost missions, and corrected p-value of each arm. The unprotected arm
            has None as its p-value.
    """
    figure = new_figure(WIDTHS_IN["one"], 0.6 + 0.17 * len(arms))
    axes = figure.add_subplot()
    print_axes(axes)
    for place, (_, lost, p) in enumerate(arms):
        colour = _LOST if p is None else DETECTORS["gad"] if p < 0.05 else NONE
        axes.hlines(place, 100 * lost.low, 100 * lost.high, color=colour, linewidth=1.4)
        axes.plot(100 * lost.share, place, "o", color=colour, markersize=4)
    axes.set_yticks(range(len(arms)), [name for name, _, _ in arms], fontsize=SMALLEST)
    axes.set_ylim(len(arms) - 0.4, -0.6)
    axes.set_xlim(left=0.0)
    axes.set_xlabel("missions lost, % (95 % interval)", fontsize=SMALLEST)
    return figure


_FATES = {"never read": "#dfe5ec", "same flight": "#b9c6d4", "changed flight": "#6a4fb3",
          "crashed": "#e4572e", "hung": "#f2b134"}  # fmt: skip


def draw_flows(flows: Mapping[str, Mapping[str, Share]]) -> Figure:
    """Draw a bar per struck kernel, divided by what the faults did to the kernel.

    Args:
        flows: shares of lost missions by kernel and fate, such as `crashed`. The total of a share
            is the number of missions with that fate.
    """
    figure = new_figure(WIDTHS_IN["one"], 0.9 + 0.26 * len(flows))
    axes = figure.add_subplot()
    print_axes(axes)
    for place, fates in enumerate(flows.values()):
        total, left = sum(share.total for share in fates.values()), 0.0
        for fate, share in fates.items():
            part = 100.0 * share.total / total
            axes.barh(place, part, left=left, height=0.66, color=_FATES[fate],
                      label=fate if not place else None)  # fmt: skip
            left += part
    axes.set_yticks(range(len(flows)), list(flows), fontsize=SMALLEST)
    axes.set_ylim(len(flows) - 0.5, -0.5)
    axes.set_xlim(0.0, 100.0)
    axes.set_xlabel("share of struck kernels, %", fontsize=SMALLEST)
    look = {"handlelength": 1.0, "columnspacing": 1.0, "labelcolor": INK}
    legend_above(figure, ncols=3, fontsize=SMALLEST, **look)
    return figure
