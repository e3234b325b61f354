"""The figure of each item, from the same flights as its table."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from mavfi_cli.analysis.pairs import PERCENT, STAGES, Flights
from mavfi_cli.analysis.trajectories import pair
from mavfi_cli.campaigns.ledger import Ledger
from mavfi_cli.core.errors import RecordError
from mavfi_cli.paper.items import printed
from mavfi_cli.paper.layouts import KERNELS_FLOWN, PROTECTED, values_and_deltas
from mavfi_cli.report.paper import (
    DETECTOR_TITLES,
    SMALLEST,
    WIDTHS_IN,
    PaperTable,
    Strip,
    draw_dots,
    draw_histograms,
    draw_stack,
    draw_strips,
)
from mavfi_cli.report.top_view import Trajectories

if TYPE_CHECKING:
    from matplotlib.figure import Figure

OVER_GOLDEN = "flight time over the golden flight of the same mission, %"
_Row = tuple[
    str, str | None, Flights, float | None
]  # label, detector, flights, the paper's longest
_Drawing = Callable[[Flights, str], "Figure"]
_STYLES = {None: 1, "gad": 2, "aad": 3}  # index into the palette, by detector
_NOTHING = "cannot draw the figure, because none of its missions has flown yet"


def draw(table: PaperTable, flights: Flights | None, columns: str) -> Figure:
    """Draw an item's figure from its flights, or from its table if it has no drawing of flights.

    Args:
        flights: the item's flights; None for an item without flights. `fig11` and `fig13` read
            their run folders; those for `fig13` must belong to one campaign.
        columns: width, `one` or `two`.

    Raises:
        RecordError: there are no rows or flights to draw, or no run folder was kept.
    """
    if not table.rows or (flights is not None and not len(flights)):
        raise RecordError(_NOTHING)
    if flights is None or table.name not in DRAWN:
        return (draw_stack if table.name == "fig6" else draw_dots)(table, columns)
    return DRAWN[table.name](flights, columns)


def panel(rows: Iterable[_Row]) -> list[Strip]:
    """Return a strip for each row, with the increases in its flight times in per cent.

    An increase is relative to the golden flight of the same mission.
    """
    return [
        Strip(label=label, values=flights.increases, style=_STYLES[detector], paper=paper)
        for label, detector, flights, paper in rows
    ]


def _number(name: str, *keys: object) -> float | None:
    number = printed(name, *keys)
    return number if isinstance(number, float) else None


def _strips(panels: Callable[[Flights], Mapping[str, list[_Row]]]) -> _Drawing:
    def draw_panels(flights: Flights, columns: str) -> Figure:
        strips = {title: panel(rows) for title, rows in panels(flights).items()}
        if not any(strips.values()):
            raise RecordError(_NOTHING)
        return draw_strips(strips, OVER_GOLDEN, columns)

    return draw_panels


def _fig7(flights: Flights) -> dict[str, list[_Row]]:
    struck = flights.faulty(level="instruction")
    return {"fault in": [
        (title, None, struck.chosen(fault_target=node, planner=planner), None)
        for title, (node, planner) in KERNELS_FLOWN.items()
    ]}  # fmt: skip


def _by_value(column: str) -> _Drawing:
    return _strips(
        lambda flights: {
            "fault in": [
                (str(x), None, mine, None) for (x,), mine in flights.faulty().by(column).items()
            ]
        }
    )


def _beside_detectors(flights: Flights, paper: float | None) -> list[_Row]:
    return [
        ("fault", None, flights.faulty(), paper),
        *((f"fault, {x.upper()}", x, flights.faulty(x), None) for x in DETECTOR_TITLES),
    ]


def _fig12(flights: Flights) -> dict[str, list[_Row]]:
    alike = flights.comparable.shared("world")
    return {
        world: _beside_detectors(
            alike.chosen(world=world), _number("fig12", "worst_increase_percent", world)
        )
        for world in alike.worlds
    }


def _fig14(flights: Flights) -> dict[str, list[_Row]]:
    """Return the rows of each world's panel, keyed by world.

    The paper's number in a row is the part of its worst increase that is not recovered.
    """
    panels: dict[str, list[_Row]] = {}
    for world in flights.worlds:
        here = flights.chosen(world=world)
        worst = _number("fig12", "worst_increase_percent", world)
        panels[world] = [("no protection", None, here.faulty(), worst)]
        for name in DETECTOR_TITLES:
            for stages in PROTECTED:
                share = _number("fig14", "recovered_percent", name, world, stages)
                left = worst * (1.0 - share / PERCENT) if worst and share else None
                mine = here.faulty(name, protect=stages)
                panels[world].append((f"{name.upper()} {_short(stages)}", name, mine, left))
    return panels


def _short(stages: str) -> str:
    """Abbreviate protected stages as the paper does."""
    if stages in STAGES:
        return stages
    return "".join(stage[0].upper() for stage in stages.split("+"))


def _fig16(flights: Flights) -> dict[str, list[_Row]]:
    panels = {}
    for (platform,), mine in flights.by("platform").items():
        ratio = _number("fig16", "worst_ratio", platform)
        worst = None if ratio is None else PERCENT * (ratio - 1.0)
        panels[platform] = _beside_detectors(mine, worst)
    return panels


def _fig11(flights: Flights, columns: str) -> Figure:
    by_state = values_and_deltas(flights.golden)
    return draw_histograms([(name, *both) for name, both in by_state.items()], columns)


def _fig13(flights: Flights, columns: str) -> Figure:
    """Draw the top view of the pair whose flight time grows most."""
    kept = [Path(path) for path in flights["path"] if path]
    if not kept:
        raise RecordError("fig13 requires run folders, but none were kept; fly with --keep all")
    with Ledger(kept[0].parents[1]) as ledger:
        flown = Trajectories.of(pair(ledger, among=frozenset(flights["number"])))
    figure = flown.draw(across=1 if columns == "one" else 2)
    for axes in figure.axes:  # room for the legend below the smaller panel
        axes.tick_params(labelsize=SMALLEST, pad=1)
        axes.set_xlabel(axes.get_xlabel(), fontsize=SMALLEST, labelpad=0)
        axes.set_ylabel(axes.get_ylabel(), fontsize=SMALLEST, labelpad=0)
    width, height = figure.get_size_inches()
    figure.set_size_inches(WIDTHS_IN[columns], height * WIDTHS_IN[columns] / width + 0.6)
    return figure


DRAWN: Mapping[str, _Drawing] = {
    "fig7": _strips(_fig7),
    "fig8": _by_value("fault_target"),
    "fig9": _by_value("fault_field"),
    "fig11": _fig11,
    "fig12": _strips(_fig12),
    "fig13": _fig13,
    "fig14": _strips(_fig14),
    "fig16": _strips(_fig16),
}
