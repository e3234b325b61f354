"""From one depth frame to its setpoint: which kernel ran when, as a time table tells.

An invocation's input is the output of the last invocation of the kernel before it that had ended
when this one started: the queues hold one message, and the newest wins.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from typing import Any

from mavfi_cli.mission.companion import SAME_TICK_S
from mavfi_cli.mission.executor import Invocation
from mavfi_cli.mission.platform import KERNELS
from mavfi_cli.mission.response import Reaction
from mavfi_cli.mission.run_folder import Run
from mavfi_cli.mission.timetable import Timetable, read_timetable

CHAIN = ("point_cloud", "octomap", "collision_check")  # from a frame to the verdict on the way
LEAST_S = 1.0  # of flight that a timeline shows
_MARGIN_S = 0.05
_SAME_S = 1e-9


def timeline_of(run: Run) -> dict[str, Any] | None:
    """One second of a flight, from a typical depth frame on; longer where its answer takes longer.

    Times count from the frame's stamp, s. `chain` holds the invocations that led to the setpoint,
    `lanes` all that ran in the window; `plan_setpoint_s` is the setpoint that first follows the
    new plan, where the verdict asked for one.

    Args:
        run: with its time table and trace.

    Returns:
        Plain values; None where no frame was ever answered.

    Raises:
        RecordError: the time table cannot be read.
    """
    timetable = read_timetable(run.folder.kernels)
    stamps = [] if run.trace is None else run.trace["stamp_s"].to_pylist()
    reaction = typical(timetable)
    if reaction is None:
        return None
    chain = chain_of(timetable.invocations, reaction)
    plan = _planned(timetable.invocations, reaction)
    zero_s, answer_s = reaction.frame_stamp_s, reaction.setpoint_stamp_s
    plan_setpoint_s = None if plan is None else _answered(timetable.invocations, stamps, plan.end_s)
    last_s = max(answer_s, plan_setpoint_s or 0.0, zero_s + LEAST_S)
    shown = (zero_s - _MARGIN_S, last_s + _MARGIN_S)
    return {
        "frame_stamp_s": zero_s,
        "response_s": answer_s - zero_s,
        "plan_setpoint_s": None if plan_setpoint_s is None else plan_setpoint_s - zero_s,
        "shown_s": [shown[0] - zero_s, shown[1] - zero_s],
        "chain": {
            each.node: [each.start_s - zero_s, each.end_s - zero_s]
            for each in (*chain, *(() if plan is None else (plan,)))
        },
        "lanes": {kernel: _spans(timetable.invocations, kernel, shown, zero_s) for kernel in KERNELS},
        "setpoints_s": [s - zero_s for s in stamps if shown[0] <= s <= shown[1]],
    }


def typical(timetable: Timetable) -> Reaction | None:
    """The reaction whose time is nearest the median of the flight's; the first of equals.

    Where verdicts asked for new plans, one of those reactions, so that the planner is seen at work.
    """
    reactions = timetable.reactions
    if not reactions:
        return None
    planned = [each for each in reactions if _planned(timetable.invocations, each) is not None]
    median_s = statistics.median(map(_time_s, reactions))
    return min(planned or reactions, key=lambda each: (abs(_time_s(each) - median_s), each.frame_stamp_s))


def _time_s(reaction: Reaction) -> float:
    return reaction.setpoint_stamp_s - reaction.frame_stamp_s


def chain_of(invocations: Sequence[Invocation], reaction: Reaction) -> list[Invocation]:
    """The invocations through which a frame reached its setpoint, in order; control's is the last.

    Fewer where the time table does not hold them all.
    """
    found: list[Invocation] = []
    before_s = reaction.setpoint_stamp_s
    for kernel in reversed(CHAIN):
        last = _last(invocations, kernel, before_s)
        if last is None:
            break
        found.insert(0, last)
        before_s = last.start_s
    ends_s = found[-1].end_s if found else reaction.frame_stamp_s
    control = [
        each
        for each in invocations
        if each.node == "control" and ends_s - _SAME_S <= each.start_s
    ]
    return [*found, *control[:1]]


def _last(
    invocations: Sequence[Invocation], kernel: str, before_s: float
) -> Invocation | None:
    """The newest output of a kernel at a moment."""
    over = [e for e in invocations if e.node == kernel and e.end_s <= before_s + _SAME_S]
    return max(over, key=lambda each: each.end_s, default=None)


def _planned(invocations: Sequence[Invocation], reaction: Reaction) -> Invocation | None:
    """The planning that began in the tick in which the frame was answered."""
    for each in invocations:
        if each.node == "planner" and abs(each.start_s - reaction.setpoint_stamp_s) <= _SAME_S:
            return each
    return None


def _answered(
    invocations: Sequence[Invocation], stamps_s: Sequence[float], ready_s: float
) -> float | None:
    """The first setpoint that knows of an output that was ready at a moment."""
    for each in invocations:
        if each.node == "control" and each.start_s >= ready_s - _SAME_S:
            delay_s = each.end_s - each.start_s
            due_s = each.start_s if delay_s < SAME_TICK_S else each.end_s
            return next((stamp for stamp in stamps_s if stamp >= due_s - _SAME_S), None)
    return None


def _spans(
    invocations: Sequence[Invocation], kernel: str, shown: tuple[float, float], zero_s: float
) -> list[list[float]]:
    """Start and end of what a kernel did in a window, s from its zero."""
    return [
        [each.start_s - zero_s, each.end_s - zero_s]
        for each in invocations
        if each.node == kernel and each.end_s >= shown[0] and each.start_s <= shown[1]
    ]
