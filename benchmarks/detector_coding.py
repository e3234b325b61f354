"""Compares ways to code a value's sign and exponent as an integer, on golden runs.

    python benchmarks/detector_coding.py RUNS

RUNS is a folder that contains golden runs of `mavfi fly`, in training worlds and in others.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from golden_runs import MATERIAL, Run, apart, golden_runs, samples_of

from mavfi_cli.core.types import BY_NAME, DType
from mavfi_cli.detect.preprocess import DETECTED


def coded(values: np.ndarray, way: str, floor: int, ceiling: int) -> np.ndarray:
    """Return the integer codes of float64 values under one of the candidate ways of coding."""
    patterns = np.ascontiguousarray(values).view(np.int64)
    negative, exponent = patterns < 0, (patterns >> 52) & 0x7FF
    if way == "12 bits":
        return (patterns >> 52) & 0xFFF
    if way == "two's complement":
        return np.where(negative, -exponent, exponent)
    fine = 4 if way == "signed log + 4 mantissa bits" else 0
    steps = (patterns >> (52 - fine)) & ((1 << (11 + fine)) - 1)
    steps = np.minimum(steps, (1023 + min(ceiling, 1024)) << fine) - ((1023 + floor) << fine)
    code = np.where(negative, -1, 1) * np.maximum(steps, 0)
    return np.where(np.isnan(values), 16384, code)


def changes(
    values: np.ndarray, way: str, floor: int, ceiling: int, *, wraps: bool = False
) -> np.ndarray:
    """Return the differences between the codes of consecutive samples.

    With `wraps`, a yaw that changes its sign beyond +-2 rad counts as unchanged.
    """
    deltas = np.diff(coded(values, way, floor, ceiling))
    wrapped = (np.abs(values) >= 2.0) & (np.abs(values) < 4.0)
    opposite = wrapped[1:] & wrapped[:-1] & (values[1:] * values[:-1] < 0.0)
    return np.where(opposite, 0, deltas) if wraps and "log" in way else deltas


def coding(runs: list[Run]) -> None:
    """Print, for each candidate, the normal range of deltas and the flips that exceed it."""
    training, held = apart(runs)
    if not (training and held):
        raise SystemExit(
            f"error: needs golden runs of both kinds, got {len(training)} in training worlds and "
            f"{len(held)} in others"
        )
    rng = np.random.default_rng(1)
    ways = [("12 bits", 0), ("two's complement", 0)]
    ways += [("signed log", floor) for floor in (-10, -4, -3, -2, -1, 0, 1, 2)]
    ways += [("signed log + 4 mantissa bits", floor) for floor in (-3, -1, 0)]
    print(
        "normal: largest |delta| of the training flights. false: deltas of the held-out flights\n"
        "beyond it, per flight hour. found: of flips of one sign or exponent bit that change the\n"
        "value by 1 m, 1 m/s, 0.5 rad or 1 s, the share whose delta is beyond it.\n"
    )
    hours = sum(run.duration_s for run in held) / 3600.0
    groups: dict[str, list[str]] = {}
    for state in DETECTED:
        if state.dtype is DType.FLOAT64:
            groups.setdefault(state.group, []).append(state.name)
    for group, names in groups.items():
        print(f"{group}\n  {'way':30} {'floor':>5} {'normal':>7} {'false':>7} {'found':>7}")
        wraps = BY_NAME[names[0]].unit == "rad"
        ceiling = 4 if group == "time_to_collision" else 1024
        for way, floor in ways:
            normal, false, found, material = 0, 0, 0, 0
            for name in names:
                trained = np.concatenate(
                    [
                        changes(samples_of(run, name), way, floor, ceiling, wraps=wraps)
                        for run in training
                    ]
                )
                limit = int(np.abs(trained).max(initial=0))  # a calm flight has one report
                normal = max(normal, limit)
                for run in held:
                    values = samples_of(run, name)
                    false += int(
                        (np.abs(changes(values, way, floor, ceiling, wraps=wraps)) > limit).sum()
                    )
                    hit, of = flips_beyond(values, name, way, floor, ceiling, limit, rng)
                    found, material = found + hit, material + of
            print(f"  {way:30} {floor:5} {normal:7} {false / hours:7.0f}"
                  f" {found / max(material, 1):7.1%}")  # fmt: skip


def flips_beyond(
    values: np.ndarray, name: str, way: str, floor: int, ceiling: int, limit: int,
    rng: np.random.Generator,
) -> tuple[int, int]:  # fmt: skip
    """Return how many material flips have a delta beyond the limit, and how many there are.

    A flip is material if it changes the value enough to matter.
    """
    if len(values) < 2:
        return 0, 0
    rows = rng.integers(1, len(values), size=20)
    hit = material = 0
    before = coded(values, way, floor, ceiling)[rows - 1]
    for bit in range(52, 64):
        flipped = (values[rows].view(np.uint64) ^ np.uint64(1 << bit)).view(np.float64)
        with np.errstate(over="ignore", invalid="ignore"):
            matters = ~(np.abs(flipped - values[rows]) < MATERIAL[BY_NAME[name].unit])
        beyond = np.abs(coded(flipped, way, floor, ceiling) - before) > limit
        hit, material = hit + int((beyond & matters).sum()), material + int(matters.sum())
    return hit, material


def main() -> None:
    """Read the runs and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("runs", type=Path)
    coding(golden_runs(parser.parse_args().runs))


if __name__ == "__main__":
    main()
