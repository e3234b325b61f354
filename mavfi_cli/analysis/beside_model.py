"""Compares the predictions of the performance model with simulated flights (`mavfi vpm --fly`)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
import pyarrow as pa

from mavfi_cli.analysis.flights import changed, chosen, errors, flags, flown, known, numbers
from mavfi_cli.analysis.overhead import ComputeOverhead
from mavfi_cli.analysis.pairs import paired
from mavfi_cli.companion.pipeline import BRAKE_SHARE
from mavfi_cli.core.types import FloatArray
from mavfi_cli.stats.bootstrap import interval
from mavfi_cli.stats.shares import Interval, Share, wilson
from mavfi_cli.vpm.model import REFERENCE, SCHEMES, Performance
from mavfi_cli.vpm.report import ModelReport, VehicleReport

BASE = "none"  # reference of ratios: one board without protection
PLACE = ("world", "seed")  # columns that identify a mission in all schemes
Key = tuple[str, str]  # vehicle and scheme
# Parts of the model that the simulation omits; printed with every report of flights.
NOT_SCALED = (
    "size, propellers and drag are those of the simulated vehicle; boards weigh, but have no "
    "size: inertia and drag do not grow with them",
    "the model's acceleration is pull / mass - g; here it is the companion's limit, of which "
    f"planning uses {100.0 * BRAKE_SHARE:g} % to speed up and to brake",
    "the simulated companion plans with 90 % of the safe velocity, flies round obstacles, stops to "
    "plan, and speeds up and slows down; the model flies straight at one velocity",
    "flights begin at take-off height and end within the goal's tolerance; climbing there is not "
    "counted, as in the model; a turn before departure, where the stack has one, is counted",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightSetup:
    """The flight limits and power of a vehicle with one protection scheme, such as TMR.

    Attributes:
        v_max_mps, a_max_mps2: limits of velocity and acceleration in the flights.
        braking_velocity_mps: safe velocity with the deceleration that the companion assumes.
        rotors_w: electrical hover power of the rotors when the vehicle carries all boards.
        boards_w: power of all boards.
        cut: one phrase for each value of the model that was clipped to what a mission allows.
    """

    v_max_mps: float
    a_max_mps2: float
    braking_velocity_mps: float
    rotors_w: float
    boards_w: float
    cut: tuple[str, ...] = ()

    def energy_j(self, flights: pa.Table) -> FloatArray:
        """Return the electrical energy of rotors and boards in each flight, in joules.

        The result has the shape (n,), with NaN for flights whose energy is unknown. The energy is
        the shaft energy, scaled by the ratio of the model's hover power to that of the simulated
        vehicle, plus the boards' power times the flight time. The ratio does not depend on the
        number of boards.
        """
        shaft_j, hover_w, time_s = (
            numbers(flights, name)
            for name in ("energy_propeller_j", "hover_shaft_w", "flight_time_s")
        )
        return np.asarray(shaft_j * self.rotors_w / hover_w + self.boards_w * time_s)


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelAndFlights:
    """One quantity as the model predicts it and as measured in flights.

    `difference_percent` is 100 * (flights / model - 1).
    """

    model: float
    flights: Interval
    difference_percent: float

    @classmethod
    def of(cls, model: float, flights: Interval) -> ModelAndFlights:
        """Compare the value that the model predicts with the value measured in flights."""
        difference = 100.0 * (flights.value / model - 1.0)
        return cls(model=model, flights=flights, difference_percent=difference)


@dataclass(frozen=True, slots=True, kw_only=True)
class FlownNumbers:
    """Results of the flights of one scheme, and the model's predictions for the same missions.

    All measured quantities except `success` and `outcomes` are computed over successful flights.

    Attributes:
        cut: as in `FlightSetup`.
        outcomes: number of flights by outcome, the most frequent first.
        errors: reasons why missions could not begin.
        path_ratio: distance flown / straight-line distance.
        shaft_energy_j, hover_shaft_w, replans, alarms: mean over the flights.
    """

    v_max_mps: float
    a_max_mps2: float
    braking_velocity_mps: float
    cut: tuple[str, ...]
    errors: tuple[str, ...]
    success: Share
    outcomes: dict[str, int]
    velocity_mps: ModelAndFlights
    top_velocity_mps: ModelAndFlights
    flight_time_s: ModelAndFlights
    path_ratio: ModelAndFlights
    energy_j: ModelAndFlights
    response_s: ModelAndFlights
    shaft_energy_j: float
    hover_shaft_w: float
    replans: float
    alarms: float


@dataclass(frozen=True, slots=True, kw_only=True)
class _FlownRatios:
    """Ratios between two schemes: geometric means over the missions that succeed with both.

    Attributes:
        pairs: number of these missions.
    """

    pairs: int
    velocity_ratio: ModelAndFlights
    flight_time_ratio: ModelAndFlights
    energy_ratio: ModelAndFlights


@dataclass(frozen=True, slots=True, kw_only=True)
class FlownScheme:
    """A protection scheme of one vehicle, with the results of its flights.

    Attributes:
        boards: number of boards that the vehicle carries.
        problem: reason why the scheme was not flown; None if it was.
        flown: results of the flights; None if the scheme was not flown.
        over_none, over_aad: ratios of this scheme to the scheme `none` or `aad`; None if that one
            was not flown.
    """

    scheme: str
    title: str
    boards: int
    overhead_percent: float
    mass_kg: float
    problem: str | None = None
    flown: FlownNumbers | None = None
    over_none: _FlownRatios | None = None
    over_aad: _FlownRatios | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class FlownVehicle:
    """One vehicle, with the results of its flights under each protection scheme."""

    vehicle: str
    board: str
    schemes: tuple[FlownScheme, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredOverhead:
    """The compute overhead of a detector as measured in flights, and as the paper gives it.

    Attributes:
        flights, alarms: number of flights that were measured, and of alarms in them.
        measured_percent: overhead relative to the compute time of the same flights.
        checks_percent: the part of `measured_percent` that is due to checks.
        checks_of_host_kernels_percent: time of the checks relative to that of the kernels, both
            measured on the host.
    """

    detector: str
    flights: int
    alarms: int
    measured_percent: float
    checks_percent: float
    checks_of_host_kernels_percent: float
    paper_percent: float

    @classmethod
    def of(cls, overhead: ComputeOverhead) -> MeasuredOverhead:
        """Convert the shares of a measured overhead to per cent, and add the paper's overhead."""
        return cls(
            detector=overhead.detector,
            flights=overhead.flights,
            alarms=overhead.alarms,
            measured_percent=100.0 * overhead.share,
            checks_percent=100.0 * overhead.checks_share,
            checks_of_host_kernels_percent=100.0 * overhead.checks_host_share,
            paper_percent=100.0 * SCHEMES[overhead.detector].overhead,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightsReport:
    """The results of the flights of all vehicles and schemes.

    Attributes:
        missions_each: number of missions of each vehicle and scheme in each world.
        detectors: where the models of the detectors come from.
        ratios_over, paper_ratios_over: schemes that the ratios here and in the paper refer to.
        not_scaled: one sentence for each part of the model that the simulation omits.
    """

    worlds: tuple[str, ...]
    missions_each: int
    first_seed: int
    stack: str
    detectors: str
    ratios_over: str = BASE
    paper_ratios_over: str = REFERENCE
    not_scaled: tuple[str, ...] = NOT_SCALED
    overheads: tuple[MeasuredOverhead, ...]
    vehicles: tuple[FlownVehicle, ...]


def side_by_side(
    model: ModelReport, setups: Mapping[Key, FlightSetup | str], flights: pa.Table
) -> tuple[FlownVehicle, ...]:
    """Compare the flights of each vehicle and scheme with what the model predicts for them.

    Args:
        model: the model's report, computed with the overheads that the schemes had in flight.
        setups: the setup of each vehicle and scheme, or the reason why it cannot be flown.
        flights: a table as returned by `analysis.flights.flights`, with the labels `group` for the
            vehicle and `arm` for the scheme.
    """
    return tuple(
        FlownVehicle(
            vehicle=vehicle.vehicle,
            board=vehicle.board,
            schemes=tuple(_schemes(vehicle, setups, flights)),
        )
        for vehicle in model.vehicles
    )


@dataclass(frozen=True, slots=True)
class _Arm:
    """A vehicle and scheme that were flown: the model's prediction, the setup and the flights."""

    performance: Performance
    setup: FlightSetup
    flights: pa.Table  # all its missions, including those that could not begin

    def numbers(self) -> FlownNumbers:
        ended, setup, performance = flown(self.flights), self.setup, self.performance
        won = chosen(ended, succeeded=True)
        straight_m = numbers(won, "straight_m")
        # Mean time to fly straight from start to goal at the model's velocity.
        model_s = _mean(straight_m / performance.velocity_mps).value

        def beside(model: float, values: FloatArray | str) -> ModelAndFlights:
            values = numbers(won, values) if isinstance(values, str) else values
            return ModelAndFlights.of(model, _mean(values))

        return FlownNumbers(
            v_max_mps=setup.v_max_mps,
            a_max_mps2=setup.a_max_mps2,
            braking_velocity_mps=setup.braking_velocity_mps,
            cut=setup.cut,
            errors=tuple(errors(self.flights, "{reason}")),
            success=wilson(won.num_rows, ended.num_rows),
            outcomes=dict(Counter(ended["outcome"].to_pylist()).most_common()),
            velocity_mps=beside(performance.velocity_mps, "mean_speed_mps"),
            top_velocity_mps=beside(performance.velocity_mps, "max_speed_mps"),
            flight_time_s=beside(model_s, "flight_time_s"),
            path_ratio=beside(1.0, numbers(won, "distance_m") / straight_m),
            energy_j=beside(performance.power_w * model_s, setup.energy_j(won)),
            response_s=beside(1.0 / performance.throughput_hz, "response_median_s"),
            shaft_energy_j=_mean(numbers(won, "energy_propeller_j")).value,
            hover_shaft_w=_mean(numbers(won, "hover_shaft_w")).value,
            replans=_mean(numbers(won, "replans")).value,
            alarms=_mean(numbers(won, "alarm_count")).value,
        )

    def over(self, base: _Arm) -> _FlownRatios:
        """Compute the ratios of this scheme to `base` over missions that succeed with both."""
        own, other = paired(flown(self.flights), flown(base.flights), PLACE)
        both = flags(own, "succeeded") & flags(other, "succeeded")
        own, other = (
            table.filter(pa.array(both)).sort_by([(name, "ascending") for name in PLACE])
            for table in (own, other)
        )

        def ratio(model: float, before: FloatArray, after: FloatArray) -> ModelAndFlights:
            flights = changed(range(len(before)), before.tolist(), after.tolist())
            return ModelAndFlights.of(model, flights)

        mine, theirs = self.performance, base.performance
        velocity = ratio(
            mine.velocity_mps / theirs.velocity_mps,
            *(numbers(table, "mean_speed_mps") for table in (other, own)),
        )
        return _FlownRatios(
            pairs=velocity.flights.count,
            velocity_ratio=velocity,
            flight_time_ratio=ratio(
                mine.flight_time_s / theirs.flight_time_s,
                *(numbers(table, "flight_time_s") for table in (other, own)),
            ),
            energy_ratio=ratio(
                mine.energy_j / theirs.energy_j,
                base.setup.energy_j(other),
                self.setup.energy_j(own),
            ),
        )


def _schemes(
    vehicle: VehicleReport, setups: Mapping[Key, FlightSetup | str], flights: pa.Table
) -> Iterator[FlownScheme]:
    arms = {}
    for row in vehicle.schemes:
        setup = setups[vehicle.vehicle, row.scheme]
        if row.performance is not None and not isinstance(setup, str):
            mine = chosen(flights, label_group=vehicle.vehicle, label_arm=row.scheme)
            arms[row.scheme] = _Arm(row.performance, setup, mine)
    for row in vehicle.schemes:
        scheme = FlownScheme(
            scheme=row.scheme, title=row.title, boards=row.boards,
            overhead_percent=row.overhead_percent, mass_kg=row.mass_kg,
        )  # fmt: skip
        arm = arms.get(row.scheme)
        if arm is None:
            yield replace(scheme, problem=str(setups[vehicle.vehicle, row.scheme]))
            continue
        over = {name: arm.over(arms[name]) for name in (BASE, REFERENCE) if name in arms}
        yield replace(
            scheme, flown=arm.numbers(), over_none=over.get(BASE), over_aad=over.get(REFERENCE)
        )


def _mean(values: FloatArray) -> Interval:
    return interval(known(values))
