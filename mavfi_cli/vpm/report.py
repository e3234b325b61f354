"""The performance model's numbers for vehicles and schemes, and where they come from."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter

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
    Performance,
    Scheme,
    safe_velocity_mps,
)

# How the latencies of a platform's kernels combine into a response time: function and its name.
CHAINS: dict[str, tuple[Callable[[list[float]], float], str]] = {
    "serial": (sum, "sum"),
    "pipelined": (max, "slowest"),
}
MODEL = "F-1, IEEE CAL 19(1), equations 1 to 3"
OTHER_BOARD = "tx2"  # calibrations are repeated with this heavier board
_CURVE_HZ = np.array([10.0**exponent for exponent in np.linspace(-1.0, 3.0, 161).tolist()])
_COMMAND = "command line"
_UNITS = {
    "mass_kg": "kg", "rotor_pull_n": "N", "tilt_deg": "deg", "range_m": "m", "sensor_hz": "Hz",
    "response_s": "s", "hover_power_w": "W", "battery_wh": "Wh",
}  # fmt: skip
_BOARD_UNITS = {"mass_kg": "kg", "power_w": "W", "heatsink_kgpw": "kg/W"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Choices:
    """The user's choices for the model. If a choice is None, the vehicle's own value is used."""

    platform: PlatformProfile | None = None
    chain: str = "serial"  # one of CHAINS
    board: Board | None = None
    response_s: float | None = None
    range_m: float | None = None
    distance_m: float = 50.0

    def inputs(self, vehicle: ModelVehicle) -> ModelInputs:
        """Return the model's inputs for a vehicle with these choices.

        If the vehicle has an unpublished parameter, it is calibrated first.

        Raises:
            ConfigError: neither the vehicle nor the choices give a required value, or a value
                cannot be used.
        """
        return _inputs(vehicle, self)[0]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Parameter:
    """A parameter that the model uses, with its value and the source of the value."""

    parameter: str
    value: float
    unit: str
    source: str
    calibrated: bool = False  # True if the value comes from a calibration


@dataclass(frozen=True, slots=True, kw_only=True)
class Ratios:
    """The results with a protection scheme, each divided by that with the scheme REFERENCE."""

    velocity_ratio: float
    flight_time_ratio: float
    energy_ratio: float
    missions_ratio: float


@dataclass(frozen=True, slots=True, kw_only=True)
class SchemeResult:
    """The results for a vehicle with a protection scheme.

    If the vehicle cannot lift the scheme's boards, `performance` and `ratios` are None, and
    `problem` explains why.
    """

    scheme: str
    title: str
    boards: int
    overhead_percent: float
    source: str
    mass_kg: float
    compute_kg: float
    performance: Performance | None = None
    ratios: Ratios | None = None
    problem: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class _SensitivityPoint:
    """The results at one value of a varied parameter. They are None if the vehicle cannot fly."""

    value: float
    velocity_mps: float | None  # safe velocity with the scheme REFERENCE
    tmr_flight_time_ratio: float | None  # flight time with TMR over that with REFERENCE


@dataclass(frozen=True, slots=True, kw_only=True)
class Sensitivity:
    """How the results change as one parameter varies.

    An elasticity is d ln(result) / d ln(parameter) at `value`: the change of the result in per cent
    if the parameter changes by one per cent.
    """

    parameter: str
    unit: str
    value: float
    velocity_elasticity_ratio: float | None
    tmr_time_elasticity_ratio: float | None
    points: tuple[_SensitivityPoint, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibratedNumber:
    """A vehicle's unpublished parameter, calibrated to reproduce a published flight-time ratio.

    Attributes:
        tmr_ratio: flight time with TMR over that with the scheme REFERENCE, which is fitted to the
            published ratio.
        predicted_dmr_ratio: the same ratio with DMR, which is not fitted.
    """

    board: str
    board_kg: float
    parameter: str
    value: float
    unit: str
    published_tmr_ratio: float
    tmr_ratio: float
    predicted_dmr_ratio: float


@dataclass(frozen=True, slots=True, kw_only=True)
class _Curves:
    """Curves of the safe velocity over the action throughput, one for each number of boards.

    All lists have the same length. Numbers of boards that the vehicle cannot lift are omitted.
    """

    throughput_hz: list[float]
    velocity_mps: dict[int, list[float]]


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleReport:
    """The model's results for one vehicle. The first of `calibrations` is the one in use."""

    vehicle: str
    description: str
    board: str
    notes: tuple[str, ...]
    parameters: tuple[_Parameter, ...]
    schemes: tuple[SchemeResult, ...]
    sensitivity: tuple[Sensitivity, ...]
    calibrations: tuple[CalibratedNumber, ...]
    curves: _Curves


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelReport:
    """The model's results for all vehicles.

    The names of all numbers end in the unit, except those of counts and ratios.
    """

    model: str = MODEL
    knee_velocity_over_roof_ratio: float = KNEE_SHARE
    distance_m: float
    ratios_over: str = REFERENCE
    notes: tuple[str, ...]
    vehicles: tuple[VehicleReport, ...]


