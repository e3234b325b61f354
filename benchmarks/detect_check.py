"""What detectors cost and what they see. `cost` needs nothing; the rest reads error-free runs.

    python benchmarks/detect_check.py cost
    python benchmarks/detect_check.py coding RUNS
    python benchmarks/detect_check.py flips RUNS
    python benchmarks/detect_check.py reference RUNS
    python benchmarks/detect_check.py fit RUNS OUT

RUNS is a folder below which golden runs of `mavfi fly` lie. `cost` times the gate itself, as the
control loop calls it. `coding` compares ways to join sign and exponent. `flips` flips bits in
flown messages and asks every detector. `reference` asks what an alarmed sample should do to the
model and to the next delta. `fit` writes models fitted to the runs of the training worlds.
"""

from __future__ import annotations

import json
import struct
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter_ns
from typing import Any

import numpy as np

from mavfi_cli.core.states import BY_NAME, DType
from mavfi_cli.core.types import CollisionReport, Command, Stage, Trajectory
from mavfi_cli.detect import fit, model, registry
from mavfi_cli.detect.dataset import Dataset
from mavfi_cli.detect.gate import Gate
from mavfi_cli.detect.gaussian import GaussianDetector
from mavfi_cli.detect.offline import columns_of, flight_of, replay
from mavfi_cli.detect.preprocess import DETECTED, NAMES, SPANS, PreprocessParams

TICK_S = 0.02
REPORT_EVERY = 15  # ticks
WAYPOINT_TICKS = 25


@dataclass(frozen=True, slots=True)
class Run:
    """One golden run."""

    world: str
    seed: int
    columns: dict[str, Any]

    @property
    def training(self) -> bool:
        """Whether its world is one to train on."""
        return self.world.startswith("train-")

    @property
    def duration_s(self) -> float:
        """Simulated seconds."""
        stamps = np.asarray(self.columns["stamp_s"], np.float64)
        return float(stamps[-1] - stamps[0])


def golden_runs(folder: Path) -> list[Run]:
    """All runs without a fault below a folder, each world and seed once."""
    import pyarrow.parquet as pq

    found: dict[tuple[str, int], Run] = {}
    for path in sorted(folder.rglob("result.json")):
        result = json.loads(path.read_text())
        trace = path.with_name("trace.parquet")
        if result["fault"] is not None or not trace.is_file():
            continue
        world, seed = result["config"]["world"], result["config"]["seed"]
        found[world, seed] = Run(world, seed, columns_of(pq.read_table(trace)))
    if not found:
        raise SystemExit(f"error: no golden runs below {folder}")
    return [found[key] for key in sorted(found)]


def dataset_of(runs: list[Run]) -> Dataset:
    """The samples of some runs."""
    flights = tuple(flight_of(run.columns, run.world, run.seed) for run in runs)
    return Dataset(flights=flights, preprocess=PreprocessParams())


# cost


