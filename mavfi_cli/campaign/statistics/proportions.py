"""Success rates: Wilson intervals, and how many missions an interval of a given width takes."""

from __future__ import annotations

import math
from statistics import NormalDist

from mavfi_cli.attack.outcome import Share, wilson
from mavfi_cli.core.errors import ConfigError


def z_of(confidence: float) -> float:
    """The two-sided normal quantile of a confidence between 0 and 1.

    Raises:
        ConfigError: it is not between them.
    """
    if not 0.0 < confidence < 1.0:
        raise ConfigError(f"must be between 0 and 1, got {confidence:g}", key="confidence")
    return NormalDist().inv_cdf(0.5 + confidence / 2.0)


def rate(successes: int, total: int, confidence: float = 0.95) -> Share:
    """A proportion with its Wilson score interval."""
    return wilson(successes, total, confidence_z=z_of(confidence))


def half_width(share: Share) -> float:
    """Half of the width of the interval."""
    return (share.high - share.low) / 2.0


def missions_for_margin(margin: float, *, expected: float = 0.5, confidence: float = 0.95) -> int:
    """The fewest missions whose Wilson interval is at most `margin` to either side of its centre.

    From (z / (1 + z²/n)) sqrt(p (1 - p)/n + z²/(4 n²)) <= m, which is, with u = z²/n, the quadratic
    u² (1/4 - m²) + u (p (1 - p) - 2 m²) - m² <= 0.

    Args:
        margin: half of the interval's width.
        expected: the rate that is expected; 0.5 is the worst case.

    Raises:
        ConfigError: a margin not between 0 and 0.5, a rate not within 0 and 1.
    """
    if not 0.0 < margin < 0.5:
        raise ConfigError(f"must be between 0 and 0.5, got {margin:g}", key="margin")
    if not 0.0 <= expected <= 1.0:
        raise ConfigError(f"must be within 0 and 1, got {expected:g}", key="expected")
    z2 = z_of(confidence) ** 2
    a, b, c = 0.25 - margin**2, expected * (1.0 - expected) - 2.0 * margin**2, -(margin**2)
    u = (-b + math.sqrt(b * b - 4.0 * a * c)) / (2.0 * a)
    return math.ceil(z2 / u - 1e-9)


def pairs_for_difference(
    difference: float, discordant: float, *, confidence: float = 0.95, power: float = 0.8
) -> int:
    """Pairs of missions that McNemar's test needs to find a difference of two success rates.

    (z_a sqrt(q) + z_b sqrt(q - d²))² / d², with q the share of pairs whose outcomes differ and d
    the difference (R. J. Connor, Biometrics 43, 1987).

    Raises:
        ConfigError: no difference, or a share of differing pairs that does not allow it.
    """
    if not 0.0 < abs(difference) <= discordant <= 1.0:
        raise ConfigError(
            "a difference d and a share q of pairs that differ need 0 < d <= q <= 1, got "
            f"d = {difference:g}, q = {discordant:g}"
        )
    if not 0.0 < power < 1.0:
        raise ConfigError(f"must be between 0 and 1, got {power:g}", key="power")
    z_b = NormalDist().inv_cdf(power)
    root = z_of(confidence) * math.sqrt(discordant) + z_b * math.sqrt(discordant - difference**2)
    return math.ceil(root**2 / difference**2 - 1e-9)
