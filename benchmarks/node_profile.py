r"""Times the profile of an invocation of each node, by single steps and from branch to branch.

    python benchmarks/node_profile.py

Flies one golden mission in `dense`. An invocation of each node is then profiled both ways, one
after the other. The script fails if the two profiles differ in any executed instruction.
"""

from __future__ import annotations

import argparse
import contextlib
import statistics
import tempfile
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mavfi_cli.attack.profile import TargetProfile
from mavfi_cli.attack.tracer_thread import TracerThread
from mavfi_cli.core.archive import unpack
from mavfi_cli.mission.instruction import rehearsal
from mavfi_cli.mission.instruction.injection import GoldenOrders, draw_invocation
from mavfi_cli.mission.instruction.server import Setup
from mavfi_cli.mission.progress import Watcher
from mavfi_cli.mission.run import fly_mission
from mavfi_cli.spec.fault import InstructionConfig
from mavfi_cli.spec.mission import MissionConfig

NODES = ("point_cloud", "octomap", "collision_check", "planner", "control")


def profiled(
    _: object, *, setup: Setup, node: str, orders: Any, seed: int, reads_own_code: bool
) -> tuple[TargetProfile, float]:
    """Profile the invocation that `seed` draws. Return the profile and its wall time, s."""
    rehearsal._STEPPED["reads_own_code"] = reads_own_code
    rng = np.random.default_rng(seed)
    with contextlib.closing(rehearsal.Rehearsal(setup, node, orders)) as place:
        drawn = draw_invocation(place.name, place.count_entries(), rng)
        begun = time.perf_counter()
        profile = place.profile(drawn, rng)
        return profile, time.perf_counter() - begun


def traces(profile: TargetProfile) -> list[list[int]]:
    """Return the addresses of the executed instructions in each window."""
    return [part.trace.tolist() for stratum in profile.strata for part in stratum.segments]


def main() -> None:
    """Fly the golden mission, and print a row for each node."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=3, help="invocations of each node")
    given = parser.parse_args()
    config = MissionConfig(world="dense", seed=2)
    print("| node | stepped instructions | single steps, s | from branch to branch, s | ratio |")
    print("|---" * 5 + "|")
    for node in NODES:
        with tempfile.TemporaryDirectory() as name:
            attacked = replace(config, instruction=InstructionConfig(target=node, seed=1))
            fly_mission(attacked, Path(name), Watcher())
            (kept,) = Path(name).glob(".profiles/*/orders.npz")
            golden = unpack(kept.read_bytes(), GoldenOrders)
        setup = Setup.of(config, golden.briefing, node)
        group = next((g for g in config.loaded_stack().processes if node in g), (node,))
        orders, steps, rows = golden.of_process(group), 0, list[tuple[float, float]]()
        for seed in range(1, given.rounds + 1):
            ways = []
            for own in (True, False):
                work = partial(profiled, setup=setup, node=node, orders=orders, seed=seed,
                               reads_own_code=own)  # fmt: skip
                ways.append(TracerThread(work).result())
            assert traces(ways[0][0]) == traces(ways[1][0]), f"{node}: the profiles differ"
            steps += ways[0][0].executed
            rows.append((ways[0][1], ways[1][1]))
        singly, branches = (statistics.median(times) for times in zip(*rows, strict=True))
        ratio = statistics.median(one / other for one, other in rows)
        print(f"| {node} | {steps:,} | {singly:.2f} | {branches:.2f} | {ratio:.1f} |", flush=True)


if __name__ == "__main__":
    main()
