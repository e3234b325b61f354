r"""Compares what alarms about collision reports do to flights, before and after a new recovery.

    python benchmarks/report_alarms.py docs/results/paper-mavbench.parquet \
        docs/results/report-alarms.parquet

Compares an export of a campaign with the missions that `--fly FOLDER` has flown again: all those
with an alarm about a collision report. Recovery from other alarms has not changed, so every other
mission of the export stays as it is. As a check, missions without such an alarm whose detector
undoes or causes harm are flown again too.

A flight does harm if it does not end in success, or takes more than 5 % longer than its golden
flight. A detector causes harm if only its flight does harm, and undoes it if only the unprotected
flight of the same fault does. The mean added time is that of the protected flight over the
unprotected one, if both succeed.

`mavfi campaign export FOLDER docs/results/report-alarms.parquet` writes the second export.
"""

from __future__ import annotations

import argparse
import collections
import json
import statistics
from pathlib import Path
from typing import Any

from exported import Key, Row, flown, key, lost

from mavfi_cli.campaigns.missions import PlannedMission, canonical
from mavfi_cli.campaigns.run import Options, run_campaign
from mavfi_cli.campaigns.specification import Keep
from mavfi_cli.core.config import structure
from mavfi_cli.spec.mission import MissionConfig

LONGER = 1.05
ARM = ("level", "platform", "detector", "protect")


class Missions:
    """The missions of an export with their golden and unprotected flights."""

    def __init__(self, rows: list[Row]) -> None:
        self.protected = {row["number"]: row for row in rows if row["detector"]}
        self._golden = {row["pair"]: row for row in rows if row["injected"] == "golden"}
        others = [row for row in rows if row["injected"] != "golden" and not row["detector"]]
        self._unprotected = {_fault(row): row for row in others}

    def harms(self, row: Row) -> bool:
        """Return True if a flight is lost, or longer than its golden flight by more than 5 %."""
        golden = self._golden[row["pair"]]
        return lost(row) or row["flight_time_s"] > LONGER * golden["flight_time_s"]

    def unprotected(self, row: Row) -> Row | None:
        """Return the unprotected flight of the same fault; None if the golden flight is lost."""
        return None if lost(self._golden[row["pair"]]) else self._unprotected[_fault(row)]

    def effect(self, row: Row) -> str:
        """Return the detector's effect on harm: "undone", "caused", or an empty text for none."""
        bare = self.unprotected(row)
        if bare is None or self.harms(bare) == self.harms(row):
            return ""
        return "undone" if self.harms(bare) else "caused"

    def again(self) -> list[PlannedMission]:
        """Return the missions to fly again, each with its number in the export as a label."""
        return [
            PlannedMission(
                config=structure(json.loads(row["changes"]), MissionConfig),
                labels={**{name: row[name] for name in ARM}, "mission": number},
            )
            for number, row in self.protected.items()
            if row["recovery_share_perception"] or self.effect(row)
        ]


def _fault(row: Row) -> str:
    """Return a text that identifies a mission without its detector."""
    changes: dict[str, Any] = json.loads(row["changes"])
    return canonical({name: value for name, value in changes.items() if name != "detector"})


def table(missions: Missions, again: list[Row]) -> list[str]:
    """Return the lines of the table, and one line about the missions without such an alarm."""
    cells: dict[Key, collections.Counter[str]] = collections.defaultdict(collections.Counter)
    added_s: dict[tuple[Key, str], list[float]] = collections.defaultdict(list)
    check: collections.Counter[bool] = collections.Counter()
    for new in again:
        old = missions.protected[new["label_mission"]]
        if not old["recovery_share_perception"]:
            check[_flight(old) == _flight(new)] += 1
            continue
        bare, arm = missions.unprotected(old), key(old, ARM)
        cell = cells[arm]
        cell["flown"] += 1
        for when, row in (("before", old), ("after", new)):
            cell[f"{when} {missions.effect(row)}"] += 1
            if bare is not None:
                cell[f"{when} lost"] += lost(row) and not lost(bare)
                cell[f"{when} equal"] += _flight(row) == _flight(bare)
                if not lost(row) and not lost(bare):
                    added_s[arm, when].append(row["flight_time_s"] - bare["flight_time_s"])
    lines = [
        "| level | computer | detector | stages | missions | harm caused | of it lost "
        "| harm undone | equal to the unprotected | mean added time, s |",
        "|" + "---|" * 10,
    ]
    for arm, cell in sorted(cells.items()):
        columns = [
            f"{cell[f'before {what}']} → {cell[f'after {what}']}"
            for what in ("caused", "lost", "undone", "equal")
        ]
        mean_s = [statistics.fmean(added_s[arm, when]) for when in ("before", "after")]
        columns.append(f"{mean_s[0]:.2f} → {mean_s[1]:.2f}")
        lines.append(f"| {' | '.join([*arm, str(cell['flown']), *columns])} |")
    equal = f"{check[True]} of {check.total()}"
    return [*lines, "", f"Without an alarm about a report: {equal} flights are as before"]


def _flight(row: Row) -> tuple[str, float]:
    return row["outcome"], row["flight_time_s"]


def main() -> None:
    """Fly the missions again, or print the table of both exports."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("before", help="export of the campaign")
    parser.add_argument("after", nargs="?", help="export of the missions flown again")
    parser.add_argument("--fly", type=Path, metavar="FOLDER", help="fly them into this folder")
    parser.add_argument("--jobs", type=int, default=1)
    given = parser.parse_args()
    missions = Missions(flown([given.before]))
    if given.fly:
        run_campaign(missions.again(), given.fly, Options(jobs=given.jobs, keep=Keep.NONE)).close()
    if given.after:
        print("\n".join(table(missions, flown([given.after]))))


if __name__ == "__main__":
    main()
