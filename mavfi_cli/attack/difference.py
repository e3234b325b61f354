"""The difference between an output and the golden one.

The templates of kernels import this and no tracer: what they load is copied for every run.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True, slots=True, kw_only=True)
class Difference:
    """The difference between an output and the golden one.

    Attributes:
        relative: the value to compare with a tolerance; inf if the outputs cannot be compared
            number by number (another shape, another kind of answer, not a number).
        absolute: the same in `unit`, or inf.
        unit: unit of `absolute`.
        text: the difference in words.
        noticeable: whether it is beyond what the taker of the output tolerates.
        parts: what the difference consists of, by name.
    """

    relative: float
    absolute: float
    unit: str = ""
    text: str = ""
    noticeable: bool = True
    parts: Mapping[str, float] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Entries of a record; a size that is not a number is null."""
        finite = math.isfinite(self.relative)
        return {
            "relative": self.relative if finite else None,
            "absolute": self.absolute if finite else None,
            "unit": self.unit,
            "text": self.text,
            "noticeable": self.noticeable,
            "parts": dict(self.parts),
        }
