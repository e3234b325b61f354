"""The whole report as plain data, to be printed, drawn, or written as JSON or CSV."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any

import numpy as np

from mavfi_cli.core.errors import CannotLift, ConfigError
from mavfi_cli.spec.platform import PlatformProfile
from mavfi_cli.vpm.model import (
    DETECTORS,
    GRAVITY_MPS2,
    KNEE_SHARE,
    REFERENCE,
    SCHEMES,
    SMALLEST,
    TABLE_V,
    Board,
    ModelInputs,
    ModelVehicle,
    Scheme,
    safe_velocity_mps,
)

# How the latencies of a platform's kernels add up to one response time, and the words for it.
CHAINS: dict[str, tuple[Callable[[list[float]], float], str]] = {
    "serial": (sum, "sum"),
    "pipelined": (max, "slowest"),
}
OTHER_BOARD = "tx2"  # calibrations are repeated with this heavier board
RATIOS = {
    "velocity_ratio": "velocity_mps",
    "flight_time_ratio": "flight_time_s",
    "energy_ratio": "energy_j",
    "missions_ratio": "missions",
}
_CURVE_HZ = np.array([10.0**exponent for exponent in np.linspace(-1.0, 3.0, 161).tolist()])
_COMMAND = "command line"
_FREE_UNITS = {"rotor_pull_n": "N", "response_s": "s"}  # units of what a calibration sets


@dataclass(frozen=True, slots=True, kw_only=True)
class Choices:
    """The user's choices; None means the vehicle's own value."""

    platform: PlatformProfile | None = None
    chain: str = "serial"  # one of CHAINS
    board: Board | None = None
    response_s: float | None = None
    range_m: float | None = None
    distance_m: float = 50.0

    def inputs(self, vehicle: ModelVehicle) -> ModelInputs:
        """The model's inputs for a vehicle with its free number calibrated.

        Raises:
            ConfigError: neither the vehicle nor the choices give a needed value.
        """
        return _setting(vehicle, self)[0]


def report(
    vehicles: Sequence[ModelVehicle], choices: Choices, schemes: Mapping[str, Scheme]
) -> dict[str, Any]:
    """Compute the model's answer for each vehicle; keys of numbers but ratios name the unit.

    Raises:
        CannotLift: a vehicle does not lift even one board.
        ConfigError: neither the vehicle nor the choices give a needed value.
    """
    return {
        "model": "F-1, IEEE CAL 19(1), equations 1 to 3",
        "knee_velocity_over_roof_ratio": KNEE_SHARE,
        "distance_m": choices.distance_m,
        "ratios_over": REFERENCE,
        "notes": _unlike_sources(schemes),
        "vehicles": [_one(vehicle, choices, schemes) for vehicle in vehicles],
    }


def _unlike_sources(schemes: Mapping[str, Scheme]) -> list[str]:
    """A note if one detector's overhead is from the paper and another's is not."""
    detectors = [schemes[name] for name in DETECTORS]
    papers = [scheme.name for scheme in detectors if scheme.source == TABLE_V]
    others = [scheme.name for scheme in detectors if scheme.source != TABLE_V]
    if not papers or not others:
        return []
    return [
        f"the overhead of {' and '.join(papers)} is the paper's and that of {' and '.join(others)} "
        "is not: different sources, so these rows are not to be ranked"
    ]


def _one(vehicle: ModelVehicle, choices: Choices, schemes: Mapping[str, Scheme]) -> dict[str, Any]:
    setting, parameters, found = _setting(vehicle, choices)
    reference = setting.performance(schemes[REFERENCE])
    calibrations = [found] if found else []
    if found and found["board"] != OTHER_BOARD:
        calibrations.append(_calibrate(vehicle, Board.load(OTHER_BOARD)))
    return {
        "vehicle": vehicle.name,
        "description": vehicle.description,
        "board": setting.board.name,
        "notes": _notes(vehicle, choices, setting, found),
        "parameters": parameters,
        "schemes": [_row(setting, scheme, reference) for scheme in schemes.values()],
        "sensitivity": _sensitivity(setting, schemes),
        "calibrations": calibrations,
        "curves": _curves(setting, schemes),
    }


def _setting(
    vehicle: ModelVehicle, choices: Choices
) -> tuple[ModelInputs, list[dict[str, Any]], dict[str, Any]]:
    """Collect the model's inputs, list them with their sources, and add the calibration or {}."""
    full, sources, free = vehicle, dict(vehicle.sources), ""
    found: dict[str, Any] = {}
    if vehicle.calibration is not None:
        found = _calibrate(vehicle)
        free = found["parameter"]
        full = replace(vehicle, calibration=None, **{free: found["value"]})
        sources[free] = (
            f"calibrated: TMR takes {found['published_tmr_ratio']:g} times the flight time of "
            f"detection and recovery, with board {found['board']} ({vehicle.calibration.source})"
        )
    board = _board(vehicle, choices)
    compute_s, given = full.response_s, ""
    if choices.response_s is not None:
        compute_s, given = choices.response_s, _COMMAND
    elif choices.platform is not None:
        kernels = choices.platform.kernels
        if choices.platform.measured_factor is not None:
            raise ConfigError(
                f"{choices.platform.name} has latencies only while it flies: mavfi fly --realtime",
                key="platform",
            )
        combined, how = CHAINS[choices.chain]
        compute_s = combined([each.latency_s for each in kernels.values()])
        if compute_s < SMALLEST:
            raise ConfigError(f"no kernel of platform {choices.platform.name!r} takes any time")
        given = f"platform {choices.platform.name}: {how} of {', '.join(kernels)}"
    if given:
        sources["response_s"], free = given, "" if free == "response_s" else free
    if compute_s is None:
        raise ConfigError(f"vehicle {vehicle.name!r} has none: give --platform or --response",
                          key="response_s")  # fmt: skip
    if choices.range_m is not None:
        sources["range_m"] = _COMMAND
    assert full.rotor_pull_n is not None
    setting = ModelInputs(
        vehicle=replace(full, response_s=compute_s, range_m=choices.range_m or full.range_m),
        board=board,
        pull_n=full.rotor_pull_n,
        range_m=choices.range_m or full.range_m,
        compute_s=compute_s,
        distance_m=choices.distance_m,
    )
    return setting, _parameters(setting, sources, free), found


