r"""Counts how much of the harm that faults do is undone by detectors and other protections.

    python benchmarks/harm_undone.py docs/results/effects-part*.parquet \
        docs/results/protected*.parquet --arms label_detector

Reads exports of campaigns (`mavfi campaign export`). A fault is harmful if its unprotected flight
(no detector, the first stack) does not end in success, or takes more than 10 % longer than its own
golden flight. An arm is a combination of values of the columns `--arms`, such as one detector. All
arms flew the same faults in the same worlds.
'Recovered' counts lost missions that the arm saves. 'Undone' counts harmful faults whose flight
with the arm succeeds and takes at most 10 % longer than the golden flight. 'Broken' counts harmless
faults that do harm with the arm. Intervals are Wilson's, 95 %; two arms are compared on the faults
that both flew by McNemar's exact test.
"""

from __future__ import annotations

import collections
import itertools

from exported import Key, Row, against, arguments, flown, key, lost, share

from mavfi_cli.analysis.pairs import LONGER

MISSION = ("world", "world_seed", "seed", "platform")
FAULT = ("fault_target", "fault_field", "fault_seed")


def arm_of(row: Row, columns: list[str]) -> str:
    """Return the name of the arm that flew a row, which is empty if its columns are empty."""
    return " ".join(str(row[column]) for column in columns if row.get(column))


class Faults:
    """All faults with their flights in every arm, and which of them do harm.

    Args:
        rows: flown missions.
        columns: the columns that name an arm.
        unprotected: name of the arm without protection.
    """

    def __init__(self, rows: list[Row], columns: list[str], unprotected: str) -> None:
        self.golden_s: dict[Key, float] = {}
        self.flights: dict[Key, dict[str, Row]] = collections.defaultdict(dict)
        golden = [row for row in rows if row["injected"] == "golden" and not lost(row)]
        for row in golden:
            if arm_of(row, columns) == unprotected:
                self.golden_s[key(row, MISSION)] = row["flight_time_s"]
        for row in rows:
            if row["injected"] != "golden" and key(row, MISSION) in self.golden_s:
                self.flights[key(row, MISSION + FAULT)][arm_of(row, columns)] = row
        self.active = {
            fault: flights
            for fault, flights in self.flights.items()
            if unprotected in flights and flights[unprotected]["activation"] == "read"
        }
        self.harmful = {
            fault for fault, flights in self.active.items() if self.harms(flights[unprotected])
        }

    def excess(self, row: Row) -> float:
        """Return the flight time divided by that of the golden flight, minus 1."""
        return float(row["flight_time_s"]) / self.golden_s[key(row, MISSION)] - 1.0

    def harms(self, row: Row) -> bool:
        """Return True if a mission is lost, or takes over 10 % longer than its golden flight."""
        return lost(row) or self.excess(row) > LONGER - 1.0


def report(faults: Faults, unprotected: str) -> list[str]:
    """Return the lines of the table of arms, and of McNemar's test for each pair of arms."""
    arms = sorted({arm for flights in faults.active.values() for arm in flights} - {unprotected})
    lines = [
        f"{len(faults.active)} active faults, {len(faults.harmful)} harmful",
        "",
        "| arm | recovered | undone | broken | worst successful flight |",
        "|---|---|---|---|---|",
    ]
    undone: dict[str, dict[Key, bool]] = {}
    for arm in [unprotected, *arms]:
        rows = {f: x[arm] for f, x in faults.active.items() if arm in x}
        failed = [f for f in rows if lost(faults.active[f][unprotected])]
        harmful = [f for f in rows if f in faults.harmful]
        undone[arm] = {f: not faults.harms(rows[f]) for f in harmful}
        broken = [f for f in rows if f not in faults.harmful and faults.harms(rows[f])]
        ok = [faults.excess(row) for row in rows.values() if not lost(row)]
        lines.append(
            f"| {arm or 'none'} "
            f"| {share(sum(not lost(rows[f]) for f in failed), len(failed))} "
            f"| {share(sum(undone[arm].values()), len(harmful))} "
            f"| {share(len(broken), len(rows) - len(harmful))} | {max(ok, default=0.0):+.1%} |"
        )
    for one, other in itertools.combinations(arms, 2):
        test = against(undone[one], undone[other])
        lines.append(
            f"\n{one} against {other}, harm undone: {test.only_first} faults by {one} only, "
            f"{test.only_second} by {other} only, of {test.pairs}; McNemar p = {test.p_value:.2g}"
        )
    return lines


def main() -> None:
    """Read the exports, pair their flights and print the report."""
    parser = arguments(__doc__)
    parser.add_argument("--arms", nargs="+", required=True, help="columns that name an arm")
    parser.add_argument("--unprotected", default="", help="name of the arm without protection")
    parser.add_argument("--where", nargs="*", default=[], metavar="COLUMN=VALUE")
    given = parser.parse_args()
    kept = flown(given.parts)
    for column, _, value in (each.partition("=") for each in given.where):
        kept = [r for r in kept if r["injected"] == "golden" or str(r.get(column)) == value]
    print("\n".join(report(Faults(kept, given.arms, given.unprotected), given.unprotected)))


if __name__ == "__main__":
    main()
