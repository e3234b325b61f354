"""Kernel invocations from a depth frame to the first setpoint that depends on it.

They are taken from the recorded timetable of a flight. When an invocation starts, its input is the
newest output of the preceding kernel, because the queues keep only the newest message.
"""

from __future__ import annotations

import statistics
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import pyarrow as pa

from mavfi_cli.analysis.flights import chosen
from mavfi_cli.companion.pipeline import SAME_TICK_S
from mavfi_cli.core.types import KERNELS, Invocation, Outcome, Reaction
from mavfi_cli.mission.run_folder import Run

_CHAIN = ("point_cloud", "octomap", "collision_check")  # from a frame to the verdict
LEAST_S = 1.0  # minimum duration of a timeline
_ANSWERS = ("slow", "stop")  # events: reactions of the pilot to a foreseen collision
_PLAN_WITHIN_S = 3.0
_MARGIN_S = 0.05
_SAME_S = 1e-9


Span = tuple[float, float]  # begin and end, s after the frame's stamp


@dataclass(frozen=True, slots=True, kw_only=True)
class Timeline:
    """The kernel invocations and setpoints in a window of a flight around a typical depth frame.

    The window is at least one second long. All times except `frame_stamp_s` are in seconds after
    the frame's stamp.

    Attributes:
        platform: name of the platform.
        frame_stamp_s: simulated time of the frame.
        response_s: time of the first setpoint that depends on the frame.
        answer: the pilot's reaction to the frame, in words.
        plan_setpoint_s: time of the first setpoint of the new plan; None if the reaction led to no
            new plan.
        shown_s: begin and end of the window.
        chain_s: begin and end of the invocations that led to the setpoints, by kernel.
        lanes_s: begin and end of all invocations in the window, by kernel.
        setpoints_s: times of all setpoints in the window.
    """

    platform: str
    frame_stamp_s: float
    response_s: float
    answer: str
    plan_setpoint_s: float | None
    shown_s: Span
    chain_s: Mapping[str, Span]
    lanes_s: Mapping[str, Sequence[Span]]
    setpoints_s: Sequence[float]


def timelines(runs: Mapping[str, Run]) -> list[Timeline]:
    """Return equally long timelines of all platforms whose flight reacted to a depth frame.

    Args:
        runs: one run per platform, with its timetable and trace, keyed by the platform's name.

    Raises:
        RecordError: a timetable cannot be read.
    """
    alone = [_timeline_of(name, run) for name, run in runs.items()]
    longest_s = max((line.shown_s[1] for line in alone if line), default=LEAST_S)
    return [line for name, run in runs.items() if (line := _timeline_of(name, run, longest_s))]


def _timeline_of(platform: str, run: Run, least_s: float = LEAST_S + _MARGIN_S) -> Timeline | None:
    """Return the timeline of a flight, or None if no setpoint of the flight reacted to a frame.

    The timeline lasts at least until `least_s` after the frame. If a foreseen collision made the
    vehicle slow down or stop, the timeline is that of a frame with this effect, and lasts at least
    until the first setpoint of the new plan.
    """
    ran, reactions = run.folder.read_timetable()
    answers = {event.stamp_s: event.text for event in run.record.events if event.kind in _ANSWERS}
    stamps = [] if run.trace is None else run.trace["stamp_s"].to_pylist()
    reaction = _typical(reactions, answers)
    if reaction is None:
        return None
    zero_s, answer_s = reaction.frame_stamp_s, reaction.setpoint_stamp_s
    chain = _chain_of(ran, reaction)
    plan = _planned(ran, answer_s) if answer_s in answers else None
    plan_setpoint_s = None if plan is None else _answered(ran, stamps, plan.end_s)
    last_s = max(answer_s, plan_setpoint_s or 0.0) + _MARGIN_S
    begin_s, end_s = zero_s - _MARGIN_S, max(last_s, zero_s + least_s)

    def span(invocation: Invocation) -> Span:
        return invocation.start_s - zero_s, invocation.end_s - zero_s

    return Timeline(
        platform=platform,
        frame_stamp_s=zero_s,
        response_s=answer_s - zero_s,
        answer=answers.get(answer_s, "uses the frame"),
        plan_setpoint_s=None if plan_setpoint_s is None else plan_setpoint_s - zero_s,
        shown_s=(begin_s - zero_s, end_s - zero_s),
        chain_s={
            invocation.node: span(invocation)
            for invocation in (*chain, *(() if plan is None else (plan,)))
        },
        lanes_s={
            kernel: [
                span(invocation)
                for invocation in ran
                if invocation.node == kernel
                and invocation.end_s >= begin_s
                and invocation.start_s <= end_s
            ]
            for kernel in KERNELS
        },
        setpoints_s=[stamp - zero_s for stamp in stamps if begin_s <= stamp <= end_s],
    )