def cost() -> None:
    """Time a minute of flight, over and over; the best of several rounds."""
    ticks = 3000
    angles = np.arange(ticks) * 0.004
    waypoints = np.zeros((ticks // WAYPOINT_TICKS + 1, 10))
    waypoints[:, 0] = np.arange(len(waypoints)) * 1.2
    waypoints[:, 4] = 2.4
    trajectory = Trajectory(
        stamp_s=0.0,
        waypoints=waypoints,
        durations_s=np.full(len(waypoints), 0.5),
        trajectory_seq=1,
        future_collision_seq=0,
    )
    commands = [
        Command(
            stamp_s=i * TICK_S,
            yaw_rad=0.5 * np.sin(a),
            velocity_enu_mps=np.array([2.0 + 0.4 * np.sin(a), np.sin(a), 0.05]),
        )
        for i, a in enumerate(angles.tolist())
    ]
    report = CollisionReport(stamp_s=0.0, collision=False, time_to_collision_s=np.inf,
                             future_collision_seq=1)  # fmt: skip

    def loop(judge: Callable[[Trajectory, int, Command], object]) -> float:
        begun = perf_counter_ns()
        for i, command in enumerate(commands):
            judge(trajectory, i // WAYPOINT_TICKS, command)
        return (perf_counter_ns() - begun) / ticks

    def timed(gate: Gate) -> float:
        for stage in Stage:
            gate.forget(stage)
        assert not any(gate.judge_tick(trajectory, i // WAYPOINT_TICKS, c) for i, c in
                       enumerate(commands)), "this flight is error-free"  # fmt: skip
        for stage in Stage:
            gate.forget(stage)
        return loop(gate.judge_tick)

    empty = min(loop(lambda *_: None) for _ in range(7))
    print(f"{'detector':10} {'a check, us':>12} {'with waypoint':>15} {'share of 50 Hz':>15}"
          f" {'a report, us':>13}")  # fmt: skip
    for name in registry.names():
        gate = Gate(registry.find(name))
        each = min(timed(gate) for _ in range(7)) - empty
        fresh = []
        for i in range(100):
            begun = perf_counter_ns()
            gate.judge_tick(trajectory, 100 - i, commands[-1])
            fresh.append(perf_counter_ns() - begun)
        begun = perf_counter_ns()
        for _ in range(ticks):
            gate.judge_report(report)
        a_report = (perf_counter_ns() - begun) / ticks
        print(f"{name:10} {each / 1e3:12.2f} {np.median(fresh) / 1e3:15.2f}"
              f" {each / (TICK_S * 1e9):15.4%} {a_report / 1e3:13.2f}")  # fmt: skip
    print(
        f"\nA check is one control tick through Gate.judge_tick, a new waypoint every "
        f'{WAYPOINT_TICKS}th; "with waypoint" has one\neach time (median). Reports come every '
        f"{REPORT_EVERY} ticks. The loop itself, {empty / 1e3:.2f} us, is taken off."
    )


# coding


def coded(values: np.ndarray, way: str, floor: int, ceiling: int) -> np.ndarray:
    """Codes of float64 values under one of the candidate ways."""
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
    """Deltas between consecutive samples; a yaw that wraps from beyond +-2 rad has not changed."""
    deltas = np.diff(coded(values, way, floor, ceiling))
    wrapped = (np.abs(values) >= 2.0) & (np.abs(values) < 4.0)
    opposite = wrapped[1:] & wrapped[:-1] & (values[1:] * values[:-1] < 0.0)
    return np.where(opposite, 0, deltas) if wraps and "log" in way else deltas


MATERIAL = {"m": 1.0, "m/s": 1.0, "rad": 0.5, "s": 1.0}  # change of a value that can matter


def samples_of(run: Run, name: str) -> np.ndarray:
    """Values of a state, one a message."""
    values = np.ma.filled(run.columns[name].astype(np.float64), np.nan)
    return np.asarray(values)[fresh_rows(run, name)]


def fresh_rows(run: Run, name: str) -> list[int]:
    """Rows in which a new message carried the state."""
    state = BY_NAME[name]
    mates = NAMES[slice(*SPANS[state.stage])]
    values = np.column_stack(
        [np.ma.filled(run.columns[mate].astype(np.float64), np.nan) for mate in mates]
    )
    present = ~np.ma.getmaskarray(run.columns[name])
    if state.stage is Stage.CONTROL:
        return np.flatnonzero(present).tolist()
    patterns = values.view(np.int64)
    new = present.copy()
    new[1:] &= (patterns[1:] != patterns[:-1]).any(axis=1) | ~present[:-1]
    return np.flatnonzero(new).tolist()


def coding(runs: list[Run]) -> None:
    """Candidates: normal range of the deltas, and the material flips that leave it."""
    training = [run for run in runs if run.training]
    held = [run for run in runs if not run.training]
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
                limit = int(np.abs(trained).max())
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
    """Material flips whose delta is beyond the limit, and all material ones."""
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


# flips


def flipped(value: float, dtype: DType, bit: int) -> float:
    """The value with one bit flipped."""
    if dtype is DType.INT32:
        pattern = int(value) & 0xFFFFFFFF ^ 1 << bit
        return float(pattern - (1 << 32) if pattern >> 31 else pattern)
    pattern = struct.unpack("<Q", struct.pack("<d", value))[0] ^ 1 << bit
    return float(struct.unpack("<d", struct.pack("<Q", pattern))[0])


def field_of(dtype: DType, bit: int) -> str:
    """Which field a bit belongs to."""
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
    """Pieces of flights, each from the message before the struck one to the one after it."""
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


def flips(runs: list[Run], count: int = 3000) -> None:
    """Which strikes raise an alarm at once, and false alarms on the same flights."""
    held = [run for run in runs if not run.training] or runs
    struck = list(strikes(held, count))
    hours = sum(run.duration_s for run in held) / 3600.0
    kept: dict[str, np.ndarray] = {}
    for name in registry.names():
        seen = []
        detector = registry.find(name)
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
            j.alarm is not None for run in held for j in replay(run.columns, registry.find(name))
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


# reference


def reference(runs: list[Run], count: int = 1500) -> None:
    """An alarmed sample: is it learned from, and is it the next delta's reference?"""
    held = [run for run in runs if not run.training] or runs
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
            detector: Any = GaussianDetector.cold() if cold else registry.find("gad")
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


def fit_models(runs: list[Run], out: Path) -> None:
    """Fit every kind to the runs of the training worlds."""
    data = dataset_of([run for run in runs if run.training])
    out.mkdir(parents=True, exist_ok=True)
    for kind in fit.KINDS:
        fitted = fit.fit(kind, data)
        model.save(out / f"{kind}.json", fitted)
        print(kind, {k: v for k, v in fitted.provenance.items() if isinstance(v, (int, float))})


def main(arguments: list[str]) -> None:
    """Run one of the subcommands."""
    commands = {"coding": coding, "flips": flips, "reference": reference}
    match arguments:
        case ["cost"]:
            cost()
        case ["fit", folder, out]:
            fit_models(golden_runs(Path(folder)), Path(out))
        case [name, folder] if name in commands:
            commands[name](golden_runs(Path(folder)))
        case _:
            raise SystemExit(__doc__)


if __name__ == "__main__":
    main(sys.argv[1:])
