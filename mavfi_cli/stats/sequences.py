"""Tests and intervals that stay valid however often one looks: asymptotic confidence sequences.

I. Waudby-Smith, D. Arbour, R. Sinha, E. H. Kennedy and A. Ramdas, Annals of Statistics 52, 2024,
theorem 2.2, the normal mixture of H. Robbins. With u = n rho^2, an estimate from n observations
that lies z standard errors from a value gives the following evidence against that value:

    e = exp(z^2 u / (2 (u + 1))) / sqrt(u + 1).

If the value is true, the probability that e ever exceeds 1/a is at most a. So 1/e is a valid
p-value at any look, and the values with e < 1/a form an interval valid at all looks at once.
"""

from __future__ import annotations

import math
from dataclasses import replace

from mavfi_cli.stats.shares import Interval, z_of

TUNED = 1000  # observations at which the interval is narrowest relative to a fixed-sample one
_LEVEL = 0.05  # level for which it is narrowest there


def anytime_p(z: float, count: int) -> float:
    """Return the anytime-valid p-value of an estimate from `count` observations.

    The estimate lies z standard errors from the tested value.
    """
    u = _u(count)
    exponent = -0.5 * z * z * u / (u + 1.0)
    return min(1.0, math.sqrt(u + 1.0) * math.exp(exponent))


def anytime_z(count: float, level: float = _LEVEL) -> float:
    """Return the distance from the tested value, in standard errors, that gives a p-value `level`.

    The p-value is that of `anytime_p`. Estimates farther away have a smaller one.
    """
    u = _u(count)
    return math.sqrt(2.0 * (1.0 + 1.0 / u) * math.log(math.sqrt(u + 1.0) / level))


def anytime_interval(effect: Interval) -> Interval:
    """Widen an effect's 95 % interval, which is valid at one look, to be valid at all looks."""
    if not effect.count:
        return effect
    wider = anytime_z(effect.count) / z_of(1.0 - _LEVEL)
    return replace(
        effect,
        low=effect.value - wider * (effect.value - effect.low),
        high=effect.value + wider * (effect.high - effect.value),
    )


def anytime_count(z: float, count: int, level: float) -> float:
    """Predict how many observations bring `anytime_p` down to `level` if the effect stays the same.

    Args:
        z, count: current distance from the tested value, in standard errors, and current number of
            observations.

    Returns:
        The predicted number, at least `count`; infinite if z or `count` is 0.
    """
    if not z or not count:
        return math.inf
    from scipy.optimize import brentq

    def short(number: float) -> float:
        """Return by how many standard errors the effect falls short of `level` at this number."""
        return anytime_z(number, level) - z * math.sqrt(number / count)

    enough = float(count)
    while short(enough) > 0.0:
        enough *= 2.0
    return enough if enough == count else float(brentq(short, enough / 2.0, enough))


def _u(count: float) -> float:
    """Return u = n rho^2 for n = `count`, with the rho that tunes intervals to TUNED values."""
    from scipy.special import lambertw

    narrowest = -float(lambertw(-(_LEVEL**2) / math.e, -1).real) - 1.0
    return narrowest * count / TUNED
