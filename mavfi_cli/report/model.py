"""The performance model and its flights as text, CSV and pictures; every number with its unit."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from mavfi_cli.mission.measures import HOST_CHECKS
from mavfi_cli.report.columns import columns, csv_text, formed, wrapped
from mavfi_cli.report.drawing import (
    INK,
    NOTE,
    SCHEMES,
    legend_above,
    new_figure,
    note_at,
    open_frame,
    whisker,
)
from mavfi_cli.vpm.report import RATIOS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def model_lines(told: Mapping[str, Any]) -> list[str]:
    """The lines that are printed: the model's, and below them those of its flights, if any."""
    lines = [
        f"Model {told['model']}; knee: where velocity is "
        f"{100 * told['knee_velocity_over_roof_ratio']:g} % of the roof",
        f"Flights of {told['distance_m']:g} m at the safe velocity and hovering power; ratios "
        f"are over {told['ratios_over']}",
    ]
    lines += [f"Note: {note}" for note in told["notes"]]
    for one in told["vehicles"]:
        lines += ["", *_vehicle(one, told["ratios_over"])]
    return [*lines, *(_flight_lines(told["flights"]) if "flights" in told else [])]


def model_csv(told: Mapping[str, Any]) -> str:
    """CSV text of the model or of its flights, one row per vehicle and scheme.

    The header names the units.
    """
    distance = {"distance_m": told["distance_m"]} if "distance_m" in told else {}
    return csv_text(
        {"vehicle": one["vehicle"], "board": one["board"], **distance}
        | {name: "; ".join(cell) if isinstance(cell, list) else cell for name, cell in row.items()
           if name != "outcomes"}
        for one in told["vehicles"]
        for row in one["schemes"]
    )  # fmt: skip


def _vehicle(one: Mapping[str, Any], over: str) -> Iterator[str]:
    title = f": {one['description']}" if one["description"] else ""
    yield f"== {one['vehicle']}{title}; board {one['board']} =="
    yield from (f"Note: {note}" for note in one["notes"])
    flying = [row for row in one["schemes"] if row["problem"] is None]
    yield from formed(
        flying, ("scheme", "{scheme}"), ("boards", "{boards}"), ("compute", "{compute_kg:.3f} kg"),
        ("mass", "{mass_kg:.3f} kg"), ("thrust/weight", "{thrust_to_weight:.2f} N/N"),
        ("acceleration", "{acceleration_mps2:.2f} m/s²"), ("roof", "{roof_mps:.2f} m/s"),
        ("knee", "{knee_hz:.1f} Hz"),
    )  # fmt: skip
    yield ""
    yield from formed(
        flying, ("scheme", "{scheme}"), ("overhead", "{overhead_percent:.4g} %"),
        ("throughput", "{throughput_hz:.3f} Hz"), ("velocity", "{velocity_mps:.3f} m/s"),
        ("bound by", "{bound}"), ("sensor ceiling", "{sensor_ceiling_mps:.2f} m/s"),
        ("compute ceiling", "{compute_ceiling_mps:.2f} m/s"),
    )  # fmt: skip
    yield ""
    heads = ("velocity", "time", "energy", "missions")
    ratios = ((head, f"x {{{name}:.4f}}") for head, name in zip(heads, RATIOS, strict=True))
    yield from formed(
        ({**row, "energy_kj": row["energy_j"] / 1000} for row in flying),
        (f"over {over}", "{scheme}"), *ratios, ("flight time", "{flight_time_s:.1f} s"),
        ("power", "{power_w:.1f} W"), ("energy", "{energy_kj:.2f} kJ"),
        ("a charge", "{missions:.1f} missions"),
    )  # fmt: skip
    for row in one["schemes"]:
        if row["problem"] is not None:
            yield f"{row['scheme']}: {row['problem']}"
    yield from _sensitivity(one["sensitivity"])
    yield from _calibrations(one["calibrations"])
    yield from _sources(one)


