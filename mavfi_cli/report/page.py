"""The page: fills the template. Numbers become words, and charts their places.

Charts are SVG by matplotlib, small enough for a phone, each with its data as CSV. The SVG stands in
the page itself, so it takes font and colours from the page: light, dark, print. No library of
interactive charts: plotly alone is 5 MB in each page, and a page without script has nothing that
can fail.
"""

from __future__ import annotations

import base64
import importlib.util
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavfi_cli.campaigns.specification import Spec
from mavfi_cli.core.errors import MavfiError
from mavfi_cli.core.files import require_output
from mavfi_cli.report.drawing import DETECTORS, GRID, INK, NONE, NOTE, legend_above, new_figure, svg
from mavfi_cli.report.paper import DETECTOR_TITLES, PALETTE, SMALLEST, WIDTHS_IN, print_axes
from mavfi_cli.report.table import Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_FOLDER = Path(__file__).parent
_NONE = "\N{EN DASH}"


def require_page(path: Path) -> None:
    """Check what a page needs before its numbers are computed.

    Raises:
        MavfiError: jinja2, which the extra `report` installs, is missing.
        RecordError: the page's folder does not exist.
    """
    if importlib.util.find_spec("jinja2") is None:
        raise MavfiError("the report needs jinja2; install with: pip install 'mavfi[report]'")
    require_output(path)


def render(told: Mapping[str, Any]) -> str:
    """The page as one HTML text; equal values give equal pages.

    Args:
        told: `mavfi_cli.paper.document.document`.
    """
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_FOLDER), autoescape=True, trim_blocks=True,
        lstrip_blocks=True, undefined=jinja2.StrictUndefined, finalize=_unbroken,
    )  # fmt: skip
    environment.filters |= FILTERS
    style = (_FOLDER / "page.css").read_text(encoding="utf-8")
    return environment.get_template("page.html").render(**told, style=style, charts=_charts(told))


def _unbroken(value: Any) -> Any:
    """A number stays in one line with its sign of per cent."""
    plain_text = isinstance(value, str) and not hasattr(value, "__html__")
    return value.replace(" %", "\N{NARROW NO-BREAK SPACE}%") if plain_text else value


# Charts -------------------------------------------------------------------------------------------

_LOST = "#b2182b"
_THEME = {INK: "var(--ink)", NOTE: "var(--note)", GRID: "var(--rule)", "#ffffff": "none",
          PALETTE[0]: "var(--deep)"}  # fmt: skip
_OWN_ID = re.compile(r' id="[a-z]+[a-z0-9]*_[0-9_]+"')  # figure_1, text_3: not unique in a page
_FONT = re.compile(r"font: (?:[a-z0-9]+ )*?([0-9.]+px)[^;\"]*")


def _chart(name: str, title: str, figure: Figure, csv: str) -> dict[str, str]:
    """A picture in the page, as an SVG element in the page's font and colours.

    Args:
        name: of its CSV file, without suffix.
        title: what it shows, in words, also for those who cannot see it.
        csv: its numbers.
    """
    text = svg(figure)
    markup = _OWN_ID.sub("", text[text.index("<svg") :])
    markup = _FONT.sub(r"font-size: \1", markup)
    for colour, variable in _THEME.items():
        markup = markup.replace(colour, variable)
    return {"name": name, "title": title, "markup": markup.strip(), "csv": csv}


def _charts(told: Mapping[str, Any]) -> dict[str, Any]:
    stacks = told["stacks"]
    return {
        "items": {
            (each["item"].name, part["stack"]): _item_chart(each["item"], part)
            for each in told["items"]
            for part in each["shown"]
            if part["figure"] is not None
        },
        "states": [
            _chart(f"states-{x}", f"Faults in states, {x}", each["figure"], _csv(each["rows"]))
            for x, each in told["spreads"].items()
            if each
        ],
        "arms": [_arm_chart(each["campaign"], each["arms"]) for each in told["arms"]],
        "flows": [_flow_chart(s, told["flows"][s]) for s in stacks if told["flows"][s]],
    }


def _item_chart(item: Any, shown: Mapping[str, Any]) -> dict[str, str]:
    name = f"{item.name}-{shown['stack']}".replace(" ", "-")
    flights, title = shown["flights"], f"{item.paper}, {shown['stack']}"
    csv = _csv(flights) if flights else shown["table"].csv()
    return _chart(f"{name}-flights" if flights else name, title, shown["figure"], csv)


