"""Whole missions for the benchmarks: each `mavfi fly` in a fresh process, with what it cost."""

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
    """One mission."""

    wall_s: float
    cpu_s: float  # of all its processes; with those of others that end while it flies
    result: dict[str, Any]  # its result.json


def fly(*options: str) -> Flown:
    """Fly to the end, without a picture or progress. A command that fails ends the benchmark."""
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
    """Both missions in turn, so that what else the machine does meets both alike."""
    flown: tuple[list[Flown], list[Flown]] = [], []
    for _ in range(count):
        for missions, options in zip(flown, (plain, attacked), strict=True):
            missions.append(fly(*options))
    return flown
