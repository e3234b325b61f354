"""Measures a campaign's own cost: to dispatch 10,000 missions, and a ledger of 1,000,000 missions.

    python benchmarks/campaign_scale.py [--queued 10000] [--rows 1000000]

Dispatch is measured with missions that do nothing, for which this file is the task. The ledger's
missions are synthetic: a tenth of them is missing, and the others are flights of 40 settings.
"""

from __future__ import annotations

import argparse
import os
import resource
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mavfi_cli.analysis.summary import groups, summarise
from mavfi_cli.campaigns.ledger import Ledger
from mavfi_cli.campaigns.missions import Injected, PlannedMission, ResultState
from mavfi_cli.campaigns.progress import Progress, Spectator
from mavfi_cli.campaigns.run import Options, run_campaign, store_plan
from mavfi_cli.campaigns.specification import Keep
from mavfi_cli.spec.mission import MissionConfig

CELLS = 40
DISPATCH_LIMIT_S, LEDGER_LIMIT_S = 0.005, 10.0


def prepare() -> None:
    """Do nothing. A task needs this function, which loads code before workers are forked."""


def perform(_changes: Mapping[str, Any], out: Path) -> Path:
    """Write the record of a mission that does nothing, and return its run folder."""
    run = out / "nothing-1"
    run.mkdir()
    (run / "result.json").write_text('{"outcome": "success", "reason": "", "nodes": {}}')
    return run


class _Last(Spectator):
    """A spectator that keeps the newest progress of a campaign."""

    progress: Progress

    def on_progress(self, progress: Progress) -> None:
        """Replace the kept progress by the newest."""
        self.progress = progress


def dispatch(count: int, jobs: int) -> str:
    """Run missions that do nothing, and return table rows with the cost of one mission."""
    here = str(Path(__file__).resolve().parent)
    os.environ["PYTHONPATH"] = os.pathsep.join([here, os.environ.get("PYTHONPATH", "")])
    missions = [PlannedMission(config=MissionConfig(seed=seed)) for seed in range(count)]
    last = _Last()
    with tempfile.TemporaryDirectory() as folder:
        options = Options(jobs=jobs, keep=Keep.NONE, task="campaign_scale")
        begun = resource.getrusage(resource.RUSAGE_SELF)
        run_campaign(missions, Path(folder) / "campaign", options, last).close()
        ended = resource.getrusage(resource.RUSAGE_SELF)
    seen = last.progress
    outside_s = (jobs * seen.elapsed_s - seen.inside_s) / count
    own_s = (ended.ru_utime + ended.ru_stime - begun.ru_utime - begun.ru_stime) / count
    return (
        f"| dispatch, {count} queued, {jobs} jobs: worker time between two missions | "
        f"{1e3 * outside_s:.2f} ms | {1e3 * DISPATCH_LIMIT_S:.0f} ms |\n"
        f"| of it processor time of the runner | {1e3 * own_s:.2f} ms | |\n"
        f"| a whole mission that does nothing | {1e3 * seen.inside_s / count:.2f} ms | |"
    )


def planned(rows: int) -> Iterator[PlannedMission]:
    """Yield planned missions with 40 combinations of world and setting, as many as in Table IV."""
    base = MissionConfig()
    for number in range(rows):
        labels = {"world": f"w{number % 4}", "setting": f"s{number // 4 % (CELLS // 4)}"}
        yield PlannedMission(config=base, labels=labels, pair=str(number // CELLS))


def fill(folder: Path, rows: int) -> None:
    """Write a ledger of `rows` missions, nine tenths of which are flown."""
    rng = np.random.Generator(np.random.PCG64(1))
    with Ledger(folder, writing=True) as ledger:
        store_plan(ledger, list(planned(0)))
        ledger.plan(planned(rows))
        database = ledger._db  # a transaction a mission would take hours
        database.execute("BEGIN")
        for number in range(rows):
            if number % 10 == 9:
                continue
            time_s, golden = 20.0 + float(rng.exponential()), number // 4 % (CELLS // 4) == 0
            database.execute(
                "INSERT INTO results VALUES (?, ?, ?, '', ?, ?, ?, ?, ?, ?, ?, ?, ?, 1, NULL)",
                (
                    number, ResultState.FLOWN.value,
                    "success" if rng.random() < 0.9 else "collision",
                    (Injected.GOLDEN if golden else Injected.ACTIVE).value,
                    time_s, 2.5 * time_s, 540.0 * time_s, 100.0 * time_s, 1.0,
                    int(rng.integers(5)), time_s + 10.0, 3.0,
                ),
            )  # fmt: skip
            database.execute("INSERT INTO records VALUES (?, x'')", (number,))
        database.execute("COMMIT")


def timed(name: str, work: Callable[[], object], limit_s: float = LEDGER_LIMIT_S) -> str:
    """Time a function, and return a row of the table with its time and the required one."""
    begun = time.perf_counter()
    work()
    return f"| {name} | {time.perf_counter() - begun:.2f} s | {limit_s:g} s |"


def ledger_rows(rows: int) -> Iterator[str]:
    """Yield table rows with the time to open, resume and summarise a ledger of `rows` missions."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "campaign"
        fill(folder, rows)
        yield timed(f"ledger of {rows} rows: open and count", lambda: _count(folder))
        yield timed("find the first missing mission, and all", lambda: _missing(folder))
        yield timed("summarise 40 settings", lambda: _summarise(folder))


def _count(folder: Path) -> None:
    with Ledger(folder) as ledger:
        assert ledger.over() < ledger.planned()


def _missing(folder: Path) -> None:
    with Ledger(folder) as ledger:
        assert sum(1 for _ in ledger.missing()) == ledger.planned() - ledger.over()


def _summarise(folder: Path) -> None:
    with Ledger(folder) as ledger:
        assert len(summarise(ledger, groups(ledger)).cells) == CELLS


def main() -> None:
    """Measure dispatch and ledger, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--queued", type=int, default=10_000)
    parser.add_argument("--rows", type=int, default=1_000_000)
    given = parser.parse_args()
    print("| what | figure | required |\n|---|---|---|", flush=True)
    print(dispatch(given.queued, os.cpu_count() or 1), flush=True)
    for line in ledger_rows(given.rows):
        print(line, flush=True)


if __name__ == "__main__":
    main()
