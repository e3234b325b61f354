"""Compares the records and times of missions forked from shared flights and of whole flights.

    python benchmarks/forked_missions.py [--missions 1000] [--jobs 2] [--instruction] [--short]

The missions of one seed are golden and protected flights, faults in states of every stage with all
persistences, faults in the detector, and ends of processes. With `--instruction`, the faults are in
instructions of every node instead. Each seed flies one of the STACKS. `--short` makes the flights
10 m long. Every file of every run folder is compared, except the host section of the result and the
measured time of a stop in a fault record.
"""

from __future__ import annotations

import argparse
import itertools
import json
import tempfile
import time
from collections import Counter
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
STACKS = (
    "hardened",
    "mavbench",
    "mavbench:restores_counters=true",
    "mavbench:processes=[],restores_counters=true",
    'mavbench:standby=["planner"]',
    'mavbench:processes=[],standby=["collision_check"]',
    "mavbench-replica:restores_counters=true",
)
NODES = ("point_cloud", "octomap", "collision_check", "planner", "control")


SHORT: dict[str, Any] = {"world": "farm", "start": (2.0, 2.0, 0.0), "goal": (10.0, 6.0, 5.0)}


def missions(instruction: bool, short: bool) -> Iterator[PlannedMission]:
    """Yield planned missions without end, seed by seed."""
    for seed in itertools.count(1):
        stack = STACKS[seed % len(STACKS)]
        base = MissionConfig(world=WORLDS[seed % len(WORLDS)], seed=seed, stack=stack)
        base = replace(base, **SHORT) if short else base
        restart_s = (0.1, 1.0)[seed % 2]
        for name in (None, "gad", "aad"):
            detector = None if name is None else DetectorConfig(name=name, any_stack=True)
            guarded = replace(base, detector=detector)
            yield PlannedMission(config=guarded)
            if instruction:
                for node, fault in itertools.product(NODES, (seed, seed + 1000)):
                    struck = InstructionConfig(target=node, seed=fault)
                    yield PlannedMission(config=replace(guarded, instruction=struck))
                continue
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


def differing(forked: MissionResult, whole: MissionResult) -> list[str]:
    """Return the names of the files that differ between a forked and a whole mission."""
    if forked.path is None or whole.path is None:
        same = (forked.path, forked.reason) == (whole.path, whole.reason)
        return [] if same else ["run folder"]
    names = {path.name for folder in (forked.path, whole.path) for path in folder.iterdir()}
    return sorted(
        name for name in names if contents(forked.path / name) != contents(whole.path / name)
    )


def contents(path: Path) -> object:
    """Return a file's contents, without values measured on this machine, or None without a file."""
    if not path.is_file():
        return None
    if path.suffix != ".json":
        return path.read_bytes()
    value = {**json.loads(path.read_text()), "host": None}
    value.get("injection", {}).pop("stop_s", None)
    return json.dumps(value)


def main() -> None:
    """Fly the missions both ways, compare their files, and exit with 1 if any differ."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--missions", type=int, default=1000)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--instruction", action="store_true")
    parser.add_argument("--short", action="store_true")
    options = parser.parse_args()
    listed = list(itertools.islice(missions(options.instruction, options.short), options.missions))
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
    hosts = [result.result.get("host", {}) for result in flown[False]]
    shared = sum("forked_s" in host for host in hosts)
    struck = Counter(host["struck"] for host in hosts if "struck" in host)
    print("struck nodes:", ", ".join(f"{count} {what}" for what, count in struck.items()) or "none")
    print(f"{len(listed)} missions compared, {shared} of them forked: {unequal} unequal")
    raise SystemExit(unequal > 0)


if __name__ == "__main__":
    main()
