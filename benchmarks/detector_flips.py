"""Flips bits in flown messages, to compare detectors, or the effects of their alarms.

    python benchmarks/detector_flips.py found RUNS
    python benchmarks/detector_flips.py reference RUNS

RUNS is a folder that contains golden runs of `mavfi fly`. `found` prints which flips each detector
finds. `reference` prints the alarms of the Gaussian detector if it learns from a sample that raised
an alarm or not, and if it computes the next delta from that sample or not.
"""

from __future__ import annotations

import argparse
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from golden_runs import MATERIAL, Run, apart, fresh_rows, golden_runs

from mavfi_cli.core.types import DType
from mavfi_cli.detect import base
from mavfi_cli.detect.gaussian import GaussianDetector
from mavfi_cli.detect.offline import replay
from mavfi_cli.detect.preprocess import DETECTED, NAMES
from mavfi_cli.spec.detector import DetectorConfig

STACK = "hardened"  # that the runs were flown on

WAYPOINT_TICKS = 25


def flipped(value: float, dtype: DType, bit: int) -> float:
    """Return a value of a data type with one bit flipped."""
    if dtype is DType.INT32:
        pattern = int(value) & 0xFFFFFFFF ^ 1 << bit
        return float(pattern - (1 << 32) if pattern >> 31 else pattern)
    pattern = struct.unpack("<Q", struct.pack("<d", value))[0] ^ 1 << bit
    return float(struct.unpack("<d", struct.pack("<Q", pattern))[0])


def field_of(dtype: DType, bit: int) -> str:
    """Return the name of the field to which a bit of a data type belongs."""
    if dtype is DType.INT32:
        return "integer"
    return "sign" if bit == 63 else "exponent" if bit >= 52 else "mantissa"


@dataclass(frozen=True, slots=True)
class Strike:
    """A short piece of a flight with one flipped bit."""

    state: str
    field: str
    material: bool
    columns: dict[str, Any]
    stamp_s: float  # when the message with the flip came
    over_s: float  # when the message after it came


def strikes(runs: list[Run], count: int) -> Iterator[Strike]:
    """Yield `count` pieces of flights, each from before the struck message to the one after it."""
    rng = np.random.default_rng(2)
    while count:
        run = runs[int(rng.integers(len(runs)))]
        state = DETECTED[int(rng.integers(len(DETECTED)))]
        rows = fresh_rows(run, state.name)
        if len(rows) < 3:
            continue
        place = int(rng.integers(1, len(rows) - 1))
        row, end = rows[place], rows[place + 1]
        width = 32 if state.dtype is DType.INT32 else 64
        # Mantissa bits seldom matter: half of the strikes are on sign and exponent.
        low = 52 if width == 64 and rng.random() < 0.5 else 0
        bit = int(rng.integers(low, width))
        first = max(0, min(rows[place - 1], row - WAYPOINT_TICKS) - 1)
        piece = {name: column[first : end + 1].copy() for name, column in run.columns.items()}
        before = float(piece[state.name][row - first])
        after = flipped(before, state.dtype, bit)
        piece[state.name] = piece[state.name].astype(np.float64)
        piece[state.name][row - first : end - first] = after
        change = abs(after - before) if np.isfinite(after) and np.isfinite(before) else np.inf
        material = not change < MATERIAL.get(state.unit, 2.0)
        stamps = np.asarray(piece["stamp_s"], np.float64)
        yield Strike(
            state.name, field_of(state.dtype, bit), material, piece,
            float(stamps[row - first]), float(stamps[end - first]),
        )  # fmt: skip
        count -= 1


def found(held: list[Run], count: int = 3000) -> None:
    """Print the share of strikes that raise an alarm at once, and false alarms, per detector."""
    struck = list(strikes(held, count))
    hours = sum(run.duration_s for run in held) / 3600.0
    kept: dict[str, np.ndarray] = {}
    for name in base.PLUG_INS.names:
        seen = []
        detector = DetectorConfig(name=name).build(STACK)
        for strike in struck:
            judged = replay(strike.columns, detector)
            seen.append(
                any(
                    j.alarm is not None and strike.stamp_s <= j.stamp_s < strike.over_s
                    for j in judged
                )
            )
        kept[name] = np.array(seen)
    print(f"{len(held)} flights, {hours:.2f} h\n\n{'false alarms':34}", end="")
    for name in kept:
        alarms = sum(
            j.alarm is not None
            for run in held
            for j in replay(run.columns, DetectorConfig(name=name).build(STACK))
        )
        print(f" {name}: {alarms} ({alarms / hours:.1f}/h)", end="")
    keys = [(strike.state, strike.field, strike.material) for strike in struck]
    print(f"\n\n{'found of the flips':34} {'flips':>6} " + " ".join(f"{n:>7}" for n in kept))
    rows: list[tuple[str, np.ndarray]] = [
        ("all", np.ones(len(keys), bool)),
        ("material", np.array([m for _, _, m in keys])),
    ]
    rows += [
        (f"material, {field}", np.array([m and f == field for _, f, m in keys]))
        for field in ("sign", "exponent", "mantissa", "integer")
    ]
    rows += [
        (f"material, {state}", np.array([m and s == state for s, _, m in keys])) for state in NAMES
    ]
    for label, chosen in rows:
        if chosen.any():
            shares = " ".join(f"{kept[n][chosen].mean():7.1%}" for n in kept)
            print(f"{label:34} {chosen.sum():6} {shares}")


def reference(held: list[Run], count: int = 1500) -> None:
    """Print the Gaussian detector's alarms for several treatments of samples that raise alarms.

    A treatment learns from such a sample or not, and uses it as the next delta's reference or not.
    """
    struck = list(strikes(held, count))
    print(f"{'GAD':38} {'strikes found':>14} {'alarms at the next message, each':>33}")
    for label, cold, learns, follows in (
        ("warmed; neither", False, False, False),
        ("warmed; next reference", False, False, True),
        ("warmed; learned", False, True, False),
        ("cold; neither", True, False, False),
        ("cold; learned", True, True, False),
    ):
        found = later = 0
        for strike in struck:
            detector: Any = GaussianDetector.cold() if cold else base.find_detector("gad")
            alarms = set()
            for judged in replay(strike.columns, detector, patience=0 if follows else 1000):
                if judged.alarm is None:
                    continue
                if learns:
                    detector.learn(judged.deltas, judged.alarm.stage)
                alarms.add(judged.stamp_s)
            caught = strike.stamp_s in alarms
            found += caught
            later += caught and strike.over_s in alarms
        print(f"{label:38} {found / count:14.1%} {later / max(found, 1):33.1%}")


def main() -> None:
    """Read the runs, and print the answer to the chosen question."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    questions = {"found": found, "reference": reference}
    parser.add_argument("question", choices=questions)
    parser.add_argument("runs", type=Path)
    given = parser.parse_args()
    runs = golden_runs(given.runs)
    questions[given.question](apart(runs)[1] or runs)


if __name__ == "__main__":
    main()