def _notes(
    vehicle: ModelVehicle, choices: Choices, setting: ModelInputs, found: Mapping[str, Any]
) -> list[str]:
    """Name what did not change with the computer, although a user may think so."""
    notes, board = [], setting.board
    own_time = choices.platform is None and choices.response_s is None
    fitted_time = found.get("parameter") == "response_s"
    if own_time and board.name != vehicle.board:
        source = vehicle.sources.get("response_s", "not given")
        if fitted_time:
            source = f"calibrated with board {found['board']}"
        notes.append(
            f"the board is {board.name}, and the response time is still the vehicle's own "
            f"({source}): give --response or --platform"
        )
    if found and (own_time or not fitted_time) and board.name != found["board"]:
        told = "{parameter} = {value:.4g} {unit} is calibrated with board {board}".format(**found)
        if board.total_kg <= 0.0:
            other = f"board {board.name} has no mass, so nothing can be calibrated with it"
        else:
            try:
                value = _calibrate(vehicle, board)["value"]
                other = f"with board {board.name} it would be {value:.4g} {found['unit']}"
            except ConfigError as error:
                other = f"it cannot be with board {board.name}: {error}"
        notes.append(f"{told}; {other}")
    return notes


def _board(vehicle: ModelVehicle, choices: Choices) -> Board:
    if choices.board is not None:
        return choices.board
    if choices.platform is not None:
        return Board.of_platform(choices.platform)
    if not vehicle.board:
        raise ConfigError(f"vehicle {vehicle.name!r} has none: give --platform or --board",
                          key="board")  # fmt: skip
    return Board.load(vehicle.board)


