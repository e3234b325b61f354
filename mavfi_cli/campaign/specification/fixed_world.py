"""Fixed worlds by rule: all missions in a world share one, chosen by the number of replans.

The paper flies one fixed world with many faults, and does not say which. The rule selects worlds by
the replans of golden runs there. `campaign.world_search` searches for them.
"""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

Flown = tuple[tuple[int, ...], ...]  # for each candidate, the replans of its golden runs


@dataclass(frozen=True, slots=True, kw_only=True)
class FixedWorld:
    """The table `[fixed_world]` of a specification.

    Attributes:
        replans: least and most replans, for the median over golden runs.
        flights: golden runs of each candidate, with seeds from the campaign's first on.
        candidates: world seeds 1 to this number are tried, and the first that fits is taken.
        worlds: the worlds that the rule is for; empty: all worlds of the campaign.
        world_seed: seed of each world, named by the user or found by the rule.
        flown: replans of the golden runs of candidates 1, 2, 3, ...; fewer than `flights` values
            for a candidate whose flights could not begin.
    """

    replans: tuple[int, int]
    flights: int = 5
    candidates: int = 60
    worlds: tuple[str, ...] = ()
    world_seed: Mapping[str, int] = field(default_factory=dict)
    flown: Mapping[str, Flown] = field(default_factory=dict)

    def __post_init__(self) -> None:
        least, most = self.replans
        if not 0 <= least <= most:
            raise ValueError(f"replans: expected [LEAST, MOST], got [{least}, {most}]")
        if self.flights < 1 or self.candidates < 1:
            raise ValueError("flights and candidates: must be at least 1")
        for world, seed in self.world_seed.items():
            if seed < 0:
                raise ValueError(f"world_seed.{world}: must not be negative, is {seed}")

    def rules(self, world: str) -> bool:
        """True if missions in this world share one; a user's own boxes already are one world."""
        named = world in self.worlds or world in self.world_seed
        return named or (not self.worlds and not world.endswith(".toml"))

    def fits(self, replans: Sequence[int]) -> bool:
        """True if a candidate fits the rule by the replans of its golden runs."""
        least, most = self.replans
        return len(replans) == self.flights and least <= statistics.median(replans) <= most

    def told(self) -> str:
        """The rule and the worlds that it has found, in one line."""
        found = [
            f"{world} {seed}{self._median(world)}" for world, seed in self.world_seed.items()
        ] or ["none yet"]
        return f"world seeds: {', '.join(found)}; {self.rule()}"

    def rule(self) -> str:
        """The rule in words."""
        least, most = self.replans
        often = f"{least} to {most} times" if most > least else f"{least} times"
        often = "once" if often == "1 times" else often
        return f"the first from 1 on whose golden flights replan {often} (median of {self.flights})"

    def _median(self, world: str) -> str:
        """Median replans of the found candidate; empty if the user has named the seed."""
        if world not in self.flown:
            return " (named)"
        return f" (median {statistics.median(self.flown[world][-1]):g})"
