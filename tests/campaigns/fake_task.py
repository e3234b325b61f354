"""Missions without a flight: the world's name says what becomes of them."""

import json
import os
import signal
import subprocess
import sys
import time

from mavfi_cli.campaigns.strata import stratum_of
from mavfi_cli.core.config import structure
from mavfi_cli.core.errors import RecordError, VehicleProcessError, WorldError
from mavfi_cli.core.seeds import Stream
from mavfi_cli.mission.instruction import CACHE, kept_in
from mavfi_cli.spec.mission import MissionConfig


def prepare():
    """Load what every mission needs, before workers are forked."""
    harmful({"fault": {"target": "waypoint_x"}})


def perform(task, out):
    [(_, changes, _)] = task["missions"]
    world, _, value = changes.get("world", "fly").partition(":")
    seed = changes.get("seed", 3)
    run = out / f"{world}-{seed}-001"
    run.mkdir()
    (run / "fault.json").write_text(json.dumps({"schema": 1, "state": "applied", "seed": seed}))
    keep_profile(changes, out)
    if world == "sleep":
        time.sleep(float(value))
    elif world == "orphan":  # a child in a session of its own, that outlives its parent
        line = [sys.executable, "-c", "import signal; signal.pause()"]
        child = subprocess.Popen(line, start_new_session=True)
        (out.parent.parent / "orphan.pid").write_text(str(child.pid))
        os.kill(os.getpid(), signal.SIGSEGV)
    elif world == "signal":
        os.kill(os.getpid(), int(value))
    elif world == "signal-once":
        mark = out.parent.parent / f"been-{seed}"
        if not mark.exists():
            mark.touch()
            os.kill(os.getpid(), int(value))
    elif world == "exit":
        os._exit(int(value))
    elif world == "blocked" or (out.parents[2] / f"blocked-{seed}").exists():
        raise WorldError("the start is blocked")
    elif world == "full":
        raise RecordError("result.json: No space left on device")
    elif world == "vehicle":
        raise VehicleProcessError("the vehicle process was killed by SIGKILL")
    elif world == "no-vehicle":
        raise VehicleProcessError("the vehicle process ended with code 1")
    elif world == "defect":
        raise ZeroDivisionError("a defect")
    (run / "result.json").write_text(json.dumps(record(changes, seed, world, value)))
    return run


def keep_profile(changes, out):
    """Leave what a mission with an instruction-level fault leaves for others."""
    if "instruction" in changes:
        golden = structure(changes, MissionConfig).golden
        kept_in(out / CACHE, golden).mkdir(exist_ok=True)


def record(changes, seed, world, value):
    rng = Stream.MISSION.generator(seed)
    outcome = value if world == "end" else "success"
    if world == "fragile" and harmful(changes):
        outcome = "collision"
    if world == "doomed" and changes.get("world_seed") in {2, 5} and seed > 1:
        outcome = "collision"
    return {
        "schema": 1,
        "outcome": outcome,
        "reason": "the vehicle process was killed by SIGKILL" if outcome == "link_lost" else "",
        "config": changes,
        "nodes": {"octomap": {"crashes": [{"how": value}] if world == "node" else []}},
        "quality_of_flight": {
            "flight_time_s": 20.0 + float(rng.normal()),
            "distance_m": 50.0 + float(rng.normal()),
        },
        "pilot": {"replans": replans(changes, world, int(rng.integers(5)))},
        "simulated_s": 30.0,
        "fault": {"state": "applied", "strikes": []} if fault_of(changes) else None,
        "kernels": {"planner": {"invocations": seed % 3 + 1}},
        "referee": None if world == "untrue" else {},
    }


def fault_of(changes):
    return changes.get("fault") or changes.get("instruction")


def harmful(changes):
    """In `fragile`, every other flip of an exponent bit, and later requests of a plan."""
    config = structure(changes, MissionConfig)
    fault = config.fault or config.instruction
    stratum = stratum_of(fault, config.seed % 3 + 1) if fault else ()
    return "later request" in stratum or ("exponent" in stratum and fault.seed % 2 == 0)


def replans(changes, world, drawn):
    """In `flat` never, in `rising` and `doomed` as the world's seed says; elsewhere as drawn."""
    seed = changes.get("world_seed", 0)
    return {"rising": seed, "doomed": seed, "flat": 0}.get(world, drawn)