def report(
    vehicles: Sequence[ModelVehicle], choices: Choices, schemes: Mapping[str, Scheme]
) -> ModelReport:
    """Compute the model's results for each vehicle with each protection scheme.

    Raises:
        CannotLift: a vehicle cannot lift even one board.
        ConfigError: neither the vehicle nor the choices give a required value, or a value cannot be
            used.
    """
    return ModelReport(
        distance_m=choices.distance_m,
        notes=_unlike_sources(schemes),
        vehicles=tuple(_vehicle(vehicle, choices, schemes) for vehicle in vehicles),
    )


def _unlike_sources(schemes: Mapping[str, Scheme]) -> tuple[str, ...]:
    """Return a note if only some of the detectors' overheads come from the paper.

    Otherwise, return an empty tuple.
    """
    detectors = [schemes[name] for name in DETECTORS]
    papers = [scheme.name for scheme in detectors if scheme.source == TABLE_V]
    others = [scheme.name for scheme in detectors if scheme.source != TABLE_V]
    if not papers or not others:
        return ()
    return (
        f"the overhead of {' and '.join(papers)} is the paper's and that of {' and '.join(others)} "
        "is not: different sources, so these rows are not to be ranked",
    )


def _vehicle(
    vehicle: ModelVehicle, choices: Choices, schemes: Mapping[str, Scheme]
) -> VehicleReport:
    inputs, parameters, calibration = _inputs(vehicle, choices)
    calibrations = [] if calibration is None else [calibration]
    if calibration is not None and calibration.board != OTHER_BOARD:
        calibrations.append(_calibrated(vehicle, Board.load(OTHER_BOARD)))
    reference = inputs.performance(schemes[REFERENCE])
    return VehicleReport(
        vehicle=vehicle.name,
        description=vehicle.description,
        board=inputs.board.name,
        notes=tuple(_notes(vehicle, choices, inputs, calibration)),
        parameters=parameters,
        schemes=tuple(_scheme(inputs, scheme, reference) for scheme in schemes.values()),
        sensitivity=tuple(_sensitivities(inputs, schemes)),
        calibrations=tuple(calibrations),
        curves=_curves(inputs, schemes),
    )


def _inputs(
    vehicle: ModelVehicle, choices: Choices
) -> tuple[ModelInputs, tuple[_Parameter, ...], CalibratedNumber | None]:
    """Return the model's inputs, the table of parameters with their sources, and the calibration.

    The calibration is None if the vehicle has no unpublished parameter. The response time is taken
    from the command line, otherwise from the platform, otherwise from the vehicle.
    """
    full, sources, free, calibration = vehicle, dict(vehicle.sources), "", None
    if vehicle.calibration is not None:
        calibration = _calibrated(vehicle)
        free = calibration.parameter
        full = _with_number(vehicle, free, calibration.value)
        sources[free] = (
            f"calibrated: TMR takes {calibration.published_tmr_ratio:g} times the flight time of "
            f"detection and recovery, with board {calibration.board} ({vehicle.calibration.source})"
        )
    board, platform = _board(vehicle, choices), choices.platform
    compute_s, given = full.response_s, ""
    if choices.response_s is not None:
        compute_s, given = choices.response_s, _COMMAND
    elif platform is not None:
        if platform.measured_factor is not None:
            raise ConfigError(
                f"{platform.name} has no fixed latencies, because it measures them in flight: "
                "give --response or another platform",
                key="platform",
            )
        combined, how = CHAINS[choices.chain]
        compute_s = combined([kernel.latency_s for kernel in platform.kernels.values()])
        if compute_s < SMALLEST:
            raise ConfigError(f"the response time of platform {platform.name!r} is below 1 us")
        given = f"platform {platform.name}: {how} of {', '.join(platform.kernels)}"
    if given:
        sources["response_s"], free = given, "" if free == "response_s" else free
    if compute_s is None:
        raise ConfigError(f"vehicle {vehicle.name!r} defines no response time: give --platform or "
                          "--response", key="response_s")  # fmt: skip
    if choices.range_m is not None:
        sources["range_m"] = _COMMAND
    range_m = choices.range_m or full.range_m
    inputs = _with_board(
        replace(full, response_s=compute_s, range_m=range_m), board, choices.distance_m
    )
    return inputs, _parameters(inputs, sources, free), calibration


def _with_number(vehicle: ModelVehicle, parameter: str, value: float) -> ModelVehicle:
    """Return a copy of the vehicle in which the unpublished `parameter` has a value."""
    if parameter == "response_s":
        return replace(vehicle, calibration=None, response_s=value)
    return replace(vehicle, calibration=None, rotor_pull_n=value)


