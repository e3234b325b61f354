"""Flies whole missions for the benchmarks: `mavfi fly` in a fresh process, with its cost."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from dataclasses import dataclass
from typing import Any

MAVFI = (sys.executable, "-m", "mavfi_cli")


@dataclass(frozen=True, slots=True, kw_only=True)
class Flown:
    """The result of one mission, with its wall and CPU time."""

    wall_s: float
    cpu_s: float  # of all its processes, and of other children that end while it flies
    result: dict[str, Any]  # its result.json


def fly(*options: str) -> Flown:
    """Fly one mission with options of `mavfi fly`, without a picture or progress.

    A command that fails ends the benchmark.
    """
    line = [*MAVFI, "fly", *options, "--no-picture", "--quiet", "--json"]
    before, begun = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    run = subprocess.run(line, capture_output=True, text=True, check=False)
    wall_s = time.perf_counter() - begun
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if run.returncode != 0:
        raise SystemExit(f"mavfi fly {' '.join(options)}: {run.stderr.strip()}")
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Flown(wall_s=wall_s, cpu_s=cpu_s, result=json.loads(run.stdout))


def fly_pairs(plain: list[str], attacked: list[str], count: int) -> tuple[list[Flown], list[Flown]]:
    """Fly two missions in turn, `count` times, and return the flights of each.

    Other load on the machine thus affects both alike.
    """
    flown: tuple[list[Flown], list[Flown]] = [], []
    for _ in range(count):
        for missions, options in zip(flown, (plain, attacked), strict=True):
            missions.append(fly(*options))
    return flown
