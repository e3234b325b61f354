"""Measures how long `mavfi report` takes for a large campaign, and how large its page is.

    python benchmarks/report_page.py [--missions 10000] [--keep FOLDER]

Makes a ledger of missions of the paper's Table IV and Fig. 14. Each mission has the record of the
same short flight, with a random flight time and outcome. Required for 10,000 missions: less than
30 s and less than 10 MB.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mavfi_cli import library
from mavfi_cli.campaigns.ledger import Ledger
from mavfi_cli.campaigns.missions import Injected, ResultState
from mavfi_cli.campaigns.specification_file import load_spec
from mavfi_cli.spec.fault import FaultConfig
from mavfi_cli.spec.mission import MissionConfig

SHORT = MissionConfig(
    world="farm", seed=5, start=(2.0, 2.0, 0.0), goal=(10.0, 6.0, 5.0),
    fault=FaultConfig(target="planning", seed=1),
)  # fmt: skip


def record_of_a_flight() -> dict[str, Any]:
    """Fly the short mission, and return its record."""
    with tempfile.TemporaryDirectory() as folder:
        return dict(library.fly(SHORT, out=folder).result)


def make(folder: Path, missions: int) -> None:
    """Write a ledger with a number of missions to a folder."""
    record, rng = record_of_a_flight(), np.random.default_rng(1)
    specs = [replace(load_spec(name), repetitions=500) for name in ("table4", "fig14")]
    with Ledger(folder, writing=True) as ledger:
        listed = [each for spec in specs for each in spec.missions()][:missions]
        ledger.plan(listed)
        for number, mission in enumerate(listed):
            golden = mission.config.instruction is None
            time_s = float(rng.normal(27.0, 0.5) if golden else rng.gamma(40.0, 0.7))
            quality = {**record["quality_of_flight"], "flight_time_s": time_s}
            told = {
                **record,
                "outcome": "success" if golden or rng.random() > 0.05 else "timeout",
                "quality_of_flight": quality,
                "fault": None if golden else record["fault"],
            }
            ledger.add(
                number, state=ResultState.FLOWN, result=told, reason="", path=None,
                injected=Injected.of(told, faulty=not golden), wall_s=1.0, attempts=1,
            )  # fmt: skip


def main() -> None:
    """Make the ledger unless it exists, and time the command on it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--missions", type=int, default=10_000)
    parser.add_argument("--keep", type=Path, help="folder for ledger and page")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = given.keep or Path(scratch)
        if not (folder / "campaign").exists():
            make(folder / "campaign", given.missions)
        page = folder / "report.html"
        begun = time.perf_counter()
        line = [sys.executable, "-m", "mavfi_cli", "report", folder / "campaign", "-o", page]
        subprocess.run(line, check=True)
        taken_s = time.perf_counter() - begun
        print(f"{given.missions} missions: {taken_s:.1f} s, {page.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
