"""Flights that nobody flew: a row of an export each."""

from dataclasses import asdict

import pyarrow as pa

from mavfi_cli.analysis.pairs import Flights
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


def table(rows):
    """An export of these rows."""
    names = dict.fromkeys(name for each in rows for name in each)
    return pa.table(
        {
            name: [n if name == "number" else x.get(name) for n, x in enumerate(rows)]
            for name in names
        }
    )


def flights(rows):
    """The flights of these rows."""
    return Flights.of(table(rows))
