"""Renders the HTML page of the report from its template, with formatted numbers and charts.

The page is one file without a script. Its charts are SVG elements, which take font and colours from
the page's style: light, dark or print.
"""

from __future__ import annotations

import base64
import importlib.util
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from mavfi_cli.campaigns.specification import Spec
from mavfi_cli.core.errors import MavfiError
from mavfi_cli.core.files import require_output
from mavfi_cli.report.paper import DETECTOR_TITLES
from mavfi_cli.report.table import number, percent, rate, spread, with_ends
from mavfi_cli.stats.shares import Interval

_FOLDER = Path(__file__).parent


def require_page(path: Path) -> None:
    """Check that the HTML page can be written to `path`, before its numbers are computed.

    Raises:
        MavfiError: jinja2, which the extra `report` installs, is missing.
        RecordError: the page's folder does not exist.
    """
    if importlib.util.find_spec("jinja2") is None:
        raise MavfiError("the report needs jinja2; install with: pip install 'mavfi[report]'")
    require_output(path)


def render(document: object) -> str:
    """Render a document as one HTML page. Equal documents give equal pages.

    Args:
        document: `mavfi_cli.paper.document.Document`.
    """
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_FOLDER), autoescape=True, trim_blocks=True,
        lstrip_blocks=True, undefined=jinja2.StrictUndefined, finalize=_unbroken,
    )  # fmt: skip
    environment.filters |= FILTERS
    style = (_FOLDER / "page.css").read_text(encoding="utf-8")
    return environment.get_template("page.html").render(page=document, style=style)


def _unbroken(value: Any) -> Any:
    """Join each per cent sign in plain text to its number with a no-break space."""
    plain_text = isinstance(value, str) and not hasattr(value, "__html__")
    return value.replace(" %", "\N{NARROW NO-BREAK SPACE}%") if plain_text else value


# Numbers as words ---------------------------------------------------------------------------------


def _effect(effect: Interval, unit: str) -> str:
    """Format an effect with its interval in a unit: `number`, `percent`, or `points` of a rate."""
    parts = (effect.value, effect.low, effect.high)
    if unit == "number":
        return with_ends(parts, "z.2f")
    ends = f"z.{_digits(max(abs(effect.low), abs(effect.high)))}f"
    shape = f"+{ends}" if unit == "points" else ends
    return with_ends(parts, shape, ends, scale=100.0, unit=_UNITS[unit])


def _digits(largest: float) -> int:
    return 0 if largest >= 0.1 else 1 if largest >= 0.001 else 4


def _range(claim: Any) -> str:
    """Format the range that a claim gives for its effect, such as `at least 10 %`."""
    scale, unit = (1.0, "") if claim.unit == "number" else (100.0, _UNITS[claim.unit])
    low, high = (f"{scale * end:.4g}" for end in (claim.low, claim.high))
    if math.isinf(claim.low) and math.isinf(claim.high):
        return "no range"
    if math.isinf(claim.low):
        return f"at most {high}{unit}"
    return f"at least {low}{unit}" if math.isinf(claim.high) else f"{low} to {high}{unit}"


_UNITS = {"points": " points", "percent": " %"}


def _p_value(chance: float | None) -> str:
    if chance is None:
        return "-"
    return "< 0.001" if chance < 0.001 else f"{chance:.2g}"


def _link(text: str) -> str:
    return f"data:text/csv;charset=utf-8;base64,{base64.b64encode(text.encode()).decode()}"


FILTERS: Mapping[str, Callable[..., Any]] = {
    "percent": percent, "rate": rate, "ends": with_ends, "effect": _effect, "p": _p_value,
    "range": _range, "number": lambda value: number(value, ".2f"),
    "spread": lambda value, sign="": spread(value, 2, sign=sign),
    "link": _link, "toml": Spec.to_toml,
    "detector": lambda name: DETECTOR_TITLES.get(name, name) if name else "none",
    "missions": lambda count: f"{math.ceil(count):,}" if math.isfinite(count) else "",
    "hourly": lambda rates: with_ends(rates, ".2g"),
    "shade": lambda share: f"{100 * math.sqrt(share):.0f}" if math.isfinite(share) else "0",
}  # fmt: skip
"""The filters of the template, keyed by the names that page.html uses."""