def _parameters(setting: ModelInputs, sources: dict[str, str], free: str) -> list[dict[str, Any]]:
    units = {
        "mass_kg": "kg", "rotor_pull_n": "N", "tilt_deg": "deg", "range_m": "m",
        "sensor_hz": "Hz", "response_s": "s", "hover_power_w": "W", "battery_wh": "Wh",
    }  # fmt: skip
    sources.setdefault("tilt_deg", "CAL20: its Table 1 is reproduced with 0 degrees")
    rows = [
        {
            "parameter": key, "value": getattr(setting.vehicle, key), "unit": unit,
            "source": sources.get(key, "not given"), "calibrated": key == free,
        }
        for key, unit in units.items()
    ]  # fmt: skip
    for key, unit in (("mass_kg", "kg"), ("power_w", "W"), ("heatsink_kgpw", "kg/W")):
        told = setting.board.sources.get(key, "not given")
        rows.append({"parameter": f"board.{key}", "value": getattr(setting.board, key),
                     "unit": unit, "source": told, "calibrated": False})  # fmt: skip
    return rows


def _row(setting: ModelInputs, scheme: Scheme, reference: Mapping[str, Any]) -> dict[str, Any]:
    told = {
        "scheme": scheme.name, "title": scheme.title, "boards": scheme.copies,
        "overhead_percent": 100.0 * scheme.overhead, "source": scheme.source,
    }  # fmt: skip
    try:
        flown = setting.performance(scheme)
    except CannotLift as error:
        weights = {"mass_kg": setting.mass_kg(scheme.copies),
                   "compute_kg": setting.carried_kg(scheme.copies)}  # fmt: skip
        nothing = dict.fromkeys([*reference, *RATIOS])
        return {**told, **nothing, **weights, "problem": str(error)}
    ratios = {ratio: flown[of] / reference[of] for ratio, of in RATIOS.items()}
    return {**told, **flown, **ratios, "problem": None}


def _curves(setting: ModelInputs, schemes: Mapping[str, Scheme]) -> dict[str, Any]:
    """Safe velocity against action throughput for the numbers of boards that can fly."""
    copies = sorted({scheme.copies for scheme in schemes.values()})
    flying = [(n, setting.acceleration_mps2(n)) for n in copies]
    return {
        "throughput_hz": _CURVE_HZ.tolist(),
        "velocity_mps": {
            str(n): safe_velocity_mps(accel, 1.0 / _CURVE_HZ, setting.range_m).tolist()
            for n, accel in flying
            if accel > 0.0
        },
    }


FACTORS = (0.5, 0.8, 1.25, 2.0)
_STEP = 1.001  # factor of the numerical derivative


# name -> unit, and field of the inputs
_PARAMETERS = {
    "sensing range": ("m", "range_m"),
    "response time": ("s", "compute_s"),
    "board mass": ("kg", "board.mass_kg"),
    "board power": ("W", "board.power_w"),
}


def _scaled(setting: ModelInputs, field: str, factor: float) -> ModelInputs:
    value = factor * attrgetter(field)(setting)
    if field.startswith("board."):
        return replace(
            setting, board=replace(setting.board, **{field.removeprefix("board."): value})
        )
    return replace(setting, **{field: value})


