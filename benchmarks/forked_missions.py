"""Missions of all kinds, forked from shared flights and flown whole: equal records, and times.

    python benchmarks/forked_missions.py [--missions 1000] [--jobs 2] [--instruction]

A repetition is one seed: golden and protected flights, faults in states of every stage with all
persistences, in the detector, and ends of processes; with `--instruction` faults in instructions
too. Every file of every run folder is compared, except the host section of the result.
"""

from __future__ import annotations

import argparse
import itertools
import json
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from mavfi_cli.campaigns.missions import MissionResult, PlannedMission
from mavfi_cli.campaigns.run import Options, run_campaign
from mavfi_cli.campaigns.specification import Keep
from mavfi_cli.spec.detector import DetectorConfig
from mavfi_cli.spec.fault import FaultConfig, InstructionConfig
from mavfi_cli.spec.mission import MissionConfig

WORLDS = ("sparse", "dense", "factory", "farm")
STATES = ("perception", "planning", "control")
PROCESSES = ("process.octomap", "process.planner", "process.control")
NODES = ("octomap", "collision_check", "planner", "control")


def missions(instruction: bool) -> Iterator[PlannedMission]:
    """Yield missions without an end, seed by seed."""
    for seed in itertools.count(1):
        stack = "mavbench" if seed % 2 else "hardened"
        base = MissionConfig(world=WORLDS[seed % len(WORLDS)], seed=seed, stack=stack)
        restart_s = (0.1, 1.0)[seed % 2]
        for name in (None, "gad", "aad"):
            guarded = replace(base, detector=None if name is None else DetectorConfig(name=name))
            yield PlannedMission(config=guarded)
            faults: list[dict[str, Any]] = [
                *({"target": state} for state in STATES),
                {"target": STATES[seed % 3], "persistence": "stuck-at", "duration_s": 2.0},
                {"target": STATES[seed % 3], "persistence": "intermittent", "duration_s": 3.0},
                *([] if name is None else [{"target": "detector"}]),
            ]
            for fault in faults:
                config = replace(guarded, fault=FaultConfig(**fault, seed=seed))
                yield PlannedMission(config=config)
            restarting = replace(guarded, node_restart_s=restart_s)
            for target in PROCESSES:
                yield PlannedMission(
                    config=replace(restarting, fault=FaultConfig(target=target, seed=seed))
                )
            for node in NODES if instruction else ():
                struck = InstructionConfig(target=node, seed=seed)
                yield PlannedMission(config=replace(guarded, instruction=struck))


def differing(forked: MissionResult, whole: MissionResult) -> list[str]:
    """Return the names of the files that differ."""
    if forked.path is None or whole.path is None:
        same = (forked.path, forked.reason) == (whole.path, whole.reason)
        return [] if same else ["run folder"]
    names = {path.name for folder in (forked.path, whole.path) for path in folder.iterdir()}
    return sorted(
        name for name in names if contents(forked.path / name) != contents(whole.path / name)
    )


def contents(path: Path) -> object:
    """Return a file's contents, without the host section of a result."""
    if not path.is_file():
        return None
    if path.name != "result.json":
        return path.read_bytes()
    return {**json.loads(path.read_text()), "host": None}


def main() -> None:
    """Fly the missions both ways, and compare."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--missions", type=int, default=1000)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--instruction", action="store_true")
    options = parser.parse_args()
    listed = list(itertools.islice(missions(options.instruction), options.missions))
    flown: dict[bool, list[MissionResult]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for whole in (False, True):
            flying = Options(jobs=options.jobs, whole=whole, keep=Keep.ALL)
            begun_s = time.perf_counter()
            with run_campaign(listed, Path(folder) / str(whole), flying) as ledger:
                flown[whole] = list(ledger.results())
            spent_s = time.perf_counter() - begun_s
            rate = 3600.0 * len(listed) / spent_s
            print(
                f"{'whole ' if whole else 'forked'} {spent_s:8.1f} s {rate:8.0f} missions an hour"
            )
        unequal = 0
        for forked, whole_one in zip(flown[False], flown[True], strict=True):
            if names := differing(forked, whole_one):
                unequal += 1
                print(f"mission {forked.number}: {', '.join(names)}")
    shared = sum("forked_s" in result.result.get("host", {}) for result in flown[False])
    print(f"{len(listed)} missions compared, {shared} of them forked: {unequal} unequal")
    raise SystemExit(unequal > 0)


if __name__ == "__main__":
    main()
