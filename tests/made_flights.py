"""Made-up flights for all tests: rows of a table of flights, records, and ledgers.

`flight` makes each row. The other functions add what a mission's configuration, a comparison or an
evaluation has besides.
"""

import json

import numpy as np
import pyarrow as pa
import pytest

from mavfi_cli.analysis import detectors, platforms
from mavfi_cli.analysis.flights import FAULT
from mavfi_cli.analysis.pairs import EVERY_STAGE, Flights
from mavfi_cli.analysis.timeline import Timeline
from mavfi_cli.campaigns.ledger import Ledger
from mavfi_cli.campaigns.missions import (
    Injected,
    PlannedMission,
    ResultState,
    canonical,
    changes_of,
)
from mavfi_cli.core.types import Command, Trajectory
from mavfi_cli.detect.fit import fit
from mavfi_cli.detect.offline import Dataset, FlightSamples
from mavfi_cli.detect.preprocess import PreprocessParams
from mavfi_cli.spec.companion import CompanionConfig
from mavfi_cli.spec.detector import DetectorConfig
from mavfi_cli.spec.fault import FaultConfig, InstructionConfig
from mavfi_cli.spec.mission import MissionConfig
from mavfi_cli.studies.compare import ComparePlan


def flight(time_s=100.0, *, outcome=None, **columns):
    """A row of a table of flights: golden unless its columns say else; lost if it has no time."""
    if columns.get("detector") and "protect" not in columns:
        columns["protect"] = EVERY_STAGE
    return {
        "pair": "a", "world": "sparse", "planner": "rrtstar", "platform": "x86", "state": "flown",
        "outcome": outcome or ("collision" if time_s is None else "success"),
        "injected": "active" if columns.get("level") else "golden", "flight_time_s": time_s,
        "distance_m": 50.0, "energy_regression_j": 10_000.0, "replans": 1, **columns,
    }  # fmt: skip


def struck(time_s=100.0, **columns):
    """A flight with a fault."""
    return flight(time_s, **{"level": "instruction", "fault_target": "planning", **columns})


_COLUMNS = ("world", "seed", "world_seed", "planner", "platform", "stack", "vehicle")


def row(
    target=None, *, seed=1, instruction=False, detector=None, protect=(), time_s=20.0,
    outcome="success", config=None, fault=None, **columns,
):  # fmt: skip
    """A flight of a mission; without a target a golden one."""
    made = target and (InstructionConfig if instruction else FaultConfig)(
        target=target, **{"seed": seed, **(fault or {})}
    )
    watched = None
    if detector is not None:
        watched = DetectorConfig(name=detector, **({"protect": protect} if protect else {}))
    mission = MissionConfig(
        **{"seed": seed, "world": "sparse", "stack": "mavbench", **(config or {})},
        detector=watched,
        **({"instruction" if instruction else "fault": made} if target else {}),
    )
    told = {
        **{name: getattr(mission, name) for name in _COLUMNS},
        "pair": PlannedMission(config=mission).pair, "changes": canonical(changes_of(mission)),
        "detector": detector, "protect": "+".join(watched.protect) if watched else None,
        "level": target and ("instruction" if instruction else "source"),
        "fault_target": target, "fault_field": getattr(made, "field", None),
        "fault_bits": getattr(made, "bits", None), "activation": target and "read",
    }  # fmt: skip
    return flight(time_s, outcome=outcome, **told | columns)


def export_table(rows):
    """An export of these rows, numbered in order."""
    rows = [{**row, "number": n} if "changes" in row else {**row, **_mission(row), "number": n}
            for n, row in enumerate(rows)]  # fmt: skip
    names = dict.fromkeys(name for row in rows for name in ("number", *row))
    return pa.table({name: [row.get(name) for row in rows] for name in names})


def _mission(row):
    """The pair with its place, and the fault as a ledger has it."""
    place = [row[name] for name in ("pair", "world", "planner", "platform")]
    fault = {f"fault_{name}": row.get(f"fault_{name}") for name in FAULT}
    level = {"instruction": "instruction", "source": "fault"}.get(row.get("level"))
    return {"pair": " ".join(place), "changes": json.dumps({level: fault} if level else {})}


def flights(rows):
    """The flights of these rows; those of one pair in other places are other missions."""
    return Flights.of(export_table(rows))


# A comparison of platforms ------------------------------------------------------------------------