def _typical(reactions: Sequence[Reaction], answers: Collection[float]) -> Reaction | None:
    """Return the reaction whose duration is closest to the median of all, or None without any.

    Ties go to the earliest frame.

    Args:
        answers: stamps of setpoints. If some reactions end in one of them, only these are
            candidates.
    """
    if not reactions:
        return None
    times_s = {
        reaction: reaction.setpoint_stamp_s - reaction.frame_stamp_s for reaction in reactions
    }
    median_s = statistics.median(times_s.values())
    chosen = [
        reaction for reaction in reactions if reaction.setpoint_stamp_s in answers
    ] or reactions
    return min(
        chosen, key=lambda reaction: (abs(times_s[reaction] - median_s), reaction.frame_stamp_s)
    )


def _chain_of(invocations: Sequence[Invocation], reaction: Reaction) -> list[Invocation]:
    """Return the invocations that led from a frame to its setpoint, in order, control last.

    The list is shorter if invocations are missing from the timetable.
    """
    chain: list[Invocation] = []
    before_s = reaction.setpoint_stamp_s
    for kernel in reversed(_CHAIN):  # the newest output of each kernel
        over = [e for e in invocations if e.node == kernel and e.end_s <= before_s + _SAME_S]
        if not over:
            break
        chain.insert(0, max(over, key=lambda invocation: invocation.end_s))
        before_s = chain[0].start_s
    ends_s = chain[-1].end_s if chain else reaction.frame_stamp_s
    control = [e for e in invocations if e.node == "control" and ends_s - _SAME_S <= e.start_s]
    return [*chain, *control[:1]]


def _planned(invocations: Sequence[Invocation], answer_s: float) -> Invocation | None:
    """Return the first invocation of the planner that starts at or after `answer_s`, or None.

    None means that no invocation starts within _PLAN_WITHIN_S.
    """
    for invocation in invocations:
        if invocation.node == "planner" and invocation.start_s >= answer_s - _SAME_S:
            return invocation if invocation.start_s <= answer_s + _PLAN_WITHIN_S else None
    return None


def _answered(
    invocations: Sequence[Invocation], stamps_s: Sequence[float], ready_s: float
) -> float | None:
    """Return the stamp of the first setpoint that uses an output ready at `ready_s`, or None.

    None means that the flight has no such setpoint.
    """
    for invocation in invocations:
        if invocation.node == "control" and invocation.start_s >= ready_s - _SAME_S:
            delay_s = invocation.end_s - invocation.start_s
            due_s = invocation.start_s if delay_s < SAME_TICK_S else invocation.end_s
            return next((stamp for stamp in stamps_s if stamp >= due_s - _SAME_S), None)
    return None


def timeline_seed(flights: pa.Table, platforms: Sequence[str]) -> int | None:
    """Return the lowest seed of a golden mission that succeeds on all platforms, or None.

    Missions that also replan on all platforms are preferred.

    Args:
        flights: golden and other flights, with the columns of `platforms.SCHEMA`.
    """
    golden = chosen(flights, target="", outcome=Outcome.SUCCESS.value)
    columns = (golden[name].to_pylist() for name in ("seed", "platform", "replans"))
    flown = list(zip(*columns, strict=True))
    for least in (1, 0):
        by_seed: dict[int, set[str]] = {}
        for seed, platform, replans in flown:
            if (replans or 0) >= least:
                by_seed.setdefault(seed, set()).add(platform)
        complete = [seed for seed, names in by_seed.items() if len(names) == len(platforms)]
        if complete:
            return min(complete)
    return None
