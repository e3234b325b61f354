"""Pictures of a platform comparison: flight times and worst cases, and the kernels over time."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

from mavfi_cli.analysis.platforms import (
    CostRow,
    PlatformComparison,
    PlatformSummary,
    SettingFlights,
)
from mavfi_cli.analysis.timeline import Span, Timeline
from mavfi_cli.report.drawing import (
    DASHED,
    GRID,
    INK,
    KERNELS,
    NOTE,
    PLATFORMS,
    Look,
    legend_above,
    new_figure,
    note_at,
    open_frame,
    scattered,
    whisker,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_WAIT = "#dfe3e9"
_CHAIN = ("point_cloud", "octomap", "collision_check", "control")
_NAMES = {"golden": "golden", "none": "faults"}
_GOLDEN, _NONE = "golden", "none"
_RATIOS = (
    ("flight_time_s", "flight time"),
    ("distance_m", "distance"),
    ("energy_regression_j", "energy\n(regression)"),
    ("energy_propeller_j", "energy\n(propellers)"),
)


def _draw_comparison(comparison: PlatformComparison) -> Figure:
    """Draw the flights of all platforms in five panels, with one colour per platform."""
    figure = new_figure(12.0, 8.0)
    figure.get_layout_engine().set(w_pad=0.12, h_pad=0.1)  # type: ignore[union-attr, call-arg]
    panels = figure.subplot_mosaic("TTTTSS;RRMMWW")
    colours = {
        row.platform: PLATFORMS[place % len(PLATFORMS)]
        for place, row in enumerate(comparison.plan.platforms)
    }
    _times(panels["T"], comparison, colours)
    _success(panels["S"], comparison, colours)
    _response(panels["R"], comparison, colours)
    _ratios(panels["M"], comparison, colours)
    _costs(panels["W"], comparison, colours)
    handles = [
        panels["S"].plot([], [], "s", color=colours[row.platform], markersize=9,
                               label=f"{row.title}: {row.description}")[0]
        for row in comparison.plan.platforms
    ]  # fmt: skip
    legend_above(figure, handles=handles, ncols=min(3, len(handles)), fontsize=9.5)
    plan, struck = comparison.plan, comparison.plan.flip or "no faults"
    figure.supxlabel(
        f"{plan.missions} {'mission' if plan.missions == 1 else 'missions'} in "
        f"{plan.world} from seed {plan.first_seed} on, the same on each platform; {struck}; "
        f"whiskers: {100 * comparison.confidence:g} % intervals",
        fontsize=8, color=NOTE,
    )  # fmt: skip
    return figure


def _frame(axes: Axes, title: str, grid: str) -> None:
    open_frame(axes, title, grid, fontsize=10, loc="left")
    axes.tick_params(labelsize=8.5)


def _places(
    comparison: PlatformComparison, settings: Sequence[str]
) -> tuple[dict[tuple[str, str], float], float]:
    platforms = [row.platform for row in comparison.plan.platforms]
    width = 0.76 / len(platforms)
    return {
        (platform, setting): group + width * (number - (len(platforms) - 1) / 2)
        for group, setting in enumerate(settings)
        for number, platform in enumerate(platforms)
    }, width


def _setting_ticks(axes: Axes, settings: Sequence[str]) -> None:
    names = [_NAMES.get(name, f"faults, {name}") for name in settings]
    axes.set_xticks(range(len(settings)), names, fontsize=9)
    axes.set_xlim(-0.55, len(settings) - 0.45)


def _times(axes: Axes, comparison: PlatformComparison, colours: Mapping[str, str]) -> None:
    settings = comparison.plan.settings
    places, width = _places(comparison, settings)
    times_s: dict[tuple[str, str], list[float]] = {}
    for flight in comparison.flights:
        if flight["counted"] and flight["outcome"] == "success":
            place = flight["platform"], flight["setting"]
            times_s.setdefault(place, []).append(flight["flight_time_s"])
    flown = [*itertools.chain(*times_s.values())] or [1.0]
    room = 0.16 * max(max(flown) - min(flown), 0.1 * max(flown))
    for row in comparison.settings:
        key = row.platform, row.setting
        x, colour = places[key], colours[row.platform]
        times = times_s.get(key, [])
        _foot(axes, x, row, len(times), colour)
        if not times:
            continue
        spread = x + 0.62 * width * scattered(len(times))
        axes.plot(spread, times, "o", color=colour, markersize=4.2, alpha=0.45, markeredgewidth=0.0)
        middle = row.quantities["flight_time_s"].median
        axes.hlines(middle.value, x - 0.38 * width, x + 0.38 * width, color=INK, linewidth=1.8)
        whisker(axes, x, middle.value, (middle.low, middle.high))
        worst = times.index(max(times))
        axes.plot(
            spread[worst], times[worst], "o", markersize=8, markerfacecolor="none",
            markeredgecolor=colour, markeredgewidth=1.2,
        )  # fmt: skip
        note_at(axes, f"{times[worst]:.1f} s", (x, times[worst]), 8, color=colour)
    axes.set_ylim(min(flown) - 2.2 * room, max(flown) + 1.2 * room)
    axes.set_ylabel("flight time, s", fontsize=9)
    _setting_ticks(axes, settings)
    _frame(axes, "Flight time of each successful mission; bar: median; ring: the worst", "y")


def _foot(axes: Axes, x: float, row: SettingFlights, succeeded: int, colour: str) -> None:
    replans, failed = row.quantities["replans"].mean.value, row.counted - succeeded
    lines = [f"{failed} failed"] if failed else []
    if not math.isnan(replans):
        lines.append(f"{replans:.1f} replans")
    for height, text in zip((4, 15), reversed(lines), strict=False):
        look = NOTE if text.endswith("failed") else colour
        foot = {"xycoords": ("data", "axes fraction"), "fontsize": 8, "color": look}
        note_at(axes, text, (x, 0.0), height, **foot)


def _success(axes: Axes, comparison: PlatformComparison, colours: Mapping[str, str]) -> None:
    settings = comparison.plan.settings
    places, width = _places(comparison, settings)
    for row in comparison.settings:
        share, x = row.success, places[row.platform, row.setting]
        if not share.total:
            continue
        axes.bar(x, 100 * share.share, width=0.9 * width, color=colours[row.platform])
        whisker(axes, x, 100 * share.share, (100 * share.low, 100 * share.high))
        axes.text(
            x, 3.0, f"{share.count}/{share.total}", ha="center", va="bottom", fontsize=7.5,
            color="white", rotation=90,
        )  # fmt: skip
    axes.set_ylim(0.0, 104.0)
    axes.set_ylabel("missions that reach the goal, %", fontsize=9)
    _setting_ticks(axes, settings)
    axes.set_xticks(range(len(settings)), [
        _NAMES.get(name, f"faults,\n{name}") for name in settings], fontsize=9)  # fmt: skip
    _frame(axes, "Success", "y")


def _response(axes: Axes, comparison: PlatformComparison, colours: Mapping[str, str]) -> None:
    """Draw the response time of golden flights, divided into kernels and waiting."""
    rows = {r.platform: r.quantities for r in comparison.settings if r.setting == _GOLDEN}
    platforms = comparison.plan.platforms
    for place, platform in enumerate(platforms):
        name, left = platform.platform, 0.0
        quantities = rows[name]
        middle_ms, late_ms = (
            1e3 * quantities[key].median.value for key in ("response_median_s", "response_p95_s")
        )
        for kernel in _CHAIN:
            length = 1e3 * platform.kernel_latency_s[kernel]
            axes.barh(place, length, left=left, height=0.46, color=KERNELS[kernel][1],
                      label=KERNELS[kernel][0] if place == 0 else None)  # fmt: skip
            left += length
        if math.isnan(middle_ms):
            continue
        axes.barh(place, max(0.0, middle_ms - left), left=left, height=0.46, color=_WAIT,
                  label="waiting" if place == 0 else None)  # fmt: skip
        axes.plot([middle_ms] * 2, [place - 0.3, place + 0.3], color=INK, linewidth=2.0,
                  label="median" if place == 0 else None)  # fmt: skip
        axes.plot(late_ms, place, "D", color=INK, markersize=5,
                  label="95th percentile" if place == 0 else None)  # fmt: skip
        axes.text(
            0.0, place - 0.35, f"{platform.title}: {middle_ms:.0f} ms, {late_ms:.0f} ms",
            fontsize=9, color=colours[name], va="bottom", weight="bold",
        )  # fmt: skip
    axes.set_ylim(len(platforms) - 0.4, -0.75)
    axes.set_yticks([])
    axes.set_xlabel("response time, ms", fontsize=9)
    axes.legend(
        loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=4, frameon=False, fontsize=7.5,
        columnspacing=1.0, handlelength=1.0, handletextpad=0.4,
    )  # fmt: skip
    _frame(axes, "Response, depth frame to setpoint (golden)", "x")
    axes.spines["left"].set_visible(False)


def _ratios(axes: Axes, comparison: PlatformComparison, colours: Mapping[str, str]) -> None:
    """Draw the ratios of each platform to the first one, mission by mission.

    Markers are filled for golden flights, and hollow for flights with faults.
    """
    drawn = [row for row in comparison.ratios if row.setting in (_GOLDEN, _NONE)]
    titles = {row.platform: row.title for row in comparison.plan.platforms}
    first = comparison.plan.platforms[0].title
    step = 0.8 / max(1, len(drawn))
    for place, (quantity, _) in enumerate(_RATIOS):
        for number, row in enumerate(drawn):
            ratio, y = row.quantities[quantity], place + step * (number - (len(drawn) - 1) / 2)
            if math.isnan(ratio.value):
                continue
            colour = colours[row.platform]
            if not math.isnan(ratio.low):
                axes.hlines(y, ratio.low, ratio.high, color=colour, linewidth=1.6)
            axes.plot(
                ratio.value, y, "o", color=colour, markersize=6, markeredgewidth=1.4,
                markerfacecolor=colour if row.setting == _GOLDEN else "white",
            )  # fmt: skip
            axes.text(
                1.01, y, f"{ratio.value:.3f}", transform=axes.get_yaxis_transform(), fontsize=8,
                va="center", color=colour,
            )  # fmt: skip
    axes.axvline(1.0, color=INK, linewidth=0.9, linestyle=DASHED)
    axes.set_ylim(len(_RATIOS) - 0.45, -0.55)
    axes.set_yticks(range(len(_RATIOS)), [title for _, title in _RATIOS], fontsize=8.5)
    others = ", ".join(dict.fromkeys(titles[row.platform] for row in drawn)) or "one platform"
    axes.set_xlabel("ratio; full: golden, open: faults", fontsize=9)
    _frame(axes, f"{others} over {first}, mission by mission", "x")
    if not drawn:
        axes.text(1.0, 1.5, "nothing to compare with", ha="center", fontsize=9, color=NOTE)


def _costs(axes: Axes, comparison: PlatformComparison, colours: Mapping[str, str]) -> None:
    """Draw the largest and the 95th-percentile increase of flight time due to faults."""
    settings = [name for name in comparison.plan.settings if name != _GOLDEN]
    places, width = _places(comparison, settings)
    rows = [row for row in comparison.costs if row.pairs]
    _frame(axes, "Worst case and recovery (paper, Fig. 16)", "y")
    if not rows:
        axes.text(0.5, 0.5, "no faults", ha="center", color=NOTE, transform=axes.transAxes)
        axes.set_xticks([])
        axes.set_yticks([])
        return
    ends = [0.0]
    for number, row in enumerate(rows):
        x, late = places[row.platform, row.setting], row.over_own.p95
        height = 100 * (row.over_own.largest - 1.0)
        axes.bar(x, height, width=0.9 * width, color=colours[row.platform])
        middle, *whiskers = (100 * (end - 1.0) for end in (late.value, late.low, late.high))
        known = [end for end in (height, middle, *whiskers) if not math.isnan(end)]
        top = max(0.0, *known)
        note_at(axes, f"{height:+.1f}", (x, top), 6 if middle >= 0.9 * top else 2)
        axes.plot(
            x, middle, "D", markersize=5, color="white", markeredgecolor=INK,
            label="95th percentile" if number == 0 else None,
        )  # fmt: skip
        whisker(axes, x, middle, (whiskers[0], whiskers[1]))
        ends += known
    _recovered(axes, rows, settings, colours)
    low, high = min(ends), max(1.0, *ends)
    axes.set_ylim(1.1 * low, 1.45 * high)
    axes.set_ylabel("longer than its own golden flight, %", fontsize=9)
    axes.legend(
        loc="upper center", bbox_to_anchor=(0.5, -0.1), frameon=False, fontsize=7.5,
        handletextpad=0.3,
    )  # fmt: skip
    _setting_ticks(axes, settings)


def _recovered(
    axes: Axes, rows: Sequence[CostRow], settings: Sequence[str], colours: Mapping[str, str]
) -> None:
    lines = {name: place for place, name in enumerate(colours)}
    style: Look = {
        "transform": axes.get_xaxis_transform(), "va": "top", "fontsize": 8.5, "ha": "center",
    }  # fmt: skip
    for row in rows:
        if row.setting == _NONE:
            continue
        share = row.over_own.recovered_share
        axes.text(
            settings.index(row.setting), 0.985 - 0.055 * lines[row.platform],
            "-" if math.isnan(share) else f"{100 * share:.0f} %",
            color=colours[row.platform], weight="bold", **style,
        )  # fmt: skip
    if len(settings) > 1:
        axes.text(0, 0.985, "recovered:", color=NOTE, **style)


# Timeline of the kernels from a depth frame to its setpoint, with a panel per platform ------------

# From top to bottom: title, colour of invocations that led to the setpoint, colour of others.
_PALE = {
    "point_cloud": "#d3e4f1",
    "octomap": "#cad6de",
    "collision_check": "#cfe9e5",
    "planner": "#f7e2c4",
    "control": "#e2d6ea",
}
_LANES = {name: (*KERNELS[name], pale) for name, pale in _PALE.items()}
_SETPOINT = len(_LANES)  # the lowest lane
_ANSWER = "#c22f2f"
_HEIGHT = 0.62
_THINNEST = 0.0022  # minimum bar length as a fraction of the window
_ROOM = 0.085  # minimum bar length for a text inside, as a fraction of the window
_LATE, _ANSWER_LATE = 0.93, 0.7  # fractions of the window beyond which text goes to the left


def _draw_timeline(comparison: PlatformComparison) -> Figure:
    """Draw a panel per platform, with a lane per kernel over simulated time since the depth frame.

    The panels share the time axis, so equal lengths mean equal times.
    """
    rows = comparison.timeline.platforms
    known = {row.platform: row for row in comparison.plan.platforms}
    figure = new_figure(11.0, 0.9 + 2.9 * max(1, len(rows)))
    panels = figure.subplots(max(1, len(rows)), 1, squeeze=False, sharex=True)[:, 0]
    if not rows:
        panels[0].set_axis_off()
        panels[0].text(0.5, 0.5, "no flight answered a depth frame", ha="center", color=NOTE)
        return figure
    window = rows[0].shown_s
    for axes, row in zip(panels, rows, strict=True):
        _panel(axes, row, known[row.platform], window)
    panels[-1].set_xlabel("simulated time since the depth frame, s", fontsize=9)
    figure.supxlabel(
        f"golden flights in {comparison.plan.world}, seed {comparison.timeline.seed}; "
        "full colour: what led from the frame to its setpoint, and to the new plan;\n"
        "an output takes effect at the end of its bar; setpoints go out every control tick",
        fontsize=7.5, color=NOTE,
    )  # fmt: skip
    return figure


def _panel(axes: Axes, row: Timeline, platform: PlatformSummary, window: Span) -> None:
    width_s = window[1] - window[0]
    axes.set_xlim(*window)
    for lane, (kernel, (_, strong, pale)) in enumerate(_LANES.items()):
        axes.axhspan(lane - 0.5, lane + 0.5, color="#f7f8fa" if lane % 2 else "white", zorder=0)
        _others(axes, lane, row.lanes_s[kernel], pale, width_s)
        if kernel in row.chain_s:
            length, begin = _length(row.chain_s[kernel], width_s), row.chain_s[kernel][0]
            axes.barh(lane, length, left=begin, height=_HEIGHT, color=strong, zorder=4)
            _duration(axes, lane, row.chain_s[kernel], strong, width_s)
    axes.vlines(row.setpoints_s, _SETPOINT - 0.16, _SETPOINT + 0.16, color="#b9c0ca", linewidth=0.7)
    _steps(axes, row)
    _answers(axes, row, width_s)
    axes.set_ylim(_SETPOINT + 1.5, -1.25)
    names = [title for title, _, _ in _LANES.values()]
    axes.set_yticks(range(_SETPOINT + 1), [*names, "setpoint"], fontsize=8.5)
    axes.tick_params(axis="y", length=0)
    axes.tick_params(axis="x", labelsize=8.5)
    axes.grid(visible=True, axis="x", color=GRID, linewidth=0.6, zorder=1)
    axes.set_axisbelow(True)
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.set_title(f"{platform.title}: {platform.description}", fontsize=10, loc="left",
                   color=INK)  # fmt: skip


def _length(span: Span, width_s: float) -> float:
    return max(span[1] - span[0], _THINNEST * width_s)


def _others(axes: Axes, lane: int, spans: Sequence[Span], colour: str, width_s: float) -> None:
    low = lane - _HEIGHT / 2
    axes.broken_barh(
        [(span[0], _length(span, width_s)) for span in spans], (low, _HEIGHT), color=colour,
        linewidth=0, zorder=2,
    )  # fmt: skip
    long = [span[1] for span in spans if span[1] - span[0] > 2 * _THINNEST * width_s]
    axes.vlines(long, low, low + _HEIGHT, color="white", linewidth=0.8, zorder=3)


def _duration(axes: Axes, lane: int, span: Span, colour: str, width_s: float) -> None:
    text = _time(span[1] - span[0])
    if span[1] - span[0] >= _ROOM * width_s:
        axes.text(
            (span[0] + span[1]) / 2, lane, text, ha="center", va="center", fontsize=8,
            color="white", zorder=6,
        )  # fmt: skip
        return
    late = span[1] > _LATE * axes.get_xlim()[1]
    axes.text(
        span[0] - 0.005 * width_s if late else span[0] + _length(span, width_s) + 0.005 * width_s,
        lane, text, ha="right" if late else "left", va="center", fontsize=8, color=colour,
        zorder=6, bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.6, "alpha": 0.85},
    )  # fmt: skip


def _time(seconds: float) -> str:
    ms = 1e3 * seconds
    return f"{ms:.0f} ms" if ms >= 10.0 else f"{ms:.1f} ms" if ms >= 1.0 else f"{ms:.2f} ms"


def _steps(axes: Axes, row: Timeline) -> None:
    """Draw a line from the end of each invocation to the start of the next one in the chain.

    The horizontal part of a line shows how long the message waits.
    """
    places = {kernel: lane for lane, kernel in enumerate(_LANES)}
    links = [("point_cloud", "octomap"), ("octomap", "collision_check"),
             ("collision_check", "control")]  # fmt: skip
    for first, second in links:
        if first in row.chain_s and second in row.chain_s:
            _step(axes, places[first], row.chain_s[first][1], places[second],
                  row.chain_s[second][0], INK)  # fmt: skip
    if "control" in row.chain_s:
        _step(axes, places["control"], row.chain_s["control"][1], _SETPOINT, row.response_s,
              INK)  # fmt: skip
    if row.plan_setpoint_s is not None:
        _step(axes, places["planner"], row.chain_s["planner"][1], _SETPOINT,
              row.plan_setpoint_s, _LANES["planner"][1])  # fmt: skip


def _step(axes: Axes, upper: int, end_s: float, lower: int, start_s: float, colour: str) -> None:
    down = upper + _HEIGHT / 2 + 0.19
    axes.plot(
        [end_s, end_s, start_s, start_s], [upper, down, down, lower - _HEIGHT / 2], color=colour,
        linewidth=0.9, zorder=3, solid_joinstyle="round",
    )  # fmt: skip


def _answers(axes: Axes, row: Timeline, width_s: float) -> None:
    answer_s, plan_s = row.response_s, row.plan_setpoint_s
    axes.vlines(0.0, -1.1, _SETPOINT + 0.3, color=INK, linewidth=0.9, zorder=1)
    axes.vlines(answer_s, -1.1, _SETPOINT, color=_ANSWER, linewidth=0.9, zorder=1)
    axes.annotate(
        "", (answer_s, -0.85), (0.0, -0.85),
        arrowprops={"arrowstyle": "<->", "color": _ANSWER, "shrinkA": 0, "shrinkB": 0,
                    "linewidth": 1.1},
    )  # fmt: skip
    late = answer_s > _ANSWER_LATE * axes.get_xlim()[1]
    axes.text(
        answer_s + (-0.02 if late else 0.008) * width_s, -0.85,
        f"{_time(answer_s)} from depth frame to setpoint", color=_ANSWER, fontsize=9, va="center",
        weight="bold", ha="right" if late else "left",
        bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.5},
    )  # fmt: skip
    axes.plot(answer_s, _SETPOINT, marker="D", color=_ANSWER, markersize=6, zorder=7)
    _acts(axes, answer_s, row.answer, _ANSWER, 0.68, width_s)
    if plan_s is not None:
        colour = _LANES["planner"][1]
        axes.plot(plan_s, _SETPOINT, marker="D", color=colour, markersize=6, zorder=7)
        near = plan_s - answer_s < 0.35 * width_s
        text = f"flies the new plan, {_time(plan_s)} after the frame"
        _acts(axes, plan_s, text, "#a55f08", 1.18 if near else 0.68, width_s)


def _acts(axes: Axes, stamp_s: float, text: str, colour: str, below: float, width_s: float) -> None:
    late = stamp_s > _ANSWER_LATE * axes.get_xlim()[1]
    axes.text(
        stamp_s + (-0.004 if late else 0.006) * width_s, _SETPOINT + below, text, fontsize=8,
        color=colour, va="center", ha="right" if late else "left", zorder=8,
    )  # fmt: skip


PICTURES: Mapping[str, Callable[[PlatformComparison], Figure]] = {
    "compare.svg": _draw_comparison,
    "timeline.svg": _draw_timeline,
}
