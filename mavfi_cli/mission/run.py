"""Flies one mission and writes its record. This is the function behind `mavfi fly`."""

from __future__ import annotations

import contextlib
import datetime
import functools
import json
import os
import platform as host_platform
import resource
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from mavfi_cli.autonomy import planners, warm
from mavfi_cli.companion import protection
from mavfi_cli.companion.injection import NoInjection
from mavfi_cli.companion.pipeline import Companion
from mavfi_cli.core.errors import Interrupted, MavfiError, VehicleProcessError, described
from mavfi_cli.core.files import file_digest, write_json, write_parquet, write_text
from mavfi_cli.core.installed import installed_versions
from mavfi_cli.core.processes import interruptible
from mavfi_cli.core.types import Outcome, Reaction
from mavfi_cli.link.images import ImageReceiver
from mavfi_cli.mission import briefing
from mavfi_cli.mission.flight import Flight
from mavfi_cli.mission.progress import Recorder, Watcher
from mavfi_cli.mission.record import quality
from mavfi_cli.mission.record.measures import record_of
from mavfi_cli.mission.record.run_folder import RunFolder, stem_of
from mavfi_cli.mission.record.tables import Timetable, write_plans, write_timetable
from mavfi_cli.mission.vehicle import (
    StartVehicle,
    Vehicle,
    other_end,
    start_vehicle,
    with_firmware,
)
from mavfi_cli.spec.mission import MissionConfig
from mavfi_cli.spec.platform import load_platform

COMPILING = "compiling the kernels, once on this machine: this takes a while"


def fly_mission(
    config: MissionConfig,
    out: Path,
    watcher: Watcher,
    *,
    recorder: Recorder | None = None,
    repeat: Mapping[str, Any] | None = None,
    for_debugger: Callable[[int], None] | None = None,
    launch: StartVehicle = start_vehicle,
) -> RunFolder:
    """Fly one mission from start to end and write its run folder.

    Every end of the flight, including a crash of the companion, is a result and is recorded.

    Args:
        out: where the run folder goes.
        recorder: keeps what the flight asks of its nodes.
        repeat: the record of an instruction-level fault to repeat, instead of drawing one.
        for_debugger: called when the node waits for a debugger at the injected instruction.
        launch: starts the simulated vehicle.

    Raises:
        MavfiError: the mission could not begin (unknown names, blocked start, no autopilot ...),
            or its record could not be written.
    """
    config = with_firmware(config)
    platform, stack = load_platform(config.platform), config.loaded_stack()
    planner = planners.find(config.planner)
    started, begun_s = datetime.datetime.now(datetime.UTC), time.perf_counter()
    _warm_up(config, watcher)  # first: else a link is full of stale messages by then
    with (
        _injection(config, out, repeat, for_debugger, launch) as injection,
        interruptible() as interrupt,
        other_end(config, launch) as (link, vehicle),
    ):
        flight = Flight(config, stack, link, platform, planner, watcher, interrupt)
        if injection is not None:
            flight.injection = injection
        _begin(flight, config, vehicle, recorder)
        name = stem_of(config.world) if config.link is None else "link"
        folder = RunFolder.new(out, f"{name}-{config.seed}")
        flight.injection.begin(folder.fault)
        flight_begun_s = time.perf_counter()
        with flight.isolated_nodes():
            crash = _fly(flight, folder.tlog)
        flight_wall_s = time.perf_counter() - flight_begun_s
        if vehicle is not None and (failure := vehicle.end()):
            flight.explain(str(failure))
        host = {
            "started": started.isoformat(timespec="seconds"),
            "startup_s": round(flight_begun_s - begun_s, 3),
            "flight_wall_s": round(flight_wall_s, 3),
            **_host(config, flight, vehicle),
        }
        _write(config, flight, folder, host, *_read_truth(vehicle), crash)
    return folder


def _warm_up(config: MissionConfig, watcher: Watcher) -> None:
    """Load and compile everything that the companion will run."""
    detector = config.detector
    known = detector is None or protection.is_compiled(detector, config.stack)
    if not (warm.is_compiled() and known):
        watcher.on_note(COMPILING)
    warm.warm_up()
    if detector is not None:
        protection.warm_up(detector, config.stack)


