"""Fills the template: numbers become words, and charts their places."""

from __future__ import annotations

import base64
import importlib.util
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mavfi_cli.campaigns.specification_file import to_toml
from mavfi_cli.core.errors import MavfiError
from mavfi_cli.core.files import require_output
from mavfi_cli.report.page.charts import Chart, arm_chart, flow_chart
from mavfi_cli.report.tables.columns import csv_text
from mavfi_cli.report.tables.paper_table import DETECTOR_TITLES, as_csv, cells_of, count_of

_FOLDER = Path(__file__).parent
_LIBRARIES = ("jinja2", "scipy")  # of the extra `report`
_NONE = "\N{EN DASH}"


def require_page(path: Path) -> None:
    """Check what a page needs before its numbers are computed.

    Raises:
        MavfiError: a library of the extra `report` is not installed. Says how to install it.
        RecordError: the page's folder does not exist.
    """
    lacking = [name for name in _LIBRARIES if importlib.util.find_spec(name) is None]
    if lacking:
        raise MavfiError(
            f"the report needs {' and '.join(lacking)}; install with: pip install 'mavfi[report]'"
        )
    require_output(path)


def render(told: Mapping[str, Any]) -> str:
    """The page as one HTML text; equal values give equal pages.

    Args:
        told: `mavfi_cli.claims.document.document`.
    """
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_FOLDER), autoescape=True, trim_blocks=True,
        lstrip_blocks=True, undefined=jinja2.StrictUndefined, finalize=_unbroken,
    )  # fmt: skip
    environment.filters |= {
        "percent": percent, "ends": ends, "effect": effect, "of": count_of, "p": p_value,
        "detector": detector, "hourly": hourly, "shade": _shade, "csv": csv_text,
        "cells": cells_of, "table_csv": as_csv, "link": _link, "toml": to_toml,
    }  # fmt: skip
    style = (_FOLDER / "page.css").read_text(encoding="utf-8")
    return environment.get_template("page.html").render(**told, style=style, charts=_charts(told))


def _charts(told: Mapping[str, Any]) -> dict[str, Any]:
    stacks = told["stacks"]
    return {
        "items": {
            (each.item.name, part.stack): _item_chart(each.item, part)
            for each in told["items"]
            for part in each.shown
            if part.figure is not None
        },
        "states": [
            Chart(
                name=f"states-{stack}",
                title=f"Faults in states, {stack}",
                figure=each["figure"],
                csv=csv_text(each["rows"]),
            )
            for stack, each in told["spreads"].items()
            if each
        ],
        "arms": [arm_chart(each["campaign"], each["arms"]) for each in told["arms"]],
        "flows": [flow_chart(s, told["flows"][s]) for s in stacks if told["flows"][s]],
    }


def _item_chart(item: Any, shown: Any) -> Chart:
    name = f"{item.name}-{shown.stack}".replace(" ", "-")
    return Chart(
        name=f"{name}-flights" if shown.flights else name,
        title=f"{item.paper}, {shown.stack}",
        figure=shown.figure,
        csv=csv_text(shown.flights) if shown.flights else as_csv(shown.table),
    )


def _link(text: str) -> str:
    """A link that holds CSV text."""
    code = base64.b64encode(text.encode()).decode()
    return f"data:text/csv;charset=utf-8;base64,{code}"


def _unbroken(value: Any) -> Any:
    """A number stays in one line with its sign of per cent."""
    plain_text = isinstance(value, str) and not hasattr(value, "__html__")
    return value.replace(" %", "\N{NARROW NO-BREAK SPACE}%") if plain_text else value


# Numbers as words ---------------------------------------------------------------------------------


def percent(value: float | None, digits: int = 0, sign: str = "") -> str:
    """A share of one as per cent."""
    if value is None or not math.isfinite(value):
        return _NONE
    return f"{100 * value:{sign}z.{digits}f} %"


def ends(share: Any, scale: float = 100.0, digits: int = 0) -> str:
    """The ends of an interval."""
    return f"{scale * share.low:z.{digits}f} to {scale * share.high:z.{digits}f}"


def effect(found: Any, unit: str) -> str:
    """An effect with its interval, in per cent or in points of a success rate."""
    if found is None:
        return _NONE
    if unit == "number":
        return f"{found.value:.2f} ({ends(found, 1.0, 2)})"
    largest = max(abs(found.low), abs(found.high))
    digits = 0 if largest >= 0.1 else 1 if largest >= 0.01 else 4
    value = f"{100 * found.value:{'+' if unit == 'points' else ''}z.{digits}f}"
    return f"{value} {'points' if unit == 'points' else '%'} ({ends(found, digits=digits)})"


def p_value(chance: float | None) -> str:
    """A p-value."""
    if chance is None:
        return _NONE
    return "< 0.001" if chance < 0.001 else f"{chance:.2g}"


def detector(name: str | None) -> str:
    """A detector as the page calls it."""
    return DETECTOR_TITLES.get(name, name) if name else "none"


def hourly(rates: tuple[float, float, float]) -> str:
    """A rate with its interval, two digits each."""
    point, low, high = (f"{each:.2g}" for each in rates)
    return f"{point} ({low} to {high})"


def _shade(share: float | None) -> str:
    """The strength of a cell's colour, from 0 to 100."""
    return "0" if share is None or not math.isfinite(share) else f"{100 * math.sqrt(share):.0f}"
