"""The page: fills the template. Numbers become words, and charts their places.

The page is one file without a script. Its charts are SVG elements, which take font and colours from
the page: light, dark, print.
"""

from __future__ import annotations

import base64
import importlib.util
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mavfi_cli.campaigns.specification import Spec
from mavfi_cli.core.errors import MavfiError
from mavfi_cli.core.files import require_output
from mavfi_cli.report.paper import DETECTOR_TITLES
from mavfi_cli.stats.shares import Interval, Share

if TYPE_CHECKING:
    pass

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


def render(document: object) -> str:
    """The page as one HTML text; equal values give equal pages.

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
    """A number stays in one line with its sign of per cent."""
    plain_text = isinstance(value, str) and not hasattr(value, "__html__")
    return value.replace(" %", "\N{NARROW NO-BREAK SPACE}%") if plain_text else value


# Numbers as words ---------------------------------------------------------------------------------


def _percent(value: float | None, digits: int = 0, sign: str = "") -> str:
    if value is None or not math.isfinite(value):
        return _NONE
    return f"{100 * value:{sign}z.{digits}f} %"


def _ends(share: Interval | Share, scale: float = 100.0, digits: int = 0) -> str:
    return f"{scale * share.low:z.{digits}f} to {scale * share.high:z.{digits}f}"


def _effect(effect: Interval | None, unit: str) -> str:
    """An effect with its interval, in per cent or in points of a success rate."""
    if effect is None:
        return _NONE
    if unit == "number":
        return f"{effect.value:.2f} ({_ends(effect, 1.0, 2)})"
    digits = _digits(max(abs(effect.low), abs(effect.high)))
    value = f"{100 * effect.value:{'+' if unit == 'points' else ''}z.{digits}f}"
    return f"{value} {'points' if unit == 'points' else '%'} ({_ends(effect, digits=digits)})"


def _digits(largest: float) -> int:
    return 0 if largest >= 0.1 else 1 if largest >= 0.001 else 4


def _range(claim: Any) -> str:
    """The range of a claim's effect."""
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
        return _NONE
    return "< 0.001" if chance < 0.001 else f"{chance:.2g}"


def _link(text: str) -> str:
    return f"data:text/csv;charset=utf-8;base64,{base64.b64encode(text.encode()).decode()}"


FILTERS: Mapping[str, Callable[..., Any]] = {
    "percent": _percent, "ends": _ends, "effect": _effect, "p": _p_value, "range": _range,
    "link": _link, "toml": Spec.to_toml,
    "detector": lambda name: DETECTOR_TITLES.get(name, name) if name else "none",
    "missions": lambda count: f"{math.ceil(count):,}" if math.isfinite(count) else "",
    "hourly": lambda rates: "{:.2g} ({:.2g} to {:.2g})".format(*rates),
    "shade": lambda share: f"{100 * math.sqrt(share):.0f}" if math.isfinite(share) else "0",
}  # fmt: skip
"""By the names that page.html uses."""
