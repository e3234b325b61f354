"""Timeline of the kernels from a depth frame to its setpoint, with a panel per platform."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from mavfi_cli.report.drawing import GRID, INK, KERNELS, NOTE, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
_LATE, _ANSWER_LATE = 0.93, 0.7  # fractions of the window from which texts go to the left
Row = Mapping[str, Any]


def draw_timeline(comparison: Row) -> Figure:
    """Draw a figure with simulated time since the frame on x and a lane per kernel.

    All platforms share the time axis, so equal lengths are equal times.
    """
    rows = comparison["timeline"]["platforms"]
    known = {row["platform"]: row for row in comparison["plan"]["platforms"]}
    figure = new_figure(11.0, 0.9 + 2.9 * max(1, len(rows)))
    panels = figure.subplots(max(1, len(rows)), 1, squeeze=False, sharex=True)[:, 0]
    if not rows:
        panels[0].set_axis_off()
        panels[0].text(0.5, 0.5, "no flight answered a depth frame", ha="center", color=NOTE)
        return figure
    shown = rows[0]["shown_s"]
    for axes, row in zip(panels, rows, strict=True):
        _panel(axes, row, known[row["platform"]], shown)
    panels[-1].set_xlabel("simulated time since the depth frame, s", fontsize=9)
    figure.supxlabel(_caption(comparison), fontsize=7.5, color=NOTE)
    return figure


def _caption(comparison: Row) -> str:
    return (
        f"golden flights in {comparison['plan']['world']}, seed {comparison['timeline']['seed']}; "
        "full colour: what led from the frame to its setpoint, and to the new plan;\n"
        "an output takes effect at the end of its bar; setpoints go out every control tick"
    )


def _panel(axes: Axes, row: Row, platform: Row, shown: list[float]) -> None:
    width_s = shown[1] - shown[0]
    axes.set_xlim(*shown)
    for lane, (kernel, (_, strong, pale)) in enumerate(_LANES.items()):
        axes.axhspan(lane - 0.5, lane + 0.5, color="#f7f8fa" if lane % 2 else "white", zorder=0)
        _others(axes, lane, row["lanes_s"][kernel], pale, width_s)
        if kernel in row["chain_s"]:
            _bar(axes, lane, row["chain_s"][kernel], strong, width_s)
            _duration(axes, lane, row["chain_s"][kernel], strong, width_s)
    axes.vlines(
        row["setpoints_s"], _SETPOINT - 0.16, _SETPOINT + 0.16, color="#b9c0ca", linewidth=0.7
    )
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
    axes.set_title(f"{platform['title']}: {platform['description']}", fontsize=10, loc="left",
                   color=INK)  # fmt: skip


def _length(span: list[float], width_s: float) -> float:
    return max(span[1] - span[0], _THINNEST * width_s)


def _others(axes: Axes, lane: int, spans: list[list[float]], colour: str, width_s: float) -> None:
    """Draw all invocations of a kernel, with gaps between neighbours if there is room."""
    low = lane - _HEIGHT / 2
    axes.broken_barh(
        [(span[0], _length(span, width_s)) for span in spans], (low, _HEIGHT), color=colour,
        linewidth=0, zorder=2,
    )  # fmt: skip
    long = [span[1] for span in spans if span[1] - span[0] > 2 * _THINNEST * width_s]
    axes.vlines(long, low, low + _HEIGHT, color="white", linewidth=0.8, zorder=3)


def _bar(axes: Axes, lane: int, span: list[float], colour: str, width_s: float) -> None:
    axes.barh(lane, _length(span, width_s), left=span[0], height=_HEIGHT, color=colour, zorder=4)


def _duration(axes: Axes, lane: int, span: list[float], colour: str, width_s: float) -> None:
    """Write the duration inside the bar if it is long enough, else to its right."""
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


def _steps(axes: Axes, row: Row) -> None:
    """Draw lines from each end to the start that it triggered, level while a message waited."""
    places = {kernel: lane for lane, kernel in enumerate(_LANES)}
    links = [("point_cloud", "octomap"), ("octomap", "collision_check"),
             ("collision_check", "control")]  # fmt: skip
    for first, second in links:
        if first in row["chain_s"] and second in row["chain_s"]:
            _step(axes, places[first], row["chain_s"][first][1], places[second],
                  row["chain_s"][second][0], INK)  # fmt: skip
    if "control" in row["chain_s"]:
        _step(axes, places["control"], row["chain_s"]["control"][1], _SETPOINT, row["response_s"],
              INK)  # fmt: skip
    if row["plan_setpoint_s"] is not None:
        _step(axes, places["planner"], row["chain_s"]["planner"][1], _SETPOINT,
              row["plan_setpoint_s"], _LANES["planner"][1])  # fmt: skip


def _step(axes: Axes, upper: int, end_s: float, lower: int, start_s: float, colour: str) -> None:
    down = upper + _HEIGHT / 2 + 0.19
    axes.plot(
        [end_s, end_s, start_s, start_s], [upper, down, down, lower - _HEIGHT / 2], color=colour,
        linewidth=0.9, zorder=3, solid_joinstyle="round",
    )  # fmt: skip


def _answers(axes: Axes, row: Row, width_s: float) -> None:
    """Mark the frame, its setpoint with the response time, and the setpoint of the new plan."""
    answer_s, plan_s = row["response_s"], row["plan_setpoint_s"]
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
    _acts(axes, answer_s, row["answer"], _ANSWER, 0.68, width_s)
    if plan_s is not None:
        colour = _LANES["planner"][1]
        axes.plot(plan_s, _SETPOINT, marker="D", color=colour, markersize=6, zorder=7)
        near = plan_s - answer_s < 0.35 * width_s
        text = f"flies the new plan, {_time(plan_s)} after the frame"
        _acts(axes, plan_s, text, "#a55f08", 1.18 if near else 0.68, width_s)


def _acts(axes: Axes, stamp_s: float, text: str, colour: str, below: float, width_s: float) -> None:
    """Write below a setpoint what the vehicle does from then on."""
    late = stamp_s > _ANSWER_LATE * axes.get_xlim()[1]
    axes.text(
        stamp_s + (-0.004 if late else 0.006) * width_s, _SETPOINT + below, text, fontsize=8,
        color=colour, va="center", ha="right" if late else "left", zorder=8,
    )  # fmt: skip
