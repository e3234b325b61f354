"""Numbers as cells of a table; NaN is a dash."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

Row = Mapping[str, Any]


def number(value: float, shape: str = "", scale: float = 1.0, unit: str = "") -> str:
    """A value in a format specification, with its unit."""
    return "-" if not math.isfinite(value) else f"{scale * value:{shape}}{unit}"


def percent(share: float, shape: str = ".1f") -> str:
    """A share of one as per cent."""
    return number(share, shape, 100.0, " %")


def fraction(share: Row) -> str:
    """A count and its total."""
    return f"{share['count']}/{share['total']}" if share["total"] else "-"


def rate(share: Row, digits: int = 1) -> str:
    """A share as per cent, with its interval."""
    if math.isnan(share["share"]):
        return "-"
    told = f"{100 * share['share']:.{digits}f} %"
    return f"{told} ({100 * share['low']:.0f} to {100 * share['high']:.0f})"


def spread(
    each: Row, digits: int, scale: float = 1.0, sign: str = "", chance: float | None = None
) -> str:
    """A value, with its interval and p-value if there are any."""
    if math.isnan(each["value"]):
        return "-"
    shape = f"{sign or 'z'}.{digits}f"  # the sign of -0.00 shows its side of zero
    value, low, high = (f"{scale * each[end]:{shape}}" for end in ("value", "low", "high"))
    told = [] if math.isnan(each["low"]) else [f"{low} to {high}"]
    told += [] if chance is None else [p_value(chance)]
    return f"{value} ({', '.join(told)})" if told else value


def p_value(chance: float) -> str:
    """A p-value in short form."""
    return "p<.001" if chance < 0.001 else f"p {chance:.1g}".replace("p 0.", "p .")
