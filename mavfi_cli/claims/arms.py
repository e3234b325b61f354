"""What each arm of a campaign loses of the same faults: hardening, ablation.

An arm is a stack with or without a detector. Its faults are those that the arm without protection
has read, so all arms are counted on the same faults in the same scenes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from mavfi_cli.claims.effects import lost_share
from mavfi_cli.claims.flights import FlownMission
from mavfi_cli.stats.paired import holm, mcnemar
from mavfi_cli.stats.shares import Share

PLAIN = "unprotected"
_BASE = "mavbench"
_NAMES = {  # what a variant of mavbench switches
    "": PLAIN,
    "refuses_far_waypoints=true": "far waypoints refused",
    "guards_tracking=true": "tracking guard",
    "owns_sequence_numbers=false": "numbers that heal",
    "control_owns_queue=false": "plan sent every tick",
    "skips_endless_slices=false": "endless slices not skipped",
    "stretches_clock=false,skips_endless_slices=false": "a follower by time",
    "position_gain_per_s=0.8,climb_gain_per_s=0.8,integral_gain_per_s2=0.05,damping_gain=0.1":
        "PID with the gains of hardened",
    "shifts_path_to_vehicle=false": "path not shifted for the check",
    "stops_on_report=false,acts_on_report_once=false": "no stop, every report counts",
    "acts_on_report_once=false": "every report counts",
    "planner_radius_m=1.1,check_radius_m=0.9": "margins of 1.1 m and 0.9 m",
    "plans_in_motion=true": "plans in motion",
    "rejected_plan_pause_s=0.0": "no pause after a rejected plan",
    "goal_tolerance_m=1.0": "goal within 1 m",
    "arrives_at_rest=false": "arrives without rest",
    "turns_before_departure=false": "no turn before departure",
    "processes=[]": "a process for each node",
}  # fmt: skip
_SITES = {
    "queue.waypoint_position": "position in control's queue",
    "waypoint_position": "position",
    "waypoint_duration": "duration",
    "plan_trajectory_seq": "trajectory_seq",
    "plan_future_collision_seq": "future_collision_seq",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Arm:
    """One row of the table.

    Attributes:
        golden: lost golden flights.
        by_site: lost missions of each injection site.
        lost: lost missions of all sites.
        p_value: McNemar's exact test against the unprotected arm; None of that arm itself.
        corrected_p: by Holm, over all arms.
    """

    name: str
    golden: Share
    by_site: Mapping[str, Share]
    lost: Share
    p_value: float | None
    corrected_p: float | None


def arm_of(flight: FlownMission) -> str:
    """The name of a flight's arm; empty if its stack is no variant of mavbench."""
    base, _, changes = flight.stack.partition(":")
    if base not in (_BASE, f"{_BASE}-protected"):
        return ""
    name = "all four checks" if base != _BASE else _NAMES.get(changes, changes)
    detector = (flight.detector or "").upper()
    if not detector:
        return name
    return detector if name == PLAIN else f"{name} and {detector}"


def arms(flights: Sequence[FlownMission]) -> list[Arm]:
    """The arms of a campaign, the unprotected one first; none unless it flew several stacks."""
    if len({each.stack for each in flights}) < 2:
        return []
    named = [(arm_of(each), each) for each in flights]
    faulty: dict[str, dict[tuple[str, str], FlownMission]] = {}
    for name, each in named:
        if name and not each.golden:
            faulty.setdefault(name, {})[each.scene, each.fault] = each
    if PLAIN not in faulty:
        return []
    active = {key for key, each in faulty[PLAIN].items() if each.activation == "read"}
    shared = sorted(active.intersection(*faulty.values()))
    if not shared:
        return []
    order = sorted(faulty, key=lambda name: name != PLAIN)
    kept = {name: [faulty[name][key] for key in shared] for name in order}
    tests = {
        name: mcnemar([not x.lost for x in kept[PLAIN]], [not x.lost for x in those]).p_value
        for name, those in kept.items()
        if name != PLAIN
    }
    corrected = dict(zip(tests, holm([*tests.values()]), strict=True))
    return [
        Arm(
            name=name,
            golden=lost_share([each for own, each in named if own == name and each.golden]),
            by_site=_by_site(those),
            lost=lost_share(those),
            p_value=tests.get(name),
            corrected_p=corrected.get(name),
        )
        for name, those in kept.items()
    ]


def _by_site(flights: Sequence[FlownMission]) -> dict[str, Share]:
    found: dict[str, list[FlownMission]] = {}
    for each in flights:
        target = str(each.fault_target)
        found.setdefault(_SITES.get(target, target), []).append(each)
    ordered = [name for name in _SITES.values() if name in found]
    return {name: lost_share(found[name]) for name in (*ordered, *(found.keys() - {*ordered}))}
