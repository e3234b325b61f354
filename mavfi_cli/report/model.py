"""The performance model and its flights as text, CSV, JSON and pictures, with units."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, fields
from operator import attrgetter
from typing import TYPE_CHECKING, Any

from mavfi_cli.analysis.beside_model import (
    FlightsReport,
    FlownNumbers,
    FlownScheme,
    FlownVehicle,
    MeasuredOverhead,
    ModelAndFlights,
)
from mavfi_cli.core.files import Json, plain
from mavfi_cli.mission.measures import HOST_CHECKS
from mavfi_cli.report.drawing import (
    DASHED,
    INK,
    NOTE,
    SCHEMES,
    Look,
    legend_above,
    new_figure,
    note_at,
    open_frame,
    whisker,
)
from mavfi_cli.report.table import Table
from mavfi_cli.vpm.model import Performance
from mavfi_cli.vpm.report import (
    CalibratedNumber,
    ModelReport,
    Ratios,
    SchemeResult,
    Sensitivity,
    VehicleReport,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Ratios of flights in vpm.json and flights.csv: field of the scheme, suffix of the keys, ratios.
_OVER: Sequence[tuple[str, str, Sequence[str]]] = (
    ("over_none", "", ("velocity_ratio", "flight_time_ratio", "energy_ratio")),
    ("over_aad", "_over_aad", ("flight_time_ratio",)),
)


def model_json(model: ModelReport, flights: FlightsReport | None = None) -> Any:
    """Return the report of the model as plain values.

    If a report of its flights is given, it is under the key `flights`.
    """
    parts = {} if flights is None else {"flights": _with_rows(flights)}
    return plain(_with_rows(model) | parts)


def model_csv(model: ModelReport | FlightsReport) -> str:
    """Return the report of the model, or of its flights, as CSV with a row per vehicle and scheme.

    The column names include the units.
    """
    distance = {"distance_m": model.distance_m} if isinstance(model, ModelReport) else {}
    return Table.of_records(
        {"vehicle": vehicle.vehicle, "board": vehicle.board, **distance}
        | {
            name: "; ".join(cell) if isinstance(cell, tuple) else cell
            for name, cell in _cells_of(row).items()
            if name != "outcomes"
        }
        for vehicle in model.vehicles
        for row in vehicle.schemes
    ).csv()


def _with_rows(report: ModelReport | FlightsReport) -> Json:
    vehicles = [
        asdict(vehicle) | {"schemes": [_cells_of(row) for row in vehicle.schemes]}
        for vehicle in report.vehicles
    ]
    return asdict(report) | {"vehicles": vehicles}


def _cells_of(row: SchemeResult | FlownScheme) -> Json:
    """Return the row of one scheme as values keyed by column name.

    A value that consists of several texts, such as `errors`, is a tuple.
    """
    if isinstance(row, SchemeResult):
        cells = asdict(row)
        problem = cells.pop("problem")
        for group, kind in (("performance", Performance), ("ratios", Ratios)):
            cells |= cells.pop(group) or dict.fromkeys(part.name for part in fields(kind))
        return {**cells, "problem": problem}
    common = ("scheme", "title", "boards", "overhead_percent", "mass_kg", "problem")
    cells = {name: getattr(row, name) for name in common}
    if (own := row.flown) is None:
        return {**cells, "errors": (), "cut": ()}
    planned = ("errors", "cut", "v_max_mps", "a_max_mps2", "braking_velocity_mps")
    cells |= {name: getattr(own, name) for name in planned}
    cells |= {"missions": own.success.total, "outcomes": own.outcomes}
    for end, share in (("", "share"), ("_low", "low"), ("_high", "high")):
        cells[f"success{end}_percent"] = 100.0 * getattr(own.success, share)
    for part in fields(own):
        value = getattr(own, part.name)
        if isinstance(value, ModelAndFlights):
            cells |= _number_with_ends(part.name, value)
        elif isinstance(value, float) and part.name not in planned:
            cells[f"flight_{part.name}"] = value
    for over, ending, names in _OVER:
        if (ratios := getattr(row, over)) is not None:
            for name in names:
                quantity, _, unit = name.rpartition("_")
                cells |= _number_with_ends(f"{quantity}{ending}_{unit}", getattr(ratios, name))
                cells[f"pairs{ending}"] = ratios.pairs
    return cells


def _number_with_ends(name: str, number: ModelAndFlights) -> dict[str, float]:
    """Return the modelled value, the flown value with its interval, and their difference.

    The values are keyed by column name.

    Args:
        name: name of the number, which ends in its unit.
    """
    quantity, _, unit = name.rpartition("_")
    compared = name if unit == "ratio" else quantity
    return {
        f"model_{name}": number.model,
        f"flight_{name}": number.flights.value,
        f"flight_{quantity}_low_{unit}": number.flights.low,
        f"flight_{quantity}_high_{unit}": number.flights.high,
        f"{compared}_difference_percent": number.difference_percent,
    }


# Text: the model ----------------------------------------------------------------------------------


def model_lines(
    model: ModelReport, flights: FlightsReport | None = None, *, full: bool = False
) -> list[str]:
    """Return the report of the model as lines of text, followed by that of its flights if given.

    The full report adds masses, roofs, sensitivities and the source of each number.
    """
    knee = f"; knee: where velocity is {100 * model.knee_velocity_over_roof_ratio:g} % of the roof"
    lines = [
        f"Model {model.model}{knee if full else ''}",
        f"Flights of {model.distance_m:g} m at the safe velocity and hovering power; ratios "
        f"are over {model.ratios_over}",
    ]
    lines += [f"Note: {note}" for note in model.notes]
    for vehicle in model.vehicles:
        lines += ["", *_vehicle_lines(vehicle, model.ratios_over, full=full)]
    if not full:
        lines += ["", "--full prints masses, sensitivities and the source of each number, too"]
    return [*lines, *(() if flights is None else _flight_lines(flights))]


def _flying(vehicle: VehicleReport) -> list[tuple[SchemeResult, Performance, Ratios]]:
    return [
        (row, row.performance, row.ratios)
        for row in vehicle.schemes
        if row.performance is not None and row.ratios is not None
    ]


def _vehicle_lines(vehicle: VehicleReport, over: str, *, full: bool) -> Iterator[str]:
    title = f": {vehicle.description}" if vehicle.description else ""
    yield f"== {vehicle.vehicle}{title}; board {vehicle.board} =="
    yield from (f"Note: {note}" for note in vehicle.notes)
    flying = _flying(vehicle)
    if full:
        yield from Table([
            ["scheme", "boards", "compute", "mass", "thrust/weight", "acceleration", "roof",
             "knee"],
            *([row.scheme, f"{row.boards}", f"{row.compute_kg:.3f} kg", f"{row.mass_kg:.3f} kg",
               f"{own.thrust_to_weight:.2f} N/N", f"{own.acceleration_mps2:.2f} m/s²",
               f"{own.roof_mps:.2f} m/s", f"{own.knee_hz:.1f} Hz"] for row, own, _ in flying),
        ]).lines()  # fmt: skip
        yield ""
    yield from Table([
        ["scheme", "overhead", "throughput", "velocity", "bound by", "sensor ceiling",
         "compute ceiling"],
        *([row.scheme, f"{row.overhead_percent:.4g} %", f"{own.throughput_hz:.3f} Hz",
           f"{own.velocity_mps:.3f} m/s", own.bound, f"{own.sensor_ceiling_mps:.2f} m/s",
           f"{own.compute_ceiling_mps:.2f} m/s"] for row, own, _ in flying),
    ]).lines()  # fmt: skip
    yield ""
    yield from Table([
        [f"over {over}", "velocity", "time", "energy", "missions", "flight time", "power",
         "energy", "a charge"],
        *([row.scheme, f"x {ratios.velocity_ratio:.4f}", f"x {ratios.flight_time_ratio:.4f}",
           f"x {ratios.energy_ratio:.4f}", f"x {ratios.missions_ratio:.4f}",
           f"{own.flight_time_s:.1f} s", f"{own.power_w:.1f} W", f"{own.energy_j / 1000:.2f} kJ",
           f"{own.missions:.1f} missions"] for row, own, ratios in flying),
    ]).lines()  # fmt: skip
    yield from (f"{row.scheme}: {row.problem}" for row in vehicle.schemes if row.problem)
    if full:
        yield from _sensitivity_lines(vehicle.sensitivity)
    yield from _calibration_lines(vehicle.calibrations)
    if not full:
        return
    yield ""
    yield from Table([
        ["number", "value", "source"],
        *([own.parameter, f"{own.value:.5g} {own.unit}", own.source]
          for own in vehicle.parameters),
        *([f"scheme {row.scheme}", f"{row.overhead_percent:.4g} %", row.source]
          for row in vehicle.schemes),
    ], prose=True).lines()  # fmt: skip


def _sensitivity_lines(rows: Sequence[Sensitivity]) -> Iterator[str]:
    yield ""
    yield "Sensitivity: velocity with detection and recovery; flight time with TMR over it"
    for row in rows:
        velocity, time = (
            "-" if slope is None else f"{slope:+.3f} %"
            for slope in (row.velocity_elasticity_ratio, row.tmr_time_elasticity_ratio)
        )
        yield (
            f"  {row.parameter} {row.value:.4g} {row.unit}; 1 % more: velocity {velocity}, "
            f"TMR's time ratio {time}"
        )
        yield from Table([
            [f"    {point.value:.4g} {row.unit}",
             "cannot lift it" if point.velocity_mps is None else f"{point.velocity_mps:.3f} m/s",
             "TMR cannot be lifted" if point.tmr_flight_time_ratio is None
             else f"x {point.tmr_flight_time_ratio:.4f}"] for point in row.points
        ]).lines()  # fmt: skip


def _calibration_lines(rows: Sequence[CalibratedNumber]) -> Iterator[str]:
    if not rows:
        return
    yield ""
    yield "Paper, Fig. 15, flight time over detection and recovery; one number is calibrated:"
    yield from Table([
        ["  board", "a copy", "calibrated", "TMR", "paper's TMR", "DMR, predicted"],
        *([f"  {row.board}", f"{1000 * row.board_kg:.0f} g",
           f"{row.parameter} = {row.value:.4g} {row.unit}", f"x {row.tmr_ratio:.4f}",
           f"x {row.published_tmr_ratio:g}", f"x {row.predicted_dmr_ratio:.4f}"] for row in rows),
    ]).lines()  # fmt: skip


# Text: flights against the model ------------------------------------------------------------------

_MANY_ALARMS = 10.0  # alarms of an error-free flight; a detector usually raises fewer
_NUMBERS = (  # heading, field of FlownNumbers, format of a number, unit, factor
    ("Mean velocity against the model's safe velocity", "velocity_mps", ".2f", "m/s", 1.0),
    ("Top velocity against it", "top_velocity_mps", ".2f", "m/s", 1.0),
    ("Flight time", "flight_time_s", ".1f", "s", 1.0),
    ("Energy of rotors and boards", "energy_j", ".2f", "kJ", 1.0e-3),
    ("Response time, median", "response_s", ".3f", "s", 1.0),
)
_RATIOS = (
    ("velocity", "over_none.velocity_ratio"),
    ("flight time", "over_none.flight_time_ratio"),
    ("energy", "over_none.energy_ratio"),
)
_HEAD = ["scheme", "model", "flight", "", "flight against model"]


def _flight_lines(flights: FlightsReport) -> list[str]:
    lines = [
        "",
        f"Flights in {', '.join(flights.worlds)}: {flights.missions_each} missions a scheme "
        f"and world, seeds from {flights.first_seed}, stack {flights.stack}",
        "Numbers are of successful flights, (low to high) are 95 % intervals over missions",
        f"Detectors: {flights.detectors}",
    ]
    for vehicle in flights.vehicles:
        lines += ["", *_flown_lines(vehicle, flights)]
    lines += ["", *_overhead_lines(flights.overheads), "", "What the flights do not scale:"]
    rows = [["", text] for text in flights.not_scaled]
    return [*lines, *Table(rows, prose=True).lines()]


def _flown(vehicle: FlownVehicle) -> list[tuple[FlownScheme, FlownNumbers]]:
    return [(row, row.flown) for row in vehicle.schemes if row.flown is not None]


def _flown_lines(vehicle: FlownVehicle, flights: FlightsReport) -> Iterator[str]:
    yield f"== {vehicle.vehicle} flown, board {vehicle.board} =="
    rows = _flown(vehicle)
    yield from Table([
        ["scheme", "mass", "v-max", "a-max", "safe, braking", "success", "ends"],
        *([row.scheme, f"{row.mass_kg:.3f} kg", f"{own.v_max_mps:.3f} m/s",
           f"{own.a_max_mps2:.2f} m/s²", f"{own.braking_velocity_mps:.3f} m/s",
           f"{100 * own.success.share:.0f} % ({100 * own.success.low:.0f} to "
           f"{100 * own.success.high:.0f} %)",
           ", ".join(f"{count} {name}" for name, count in own.outcomes.items())]
          for row, own in rows),
    ]).lines()  # fmt: skip
    for heading, field, shape, unit, factor in _NUMBERS:
        cells = [
            [row.scheme, *_number_cells(getattr(own, field), shape, unit, factor)]
            for row, own in rows
        ]
        yield from ["", f"{heading}:", *Table([_HEAD, *cells]).lines()]
    yield ""
    yield "Why flights take longer than the model says:"
    yield from Table([["scheme", "path", "pace", "replans", "alarms"],
                        *([row.scheme, *_reasons(own)] for row, own in rows)]).lines()  # fmt: skip
    over, paper = flights.ratios_over, flights.paper_ratios_over
    for heading, field in (
        *((f"{title.capitalize()} over {over}", field) for title, field in _RATIOS),
        (f"Flight time over {paper}, as the paper's Fig. 15", "over_aad.flight_time_ratio"),
    ):
        ratio = attrgetter(field)
        cells = [
            [row.scheme, *_ratio_cells(ratio(row))]
            for row, _ in rows
            if getattr(row, field.partition(".")[0]) is not None
        ]
        yield from ["", f"{heading}:", *Table([_HEAD, *cells]).lines()]
    for row in vehicle.schemes:
        yield from _remarks(row)


def _number_cells(number: ModelAndFlights, shape: str, unit: str, factor: float) -> list[str]:
    model, flight, low, high = (
        factor * value
        for value in (number.model, number.flights.value, number.flights.low, number.flights.high)
    )
    return [
        _known(f"{model:{shape}} {unit}", model),
        _known(f"{flight:{shape}} {unit}", flight),
        _known(f"({low:{shape}} to {high:{shape}} {unit})", low, ""),
        _known(f"{number.difference_percent:+.1f} %", flight),
    ]


def _ratio_cells(ratio: ModelAndFlights) -> list[str]:
    flights = ratio.flights
    ends = _known(f"x {flights.low:.4f} to x {flights.high:.4f}, ", flights.low, "")
    return [
        _known(f"x {ratio.model:.4f}", ratio.model),
        _known(f"x {flights.value:.4f}", flights.value),
        f"({ends}{flights.count} pairs)",
        _known(f"{ratio.difference_percent:+.1f} %", flights.value),
    ]


def _reasons(own: FlownNumbers) -> list[str]:
    path = own.path_ratio.flights.value
    pace = own.velocity_mps.model / own.velocity_mps.flights.value
    return [
        _known(f"x {path:.3f} longer", path),
        _known(f"x {pace:.3f} slower", pace),
        _known(f"{own.replans:.1f} a flight", own.replans),
        _known(f"{own.alarms:.1f} a flight", own.alarms, "no detector"),
    ]


def _known(text: str, value: float, otherwise: str = "-") -> str:
    """Return the text of a value, or `otherwise` if it is NaN because no flight succeeded."""
    return otherwise if math.isnan(value) else text


def _remarks(row: FlownScheme) -> Iterator[str]:
    own = row.flown
    if own is None:
        yield f"{row.scheme}: not flown: {row.problem}"
        return
    if row.overhead_percent:
        yield (
            f"{row.scheme}: an overhead of {row.overhead_percent:.4g} % in its flights and "
            "in the model beside them"
        )
    if own.alarms >= _MANY_ALARMS:
        yield (
            f"{row.scheme}: {own.alarms:.0f} alarms in a flight without a fault: its "
            "model was fitted to other flights; --train fits one to these"
        )
    if own.cut:
        yield f"{row.scheme}: flown with {', '.join(own.cut)}"
    if own.errors:
        yield f"{row.scheme}: {len(own.errors)} could not begin, the first: {own.errors[0]}"


def _overhead_lines(rows: Sequence[MeasuredOverhead]) -> Iterator[str]:
    if not rows:
        yield "Overhead of detection and recovery: no flight with a detector"
        return
    yield "Overhead of detection and recovery, of the kernels' time on the flights' platform:"
    yield from Table([
        ["detector", "measured", "of it checks", "paper", "recomputations",
         "checks of this host's kernel time"],
        *([row.detector, f"{row.measured_percent:.4g} %", f"{row.checks_percent:.4g} %",
           f"{row.paper_percent:.4g} %", f"{row.alarms} in {row.flights} flights",
           f"{row.checks_of_host_kernels_percent:.4g} %"] for row in rows),
    ]).lines()  # fmt: skip
    yield f"({HOST_CHECKS})"


# Roofline: safe velocity against action throughput -----------------------------------------------

_OF_COPIES = {1: "none", 2: "dmr", 3: "tmr"}
_MOST_HZ = 1000.0
_LABELS = {1: "one board", 2: "two boards (DMR)", 3: "three boards (TMR)"}


def _draw_roofline(model: ModelReport) -> Figure:
    """Draw safe velocity over action throughput on logarithmic axes, with a panel per vehicle."""
    vehicles = model.vehicles
    figure = new_figure(max(6.4, 4.9 * len(vehicles)), 4.9)
    panels = figure.subplots(1, len(vehicles), squeeze=False, sharey=True)[0]
    for axes, vehicle in zip(panels, vehicles, strict=True):
        _roofline_panel(axes, vehicle, model.knee_velocity_over_roof_ratio)
    panels[0].set_ylabel("safe velocity, m/s")
    panels[0].set_ylim(
        top=1.25 * max(own.roof_mps for vehicle in vehicles for _, own, _ in _flying(vehicle))
    )
    handles: dict[str, Any] = {}
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    legend_above(figure, handles.values(), handles)
    share = 100.0 * model.knee_velocity_over_roof_ratio
    figure.supxlabel(
        f"action throughput, Hz\n{model.model}; knee: {share:g} % of the roof", fontsize=9
    )
    return figure


def _roofline_panel(axes: Axes, vehicle: VehicleReport, share: float) -> None:
    from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

    flying = {row.boards: own for row, own, _ in reversed(_flying(vehicle))}
    point: Look = {"markeredgecolor": INK, "linestyle": "none"}
    for copies, own in sorted(flying.items()):
        colour = SCHEMES[_OF_COPIES[copies]]
        axes.plot(
            vehicle.curves.throughput_hz, vehicle.curves.velocity_mps[copies], color=colour,
            linewidth=1.8, label=_LABELS[copies],
        )  # fmt: skip
        axes.axhline(own.roof_mps, color=colour, linewidth=0.8, linestyle=DASHED)
        axes.plot(own.knee_hz, share * own.roof_mps, "D", markersize=5, color=colour,
                  markeredgewidth=0.6, **point)  # fmt: skip
        axes.plot(own.throughput_hz, own.velocity_mps, "o", markersize=7, color=colour, **point)
    axes.plot([], [], "D", color="white", markeredgecolor=INK, markersize=5, label="knee")
    axes.plot([], [], "o", color="white", markeredgecolor=INK, markersize=7, label="flies here")
    axes.plot([], [], color=NOTE, linewidth=0.8, label="roof", linestyle=DASHED)
    axes.plot([], [], color=INK, linewidth=1.0, linestyle=":", label="ceiling of one board")
    own = flying[1]
    (sensor_hz,) = (row.value for row in vehicle.parameters if row.parameter == "sensor_hz")
    label = [f"one board\nroof {own.roof_mps:.2f} m/s, knee {own.knee_hz:.1f} Hz"]
    for name, at_hz, ceiling in (
        ("sensor", sensor_hz, own.sensor_ceiling_mps),
        ("compute", own.compute_hz, own.compute_ceiling_mps),
    ):
        if at_hz < own.knee_hz:
            axes.hlines(ceiling, at_hz, _MOST_HZ, color=INK, linewidth=1.0, linestyle=":")
            label.append(f"{name} ceiling {ceiling:.2f} m/s at {at_hz:.3g} Hz")
    axes.text(
        0.98, 0.04, "\n".join(label), transform=axes.transAxes, ha="right", va="bottom",
        fontsize=8, color=NOTE,
    )  # fmt: skip
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlim(vehicle.curves.throughput_hz[0], _MOST_HZ)
    axes.xaxis.set_major_formatter(FormatStrFormatter("%g"))
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(FormatStrFormatter("%g"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.grid(color="#e6e9ee", linewidth=0.6)
    heavy = any(row.boards == 3 and row.problem for row in vehicle.schemes)
    title = f"{vehicle.vehicle}, board {vehicle.board}: {own.bound} bound"
    open_frame(axes, title + ("; TMR cannot be lifted" if heavy else ""))


# Cost of redundancy: flight time and energy over detection and recovery ---------------------------

_COSTS = (("flight_time_ratio", "flight time"), ("energy_ratio", "energy"))
_COST_WIDTH = 0.15


def _draw_redundancy(model: ModelReport) -> Figure:
    """Draw flight time and energy of each scheme over the reference, with a panel per vehicle."""
    vehicles = model.vehicles
    figure = new_figure(max(6.8, 4.6 * len(vehicles)), 4.2)
    panels = figure.subplots(1, len(vehicles), squeeze=False)[0]
    captions = [f"{model.model}; flights of {model.distance_m:g} m at the safe velocity"]
    for axes, vehicle in zip(panels, vehicles, strict=True):
        _cost_panel(axes, vehicle)
        if any(parameter.calibrated for parameter in vehicle.parameters):
            own = vehicle.calibrations[0]
            captions.append(
                f"{vehicle.vehicle}: {own.parameter} = {own.value:.4g} {own.unit} is "
                f"calibrated on the paper's TMR flight time x {own.published_tmr_ratio:g}"
            )
    panels[0].set_ylabel("times that with detection (autoencoder)")
    handles, labels = panels[0].get_legend_handles_labels()
    legend_above(figure, handles, labels, ncols=len(labels))
    figure.supxlabel("\n".join(captions), fontsize=7.5, color=NOTE)
    return figure


def _cost_panel(axes: Axes, vehicle: VehicleReport) -> None:
    rows, highest = vehicle.schemes, 0.0
    for number, row in enumerate(rows):
        heights = [getattr(row.ratios, field, None) for field, _ in _COSTS]  # None: too heavy
        bars = axes.bar(
            [_beside(place, number, len(rows), _COST_WIDTH) for place in range(len(_COSTS))],
            [height or 0.0 for height in heights], width=0.92 * _COST_WIDTH,
            color=SCHEMES[row.scheme], label=row.title,
        )  # fmt: skip
        for bar, height in zip(bars, heights, strict=True):
            text = "cannot be lifted" if height is None else f"{height:.2f}"
            look = {"va": "bottom", "fontsize": 7.5, "rotation": 90.0 if height is None else 0.0}
            note_at(axes, text, (bar.get_x() + bar.get_width() / 2, height or 0.0), 2, **look)
            highest = max(highest, height or 0.0)
    axes.axhline(1.0, color=INK, linewidth=0.7, linestyle=DASHED)
    axes.set_xticks(range(len(_COSTS)), [title for _, title in _COSTS])
    axes.set_ylim(0.0, 1.12 * highest)
    open_frame(axes, f"{vehicle.vehicle}, board {vehicle.board}")


def _beside(place: float, number: int, count: int, width: float) -> float:
    """Return the centre of bar `number` of `count` bars, which are centred on `place`."""
    return place + (number - (count - 1) / 2) * width


# Model against flight: velocity, flight time and energy of every scheme ---------------------------

_STEP = 0.17
_UPRIGHT: Look = {"va": "bottom", "fontsize": 7, "rotation": 90.0}


def draw_flights(flights: FlightsReport) -> Figure:
    """Draw the flights of each vehicle beside the model's predictions, one row per vehicle.

    Velocities are on the left, and ratios to the reference scheme on the right. A diamond marks the
    model. A bar shows the flights with their 95 % interval over missions.
    """
    vehicles = flights.vehicles
    figure = new_figure(9.6, 1.0 + 3.1 * len(vehicles))
    panels = figure.subplots(
        len(vehicles), 2, squeeze=False, gridspec_kw={"width_ratios": (1.0, 1.7)}
    )
    for (left, right), vehicle in zip(panels, vehicles, strict=True):
        _velocities(left, vehicle)
        _ratio_panel(right, vehicle, flights.ratios_over)
        for axes in (left, right):
            axes.tick_params(labelsize=8)
    first = panels[0][0]
    handles = [
        first.bar(0, 0, color=SCHEMES[row.scheme], label=row.title) for row in vehicles[0].schemes
    ]
    handles += first.plot([], [], "D", color="white", markeredgecolor=INK, markersize=5,
                          label="model")  # fmt: skip
    handles += first.plot([], [], "_", color=INK, markersize=9, label="top of a flight")
    legend_above(figure, handles=handles)
    figure.supxlabel(
        f"bars: means of successful flights in {', '.join(flights.worlds)}, "
        f"{flights.missions_each} missions each; whiskers: 95 % intervals over missions; "
        "ratios: over the same missions",
        fontsize=7.5, color=NOTE,
    )  # fmt: skip
    return figure


def _velocities(axes: Axes, vehicle: FlownVehicle) -> None:
    highest = 0.0
    for place, row in enumerate(vehicle.schemes):
        own = row.flown
        _bar(axes, place, 0.7, row, None if own is None else own.velocity_mps)
        if own is None:
            continue
        top = own.top_velocity_mps.flights.value
        axes.plot(place, top, "_", color=INK, markersize=12)
        highest = max(highest, own.velocity_mps.model, 0.0 if math.isnan(top) else top)
        text = f"{100 * own.success.share:.0f} % of {own.success.total} succeed"
        note_at(axes, text, (place, 0.0), 3, **_UPRIGHT)
    axes.set_xticks(range(len(vehicle.schemes)), [row.scheme for row in vehicle.schemes])
    axes.set_ylim(0.0, 1.12 * highest or 1.0)
    axes.set_ylabel("mean velocity, m/s", fontsize=8.5)
    open_frame(axes, f"{vehicle.vehicle}, board {vehicle.board}")


def _ratio_panel(axes: Axes, vehicle: FlownVehicle, reference: str) -> None:
    rows = vehicle.schemes
    for number, row in enumerate(rows):
        for place, (_, field) in enumerate(_RATIOS):
            ratio = None if row.over_none is None else attrgetter(field)(row)
            _bar(axes, _beside(place, number, len(rows), _STEP), 0.9 * _STEP, row, ratio)
    axes.axhline(1.0, color=INK, linewidth=0.7, linestyle=DASHED)
    axes.set_xticks(range(len(_RATIOS)), [title for title, _ in _RATIOS])
    axes.set_ylabel(f"times that with {reference}", fontsize=8.5)
    axes.set_ylim(bottom=0.0)
    open_frame(axes, f"{vehicle.vehicle}: ratios, model and flight")


def _bar(
    axes: Axes, place: float, width: float, row: FlownScheme, number: ModelAndFlights | None
) -> None:
    """Draw the flights' number as a bar, and the model's as a diamond.

    Args:
        number: None if the scheme was not flown.
    """
    if number is None:
        note_at(axes, "not flown", (place, 0.0), 3, **{**_UPRIGHT, "color": NOTE})
        return
    flights = number.flights
    if not math.isnan(flights.value):
        axes.bar(place, flights.value, width=width, color=SCHEMES[row.scheme])
        ends = (flights.low, flights.high)
        whisker(axes, place, flights.value, ends, ecolor=NOTE, elinewidth=1.0, capsize=2.0)
    axes.plot(place, number.model, "D", color="white", markeredgecolor=INK, markersize=5)


MODEL_PICTURES: Mapping[str, Callable[[ModelReport], Figure]] = {
    "roofline.svg": _draw_roofline,
    "redundancy.svg": _draw_redundancy,
}
"""The functions that draw the pictures of the model, keyed by file name."""