def _with_board(vehicle: ModelVehicle, board: Board, distance_m: float) -> ModelInputs:
    """Return the model's inputs for a board and a vehicle whose parameters are all known."""
    assert vehicle.rotor_pull_n is not None
    assert vehicle.response_s is not None
    return ModelInputs(
        vehicle=vehicle, board=board, pull_n=vehicle.rotor_pull_n, range_m=vehicle.range_m,
        compute_s=vehicle.response_s, distance_m=distance_m,
    )  # fmt: skip


def _notes(
    vehicle: ModelVehicle,
    choices: Choices,
    inputs: ModelInputs,
    calibration: CalibratedNumber | None,
) -> list[str]:
    """Return notes on values that the chosen computer did not change, though a user may expect it.

    These are the response time and the calibrated parameter of the vehicle.
    """
    notes, board = [], inputs.board
    own_time = choices.platform is None and choices.response_s is None
    calibrated_time = calibration is not None and calibration.parameter == "response_s"
    if own_time and board.name != vehicle.board:
        source = vehicle.sources.get("response_s", "not given")
        if calibration is not None and calibrated_time:
            source = f"calibrated with board {calibration.board}"
        notes.append(
            f"the board is {board.name}, and the response time is still the vehicle's own "
            f"({source}): give --response or --platform"
        )
    in_use = own_time or not calibrated_time
    if calibration is not None and in_use and board.name != calibration.board:
        if board.total_kg <= 0.0:
            other = f"board {board.name} has no mass, so nothing can be calibrated with it"
        else:
            try:
                value = _calibrated(vehicle, board).value
                other = f"with board {board.name} it would be {value:.4g} {calibration.unit}"
            except ConfigError as error:
                other = f"it cannot be with board {board.name}: {error}"
        notes.append(
            f"{calibration.parameter} = {calibration.value:.4g} {calibration.unit} is calibrated "
            f"with board {calibration.board}; {other}"
        )
    return notes


def _board(vehicle: ModelVehicle, choices: Choices) -> Board:
    if choices.board is not None:
        return choices.board
    if choices.platform is not None:
        return Board.of_platform(choices.platform)
    if not vehicle.board:
        raise ConfigError(f"vehicle {vehicle.name!r} defines no board: give --platform or --board",
                          key="board")  # fmt: skip
    return Board.load(vehicle.board)


def _parameters(
    inputs: ModelInputs, sources: Mapping[str, str], calibrated: str
) -> tuple[_Parameter, ...]:
    sources = {"tilt_deg": "CAL20: its Table 1 is reproduced with 0 degrees", **sources}
    own = (
        _Parameter(
            parameter=key, value=getattr(inputs.vehicle, key), unit=unit,
            source=sources.get(key, "not given"), calibrated=key == calibrated,
        )
        for key, unit in _UNITS.items()
    )  # fmt: skip
    boards = (
        _Parameter(
            parameter=f"board.{key}", value=getattr(inputs.board, key), unit=unit,
            source=inputs.board.sources.get(key, "not given"),
        )
        for key, unit in _BOARD_UNITS.items()
    )  # fmt: skip
    return (*own, *boards)


def _scheme(inputs: ModelInputs, scheme: Scheme, reference: Performance) -> SchemeResult:
    result = SchemeResult(
        scheme=scheme.name, title=scheme.title, boards=scheme.copies,
        overhead_percent=100.0 * scheme.overhead, source=scheme.source,
        mass_kg=inputs.mass_kg(scheme.copies), compute_kg=inputs.carried_kg(scheme.copies),
    )  # fmt: skip
    try:
        performance = inputs.performance(scheme)
    except CannotLift as error:
        return replace(result, problem=str(error))
    ratios = Ratios(
        velocity_ratio=performance.velocity_mps / reference.velocity_mps,
        flight_time_ratio=performance.flight_time_s / reference.flight_time_s,
        energy_ratio=performance.energy_j / reference.energy_j,
        missions_ratio=performance.missions / reference.missions,
    )
    return replace(result, performance=performance, ratios=ratios)


def _curves(inputs: ModelInputs, schemes: Mapping[str, Scheme]) -> _Curves:
    copies = sorted({scheme.copies for scheme in schemes.values()})
    flying = [(n, inputs.acceleration_mps2(n)) for n in copies]
    return _Curves(
        throughput_hz=_CURVE_HZ.tolist(),
        velocity_mps={
            n: safe_velocity_mps(accel, 1.0 / _CURVE_HZ, inputs.range_m).tolist()
            for n, accel in flying
            if accel > 0.0
        },
    )


# Sensitivity --------------------------------------------------------------------------------------