def _begin(
    flight: Flight, config: MissionConfig, vehicle: Vehicle | None, recorder: Recorder | None
) -> None:
    """Connect and brief the flight.

    Raises:
        MavfiError: why it cannot fly; the vehicle's own reason where it has one.
    """
    try:
        flight.connect()
        if vehicle is None:
            flight.brief(briefing.of_config(config, flight.place_enu_m))
        else:
            told = briefing.of_simulation(vehicle.folder)
            foreign = config.link is not None
            flight.brief(replace(told, start_enu_m=flight.place_enu_m) if foreign else told)
        if recorder is not None:
            flight.record(recorder)
    except MavfiError:
        if vehicle is not None and (failure := vehicle.end()):
            raise failure from None
        raise


def _host(config: MissionConfig, flight: Flight, vehicle: Vehicle | None) -> dict[str, Any]:
    """Return what this machine did for the flight, which no repetition repeats."""
    own_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    told = _left_behind(vehicle, "host.json") or {}
    return {
        "machine": host_platform.machine(),
        "cores": os.cpu_count(),
        "isolated": list(config.isolate),
        "memory_mb": {
            "companion": round(own_mb, 1),
            "vehicle": round(told.get("memory_mb", 0.0), 1),
        },
        "stage_wall_s": _rounded(flight.wall.totals),
        "vehicle_stage_wall_s": _rounded(told.get("stage_wall_s", {})),
    }


def _left_behind(vehicle: Vehicle | None, name: str) -> dict[str, Any] | None:
    """Read a JSON file that the vehicle has left; None if it has not."""
    if vehicle is None or not (vehicle.folder / name).is_file():
        return None
    told: dict[str, Any] = json.loads((vehicle.folder / name).read_text())
    return told


@contextlib.contextmanager
def _injection(
    config: MissionConfig,
    out: Path,
    repeat: Mapping[str, Any] | None,
    for_debugger: Callable[[int], None] | None,
    launch: StartVehicle,
) -> Iterator[NoInjection | None]:
    """Create the instruction-level fault of a mission and start its node's process."""
    if config.instruction is None:
        yield None
        return
    from mavfi_cli.mission.instruction.injection import injection_of  # loads the debugger

    injection = injection_of(
        config,
        out,
        installed_versions(),
        functools.partial(fly_golden, launch=launch),
        repeat=repeat,
        for_debugger=for_debugger,
    )
    try:
        yield injection
    finally:
        injection.close()


def fly_golden(
    config: MissionConfig,
    out: Path,
    recorder: Recorder,
    *,
    launch: StartVehicle = start_vehicle,
) -> dict[str, Any]:
    """Fly a golden run, from which faults or inputs are drawn.

    Returns:
        Contents of its result.json.

    Raises:
        Interrupted: The run was cut off, so other faults would be drawn.
        VehicleProcessError: The vehicle died, so there is nothing to draw from.
    """
    flown = fly_mission(config, out, Watcher(), recorder=recorder, launch=launch)
    result: dict[str, Any] = json.loads(flown.result.read_text())
    flight = record_of(result)
    if flight.interrupted:
        raise Interrupted("interrupted")
    if flight.referee is None:
        raise VehicleProcessError("the vehicle process of the golden flight died")
    return result


def _fly(flight: Flight, tlog: Path) -> str | None:
    """Fly to the end. A crash of the companion's software is an outcome: returns its traceback."""
    try:
        flight.fly(tlog)
    except MavfiError:
        raise
    except Exception as error:  # the mission-process boundary: a crash is a result
        flight.end(Outcome.CRASH, described(error))
        return traceback.format_exc()
    return None


def _read_truth(vehicle: Vehicle | None) -> tuple[quality.Truth | None, dict[str, Any] | None]:
    """Read the referee's log and report; None for a foreign autopilot or a dead vehicle."""
    report = _left_behind(vehicle, "truth.json")
    if vehicle is None or report is None:
        return None, None
    with np.load(vehicle.folder / "truth.npz") as data:
        return {name: data[name] for name in data.files}, report


