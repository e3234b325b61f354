"""Every claim of the paper: its words, the number that decides it, and what the paper's n can tell.

claims.toml has the claims. A claim is decided by one number, its effect, and by the range that the
claim gives for it; `stats.effects.judge` does the rest.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from mavfi_cli.claims.effects import MEASURES, Finding
from mavfi_cli.core.config import read_toml
from mavfi_cli.stats.bootstrap import Interval
from mavfi_cli.stats.effects import (
    Count,
    effect_difference,
    fisher,
    rate_difference,
    recovered_share,
)
from mavfi_cli.stats.shares import wilson

_FILE = Path(__file__).parent / "claims.toml"
_AS_PRINTED = "paper"  # an end of the range that the paper's own interval has


@dataclass(frozen=True, slots=True, kw_only=True)
class Claim:
    """A claim of the paper.

    Attributes:
        name: unique, such as `table4-dense`.
        item: table or figure, by its name in `mavfi reproduce`.
        words: the claim as a sentence.
        paper: its numbers; empty if the paper prints none.
        effect: the number that decides, in words.
        find: the effect of a stack's flights, or of the isolated kernels.
        low, high: the claimed range of the effect.
        unit: `points` of a rate, `percent` of a whole, or `number`.
        paper_tells: what the paper's own number of missions can tell.
        isolated: whether it is about isolated kernels.
    """

    name: str
    item: str
    words: str
    effect: str
    find: Callable[[Any], Finding]
    paper: str = "no number printed"
    low: float = -math.inf
    high: float = math.inf
    unit: str = "points"
    paper_tells: str = "drawn only, without counts"
    isolated: bool = False


def _read(path: Path) -> Iterator[Claim]:
    data, _ = read_toml(path)
    for told in data["claim"]:
        measure, given = told.pop("measure"), told.pop("given", {})
        counts = [(wins, missions) for wins, missions in told.pop("paper_counts", ())]
        if counts:
            told |= _in_the_paper(told, counts)
        yield Claim(
            item=told["name"].partition("-")[0],
            find=partial(MEASURES[measure], **_arguments(given, data["flights"])),
            **told,
        )


def _in_the_paper(told: Mapping[str, Any], counts: Sequence[Count]) -> dict[str, Any]:
    """The parts of a claim that follow from the paper's counts."""
    spread = _spread(counts)
    ends = {end: getattr(spread, end) for end in ("low", "high")}
    chance = fisher(counts[0], counts[1])
    texts = {name: f"{100 * end:z.0f}" for name, end in ends.items()}
    texts["p"] = "p < 0.001" if chance < 0.001 else f"p = {chance:.2g}"
    found = {name: ends[name] for name in ends if told.get(name) == _AS_PRINTED}
    return found | {"paper_tells": told["paper_tells"].format_map(texts)}


def _spread(counts: Sequence[Count]) -> Interval:
    """Difference of two rates, recovered share of three, difference of two losses of four."""
    if len(counts) == 3:
        return recovered_share(*counts)
    first, second, *others = (wilson(*each) for each in counts)
    loss = rate_difference(first, second)
    return effect_difference(loss, rate_difference(*others)) if others else loss


def _arguments(given: Mapping[str, Any], sets: Mapping[str, Any]) -> dict[str, Any]:
    """What a measure is given: named flights become the columns that choose them."""
    found: dict[str, Any] = {}
    for name, value in given.items():
        if name == "flights":
            found |= _arguments(sets[value], sets)
        elif isinstance(value, Mapping):
            found[name] = _arguments(value, sets)
        else:
            found[name] = tuple(value) if isinstance(value, list) else value
    return found


CLAIMS = tuple(_read(_FILE))