FACTORS = (0.5, 0.8, 1.25, 2.0)
_STEP = 1.001  # factor of the numerical derivative
# name -> unit, and field of the inputs; power also changes the mass of the heat sink
_VARIED = {
    "sensing range": ("m", "range_m"),
    "response time": ("s", "compute_s"),
    "board mass": ("kg", "board.mass_kg"),
    "board power": ("W", "board.power_w"),
}


def _scaled(inputs: ModelInputs, field: str, factor: float) -> ModelInputs:
    value = factor * attrgetter(field)(inputs)
    if field.startswith("board."):
        return replace(inputs, board=replace(inputs.board, **{field.removeprefix("board."): value}))
    return replace(inputs, **{field: value})


def _sensitivities(inputs: ModelInputs, schemes: Mapping[str, Scheme]) -> list[Sensitivity]:
    rows = []
    for name, (unit, field) in _VARIED.items():
        middle = attrgetter(field)(inputs)
        if middle == 0.0:
            continue
        below, above, *points = (
            _point(_scaled(inputs, field, factor), factor * middle, schemes)
            for factor in (1.0 / _STEP, _STEP, *FACTORS)
        )
        rows.append(
            Sensitivity(
                parameter=name,
                unit=unit,
                value=middle,
                velocity_elasticity_ratio=_elasticity(below.velocity_mps, above.velocity_mps),
                tmr_time_elasticity_ratio=_elasticity(
                    below.tmr_flight_time_ratio, above.tmr_flight_time_ratio
                ),
                points=tuple(points),
            )
        )
    return rows


def _point(inputs: ModelInputs, value: float, schemes: Mapping[str, Scheme]) -> _SensitivityPoint:
    return _SensitivityPoint(
        value=value,
        velocity_mps=inputs.velocity_mps(schemes[REFERENCE]),
        tmr_flight_time_ratio=_time_ratio(inputs, schemes, "tmr"),
    )


def _elasticity(below: float | None, above: float | None) -> float | None:
    if below is None or above is None:
        return None
    return math.log(above / below) / (2 * math.log(_STEP))


def _time_ratio(inputs: ModelInputs, schemes: Mapping[str, Scheme], scheme: str) -> float | None:
    """Return the flight time with a scheme divided by that with the scheme REFERENCE.

    Return None if the vehicle cannot lift the boards of one of the two schemes.
    """
    fast, slow = (inputs.velocity_mps(schemes[name]) for name in (REFERENCE, scheme))
    return None if fast is None or slow is None else fast / slow


# Calibration: a vehicle's unpublished parameter from a published ratio of flight times ---------

_SPAN = 1.0e4  # ratio of the largest to the smallest tried value
_STEPS = 200  # halvings of the interval; more than a float can resolve


def _calibrated(vehicle: ModelVehicle, board: Board | None = None) -> CalibratedNumber:
    """Find the value of the vehicle's unpublished parameter that gives the published ratio.

    The ratio of flight times falls as the parameter grows, so bisection finds the value.

    Args:
        board: the board of the redundant computers. If None, it is the calibration's own.

    Raises:
        ConfigError: no value gives the ratio; the message names the ratios that can be reached.
        UnknownName: the calibration's board does not exist.
    """
    calibration = vehicle.calibration
    assert calibration is not None
    board = board or Board.load(calibration.board)
    parameter, wanted = calibration.parameter, calibration.tmr_time_ratio

    def time_ratio(value: float, scheme: str = "tmr") -> float:
        """Return the flight-time ratio for a value of `parameter`; infinity if it cannot fly."""
        inputs = _with_board(_with_number(vehicle, parameter, value), board, 1.0)
        ratio = _time_ratio(inputs, SCHEMES, scheme)
        return math.inf if ratio is None else ratio

    low = 1.0 / vehicle.sensor_hz
    if parameter == "rotor_pull_n":
        three_kg = vehicle.mass_kg + SCHEMES["tmr"].copies * board.total_kg
        low = three_kg * GRAVITY_MPS2 / math.cos(vehicle.tilt_rad)
    value = low * _SPAN
    least, most = time_ratio(value), time_ratio(low)
    if not least <= wanted <= most:
        raise ConfigError(
            f"no value of {parameter} gives vehicle {vehicle.name!r} a ratio of {wanted:g}; "
            f"possible ratios are {least:.3f} to {most:.3f}",
            key="calibration.tmr_time_ratio",
        )
    for _ in range(_STEPS):
        middle = 0.5 * (low + value)
        low, value = (middle, value) if time_ratio(middle) > wanted else (low, middle)
    return CalibratedNumber(
        board=board.name,
        board_kg=board.total_kg,
        parameter=parameter,
        value=value,
        unit=_UNITS[parameter],
        published_tmr_ratio=wanted,
        tmr_ratio=time_ratio(value),
        predicted_dmr_ratio=time_ratio(value, "dmr"),
    )