def _rounded(stages: Mapping[str, float]) -> dict[str, float]:
    return {name: round(value, 4) for name, value in stages.items()}


def _write(
    config: MissionConfig,
    flight: Flight,
    folder: RunFolder,
    host: dict[str, Any],
    truth: quality.Truth | None,
    referee: dict[str, Any] | None,
    crash: str | None,
) -> None:
    companion, goal = flight.companion, flight.goal_enu_m
    if truth is not None and goal is not None:
        qof = quality.from_truth(truth, flight.takeover_s, flight.end_s, goal)
    else:
        qof = flight.own_quality()
    assert flight.outcome is not None
    asked = config.fault or config.instruction
    result = {
        "schema": 1,
        "outcome": flight.outcome.value,
        "reason": flight.reason,
        "config": replace(config, goal_tolerance_m=flight.goal_tolerance_m).to_dict(),
        "seeds": {"root": config.seed, "fault": asked.seed if asked else None},
        "simulated_s": flight.end_s - flight.begun_s,
        "quality_of_flight": qof,
        **_statistics(companion, flight.images),
        "measured_platform": companion.latency.summary() if companion else None,
        "response_time_s": response_times(companion.reactions if companion else []),
        "events": [asdict(event) for event in flight.logger.events],
        "plans": [
            {"stamp_s": plan.stamp_s, "points_enu_m": np.round(plan.waypoints[:, 0:3], 3).tolist()}
            for plan in (companion.plans if companion else [])
        ],
        "fault": flight.injection.finish(),
        "detection": companion.protection.summary() if companion else None,
        "goal_enu_m": None if goal is None else goal.tolist(),
        "world": None if referee is None else referee["world"],
        "referee": None if referee is None else {k: v for k, v in referee.items() if k != "world"},
        "versions": installed_versions(),
        "host": host,
        **(
            {"plan_failures": dict(companion.plan_failures)}
            if companion and companion.plan_failures
            else {}
        ),
        **({"files": {name: file_digest(name) for name in config.files}} if config.files else {}),
    }
    write_parquet(folder.trace, flight.trace.table(truth))
    write_plans(folder.plans, companion.plans if companion else [])
    timetable, told = Timetable(), [crash]
    if companion is not None:
        ran = companion.executor.timetable
        timetable = Timetable(invocations=ran, reactions=companion.reactions)
        told = [*(loss.traceback for loss in companion.executor.losses), crash]
    write_timetable(folder.kernels, timetable)
    if errors := [text for text in told if text]:
        write_text(folder.crash, "\n".join(errors))
    write_json(folder.result, result)


def _statistics(companion: Companion | None, images: ImageReceiver) -> dict[str, Any]:
    """Return the counters of pilot, kernels, nodes and camera link; empty without a flight."""
    if companion is None:
        return {"pilot": None, "kernels": {}, "nodes": {}, "images": {}}
    nodes = companion.executor.nodes
    return {
        "pilot": asdict(companion.pilot.counters),
        "kernels": {
            name: {
                "invocations": node.invocations,
                "dropped_inputs": node.dropped,
                "busy_s": round(node.busy_s, 9),
            }
            for name, node in nodes.items()
        },
        "nodes": {
            name: {
                "crashes": [
                    {"stamp_s": round(loss.stamp_s, 9), "how": loss.how}
                    for loss in node.losses
                    if not loss.hung
                ],
                "hangs": sum(loss.hung for loss in node.losses),
                "restarts": node.restarts,
            }
            for name, node in nodes.items()
        },
        "images": {"received": images.received, "lost": images.lost},
    }


def response_times(reactions: Sequence[Reaction]) -> dict[str, float | None]:
    """Return median and 95th percentile of the response time, s."""
    times = np.array([r.setpoint_stamp_s - r.frame_stamp_s for r in reactions])
    times = times[np.isfinite(times)]
    if not len(times):
        return {"median": None, "p95": None, "count": 0}
    return {
        "median": round(float(np.median(times)), 9),
        "p95": round(float(np.percentile(times, 95.0)), 9),
        "count": len(times),
    }
