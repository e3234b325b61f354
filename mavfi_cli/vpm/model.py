"""The F-1 model (Krishnan et al., IEEE CAL 19(1), 2020): equations of floats and arrays.

A vehicle that sees `range_m` far and takes `response_s` from sensing to acting may fly only as
fast as it can stop in front of what it sees. All units are SI.
"""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

GRAVITY_MPS2 = 9.80665
KNEE_SHARE = 0.97  # of the roof; CAL20 gives no closed form, its Fig. 4 shows 0.96 to 0.97

Number = TypeVar("Number", float, NDArray[np.float64])


def acceleration_mps2(pull_n: float, mass_kg: float, tilt_rad: float = 0.0) -> float:
    """Largest acceleration, CAL20 equation 2: (T cos(tilt) - m g) / m.

    At zero or less the vehicle cannot lift its mass.

    Args:
        pull_n: thrust of all rotors at full throttle, N.
        mass_kg: mass of everything that flies, kg.
        tilt_rad: tilt, rad; 0 reproduces the paper's Table 1.
    """
    return pull_n * math.cos(tilt_rad) / mass_kg - GRAVITY_MPS2


def safe_velocity_mps(accel_mps2: float, response_s: Number, range_m: float) -> Number:
    """Velocity from which the vehicle stops within `range_m`, CAL20 equation 3.

    v = a (sqrt(T^2 + 2 d / a) - T), the root of d = v T + v^2 / (2 a), written here without the
    difference of two nearly equal numbers: v = 2 d / (T + sqrt(T^2 + 2 d / a)).

    Args:
        accel_mps2: acceleration, m/s^2, above zero.
        response_s: time from sensing to acting, s; a float or an array of any shape.
        range_m: range of the sensor, m.
    """
    root: Number = (response_s**2 + 2.0 * range_m / accel_mps2) ** 0.5
    return 2.0 * range_m / (response_s + root)


def roof_mps(accel_mps2: float, range_m: float) -> float:
    """Velocity that the body's dynamics allow with an instant response, m/s: sqrt(2 d a)."""
    return math.sqrt(2.0 * range_m * accel_mps2)


def knee_hz(accel_mps2: float, range_m: float, share: float = KNEE_SHARE) -> float:
    """Action throughput, Hz, at which the safe velocity is `share` of the roof.

    Equation 3 solved for the throughput: f = sqrt(a / (2 d)) 2 share / (1 - share^2).
    """
    return math.sqrt(accel_mps2 / (2.0 * range_m)) * 2.0 * share / (1.0 - share**2)


def hover_power_w(known_w: float, known_kg: float, mass_kg: float) -> float:
    """Rotor power in hover at another mass, W: momentum theory, P ~ (m g)^1.5 / sqrt(2 rho A).

    Disc and figure of merit stay the same, so one known pair of power and mass is enough.
    """
    return float(known_w * (mass_kg / known_kg) ** 1.5)