def _sensitivity(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    yield ""
    yield "Sensitivity: velocity with detection and recovery; flight time with TMR over it"
    for row in rows:
        slopes = [row["velocity_elasticity_ratio"], row["tmr_time_elasticity_ratio"]]
        told = ["-" if slope is None else f"{slope:+.3f} %" for slope in slopes]
        yield (
            f"  {row['parameter']} {row['value']:.4g} {row['unit']}; 1 % more: velocity {told[0]}, "
            f"TMR's time ratio {told[1]}"
        )
        yield from columns(_point(point, row["unit"]) for point in row["points"])


def _point(point: Mapping[str, Any], unit: str) -> list[str]:
    velocity, ratio = point["velocity_mps"], point["tmr_flight_time_ratio"]
    return [
        f"    {point['value']:.4g} {unit}",
        "cannot lift it" if velocity is None else f"{velocity:.3f} m/s",
        "TMR cannot be lifted" if ratio is None else f"x {ratio:.4f}",
    ]


def _calibrations(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    if not rows:
        return
    yield ""
    yield "Paper, Fig. 15, flight time over detection and recovery; one number is calibrated:"
    yield from formed(
        ({**row, "board_g": 1000 * row["board_kg"]} for row in rows),
        ("  board", "  {board}"), ("a copy", "{board_g:.0f} g"),
        ("calibrated", "{parameter} = {value:.4g} {unit}"), ("TMR", "x {tmr_ratio:.4f}"),
        ("paper's TMR", "x {published_tmr_ratio:g}"),
        ("DMR, predicted", "x {predicted_dmr_ratio:.4f}"),
    )  # fmt: skip


def _sources(one: Mapping[str, Any]) -> Iterator[str]:
    yield ""
    rows = [["number", "value", "source"]]
    rows += [
        [row["parameter"], f"{row['value']:.5g} {row['unit']}", row["source"]]
        for row in one["parameters"]
    ]
    rows += [
        [f"scheme {row['scheme']}", f"{row['overhead_percent']:.4g} %", row["source"]]
        for row in one["schemes"]
    ]
    yield from wrapped(rows)


# Beside flights -----------------------------------------------------------------------------------

_MANY_ALARMS = 10.0  # alarms of an error-free flight; more is not the detector's usual rate
_NUMBERS = (  # heading, name, unit in the key, format, factor
    ("Mean velocity against the model's safe velocity", "velocity", "_mps", "{:.2f} m/s", 1.0),
    ("Top velocity against it", "top_velocity", "_mps", "{:.2f} m/s", 1.0),
    ("Flight time", "flight_time", "_s", "{:.1f} s", 1.0),
    ("Energy of rotors and boards", "energy", "_j", "{:.2f} kJ", 1.0e-3),
    ("Response time, median", "response", "_s", "{:.3f} s", 1.0),
)
_RATIOS = (("velocity", "Velocity"), ("flight_time", "Flight time"), ("energy", "Energy"))


def _flight_lines(flights: Mapping[str, Any]) -> list[str]:
    lines = [
        "",
        f"Flights in {', '.join(flights['worlds'])}: {flights['missions_each']} missions a scheme "
        f"and world, seeds from {flights['first_seed']}, stack {flights['stack']}",
        "Numbers are of successful flights, (low to high) are 95 % intervals over missions",
        f"Detectors: {flights['detectors']}",
    ]
    for one in flights["vehicles"]:
        lines += ["", *_flown(one, flights)]
    lines += ["", *_overheads(flights["overheads"]), "", "What the flights do not scale:"]
    return [*lines, *wrapped(["", text] for text in flights["not_scaled"])]


def _flown(one: Mapping[str, Any], flights: Mapping[str, Any]) -> Iterator[str]:
    yield f"== {one['vehicle']} flown, board {one['board']} =="
    rows = [row for row in one["schemes"] if row["problem"] is None]
    ends = (", ".join(f"{count} {name}" for name, count in row["outcomes"].items()) for row in rows)
    yield from formed(
        ({**row, "ends": told} for row, told in zip(rows, ends, strict=True)),
        ("scheme", "{scheme}"), ("mass", "{mass_kg:.3f} kg"), ("v-max", "{v_max_mps:.3f} m/s"),
        ("a-max", "{a_max_mps2:.2f} m/s²"), ("safe, braking", "{braking_velocity_mps:.3f} m/s"),
        ("success", "{success_percent:.0f} % ({success_low_percent:.0f} to "
                    "{success_high_percent:.0f} %)"),
        ("ends", "{ends}"),
    )  # fmt: skip
    for heading, name, key, form, factor in _NUMBERS:
        yield from _beside(heading, rows, name, key, form, factor)
    yield ""
    yield "Why flights take longer than the model says:"
    yield from columns([["scheme", "path", "pace", "replans", "alarms"], *(_why(r) for r in rows)])
    over, paper = flights["ratios_over"], flights["paper_ratios_over"]
    for name, title, suffix in (
        *((name, f"{title} over {over}", "") for name, title in _RATIOS),
        ("flight_time", f"Flight time over {paper}, as the paper's Fig. 15", f"_over_{paper}"),
    ):
        told = [row for row in rows if f"pairs{suffix}" in row]
        yield from _beside(title, told, f"{name}{suffix}", "_ratio", "x {:.4f}", pairs=suffix)
    for row in one["schemes"]:
        yield from _remarks(row)


def _beside(
    heading: str,
    rows: Sequence[Mapping[str, Any]],
    name: str,
    key: str,
    form: str,
    factor: float = 1.0,
    pairs: str | None = None,
) -> Iterator[str]:
    """A number of the model beside that of its flights.

    Args:
        key: unit, as in the names of the row's fields.
        pairs: suffix of the field that counts the pairs of a ratio; None of what is no ratio.
    """
    lines = [["scheme", "model", "flight", "", "flight against model"]]
    for row in rows:
        model, flight, low, high = (
            factor * row[f"{which}{key}"]
            for which in (f"model_{name}", f"flight_{name}", f"flight_{name}_low",
                          f"flight_{name}_high")
        )  # fmt: skip
        if pairs is None:
            number, _, unit = form.partition(" ")
            ends = f"({number.format(low)} to {number.format(high)} {unit})"
            ends, difference = _known(ends, low, ""), f"{name}_difference_percent"
        else:
            ends = _known(f"{form.format(low)} to {form.format(high)}, ", low, "")
            ends = f"({ends}{row[f'pairs{pairs}']} pairs)"
            difference = f"{name}_ratio_difference_percent"
        told = (_known(form.format(each), each) for each in (model, flight))
        lines.append([row["scheme"], *told, ends, _known(f"{row[difference]:+.1f} %", flight)])
    yield from ["", f"{heading}:", *columns(lines)]


def _why(row: Mapping[str, Any]) -> list[str]:
    pace = row["model_velocity_mps"] / row["flight_velocity_mps"]
    alarms = row["flight_alarms"]
    return [
        row["scheme"],
        _known(f"x {row['flight_path_ratio']:.3f} longer", row["flight_path_ratio"]),
        _known(f"x {pace:.3f} slower", pace),
        _known(f"{row['flight_replans']:.1f} a flight", row["flight_replans"]),
        "no detector" if alarms != alarms else f"{alarms:.1f} a flight",
    ]


def _known(text: str, value: float, otherwise: str = "-") -> str:
    """The text of a value, if it has one: without successful flights there is none."""
    return otherwise if math.isnan(value) else text


def _remarks(row: Mapping[str, Any]) -> Iterator[str]:
    if row["problem"] is not None:
        yield f"{row['scheme']}: not flown: {row['problem']}"
        return
    if row["overhead_percent"]:
        yield (
            f"{row['scheme']}: an overhead of {row['overhead_percent']:.4g} % in its flights and "
            "in the model beside them"
        )
    if row["flight_alarms"] >= _MANY_ALARMS:
        yield (
            f"{row['scheme']}: {row['flight_alarms']:.0f} alarms in a flight without a fault: its "
            "model was fitted to other flights; --train fits one to these"
        )
    if row["cut"]:
        yield f"{row['scheme']}: flown with {', '.join(row['cut'])}"
    if row["errors"]:
        many = len(row["errors"])
        yield f"{row['scheme']}: {many} could not begin, the first: {row['errors'][0]}"


def _overheads(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    if not rows:
        yield "Overhead of detection and recovery: no flight with a detector"
        return
    yield "Overhead of detection and recovery, of the kernels' time on the flights' platform:"
    yield from formed(
        rows, ("detector", "{detector}"), ("measured", "{measured_percent:.4g} %"),
        ("of it checks", "{checks_percent:.4g} %"), ("paper", "{paper_percent:.4g} %"),
        ("recomputations", "{alarms} in {flights} flights"),
        ("checks of this host's kernel time", "{checks_of_host_kernels_percent:.4g} %"),
    )  # fmt: skip
    yield f"({HOST_CHECKS})"


# Pictures -----------------------------------------------------------------------------------------

# Roofline: safe velocity against action throughput -----------------------------------------------

_OF_COPIES = {1: "none", 2: "dmr", 3: "tmr"}
_MOST_HZ = 1000.0
_LABELS = {1: "one board", 2: "two boards (DMR)", 3: "three boards (TMR)"}


def _draw_roofline(report: Mapping[str, Any]) -> Figure:
    """Draw a figure with throughput in Hz and velocity in m/s on logarithmic axes."""
    vehicles = report["vehicles"]
    figure = new_figure(max(6.4, 4.9 * len(vehicles)), 4.9)
    panels = figure.subplots(1, len(vehicles), squeeze=False, sharey=True)[0]
    for axes, one in zip(panels, vehicles, strict=True):
        _roofline_panel(axes, one, report["knee_velocity_over_roof_ratio"])
    panels[0].set_ylabel("safe velocity, m/s")
    panels[0].set_ylim(top=1.25 * max(row["roof_mps"] or 0.0 for one in vehicles
                                      for row in one["schemes"]))  # fmt: skip
    handles: dict[str, Any] = {}
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    legend_above(figure, handles.values(), handles)
    share = 100.0 * report["knee_velocity_over_roof_ratio"]
    figure.supxlabel(
        f"action throughput, Hz\n{report['model']}; knee: {share:g} % of the roof", fontsize=9
    )
    return figure


def _roofline_panel(axes: Axes, one: Mapping[str, Any], share: float) -> None:
    flying = {row["boards"]: row for row in reversed(one["schemes"]) if row["problem"] is None}
    for copies in sorted(flying):
        row, colour = flying[copies], SCHEMES[_OF_COPIES[copies]]
        curve = one["curves"]["velocity_mps"][str(copies)]
        axes.plot(
            one["curves"]["throughput_hz"], curve, color=colour, linewidth=1.8,
            label=_LABELS[copies],
        )  # fmt: skip
        axes.axhline(row["roof_mps"], color=colour, linewidth=0.8, linestyle=(0, (5, 3)))
        axes.plot(
            row["knee_hz"], share * row["roof_mps"], marker="D", markersize=5,
            color=colour, markeredgecolor=INK, linestyle="none", markeredgewidth=0.6,
        )  # fmt: skip
        axes.plot(
            row["throughput_hz"], row["velocity_mps"], marker="o", markersize=7, color=colour,
            markeredgecolor=INK, linestyle="none",
        )  # fmt: skip
    axes.plot([], [], "D", color="white", markeredgecolor=INK, markersize=5, label="knee")
    axes.plot([], [], "o", color="white", markeredgecolor=INK, markersize=7, label="flies here")
    axes.plot([], [], color=NOTE, linewidth=0.8, linestyle=(0, (5, 3)), label="roof")
    axes.plot([], [], color=INK, linewidth=1.0, linestyle=":", label="ceiling of one board")
    _ceilings(axes, one, flying[1])
    _log_axes(axes, one)


def _ceilings(axes: Axes, one: Mapping[str, Any], row: Mapping[str, Any]) -> None:
    sensor_hz = next(p["value"] for p in one["parameters"] if p["parameter"] == "sensor_hz")
    label = [f"one board\nroof {row['roof_mps']:.2f} m/s, knee {row['knee_hz']:.1f} Hz"]
    for name, at_hz, ceiling in (
        ("sensor", sensor_hz, row["sensor_ceiling_mps"]),
        ("compute", row["compute_hz"], row["compute_ceiling_mps"]),
    ):
        if at_hz < row["knee_hz"]:
            axes.hlines(ceiling, at_hz, _MOST_HZ, color=INK, linewidth=1.0, linestyle=":")
            label.append(f"{name} ceiling {ceiling:.2f} m/s at {at_hz:.3g} Hz")
    axes.text(
        0.98, 0.04, "\n".join(label), transform=axes.transAxes, ha="right", va="bottom",
        fontsize=8, color=NOTE,
    )  # fmt: skip


def _log_axes(axes: Axes, one: Mapping[str, Any]) -> None:
    from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlim(one["curves"]["throughput_hz"][0], _MOST_HZ)
    axes.xaxis.set_major_formatter(FormatStrFormatter("%g"))
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(FormatStrFormatter("%g"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.grid(color="#e6e9ee", linewidth=0.6)
    tmr = next((row for row in one["schemes"] if row["boards"] == 3), None)
    heavy = "; TMR cannot be lifted" if tmr is not None and tmr["problem"] else ""
    bound = next(row["bound"] for row in one["schemes"] if row["boards"] == 1)
    open_frame(axes, f"{one['vehicle']}, board {one['board']}: {bound} bound{heavy}")


# Cost of redundancy: flight time and energy over detection and recovery ---------------------------

_QUANTITIES = (("flight_time_ratio", "flight time"), ("energy_ratio", "energy"))
_COST_WIDTH = 0.15


def _draw_redundancy(report: Mapping[str, Any]) -> Figure:
    """Draw a figure with a panel per vehicle, a bar per scheme and ratios to the reference."""
    vehicles = report["vehicles"]
    figure = new_figure(max(6.8, 4.6 * len(vehicles)), 4.2)
    panels = figure.subplots(1, len(vehicles), squeeze=False)[0]
    for axes, one in zip(panels, vehicles, strict=True):
        _cost_panel(axes, one)
    panels[0].set_ylabel("times that with detection (autoencoder)")
    handles, labels = panels[0].get_legend_handles_labels()
    legend_above(figure, handles, labels, ncols=len(labels))
    figure.supxlabel(_cost_caption(report), fontsize=7.5, color=NOTE)
    return figure


def _cost_panel(axes: Axes, one: Mapping[str, Any]) -> None:
    rows = one["schemes"]
    highest = max(row[key] or 0.0 for row in rows for key, _ in _QUANTITIES)
    for number, row in enumerate(rows):
        places = [k + (number - (len(rows) - 1) / 2) * _COST_WIDTH for k in range(len(_QUANTITIES))]
        heights = [row[key] for key, _ in _QUANTITIES]
        axes.bar(
            places, [height or 0.0 for height in heights], width=0.92 * _COST_WIDTH,
            color=SCHEMES[row["scheme"]], label=row["title"],
        )  # fmt: skip
        for place, height in zip(places, heights, strict=True):
            told = "cannot be lifted" if height is None else f"{height:.2f}"
            look = {"va": "bottom", "fontsize": 7.5, "rotation": 90.0 if height is None else 0.0}
            note_at(axes, told, (place, height or 0.0), 2, **look)
    axes.axhline(1.0, color=INK, linewidth=0.7, linestyle=(0, (5, 3)))
    axes.set_xticks(range(len(_QUANTITIES)), [title for _, title in _QUANTITIES])
    axes.set_ylim(0.0, 1.12 * highest)
    open_frame(axes, f"{one['vehicle']}, board {one['board']}")


def _cost_caption(report: Mapping[str, Any]) -> str:
    lines = [f"{report['model']}; flights of {report['distance_m']:g} m at the safe velocity"]
    for one in report["vehicles"]:
        if any(row["calibrated"] for row in one["parameters"]):
            found = one["calibrations"][0]
            lines.append(
                f"{one['vehicle']}: {found['parameter']} = {found['value']:.4g} {found['unit']} is "
                f"calibrated on the paper's TMR flight time x {found['published_tmr_ratio']:g}"
            )
    return "\n".join(lines)


# Model against flight: velocity, flight time and energy of every scheme ---------------------------

_FLOWN_RATIOS = (("velocity", "velocity"), ("flight_time", "flight time"), ("energy", "energy"))
_STEP = 0.17
_UPRIGHT: Mapping[str, Any] = {"va": "bottom", "fontsize": 7, "rotation": 90.0}


def _draw_flights(report: Mapping[str, Any]) -> Figure:
    """Draw a figure with a row per vehicle: velocities left, ratios to the reference right.

    A diamond marks the model. A bar shows the flights with their 95 % interval over missions.
    """
    flights = report["flights"]
    vehicles = flights["vehicles"]
    figure = new_figure(9.6, 1.0 + 3.1 * len(vehicles))
    panels = figure.subplots(
        len(vehicles), 2, squeeze=False, gridspec_kw={"width_ratios": (1.0, 1.7)}
    )
    for (left, right), one in zip(panels, vehicles, strict=True):
        _velocities(left, one)
        _ratios(right, one, flights["ratios_over"])
    handles = [
        panels[0][0].bar(0, 0, color=SCHEMES[row["scheme"]], label=row["title"])
        for row in vehicles[0]["schemes"]
    ]
    handles += panels[0][0].plot([], [], "D", color="white", markeredgecolor=INK, markersize=5,
                                 label="model")  # fmt: skip
    handles += panels[0][0].plot([], [], "_", color=INK, markersize=9, label="top of a flight")
    legend_above(figure, handles=handles)
    figure.supxlabel(
        f"bars: means of successful flights in {', '.join(flights['worlds'])}, "
        f"{flights['missions_each']} missions each; whiskers: 95 % intervals over missions; "
        "ratios: over the same missions",
        fontsize=7.5, color=NOTE,
    )  # fmt: skip
    return figure


def _velocities(axes: Axes, one: Mapping[str, Any]) -> None:
    highest = 0.0
    for place, row in enumerate(one["schemes"]):
        if row["problem"] is not None:
            _not_flown(axes, place)
            continue
        _bar(axes, place, 0.7, row, "velocity", "_mps")
        model, top = row["model_velocity_mps"], row["flight_top_velocity_mps"]
        axes.plot(place, top, "_", color=INK, markersize=12)
        highest = max(highest, model, 0.0 if math.isnan(top) else top)
        told = f"{row['success_percent']:.0f} % of {row['missions']} succeed"
        note_at(axes, told, (place, 0.0), 3, **_UPRIGHT)
    axes.set_xticks(range(len(one["schemes"])), [row["scheme"] for row in one["schemes"]])
    axes.set_ylim(0.0, 1.12 * highest or 1.0)
    axes.set_ylabel("mean velocity, m/s", fontsize=8.5)
    axes.tick_params(labelsize=8)
    open_frame(axes, f"{one['vehicle']}, board {one['board']}")


def _ratios(axes: Axes, one: Mapping[str, Any], reference: str) -> None:
    rows = one["schemes"]
    for number, row in enumerate(rows):
        for place, (name, _) in enumerate(_FLOWN_RATIOS):
            at = place + (number - (len(rows) - 1) / 2) * _STEP
            if f"model_{name}_ratio" in row:
                _bar(axes, at, 0.9 * _STEP, row, name, "_ratio")
            else:
                _not_flown(axes, at)
    axes.axhline(1.0, color=INK, linewidth=0.7, linestyle=(0, (5, 3)))
    axes.set_xticks(range(len(_FLOWN_RATIOS)), [title for _, title in _FLOWN_RATIOS])
    axes.set_ylabel(f"times that with {reference}", fontsize=8.5)
    axes.set_ylim(bottom=0.0)
    axes.tick_params(labelsize=8)
    open_frame(axes, f"{one['vehicle']}: ratios, model and flight")


def _bar(
    axes: Axes, place: float, width: float, row: Mapping[str, Any], name: str, unit: str
) -> None:
    flight, low, high = (row[f"flight_{name}{end}{unit}"] for end in ("", "_low", "_high"))
    if not math.isnan(flight):
        axes.bar(place, flight, width=width, color=SCHEMES[row["scheme"]])
        whisker(axes, place, flight, (low, high), ecolor=NOTE, elinewidth=1.0, capsize=2.0)
    axes.plot(
        place, row[f"model_{name}{unit}"], "D", color="white", markeredgecolor=INK, markersize=5
    )


def _not_flown(axes: Axes, place: float) -> None:
    note_at(axes, "not flown", (place, 0.0), 3, **{**_UPRIGHT, "color": NOTE})


PICTURES: Mapping[str, Callable[[Mapping[str, Any]], Figure]] = {
    "roofline.svg": _draw_roofline,
    "redundancy.svg": _draw_redundancy,
    "flights.svg": _draw_flights,
}
"""By the names of their files; the last shows flights."""
