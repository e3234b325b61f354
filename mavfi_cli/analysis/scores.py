"""Recorded flights as seen by detectors: samples for fitting, and one score per replayed flight.

The score of an unprotected flight is the highest score of its messages, divided by the detector's
threshold. With a score above 1, the gate would have raised an alarm. Nothing is withheld during the
replay, so a message's score does not depend on the threshold. Steps of the active plan are scored
too.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import pyarrow as pa

from mavfi_cli.analysis.detectors import NONE, Scored, harmful
from mavfi_cli.analysis.flights import chosen
from mavfi_cli.core.errors import MavfiError, ModelError, RecordError
from mavfi_cli.core.files import Json, read_json, write_json
from mavfi_cli.core.types import BY_NAME, Outcome, StackMark, Stage, Trajectory
from mavfi_cli.detect.base import Model
from mavfi_cli.detect.offline import Columns, FlightSamples, PlanStrike, columns_of, replay
from mavfi_cli.detect.preprocess import PreprocessParams
from mavfi_cli.fi import bits
from mavfi_cli.mission.run_folder import RESULT, Run, load_run
from mavfi_cli.mission.setpoints import samples_of_tlog
from mavfi_cli.spec.companion import CompanionConfig
from mavfi_cli.spec.detector import DetectorConfig
from mavfi_cli.spec.mission import OWN_AUTOPILOT
from mavfi_cli.spec.stack import load_stack

SCORES = "scores.json"
_LARGEST = 1 << 27  # bytes of stored scores
_WAY = "looks ahead"  # scoring method; scores of other methods are not mixed with these


_Seen = tuple[Columns, Sequence[Trajectory], list[PlanStrike]]  # what the gate sees of a flight


def scored(
    detectors: Sequence[DetectorConfig],
    stack: str,
    folder: Path,
    pairs: tuple[pa.Table, pa.Table],
    note: Callable[[str], None],
) -> Scored:
    """Replay flights through detectors. Return a function that looks up the scores of a detector.

    The scored flights are the unprotected ones with a harmful fault, and the golden ones.

    Args:
        detectors: the detectors to score, without `none`.
        folder: folder whose file SCORES caches the scores by run folder. Only missing scores are
            computed.
        pairs: the pairs without a fault and those with one, as `detectors.pairs_of` returns them.
        note: called with a text that tells how many flights are replayed.
    """
    store = folder / SCORES
    kept: dict[str, dict[str, float | None]] = {}
    with contextlib.suppress(RecordError):  # missing or damaged
        kept = read_json(store, _LARGEST)
    names = {
        detector.name: f"{detector.name}/{'+'.join(sorted(detector.protect))}/{_WAY}/"
        f"{detector.model_digest(stack)}"
        for detector in detectors
    }
    scores = {detector.name: kept.setdefault(names[detector.name], {}) for detector in detectors}
    struck = harmful(pairs[1])
    paths = struck["faulty_path"].to_pylist()
    golden = chosen(pairs[0], detector=NONE)["golden_path"].to_pylist()
    begins = [*struck["faulty_struck_s"].to_pylist(), *[None] * len(golden)]
    missing = [
        (Path(path), struck_s)
        for path, struck_s in zip([*paths, *golden], begins, strict=True)
        if path is not None and any(Path(path).name not in own for own in scores.values())
    ]
    if missing:
        note(f"replaying {len(missing)} flights through {len(names)} detectors")
        for path, struck_s in missing:
            seen = _seen_of(path)
            for detector in detectors:
                if path.name not in scores[detector.name]:
                    scores[detector.name][path.name] = _score(seen, struck_s, detector, stack)
        write_json(store, kept)

    def known(path: str | None, detector: str) -> float | None:
        """Return the score of a flight, or None if the flight was not replayed.

        A stored null, which stands for NaN or infinity, gives an infinite score.
        """
        if path is None or Path(path).name not in scores[detector]:
            return None
        score = scores[detector][Path(path).name]
        return math.inf if score is None else score

    def of(detector: str) -> tuple[pa.Table, list[float]]:
        positive = pa.array([known(path, detector) for path in paths], pa.float64())
        table = struck.select(["stage", "field"]).append_column("score", positive)
        negative = (known(path, detector) for path in golden)
        return table.drop_null(), [score for score in negative if score is not None]

    return of


def _seen_of(path: Path) -> _Seen:
    run = load_run(path)
    if run.trace is None:
        return {}, (), []
    strikes = [
        PlanStrike(
            stamp_s=strike.stamp_s, state=change.state, waypoint=change.index,
            before=_value(change.state, change.before_hex),
            after=_value(change.state, change.after_hex),
        )
        for strike in run.record.strikes
        for change in strike.changes
        if change.state in BY_NAME and BY_NAME[change.state].stage is Stage.PLANNING
    ]  # fmt: skip
    return columns_of(run.trace), run.folder.read_plans(), strikes


def _value(state: str, pattern: str) -> float | int | bool:
    """Decode the value of a state from its bits in hexadecimal.

    The bits are used because a record contains only finite numbers.
    """
    kind = bits.NUMPY_TYPES[BY_NAME[state].dtype.value]
    return kind.value(int(pattern, 16))


def _score(seen: _Seen, struck_s: float | None, detector: DetectorConfig, stack: str) -> float:
    """Return the highest score of a flight, divided by the detector's threshold.

    If a fault struck, only messages from `struck_s` on count. A NaN score gives infinity.
    """
    columns, plans, strikes = seen
    if not columns:  # the flight ended before the first tick
        return 0.0
    path, fresh = detector.model_path(stack), detector.build(stack)
    from_s = -math.inf if struck_s is None else struck_s - 1e-9
    highest = 0.0
    judgements = replay(
        columns, fresh, None if path is None else Model.read(path).preprocess,
        protect=frozenset(map(Stage, detector.protect)), plans=plans, strikes=strikes,
    )  # fmt: skip
    for judged in judgements:
        if judged.stamp_s >= from_s and not judged.score <= highest:
            highest = judged.score
            if math.isnan(highest):
                return math.inf
    return highest / fresh.threshold


def flown_samples(flown: Path, stack: StackMark) -> tuple[list[FlightSamples], int, set[str]]:
    """Collect training samples from the error-free flights of a stack in the folder `flown`.

    Returns:
        The samples of each error-free flight, the number of runs that were rejected because they
        are not error-free flights of the stack, and the autopilots of the error-free flights. A
        flight is named after its world, or after its run folder if an earlier flight has the same
        world and seed.

    Raises:
        ModelError: no run in the folder is an error-free flight of the stack.
    """
    runs = [load_run(path) for path in sorted(flown.glob(f"*/{RESULT}"))]
    usable = [run for run in runs if _is_error_free(run, stack)]
    if not usable:
        problem = f"none of the {len(runs)} runs is an error-free flight of stack {stack.name!r}"
        raise ModelError(problem, path=flown)
    flights: dict[tuple[str, int], FlightSamples] = {}
    for run in usable:
        config = run.record.config
        world = config["world"]
        name = run.folder.path.name if (world, config["seed"]) in flights else world
        if config.get("companion"):
            seed = config["seed"]
            flights[name, seed] = samples_of_tlog(run.folder.tlog, name, seed)
            continue
        assert run.trace is not None
        columns, plans = columns_of(run.trace), run.folder.read_plans()
        flights[name, config["seed"]] = FlightSamples.of_trace(
            columns, name, config["seed"], PreprocessParams(), plans
        )
    autopilots = {run.record.config.get("autopilot", OWN_AUTOPILOT) for run in usable}
    return list(flights.values()), len(runs) - len(usable), autopilots


def _is_error_free(run: Run, stack: StackMark) -> bool:
    """Return True for a flight of the stack that reached the goal without a fault or an alarm."""
    record = run.record
    faults = (record.config["fault"], record.config["instruction"])
    return (
        record.outcome == Outcome.SUCCESS.value
        and faults == (None, None)
        and not (record.detection and record.detection.alarm_count)
        and (record.mark or _digest_of(record.config)) == stack.digest
    )


def _digest_of(config: Json) -> str:
    """Return the digest of what a configuration names, or "" if its file is gone or bad."""
    companion = config.get("companion")
    with contextlib.suppress(MavfiError):
        if companion:
            return CompanionConfig.load(companion, starts=False).mark.digest
        return load_stack(config["stack"]).mark.digest
    return ""
