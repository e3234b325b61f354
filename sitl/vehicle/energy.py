"""Rotor power by regression, and the battery model."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.core.compiled import compiled
from sitl.vehicle.profile import Battery, EnergyRegression

Vector = NDArray[np.float64]

KMH_PER_MPS = 3.6
GRAMS_PER_KG = 1000.0
SECONDS_PER_HOUR = 3600.0

# Remaining charge at a lithium cell's empty, nominal, middle and full voltage. The middle
# voltage lies 30 % of the way from nominal to full: 3.85 V for an ordinary 4.2 V cell.
_KNEES = np.array([0.0, 0.1, 0.5, 1.0])
_MIDDLE = 0.3


def regression_coefficients(energy: EnergyRegression, payload_kg: float) -> Vector:
    """Return b1..b6 and the constant, which includes the payload (7,), for `regression_power`."""
    constant = energy.b9 + energy.b7 * payload_kg * GRAMS_PER_KG
    return np.array([energy.b1, energy.b2, energy.b3, energy.b4, energy.b5, energy.b6, constant])


def battery_parameters(battery: Battery) -> Vector:
    """Return four open-circuit voltages, resistance, capacity C, efficiency and W (8,)."""
    middle = battery.cell_nominal_v + _MIDDLE * (battery.cell_full_v - battery.cell_nominal_v)
    cells = (battery.cell_empty_v, battery.cell_nominal_v, middle, battery.cell_full_v)
    return np.array(
        [
            *(battery.cells * voltage for voltage in cells),
            battery.resistance_ohm,
            battery.capacity_ah * SECONDS_PER_HOUR,
            battery.drive_efficiency,
            battery.avionics_w,
        ]
    )


@compiled
def regression_power(velocity_mps: Vector, acceleration_mps2: Vector, b: Vector) -> float:
    """Return rotor power, W, for velocity (3,), acceleration (3,) and coefficients (7,).

    The regression is that of Tseng et al., arXiv 1703.10049, with speeds and accelerations in km/h
    as in AirSim's fork. The result is never below zero.
    """
    v = KMH_PER_MPS * math.sqrt(velocity_mps[0] ** 2 + velocity_mps[1] ** 2)
    a = KMH_PER_MPS * math.sqrt(acceleration_mps2[0] ** 2 + acceleration_mps2[1] ** 2)
    vz = KMH_PER_MPS * abs(velocity_mps[2])
    az = KMH_PER_MPS * abs(acceleration_mps2[2])
    horizontal = b[0] * v + b[1] * a + b[2] * v * a
    vertical = b[3] * vz + b[4] * az + b[5] * vz * az
    power: float = horizontal + vertical + b[6]
    return max(power, 0.0)


@compiled
def open_circuit_voltage(remaining: float, parameters: Vector) -> float:
    """Return the voltage of the unloaded pack, V, at a remaining charge in 0..1."""
    for segment in range(3):
        if remaining <= _KNEES[segment + 1]:
            share: float = (remaining - _KNEES[segment]) / (_KNEES[segment + 1] - _KNEES[segment])
            low: float = parameters[segment]
            high: float = parameters[segment + 1]
            return low + share * (high - low)
    return float(parameters[3])


@compiled
def battery_current(power_w: float, open_circuit_v: float, resistance_ohm: float) -> float:
    """Return the current, A, at which the loaded pack delivers a power, or its maximum power.

    It is the smaller root of P = I (V - I R), in the form without cancellation.
    """
    if 4.0 * resistance_ohm * power_w > open_circuit_v * open_circuit_v:
        return open_circuit_v / (2.0 * resistance_ohm)
    root = math.sqrt(open_circuit_v * open_circuit_v - 4.0 * resistance_ohm * power_w)
    return 2.0 * power_w / (open_circuit_v + root)
