"""Made-up flights for all tests: rows of an export, and the `Flights` of such rows.

`row` has the columns of a mission that a configuration describes; `flight` and `struck` have those
that a layout reads.
"""

import json
from dataclasses import asdict

import pyarrow as pa

from mavfi_cli.analysis.flights import FAULT
from mavfi_cli.analysis.pairs import EVERY_STAGE, Flights
from mavfi_cli.campaigns.missions import PlannedMission, canonical, changes_of
from mavfi_cli.spec.detector import DetectorConfig
from mavfi_cli.spec.fault import FaultConfig, InstructionConfig
from mavfi_cli.spec.mission import MissionConfig

COLUMNS = (
    "number", "pair", "world", "seed", "world_seed", "planner", "platform", "stack", "vehicle",
    "level", "fault_target", "fault_field", "fault_bits", "detector", "protect", "state",
    "outcome", "injected", "activation", "flight_time_s", "changes",
)  # fmt: skip


def row(
    target=None, *, seed=1, instruction=False, detector=None, protect=(), time_s=20.0,
    outcome="success", injected=None, config=None, fault=None, **columns,
):  # fmt: skip
    """A row of an export; without a target a golden flight."""
    fault = {"target": target, "seed": seed, **(fault or {})}
    kind = "instruction" if instruction else "fault"
    made = InstructionConfig(**fault) if instruction else target and FaultConfig(**fault)
    watched = None
    if detector is not None:
        watched = DetectorConfig(name=detector, **({"protect": protect} if protect else {}))
    settings = {"world": "sparse", "stack": "mavbench", **(config or {})}
    mission = MissionConfig(
        seed=seed, detector=watched, **settings, **({kind: made} if target else {})
    )
    told = asdict(mission)
    return {
        "number": 0, "pair": PlannedMission(config=mission).pair,
        **{name: told[name] for name in COLUMNS if name in told},
        "detector": detector, "protect": "+".join(watched.protect) if watched else None,
        "level": None if not target else "instruction" if instruction else "source",
        "fault_target": target, "fault_field": getattr(made, "field", None),
        "fault_bits": getattr(made, "bits", None), "state": "flown", "outcome": outcome,
        "injected": injected or ("active" if target else "golden"),
        "activation": "read" if target else None, "flight_time_s": time_s,
        "changes": canonical(changes_of(mission)), **columns,
    }  # fmt: skip


def export_table(rows):
    """An export of these rows, numbered in order."""
    names = dict.fromkeys(name for row in rows for name in ("number", *row))
    numbered = [{**row, "number": number} for number, row in enumerate(rows)]
    return pa.table({name: [row.get(name) for row in numbered] for name in names})


def flights(rows):
    """The flights of these rows."""
    return Flights.of(export_table(rows))


# Flights in the columns that layouts read ---------------------------------------------------------

_USUAL = {
    "world": "sparse", "planner": "rrtstar", "platform": "x86", "state": "flown",
    "outcome": "success", "distance_m": 50.0, "energy_regression_j": 10_000.0, "replans": 1,
}  # fmt: skip


def flight(pair, time_s, **values):
    """One golden flight, or one with the values of a fault and a detector."""
    if values.get("detector") and "protect" not in values:
        values["protect"] = EVERY_STAGE
    lost = {"outcome": "collision", "flight_time_s": None} if time_s is None else {}
    return {**_USUAL, "pair": pair, "flight_time_s": time_s, **values, **lost}


def struck(pair, time_s, **values):
    """One flight with a fault."""
    return flight(pair, time_s, **{"level": "instruction", "fault_target": "planning", **values})


def table(*rows):
    """The flights of these rows; those of one pair in other places are other missions."""
    return flights([{**row, **_mission(row)} for row in rows])


def _mission(row):
    """The pair with its place, and the fault as a ledger has it."""
    place = [row[name] for name in ("pair", "world", "planner", "platform")]
    fault = {f"fault_{name}": row.get(f"fault_{name}") for name in FAULT}
    level = {"instruction": "instruction", "source": "fault"}.get(row.get("level"))
    return {"pair": " ".join(place), "changes": json.dumps({level: fault} if level else {})}
