"""Flights of a comparison, made up."""

import json

import pytest
from made_flights import export_table

from mavfi_cli.analysis.platforms import ComparedTimelines, compared, figures
from mavfi_cli.analysis.timeline import Timeline
from mavfi_cli.studies.compare import ComparePlan

PLAN = ComparePlan(inject=("planning",), missions=10)
SEEDS = range(1, 11)


def flight(platform, seed, time_s, setting="golden", **changes):
    """A successful flight; with faults where the setting is not golden."""
    faulty = setting != "golden"
    values = {
        "platform": platform,
        "setting": setting,
        "target": "planning" if faulty else "",
        "seed": seed,
        "fault_seed": 7 * seed if faulty else None,
        "outcome": "success",
        "counted": True,
        "flight_time_s": time_s,
        "distance_m": 50.0,
        "energy_regression_j": 400.0 * time_s,
        "energy_propeller_j": 100.0 * time_s,
        "replans": 1.0,
        "response_median_s": 0.4 if platform == "x86" else 1.6,
        "response_p95_s": 0.5 if platform == "x86" else 2.0,
    }
    return values | changes


def table(flights):
    """The flights, each beside its golden one and the one with the same fault and no detector."""
    return compared(export_table([{**own, **_configured(own)} for own in flights]))


def _configured(own):
    """What a ledger has of the mission of a flight."""
    fault = {"target": own["target"], "seed": own["fault_seed"]}
    faulty, setting = own["setting"] != "golden", own["setting"]
    return {
        "pair": f"{own['platform']} {own['seed']}",
        "state": "flown",
        "level": "source" if faulty else None,
        "detector": setting if setting in ("gad", "aad") else None,
        "fault_target": own["target"] or None,
        "changes": json.dumps({"fault": fault} if faulty else {}),
    }


def figures_of(plan, flights):
    """The numbers of flights of a plan."""
    return comparison(plan, flights)


def made_up():
    """TX2 is 1.5 times as slow; seed 2's fault costs as much again, and detectors save part."""
    flights = []
    for platform, factor in (("x86", 1.0), ("tx2", 1.5)):
        for seed in SEEDS:
            own_s = factor * (20.0 + seed)
            flights.append(flight(platform, seed, own_s))
            flights.append(flight(platform, seed, own_s * (2.0 if seed == 2 else 1.0), "none"))
            flights.append(flight(platform, seed, own_s * (1.25 if seed == 2 else 1.0), "gad"))
            flights.append(flight(platform, seed, own_s, "aad"))
    return flights


def panel(platform, factor):
    """A frame's way through kernels that take so many times as long as on x86."""
    octomap, check = 0.3 * factor, 0.02 * factor
    answer = round(octomap + check + 0.04, 2)
    chain = {
        "point_cloud": (0.0, 0.002),
        "octomap": (0.02, 0.02 + octomap),
        "collision_check": (0.02 + octomap, 0.02 + octomap + check),
        "control": (answer, answer + 0.0005),
        "planner": (answer, answer + 0.08 * factor),
    }
    return Timeline(
        platform=platform,
        frame_stamp_s=12.0,
        response_s=answer,
        answer="stops before an obstacle",
        plan_setpoint_s=answer + 0.1 * factor,
        shown_s=(-0.05, 2.5),
        chain_s=chain,
        lanes_s={name: [span] for name, span in chain.items()},
        setpoints_s=[0.02 * tick for tick in range(125)],
    )


def comparison(plan, flights, *, errors=(), timelines=()):
    """All that `mavfi compare` would compute of these flights."""
    return figures(
        plan.described(), table(flights), schema=1, versions={},
        errors=[*errors], timeline=ComparedTimelines(seed=4, platforms=[*timelines]),
    )  # fmt: skip


@pytest.fixture(scope="session")
def whole():
    """A comparison of made-up flights."""
    return comparison(PLAN, made_up(), timelines=[panel("x86", 1.0), panel("tx2", 4.0)])
