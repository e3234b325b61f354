"""Readable names of functions."""

from __future__ import annotations

import re


def short_name(symbol: str) -> str:
    """The plain name of a function in a mangled one: the last part of its qualified name."""
    mangled = symbol.partition("+")[0]
    for size in re.finditer(r"\d+", mangled):
        end = size.end() + int(size.group())
        name = mangled[size.end() : end]
        if name[:1].islower() and mangled[end : end + 1] in ("E", "I"):
            return name
    return mangled or "its entry"
