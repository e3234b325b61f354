"""Protection schemes and their cost: copies of the board, or compute time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from mavfi_cli.core.errors import ConfigError, UnknownName
from mavfi_cli.spec.platform import LARGEST

REFERENCE = "aad"  # the paper's Fig. 15 compares redundancy with it


@dataclass(frozen=True, slots=True, kw_only=True)
class Scheme:
    """One way to protect the computer."""

    name: str
    title: str
    copies: int = 1  # boards with their heat sinks
    overhead: float = 0.0  # additional compute time, as a fraction of it
    source: str = ""


_TABLE_V = "paper, Table V: Dense, the worst of four environments"
SCHEMES = (
    Scheme(name="none", title="no protection", source="one board"),
    Scheme(name="dmr", title="DMR", copies=2, source="two boards; no time for the comparison"),
    Scheme(name="tmr", title="TMR", copies=3, source="three boards; no time for the vote"),
    Scheme(name="gad", title="detection (Gaussian)", overhead=0.022223, source=_TABLE_V),
    Scheme(name="aad", title="detection (autoencoder)", overhead=0.000062, source=_TABLE_V),
)

DETECTORS = tuple(scheme.name for scheme in SCHEMES if scheme.overhead > 0.0)


def schemes_with(overheads: Mapping[str, tuple[float, str]]) -> tuple[Scheme, ...]:
    """Return the schemes with measured overheads in place of the paper's.

    Args:
        overheads: detector name -> its overhead in per cent of the compute time, and the source
            of that number.

    Raises:
        UnknownName: no scheme of this name detects and recovers.
        ConfigError: an overhead is negative, not finite, or probably in the wrong unit.
    """
    for name, (percent, _) in overheads.items():
        if name not in DETECTORS:
            raise UnknownName("detector", name, DETECTORS)
        if not 0.0 <= percent <= LARGEST:
            raise ConfigError(
                f"must be within 0 and {LARGEST:g} %, is {percent:g} %", key=f"overhead of {name}"
            )
    given = {name: (percent / 100.0, source) for name, (percent, source) in overheads.items()}
    return tuple(
        replace(scheme, overhead=given[scheme.name][0], source=given[scheme.name][1])
        if scheme.name in given
        else scheme
        for scheme in SCHEMES
    )


def unlike_sources(schemes: tuple[Scheme, ...]) -> str | None:
    """A note if one detector's overhead is from the paper and another's is not."""
    detectors = [scheme for scheme in schemes if scheme.name in DETECTORS]
    papers = [scheme.name for scheme in detectors if scheme.source == _TABLE_V]
    others = [scheme.name for scheme in detectors if scheme.source != _TABLE_V]
    if not papers or not others:
        return None
    return (
        f"the overhead of {' and '.join(papers)} is the paper's and that of {' and '.join(others)} "
        "is not: different sources, so these rows are not to be ranked"
    )


def named(schemes: tuple[Scheme, ...], name: str) -> Scheme:
    """The scheme of this name, which must exist."""
    return next(scheme for scheme in schemes if scheme.name == name)
