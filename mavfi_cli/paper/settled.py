"""What was flown to settle claims: stored with a reproduction, and with its exports."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Self

from mavfi_cli.campaigns.progress import duration
from mavfi_cli.core.config import structure
from mavfi_cli.paper.verdicts import FirstLook


@dataclass(frozen=True, slots=True, kw_only=True)
class SettledClaim:
    """The missions that were flown for one claim.

    Attributes:
        looks: number of looks after missions that were flown for this claim.
        missions: number of those missions; other claims use them as well.
        seconds: wall time that they took, s.
        verdict: the verdict at the last look.
    """

    looks: int = 0
    missions: int = 0
    seconds: float = 0.0
    verdict: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Settling:
    """All claims for which missions were flown, and the number of all looks.

    Attributes:
        first: the first look at each claim that had an effect, by claim and by the fate of faults.
    """

    first: Mapping[str, Mapping[str, FirstLook]] = field(default_factory=dict)
    looks: int = 0
    claims: Mapping[str, SettledClaim] = field(default_factory=dict)

    @classmethod
    def of(cls, stored: Any) -> Self | None:
        """Read a stored value, which may be damaged; None if nothing was settled.

        Raises:
            ConfigError: the value has another form.
        """
        if stored is None:
            return None
        return structure(json.loads(stored) if isinstance(stored, str) else stored, cls)

    def to_json(self) -> str:
        """The text that `of` reads."""
        return json.dumps(asdict(self), sort_keys=True)

    def first_look(self, name: str, fate: str) -> FirstLook | None:
        """Return the first look at a claim; None if it had no effect then."""
        return self.first.get(name, {}).get(fate)

    def describe(self, name: str) -> str:
        """Describe what was flown for a claim."""
        claim = self.claims.get(name)
        if claim is None:
            return "no mission was added for it"
        return (
            f"{claim.missions:,} missions were added for it in {duration(claim.seconds)}, at "
            f"{claim.looks} of {self.looks} looks"
        )
