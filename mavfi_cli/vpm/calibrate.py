"""Finds the one free number of a vehicle from one published ratio of flight times."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from mavfi_cli.core.errors import ConfigError
from mavfi_cli.vpm.model import GRAVITY_MPS2, REFERENCE, SCHEMES, ModelInputs, named
from mavfi_cli.vpm.vehicle import Board, ModelVehicle, load_board

_SPAN = 1.0e4  # ratio of the largest to the smallest tried value
_STEPS = 200  # halvings of the interval; far below a float's resolution


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibrated:
    """A vehicle with its calibrated number, and the resulting ratios of flight times."""

    vehicle: ModelVehicle
    board: Board
    parameter: str
    value: float  # in the unit of the parameter
    published_ratio: float
    tmr_ratio: float  # flight time with TMR over that with detection and recovery
    dmr_ratio: float  # a prediction, not fitted


def calibrated(vehicle: ModelVehicle, board: Board | None = None) -> Calibrated:
    """Find the vehicle's free number that gives its published ratio.

    The ratio falls as the free number grows, so bisection finds it.

    Args:
        board: the board of the redundant computers; None: the calibration's own.

    Raises:
        ConfigError: no value gives the ratio; says which ratios can be reached.
        UnknownName: the calibration's board does not exist.
    """
    plan = vehicle.calibration
    assert plan is not None
    board = board or load_board(plan.board)
    known = {scheme.name: scheme for scheme in SCHEMES}

    def setting(value: float) -> ModelInputs:
        """The vehicle with a trial value of the parameter."""
        pull_n, compute_s = vehicle.rotor_pull_n, vehicle.response_s
        if plan.parameter == "rotor_pull_n":
            pull_n = value
        else:
            compute_s = value
        full = replace(vehicle, calibration=None, rotor_pull_n=pull_n, response_s=compute_s)
        assert pull_n is not None  # the vehicle has the number that is not calibrated
        assert compute_s is not None
        return ModelInputs(
            vehicle=full, board=board, pull_n=pull_n, range_m=full.range_m,
            compute_s=compute_s, distance_m=1.0,
        )  # fmt: skip

    def ratio(value: float, scheme: str) -> float:
        """Flight time of a scheme over the reference's; infinite if one of them cannot fly."""
        fast = setting(value).velocity_mps(named(SCHEMES, REFERENCE))
        slow = setting(value).velocity_mps(known[scheme])
        return math.inf if fast is None or slow is None else fast / slow

    low = 1.0 / vehicle.sensor_hz
    if plan.parameter == "rotor_pull_n":
        three_kg = vehicle.mass_kg + known["tmr"].copies * board.total_kg
        low = three_kg * GRAVITY_MPS2 / math.cos(vehicle.tilt_rad)
    value = _halving(lambda trial: ratio(trial, "tmr"), plan.tmr_time_ratio, low, low * _SPAN)
    if value is None:
        ends = f"{ratio(low * _SPAN, 'tmr'):.3f} to {ratio(low, 'tmr'):.3f}"
        raise ConfigError(
            f"no {plan.parameter} gives {vehicle.name!r} a ratio of {plan.tmr_time_ratio:g}; "
            f"it can be {ends}",
            key="calibration.tmr_time_ratio",
        )
    return Calibrated(
        vehicle=setting(value).vehicle,
        board=board,
        parameter=plan.parameter,
        value=value,
        published_ratio=plan.tmr_time_ratio,
        tmr_ratio=ratio(value, "tmr"),
        dmr_ratio=ratio(value, "dmr"),
    )


def _halving(
    falling: Callable[[float], float], target: float, low: float, high: float
) -> float | None:
    """The argument at which a falling function equals `target`; None outside its range."""
    if not falling(high) <= target <= falling(low):
        return None
    for _ in range(_STEPS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if falling(middle) > target else (low, middle)
    return high