PLAN = ComparePlan(inject=("planning",), missions=10)
SEEDS = range(1, 11)


def on(platform, seed, time_s, setting="golden", **columns):
    """A flight on a platform; with faults where the setting is not golden."""
    faulty = setting != "golden"
    return flight(**{
        "platform": platform, "seed": seed, "time_s": time_s, "setting": setting, "counted": True,
        "detector": setting if setting in ("gad", "aad") else None,
        "target": "planning" if faulty else "", "fault_seed": 7 * seed if faulty else None,
        "energy_propeller_j": 2500.0, "response_median_s": 0.4 if platform == "x86" else 1.6,
        "response_p95_s": 0.5 if platform == "x86" else 2.0, **columns,
    })  # fmt: skip


def compared(rows):
    """The flights of a comparison, each beside its golden one and the one without a detector."""
    return platforms.compared(export_table([{**row, **_configured(row)} for row in rows]))


def _configured(row):
    """What a ledger has of the mission of a row of `on`."""
    fault = {"target": row["target"], "seed": row["fault_seed"]}
    faulty = row["setting"] != "golden"
    return {
        "pair": f"{row['platform']} {row['seed']}",
        "state": "flown",
        "level": "source" if faulty else None,
        "fault_target": row["target"] or None,
        "changes": json.dumps({"fault": fault} if faulty else {}),
    }


def comparison(plan, rows, *, errors=(), timelines=()):
    """All that `mavfi compare` would compute of these flights."""
    return platforms.figures(
        plan.described(), compared(rows), schema=1, versions={}, errors=[*errors],
        timeline=platforms.ComparedTimelines(seed=4, platforms=[*timelines]),
    )  # fmt: skip


def _panel(platform, factor):
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


@pytest.fixture(scope="session")
def whole():
    """TX2 is 1.5 times as slow; seed 2's fault costs as much again, and detectors save part."""
    rows = []
    for platform, factor in (("x86", 1.0), ("tx2", 1.5)):
        for seed in SEEDS:
            for setting, more in (("golden", 1.0), ("none", 2.0), ("gad", 1.25), ("aad", 1.0)):
                longer = more if seed == 2 else 1.0
                rows.append(on(platform, seed, factor * (20.0 + seed) * longer, setting))
    return comparison(PLAN, rows, timelines=[_panel("x86", 1.0), _panel("tx2", 4.0)])


# Pairs of an evaluation of detectors --------------------------------------------------------------


def labelled(row, **labels):
    """A row of a ledger's table, with alarms of control at its `alarms_s`."""
    alarms_s, faulty = row.get("alarms_s", ()), row.get("level") is not None
    return {
        **{f"label_{name}": labels.get(name) for name in ("kind", "detector", *detectors.KEY)},
        "struck_s": 20.0 if faulty else None, "struck_sites": ["command_vx"] if faulty else [],
        "first_bits": [62] if faulty else [], "crashed": False, "path": None,
        "succeeded": row["outcome"] == "success", "alarm_count": len(alarms_s),
        "alarms": [{"stamp_s": stamp_s, "stage": "control"} for stamp_s in alarms_s],
        "episodes": min(1, len(alarms_s)), **row,
    }  # fmt: skip


def paired(rows, detector, complete=lambda seed: True):
    """The pairs of labelled flights: without faults, and with one."""
    found = detectors.pairs_of([pa.Table.from_pylist(rows)], [detector], complete)
    return [table.to_pylist() for table in found]


def error_free(golden=None, watched=None, *, world="dense", seed=1, detector="gad"):
    """A pair without a fault."""
    golden = golden or flight()
    mission = {"kind": "error-free", "world": world, "seed": seed}
    rows = [labelled(golden, detector="none", **mission)]
    if detector != "none":
        rows.append(labelled(watched or golden, detector=detector, **mission))
    (found,), _ = paired(rows, detector)
    return found


def pair(
    faulty, protected=None, *, golden=None, watched=None, world="dense", seed=1, detector="gad",
    complete=True,
):  # fmt: skip
    """A pair with a fault; without a protected flight that of the detector `none`."""
    golden = golden or flight()
    mission = {"kind": "error-free", "world": world, "seed": seed}
    fault = {
        **mission, "kind": "fault", "level": "source", "stage": "control", "target": "control",
        "field": "exponent",
    }  # fmt: skip
    rows = [
        labelled(golden, detector="none", **mission),
        labelled(faulty, detector="none", **fault),
    ]
    if protected is None:
        detector = "none"
    else:
        rows.append(labelled(watched or golden, detector=detector, **mission))
        rows.append(labelled(protected, detector=detector, **fault))
    _, (found,) = paired(rows, detector, lambda _: complete)
    return found


