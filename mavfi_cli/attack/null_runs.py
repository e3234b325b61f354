"""Null runs, which leave out the flip, show whether a target's runs are repeatable.

An outcome is meaningful only if a run without a flip ends as the golden run did. A target may
depend on time or on chance. It may also read its own code as data; then a detour, which counts
executions by patching code, changes its output. So a campaign begins with null runs of some of its
first faults, which cover every counting method, and then avoids detours that change the output.
"""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest

from mavfi_cli.attack.attacker import RunResult, Task
from mavfi_cli.attack.profile import TargetProfile
from mavfi_cli.attack.target import RunOutcome
from mavfi_cli.core.errors import TargetError
from mavfi_cli.fi.tracer.counted import CountedStop, Counting
from mavfi_cli.fi.tracer.fault import InstructionFault
from mavfi_cli.fi.tracer.image import Location
from mavfi_cli.fi.tracer.tracee import DETOUR_COST

NULL_RUNS = 20
_FAULTS = 64  # first faults of the campaign, from which null runs are chosen
_REPEATED = 3  # repetitions of a differing null run, to separate detours from chance
_APART_S = 1.0  # minimum time between the golden runs and the last null run
_TIMER = "timer"
_DETOURS = (Counting.FAR_DETOUR, Counting.DETOUR)
Profiles = tuple[TargetProfile | None, ...]  # one per input; None for time rules
Run = Callable[[Sequence[Task]], Iterable[tuple[int, RunResult]]]


@dataclass(frozen=True, slots=True, kw_only=True)
class NullRuns:
    """The null runs of a target. All ended as the golden run did.

    Attributes:
        tasks: the faults whose flips were left out.
        counting: number of null runs that reached the instruction of their fault, keyed by the name
            of the counting method.
        unused: names of the counting methods that are avoided because they change the output.
    """

    tasks: tuple[Task, ...]
    counting: Mapping[str, int]
    unused: tuple[str, ...]

    @property
    def reached(self) -> int:
        """Number of null runs that reached the instruction of their fault."""
        return sum(self.counting.values())


def make_null_runs(
    name: str,
    profiles: Profiles,
    draw: Callable[[Profiles, int], InstructionFault | None],
    run: Run,
) -> tuple[Profiles, NullRuns]:
    """Make null runs of a target, and stop using detours if they change its output.

    Args:
        name: the target's name for errors.
        draw: returns the fault with a given number, drawn from the profiles; None for time rules.
        run: runs tasks without their flips.

    Returns:
        The profiles without the dropped counting methods, and the null runs.

    Raises:
        TargetError: null runs end differently from the golden run.
    """
    unused: tuple[Counting, ...] = ()
    while True:
        tasks = _by_turns([(number, draw(profiles, number)) for number in range(_FAULTS)])
        made = _make(tasks, run)
        differing = [null_run for null_run in made if null_run.differs]
        if not differing:
            return profiles, NullRuns(
                tasks=tasks,
                counting=Counter(null_run.method for null_run in made if null_run.reached),
                unused=tuple(method.value for method in unused),
            )
        methods = {null_run.method for null_run in differing}
        spoiling = [at for at, method in enumerate(_DETOURS) if method.value in methods]
        again = [null_run.differs for null_run in _make([differing[0].task] * _REPEATED, run)]
        if len(spoiling) < len(methods) or not all(again):
            raise TargetError(name, _problem(made))
        unused = _DETOURS[: spoiling[-1] + 1]
        profiles = tuple(profile and profile.without(unused) for profile in profiles)


def require_golden_again(name: str, null_runs: NullRuns, run: Run, golden_s: float) -> None:
    """Repeat the first null run, to detect a change over time, such as a change of date.

    Args:
        golden_s: end of the golden runs on `time.monotonic`. The null run begins at least a
            second later, which exposes a program that prints the time in seconds.

    Raises:
        TargetError: the null run no longer ends as the golden run did.
    """
    time.sleep(max(0.0, golden_s + _APART_S - time.monotonic()))
    if any(null_run.differs for null_run in _make(null_runs.tasks[:1], run)):
        raise TargetError(
            name,
            "a run without a flip no longer ends as the golden run did, so no outcome can be "
            "judged: the target depends on time or on what earlier runs left behind",
        )


@dataclass(frozen=True, slots=True)
class _NullRun:
    task: Task
    outcome: RunOutcome
    reached: bool

    @property
    def differs(self) -> bool:
        """Whether the null run ended differently from the golden run."""
        return self.outcome is not RunOutcome.BENIGN

    @property
    def method(self) -> str:
        """Name of the method that counted the executions up to the fault.

        If several methods did, it is the one that changes the most code.
        """
        if self.task[1] is None:
            return _TIMER
        return _counting(self.task[1]).value


def _make(tasks: Sequence[Task], run: Run) -> list[_NullRun]:
    return [
        _NullRun(task, result.verdict.outcome, result.fault is None or not result.reason)
        for task, (_, result) in zip(tasks, run(tasks), strict=True)
    ]


def _problem(made: Iterable[_NullRun]) -> str:
    """Explain why no outcome can be judged, with the number of differing null runs per method."""
    methods: dict[str, list[_NullRun]] = defaultdict(list)
    for null_run in made:
        methods[null_run.method].append(null_run)
    parts = []
    for method, runs in methods.items():
        ends = Counter(null_run.outcome.title for null_run in runs if null_run.differs)
        text = ", ".join(f"{title} {count}" for title, count in ends.items())
        parts.append(f"{method}: {ends.total()} of {len(runs)}{text and f' ({text})'}")
    return (
        "runs without a flip end differently from the golden run, so no outcome can be judged; by "
        f"counting method: {'; '.join(parts)}; --ignore-lines skips lines of a "
        "program that vary"
    )


def _by_turns(faults: Sequence[Task]) -> tuple[Task, ...]:
    """Choose up to `NULL_RUNS` faults, in rotation among counting methods and detour locations."""
    methods: dict[Counting, dict[Location | None, list[Task]]] = {}
    for task in faults:
        stops = _detours(task[1])
        places = methods.setdefault(_counting(task[1]), {})
        places.setdefault(stops[0].location if stops else None, []).append(task)
    return tuple(_in_turn([_in_turn(group.values()) for group in methods.values()])[:NULL_RUNS])


def _in_turn(lists: Iterable[Sequence[Task]]) -> list[Task]:
    return [task for row in zip_longest(*lists) for task in row if task is not None]


def _detours(fault: InstructionFault | None) -> list[CountedStop]:
    """Return the stages of a fault's trigger whose executions a detour counts."""
    stages = () if fault is None else fault.trigger
    return [stage for stage in stages if stage.detour is not None and stage.count >= DETOUR_COST]


def _counting(fault: InstructionFault | None) -> Counting:
    """Return the method that counts the executions up to a fault.

    If several methods do, return the one that changes the most code.
    """
    used = {stage.detour.counting for stage in _detours(fault) if stage.detour is not None}
    return next((method for method in Counting if method in used), Counting.BREAKPOINT)
