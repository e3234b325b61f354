"""Tests and intervals that hold however often one looks: asymptotic confidence sequences.

I. Waudby-Smith, D. Arbour, R. Sinha, E. H. Kennedy and A. Ramdas, Annals of Statistics 52, 2024,
theorem 2.2, the normal mixture of H. Robbins. With u = n rho^2, an estimate from n observations
that lies z standard errors from a value gives the following evidence against that value:

    e = exp(z^2 u / (2 (u + 1))) / sqrt(u + 1).

The probability that it ever exceeds 1/a is at most a, if the value is true. So 1/e is a p-value at
any look, and the values with e < 1/a form an interval that holds at all looks together.
"""

from __future__ import annotations

import math
from dataclasses import replace

from mavfi_cli.stats.shares import Interval, z_of

TUNED = 1000  # observations at which the interval is narrowest relative to a fixed-sample one
_LEVEL = 0.05  # level for which it is narrowest there


def anytime_p(z: float, count: int) -> float:
    """Return the p-value at any look of an estimate from `count` values, z standard errors away."""
    u = _u(count)
    exponent = -0.5 * z * z * u / (u + 1.0)
    return min(1.0, math.sqrt(u + 1.0) * math.exp(exponent))


def anytime_z(count: float, level: float = _LEVEL) -> float:
    """Return the number of standard errors beyond which `anytime_p` is below a level."""
    u = _u(count)
    return math.sqrt(2.0 * (1.0 + 1.0 / u) * math.log(math.sqrt(u + 1.0) / level))


def anytime_interval(effect: Interval) -> Interval:
    """Return an effect's 95 % interval for all looks together, given the one for a single look."""
    if not effect.count:
        return effect
    wider = anytime_z(effect.count) / z_of(1.0 - _LEVEL)
    return replace(
        effect,
        low=effect.value - wider * (effect.value - effect.low),
        high=effect.value + wider * (effect.high - effect.value),
    )


def anytime_count(z: float, count: int, level: float) -> float:
    """Return the count at which `anytime_p` falls below a level, if the effect stays as it is.

    Args:
        z, count: current distance in standard errors, and number of observations.

    Returns:
        Infinite if z is 0.
    """
    if not z or not count:
        return math.inf
    from scipy.optimize import brentq

    def short(number: float) -> float:
        """Return the standard errors still missing at this number of observations."""
        return anytime_z(number, level) - z * math.sqrt(number / count)

    enough = float(count)
    while short(enough) > 0.0:
        enough *= 2.0
    return enough if enough == count else float(brentq(short, enough / 2.0, enough))


def _u(count: float) -> float:
    """Return n rho^2 for the rho whose interval is narrowest at TUNED observations."""
    from scipy.special import lambertw

    narrowest = -float(lambertw(-(_LEVEL**2) / math.e, -1).real) - 1.0
    return narrowest * count / TUNED
