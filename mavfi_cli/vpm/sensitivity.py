"""Sensitivity of the answer to range, response time, board mass and board power."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from mavfi_cli.vpm.schemes import REFERENCE, Scheme, named
from mavfi_cli.vpm.setting import ModelInputs

FACTORS = (0.5, 0.8, 1.25, 2.0)
_STEP = 1.001  # factor of the numerical derivative


def _with_range(setting: ModelInputs, factor: float) -> ModelInputs:
    return replace(setting, range_m=factor * setting.range_m)


def _with_response(setting: ModelInputs, factor: float) -> ModelInputs:
    return replace(setting, compute_s=factor * setting.compute_s)


def _with_mass(setting: ModelInputs, factor: float) -> ModelInputs:
    return replace(setting, board=replace(setting.board, mass_kg=factor * setting.board.mass_kg))


def _with_power(setting: ModelInputs, factor: float) -> ModelInputs:
    return replace(setting, board=replace(setting.board, power_w=factor * setting.board.power_w))


_PARAMETERS: dict[str, tuple[str, Callable[[ModelInputs], float], Callable[..., ModelInputs]]] = {
    "sensing range": ("m", lambda setting: setting.range_m, _with_range),
    "response time": ("s", lambda setting: setting.compute_s, _with_response),
    "board mass": ("kg", lambda setting: setting.board.mass_kg, _with_mass),
    "board power": ("W", lambda setting: setting.board.power_w, _with_power),
}


def sensitivity(setting: ModelInputs, schemes: tuple[Scheme, ...]) -> list[dict[str, Any]]:
    """One row for each parameter: the answer at each factor, and its elasticity at factor 1.

    An elasticity is d ln(answer) / d ln(parameter): the change of the answer in per cent for one
    per cent of the parameter. The answers are the safe velocity with the reference scheme, and
    the flight time with TMR over that with the reference. They are None if the vehicle cannot
    fly. Power also changes the mass of the heat sink.
    """
    rows = []
    for name, (unit, value, scaled) in _PARAMETERS.items():
        middle = value(setting)
        if middle == 0.0:
            continue
        below, above = (_answers(scaled(setting, f), schemes) for f in (1.0 / _STEP, _STEP))
        slopes = [
            None if low is None or high is None else math.log(high / low) / (2 * math.log(_STEP))
            for low, high in zip(below, above, strict=True)
        ]
        rows.append(
            {
                "parameter": name,
                "unit": unit,
                "value": middle,
                "velocity_elasticity_ratio": slopes[0],
                "tmr_time_elasticity_ratio": slopes[1],
                "points": [
                    _point(scaled(setting, factor), schemes, factor * middle) for factor in FACTORS
                ],
            }
        )
    return rows


def _answers(
    setting: ModelInputs, schemes: tuple[Scheme, ...]
) -> tuple[float | None, float | None]:
    fast = setting.velocity_mps(named(schemes, REFERENCE))
    slow = setting.velocity_mps(named(schemes, "tmr"))
    return fast, None if fast is None or slow is None else fast / slow


def _point(setting: ModelInputs, schemes: tuple[Scheme, ...], value: float) -> dict[str, Any]:
    velocity, ratio = _answers(setting, schemes)
    return {"value": value, "velocity_mps": velocity, "tmr_flight_time_ratio": ratio}
