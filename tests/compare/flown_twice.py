"""Flights of a comparison, made up."""

from mavfi_cli.campaign.compare.flights import Flown
from mavfi_cli.campaign.compare.plan import ComparePlan

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
    return Flown(**(values | changes))


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