def _sensitivity(setting: ModelInputs, schemes: Mapping[str, Scheme]) -> list[dict[str, Any]]:
    """One row for each parameter: the answer at each factor, and its elasticity at factor 1.

    An elasticity is d ln(answer) / d ln(parameter): the change of the answer in per cent for one
    per cent of the parameter. The answers are the safe velocity with the reference scheme, and
    the flight time with TMR over that with the reference. They are None if the vehicle cannot
    fly. Power also changes the mass of the heat sink.
    """
    rows = []
    for name, (unit, field) in _PARAMETERS.items():
        middle = attrgetter(field)(setting)
        if middle == 0.0:
            continue
        factors = (1.0 / _STEP, _STEP, *FACTORS)
        below, above, *others = (_answers(_scaled(setting, field, f), schemes) for f in factors)
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
                    {"value": f * middle, "velocity_mps": fast, "tmr_flight_time_ratio": ratio}
                    for f, (fast, ratio) in zip(FACTORS, others, strict=True)
                ],
            }
        )
    return rows


def _answers(
    setting: ModelInputs, schemes: Mapping[str, Scheme]
) -> tuple[float | None, float | None]:
    fast = setting.velocity_mps(schemes[REFERENCE])
    slow = setting.velocity_mps(schemes["tmr"])
    return fast, None if fast is None or slow is None else fast / slow


# Calibration: the one free number of a vehicle from one published ratio of flight times --------

_SPAN = 1.0e4  # ratio of the largest to the smallest tried value
_STEPS = 200  # halvings of the interval; far below a float's resolution


def _calibrate(vehicle: ModelVehicle, board: Board | None = None) -> dict[str, Any]:
    """Find the vehicle's free number that gives its published ratio.

    The ratio falls as the free number grows, so bisection finds it.

    Args:
        board: the board of the redundant computers; None: the calibration's own.

    Returns:
        The free `parameter` with its `value`, and ratios of flight times with TMR and with DMR, of
        which the last is predicted and not fitted, over that with detection and recovery.

    Raises:
        ConfigError: no value gives the ratio; says which ratios can be reached.
        UnknownName: the calibration's board does not exist.
    """
    plan = vehicle.calibration
    assert plan is not None
    board = board or Board.load(plan.board)

    def ratio(value: float, scheme: str) -> float:
        """Flight time of a scheme over the reference's; infinite if one of them cannot fly."""
        free: dict[str, Any] = {plan.parameter: value}
        full = replace(vehicle, calibration=None, **free)
        assert full.rotor_pull_n is not None  # the vehicle has the number that is not calibrated
        assert full.response_s is not None
        setting = ModelInputs(
            vehicle=full, board=board, pull_n=full.rotor_pull_n, range_m=full.range_m,
            compute_s=full.response_s, distance_m=1.0,
        )  # fmt: skip
        fast, slow = (setting.velocity_mps(SCHEMES[name]) for name in (REFERENCE, scheme))
        return math.inf if fast is None or slow is None else fast / slow

    low = 1.0 / vehicle.sensor_hz
    if plan.parameter == "rotor_pull_n":
        three_kg = vehicle.mass_kg + SCHEMES["tmr"].copies * board.total_kg
        low = three_kg * GRAVITY_MPS2 / math.cos(vehicle.tilt_rad)
    value = low * _SPAN
    least, most = ratio(value, "tmr"), ratio(low, "tmr")
    if not least <= plan.tmr_time_ratio <= most:
        raise ConfigError(
            f"no {plan.parameter} gives {vehicle.name!r} a ratio of {plan.tmr_time_ratio:g}; "
            f"it can be {least:.3f} to {most:.3f}",
            key="calibration.tmr_time_ratio",
        )
    for _ in range(_STEPS):
        middle = 0.5 * (low + value)
        low, value = (
            (middle, value) if ratio(middle, "tmr") > plan.tmr_time_ratio else (low, middle)
        )
    return {
        "board": board.name,
        "board_kg": board.total_kg,
        "parameter": plan.parameter,
        "value": value,
        "unit": _FREE_UNITS[plan.parameter],
        "published_tmr_ratio": plan.tmr_time_ratio,
        "tmr_ratio": ratio(value, "tmr"),
        "predicted_dmr_ratio": ratio(value, "dmr"),
    }
