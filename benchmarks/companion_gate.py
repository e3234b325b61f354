r"""Counts the flights of a user's companion that faults lose, with and without the gate.

    python benchmarks/companion_gate.py docs/results/mavsdk-gate.parquet
    python benchmarks/companion_gate.py docs/results/mavsdk-messages.parquet \
        --by label_persistence label_site

Reads exports of campaigns (`mavfi campaign export`) with golden flights, null faults, and faults in
instructions or messages. A fault struck if the record has its activation. It is dead if its process
ended, and silent if it was read and its process did not end. The others were neither read nor
overwritten within the instructions that mavfi follows. A process that a program has started
and that ends with an exit code is not dead if the flight succeeds, because the program ended
without an error. A flight is lost if it does not end in success. Intervals are Wilson's, 95 %; p is
that of Fisher's exact test. --by adds the lost flights by one column, or by several together, with
p corrected by Holm for the rows. With --whole, a flight that covers less than three quarters of the
median golden distance is lost, too.

Flights before 30 November 2026 do not record the end of a process that a program has started, such
as `mavsdk_server`, if the program fails at the same time. Such a fault therefore counts as dead if
its program failed. The program's output says that it lost the process in all 70 of these flights
whose output is kept.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from statistics import median

from exported import Row, arguments, cells, flown, lost, share

from mavfi_cli.stats.paired import holm
from mavfi_cli.stats.shares import wilson


def main() -> None:
    """Read the exports, and print the fault-free flights and the faults, each as a table."""
    parser = arguments(__doc__, by=[])
    parser.add_argument("--whole", action="store_true", help="short flights are lost, too")
    options = parser.parse_args()
    rows = flown(options.parts)
    if options.whole:
        rows = [*_short_are_lost(rows)]
    null = [row for row in rows if row.get("label_null")]
    golden = [row for row in rows if row["injected"] == "golden"]
    plain, gated = ([row for row in golden if bool(row["detector"]) is on] for on in (False, True))
    print("| | succeeded | alarms |\n|---|---|---|")
    for name, part in (("golden", plain), ("golden, with the gate", gated), ("null faults", null)):
        alarms = _alarms(part) if part is gated else ""
        print(f"| {name} | {share(len(part) - sum(map(lost, part)), len(part))} | {alarms} |")

    drawn = [row for row in rows if row["injected"] != "golden" and not row.get("label_null")]
    sides = [[row for row in drawn if bool(row["detector"]) is on] for on in (False, True)]
    struck = [[row for row in side if row["activation"]] for side in sides]
    print("\n| | without the gate | with the gate | p (Fisher) |\n|---|---|---|---|")
    print(f"| drawn faults | {len(sides[0])} | {len(sides[1])} | |")
    _compare("faults that struck", [[*map(bool, side)] for side in struck], counts=True)
    _compare("lost", [[*map(lost, side)] for side in struck])
    _compare("dead", [[*map(_dead, side)] for side in struck], counts=True)
    for name, kind in (("dead", _dead), ("silent", _silent)):
        _compare(f"lost, of the {name}", [[*map(lost, filter(kind, side))] for side in struck])
    for name, kind in (("overwritten", _overwritten), ("others", _unknown)):
        _compare(f"lost, of the {name}", [[*map(lost, filter(kind, side))] for side in struck])
    alarmed = [row for row in struck[1] if row["alarm_count"]]
    print(f"\nAlarms in {len(alarmed)} of {len(struck[1])} struck flights with the gate, ", end="")
    print(f"of which {sum(map(lost, alarmed))} were lost.")
    failed = sum(not row["node_ended"] for side in struck for row in filter(_dead, side))
    print(f"{failed} of the dead count because their program failed.")
    if options.by:
        _by(options.by, struck)


def _short_are_lost(rows: list[Row]) -> Iterator[Row]:
    whole_m = median(row["distance_m"] for row in rows if row["injected"] == "golden")
    for row in rows:
        short = (row["distance_m"] or 0.0) < 0.75 * whole_m
        yield {**row, "outcome": "short"} if short and not lost(row) else row


def _by(names: Sequence[str], struck: list[list[Row]]) -> None:
    """Print the lost flights of both sides for each cell, with corrected tests."""
    print(f"\n| {' | '.join(names)} | without the gate | with the gate | p (Holm) |")
    print("|---" * (len(names) + 3) + "|")
    without, gated = (cells(side, names) for side in struck)
    places = sorted({*without, *gated})
    groups = [[[*map(lost, side.get(place, ()))] for side in (without, gated)] for place in places]
    for place, sides, p_value in zip(places, groups, holm([*map(_fisher, groups)]), strict=True):
        shares = " | ".join(share(sum(side), len(side)) for side in sides)
        print(f"| {' | '.join(place)} | {shares} | {p_value:.2g} |")


def _dead(row: Row) -> bool:
    child, ended = "/" in (row["label_site"] or ""), row["node_ended"] or ""
    if child and ended.startswith("ended with code") and not lost(row):
        return False
    return bool(ended or (child and "ended with code 1" in (row["reason"] or "")))


def _silent(row: Row) -> bool:
    return row["activation"] == "read" and not _dead(row)


def _overwritten(row: Row) -> bool:
    return bool(row["activation"] == "overwritten")


def _unknown(row: Row) -> bool:
    return row["activation"] not in ("read", "overwritten")


def _alarms(rows: list[Row]) -> str:
    """Return the number of flights with an alarm, and the time flown, as text."""
    hours = sum(row["flight_time_s"] or 0.0 for row in rows) / 3600.0
    return f"in {sum(bool(row['alarm_count']) for row in rows)} flights, {hours:.2f} h"


def _compare(name: str, sides: list[list[bool]], *, counts: bool = False) -> None:
    """Print a row with the counts of both sides, or their shares and the test of these."""
    hits, totals = [sum(side) for side in sides], [len(side) for side in sides]
    if counts:
        print(f"| {name} | {hits[0]} | {hits[1]} | |")
        return
    cells = " | ".join(share(*pair) for pair in zip(hits, totals, strict=True))
    print(f"| {name} | {cells} | {_fisher(sides):.2g} |")


def _fisher(sides: list[list[bool]]) -> float:
    without, gated = (wilson(sum(side), len(side)) for side in sides)
    return without.fisher(gated)


if __name__ == "__main__":
    main()