def _arm_chart(campaign: str, arms: Sequence[Any]) -> dict[str, str]:
    figure = new_figure(WIDTHS_IN["one"], 0.6 + 0.17 * len(arms))
    axes = figure.add_subplot()
    print_axes(axes)
    rows = []
    for place, arm in enumerate(arms):
        lost, p = arm["lost"], arm["corrected_p"]
        colour = _LOST if p is None else DETECTORS["gad"] if p < 0.05 else NONE
        axes.hlines(place, 100 * lost.low, 100 * lost.high, color=colour, linewidth=1.4)
        axes.plot(100 * lost.share, place, "o", color=colour, markersize=4)
        rows.append({"arm": arm["name"], "lost": lost.count, "of": lost.total, "low": lost.low,
                     "high": lost.high, "p": "" if p is None else p})  # fmt: skip
    axes.set_yticks(range(len(arms)), [each["name"] for each in arms], fontsize=SMALLEST)
    axes.set_ylim(len(arms) - 0.4, -0.6)
    axes.set_xlim(left=0.0)
    axes.set_xlabel("missions lost, % (95 % interval)", fontsize=SMALLEST)
    title = f"Lost missions of each arm of {campaign}"
    return _chart(f"arms-{campaign}", title, figure, _csv(rows))


_FATES = {"never read": "#dfe5ec", "same flight": "#b9c6d4", "changed flight": "#6a4fb3",
          "crashed": "#e4572e", "hung": "#f2b134"}  # fmt: skip


def _flow_chart(stack: str, flows: Sequence[Any]) -> dict[str, str]:
    figure = new_figure(WIDTHS_IN["one"], 0.9 + 0.26 * len(flows))
    axes = figure.add_subplot()
    print_axes(axes)
    rows = []
    for place, flow in enumerate(flows):
        total, left = sum(each.total for each in flow["fates"].values()), 0.0
        for fate, share in flow["fates"].items():
            part = 100.0 * share.total / total
            label = fate if not place else None
            axes.barh(place, part, left=left, height=0.66, color=_FATES[fate], label=label)
            left += part
            rows.append({"kernel": flow["kernel"], "fate": fate, "missions": share.total,
                         "lost": share.count})  # fmt: skip
    names = [each["kernel"].replace("_", " ") for each in flows]
    axes.set_yticks(range(len(flows)), names, fontsize=SMALLEST)
    axes.set_ylim(len(flows) - 0.5, -0.5)
    axes.set_xlim(0.0, 100.0)
    axes.set_xlabel("share of struck kernels, %", fontsize=SMALLEST)
    look = {"handlelength": 1.0, "columnspacing": 1.0, "labelcolor": INK}
    legend_above(figure, ncols=3, fontsize=SMALLEST, **look)
    title = f"What struck kernels did, {stack}"
    return _chart(f"kernels-{stack}", title, figure, _csv(rows))


# Numbers as words ---------------------------------------------------------------------------------


def _csv(records: Iterable[Mapping[str, Any]]) -> str:
    return Table.of_records(records).csv()


def _percent(value: float | None, digits: int = 0, sign: str = "") -> str:
    if value is None or not math.isfinite(value):
        return _NONE
    return f"{100 * value:{sign}z.{digits}f} %"


def _ends(share: Any, scale: float = 100.0, digits: int = 0) -> str:
    return f"{scale * share.low:z.{digits}f} to {scale * share.high:z.{digits}f}"


def _effect(found: Any, unit: str) -> str:
    """An effect with its interval, in per cent or in points of a success rate."""
    if found is None:
        return _NONE
    if unit == "number":
        return f"{found.value:.2f} ({_ends(found, 1.0, 2)})"
    largest = max(abs(found.low), abs(found.high))
    digits = 0 if largest >= 0.1 else 1 if largest >= 0.001 else 4
    value = f"{100 * found.value:{'+' if unit == 'points' else ''}z.{digits}f}"
    return f"{value} {'points' if unit == 'points' else '%'} ({_ends(found, digits=digits)})"


def _p_value(chance: float | None) -> str:
    if chance is None:
        return _NONE
    return "< 0.001" if chance < 0.001 else f"{chance:.2g}"


def _link(text: str) -> str:
    return f"data:text/csv;charset=utf-8;base64,{base64.b64encode(text.encode()).decode()}"


FILTERS: Mapping[str, Callable[..., Any]] = {
    "percent": _percent, "ends": _ends, "effect": _effect, "p": _p_value, "csv": _csv,
    "link": _link, "toml": Spec.to_toml,
    "detector": lambda name: DETECTOR_TITLES.get(name, name) if name else "none",
    "hourly": lambda rates: "{:.2g} ({:.2g} to {:.2g})".format(*rates),
    "shade": lambda share: f"{100 * math.sqrt(share):.0f}" if math.isfinite(share) else "0",
}  # fmt: skip
"""By the names that page.html uses."""