def pairs_table(pairs):
    """Pairs as columns."""
    return pa.Table.from_pylist(pairs, detectors.SCHEMA)


# Records and ledgers ------------------------------------------------------------------------------

KERNELS = {
    name: {"invocations": invocations, "busy_s": busy_s}
    for name, invocations, busy_s in (
        ("point_cloud", 100, 1.0), ("octomap", 20, 6.0), ("collision_check", 10, 0.5),
        ("planner", 5, 1.0), ("control", 1000, 0.5),
    )
}  # fmt: skip


def watched(detector, gate_s, alarms=(), **detection):
    """What a flight with a detector has in its record; alarms as stage and response.

    A recomputation takes 0.01 + 0.3 + 0.05 s for perception, 0.2 s for planning, 0.5 ms for
    control.
    """
    responses = [response for _, response in alarms]
    return {
        "detection": {
            "detector": detector,
            "checks": {"report": 100, "tick": 900},
            "responses": {name: responses.count(name) for name in ("recompute", "hold", "accept")},
            "alarms": [{"stage": stage, "response": response} for stage, response in alarms],
            **detection,
        },
        "host": {"stage_wall_s": {"gate": gate_s, "octomap": 0.15, "planner": 0.05, "link": 9.0}},
        "kernels": KERNELS,
    }  # fmt: skip


def companion_gate(companion, threshold):
    """A range detector for a companion's file, which knows any state, and speeds up to 3 m/s.

    Its ten flights have random states and velocities, of which every second is zero.
    """

    def flown(seed):
        rng = np.random.default_rng(seed)

        def command(number):
            velocity = rng.uniform(-3.0, 3.0, 3) * (number % 2)
            return Command(stamp_s=0.0, velocity_enu_mps=velocity, yaw_rad=0.0)

        def plan(number):
            return Trajectory(
                stamp_s=0.1 * number, waypoints=rng.uniform(-30.0, 30.0, (1, 10)) * (number % 2),
                durations_s=np.ones(1), trajectory_seq=0, future_collision_seq=0,
            )  # fmt: skip

        ticks = ((0.1 * number, plan(number), command(number)) for number in range(60))
        return FlightSamples.of_ticks(ticks, "farm", seed)

    samples = tuple(map(flown, range(10)))
    mark = CompanionConfig.load(str(companion)).mark
    model = fit("range", Dataset(flights=samples, preprocess=PreprocessParams(), stack=mark))
    path = companion.with_name("range.json")
    model.save(path)
    return DetectorConfig(name="range", model=str(path), threshold=threshold)


class Book:
    """Writes a ledger mission by mission; each method takes labels and seed, and tells a number."""

    def __init__(self, folder):
        self.ledger = Ledger(folder, writing=True)

    def plan(self, labels, seed, config=None):
        """A mission that is not flown yet."""
        number = self.ledger.planned()
        config = config or MissionConfig(seed=seed)
        self.ledger.plan([PlannedMission(config=config, labels=labels)])
        return number

    def add(self, labels, seed, time_s=20.0, *, injected=Injected.ACTIVE, outcome="success",
            config=None, path=None, record=None):  # fmt: skip
        """A flown mission, with what else its record says."""
        fault = None if injected is Injected.GOLDEN else FaultConfig(target="control", seed=seed)
        number = self.plan(labels, seed, config or MissionConfig(seed=seed, fault=fault))
        quality = {"flight_time_s": time_s, "distance_m": 50.0, "energy_regression_j": 9e3}
        result = {"outcome": outcome, "quality_of_flight": quality, "pilot": {"replans": seed}}
        self._end(number, result | (record or {}), injected=injected, path=path)
        return number

    def fail(self, labels, seed, config=None):
        """A mission that could not begin."""
        number = self.plan(labels, seed, config)
        self._end(number, {}, state=ResultState.ERROR, reason="blocked")
        return number

    def _end(self, number, result, **columns):
        told = {"state": ResultState.FLOWN, "reason": "", "injected": None, "path": None}
        self.ledger.add(number, result=result, wall_s=1.0, attempts=1, **told | columns)
