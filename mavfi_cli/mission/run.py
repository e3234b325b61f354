"""Flies one mission and writes its record (`mavfi fly`), or repeats a recorded one."""

from __future__ import annotations

import contextlib
import datetime
import gc
import os
import platform as host_platform
import resource
import shutil
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from mavfi_cli.autonomy import warm
from mavfi_cli.companion.injection import NoInjection, SourceInjection
from mavfi_cli.companion.pipeline import Companion, CompanionParts
from mavfi_cli.companion.protection import Protection
from mavfi_cli.core.compiled import processor_level
from mavfi_cli.core.errors import Interrupted, MavfiError, VehicleProcessError, described
from mavfi_cli.core.files import (
    Json,
    ScratchFolder,
    file_digest,
    write_json,
    write_parquet,
    write_text,
    writing,
)
from mavfi_cli.core.flight_record import SCHEMA, KernelUse, NodeCrash, NodeEnds, ResponseTime
from mavfi_cli.core.installed import installed_versions
from mavfi_cli.core.processes import interruptible
from mavfi_cli.core.types import FlightTruth, FloatArray, Outcome, Reaction
from mavfi_cli.fi.tracer.record_fields import FaultRecord
from mavfi_cli.link.transport import signing_from_file
from mavfi_cli.mission.companion_faults import (
    CompanionFault,
    CompanionInjection,
    check_companion_fault,
)
from mavfi_cli.mission.companion_flight import CompanionFlight, LockstepFlight
from mavfi_cli.mission.flight import Flight
from mavfi_cli.mission.instruction import CACHE
from mavfi_cli.mission.measures import quality_of
from mavfi_cli.mission.progress import Recorder, Watcher
from mavfi_cli.mission.run_folder import Run, RunFolder, load_run
from mavfi_cli.mission.setpoint_gate import SetpointGate
from mavfi_cli.mission.shared_flight import SharedFlight
from mavfi_cli.mission.vehicle import StartVehicle, Vehicle, other_end
from mavfi_cli.spec.companion import CompanionConfig
from mavfi_cli.spec.mission import MissionConfig

_ALLOCATIONS = 100_000  # growth in live objects that starts the garbage collector
COMPILING = "compiling the {}, once on this machine: this takes a while"


def fly_mission(
    config: MissionConfig,
    out: Path,
    watcher: Watcher,
    *,
    recorder: Recorder | None = None,
    repeat: FaultRecord | None = None,
    profiles: Path | None = None,
    for_debugger: Callable[[int], None] | None = None,
    launch: StartVehicle = Vehicle.start,
    shared: SharedFlight | None = None,
    host: Mapping[str, Any] | None = None,
) -> RunFolder:
    """Fly one mission from start to end, write its record, and return its run folder.

    However the flight ends, the record states its outcome, even if the companion crashes.

    Args:
        out: parent of the run folder.
        recorder: records the inputs of the nodes.
        repeat: record of the instruction-level fault to repeat. If None, a new fault is drawn.
        profiles: folder that keeps the profiles for instruction-level faults. If None, it is a
            subfolder of `out`.
        for_debugger: called with the id of the attacked node's process once that process waits
            for a debugger at the injected instruction.
        launch: starts the simulated vehicle.
        shared: missions to fork from this flight; the flight itself then writes no record.
        host: further entries for the host section of the record.

    Raises:
        SystemExit: this process has completed the shared flight.
        MavfiError: the mission could not begin (unknown name, blocked start, no autopilot, ...), or
            its record could not be written.
    """
    config = config.with_firmware()
    if config.companion is not None:
        return _fly_companion(config, out, watcher, repeat)
    parts = CompanionParts.of(config)  # raises for unknown names
    started, begun_s = datetime.datetime.now(datetime.UTC), time.perf_counter()
    _warm_up(config, watcher)  # before connecting, or the link fills with stale messages
    if shared is not None:
        recorder = shared.recorder
    injection = shared or _plan_injection(config, profiles or out / CACHE, repeat, for_debugger)
    with (
        _rare_collections(),
        contextlib.closing(injection),
        interruptible() as interrupt,
        other_end(config, launch) as (link, vehicle),
    ):
        flight = Flight(config, parts, link, watcher, interrupt, injection)
        companion = _begin(flight, config, vehicle, recorder)
        folder = RunFolder.new(out, config.world if config.link is None else "link", config.seed)
        flight.injection.begin(folder.fault)
        flight_begun_s = time.perf_counter()
        added = dict(host or {})
        if shared is not None:
            shared.flight = flight
        with flight.isolated_nodes():
            crash = _fly(flight, folder.tlog)
            if shared is not None:
                config, folder = shared.end()
                flight_begun_s += flight.wall.skipped_s
                added |= shared.host
        flight_wall_s = time.perf_counter() - flight_begun_s
        if vehicle is not None and (failure := vehicle.end()):
            flight.explain(str(failure))
        truth = None if vehicle is None else vehicle.truth
        section = {
            "started": started.isoformat(timespec="seconds"),
            "startup_s": round(flight_begun_s - begun_s, 3),
            "flight_wall_s": round(flight_wall_s, 3),
            **added,
            **_host(config, flight, truth),
        }
        _write(config, flight, companion, folder, section, truth, crash)
    return folder


def _fly_companion(
    config: MissionConfig, out: Path, watcher: Watcher, repeat: FaultRecord | None
) -> RunFolder:
    """Fly a mission with the programs of a user's companion, and return its run folder.

    Raises the same errors as `fly_mission`.
    """
    assert config.companion is not None
    programs = CompanionConfig.load(config.companion)
    if config.detector is not None:
        SetpointGate.warm_up(config.detector, programs.mark)
    started, begun_s = datetime.datetime.now(datetime.UTC), time.perf_counter()
    injection = CompanionFault()
    if (fault := config.fault or config.instruction) is not None:
        check_companion_fault(fault, programs)
    if config.fault is not None:
        key = signing_from_file(programs.key_file)
        injection = CompanionInjection(config.fault, key)
    elif config.instruction is not None:
        from mavfi_cli.mission.instruction.companion import ProcessInjection  # loads the tracer

        injection = ProcessInjection(config.instruction, repeat)
    kind, launch = CompanionFlight, Vehicle.start
    if programs.in_lockstep:
        kind, launch = LockstepFlight, Vehicle.start_in_lockstep
    with interruptible() as interrupt, other_end(config, launch) as (link, vehicle):
        assert vehicle is not None
        flight = kind(config, programs, link, watcher, interrupt, injection)
        with contextlib.closing(flight):
            briefing = vehicle.await_briefing(interrupt)
            folder = RunFolder.new(out, config.world, config.seed)
            flight_begun_s = time.perf_counter()
            flight.fly(folder, briefing, vehicle.depth)
        flight_wall_s = time.perf_counter() - flight_begun_s
        if failure := vehicle.end():
            flight.explain(str(failure))
    host = {
        "started": started.isoformat(timespec="seconds"),
        "startup_s": round(flight_begun_s - begun_s, 3),
        "flight_wall_s": round(flight_wall_s, 3),
        **_host(config, flight, vehicle.truth),
    }
    goal = briefing.goal_enu_m
    near_m = programs.success.goal_m or config.loaded_stack().goal_tolerance_m
    config = replace(config, goal_tolerance_m=near_m)
    result = _flown(config, flight, host, vehicle.truth, goal)
    guarded = {} if flight.detection is None else {"detection": flight.detection}
    ends = {name: asdict(program) for name, program in flight.programs.items()}
    result |= {"pilot": {}, "plans": [], "programs": ends, "mark": programs.mark.digest, **guarded}
    if deaths := {name: asdict(end) for name, end in injection.ends.items()}:
        result |= {"nodes": deaths}
    result |= {"in_lockstep": True} if programs.in_lockstep else {}
    log = None if vehicle.truth is None else vehicle.truth.log
    write_parquet(folder.trace, flight.trace.table(log))
    write_json(folder.result, result)
    return folder


@contextlib.contextmanager
def _rare_collections() -> Iterator[None]:
    """Make Python's cyclic garbage collector run rarely during a flight.

    The collector traverses the growing traces repeatedly, which takes a tenth of a flight's CPU
    time. A flight leaves only a few thousand objects in cycles.
    """
    usual = gc.get_threshold()
    gc.set_threshold(_ALLOCATIONS, *usual[1:])
    try:
        yield
    finally:
        gc.set_threshold(*usual)


def _plan_injection(
    config: MissionConfig,
    profiles: Path,
    repeat: FaultRecord | None,
    for_debugger: Callable[[int], None] | None,
) -> NoInjection:
    """Return the injection of a mission's fault, or `NoInjection` if the mission has no fault.

    The arguments are those of `fly_mission`.
    """
    if config.fault is not None:
        return SourceInjection(config.fault)
    if config.instruction is None:
        return NoInjection()
    from mavfi_cli.mission.instruction.injection import InstructionInjection  # loads the tracer

    if repeat is not None:
        return InstructionInjection.of_record(repeat, for_debugger)
    return InstructionInjection.plan(config, profiles, fly_golden, for_debugger)


def _warm_up(config: MissionConfig, watcher: Watcher) -> None:
    detector = config.detector
    if not warm.is_compiled():
        watcher.on_note(COMPILING.format("kernels"))
    elif detector is not None and not Protection.is_compiled(detector, config.stack):
        watcher.on_note(COMPILING.format("detector"))
    warm.warm_up()
    if detector is not None:
        Protection.warm_up(detector, config.stack)


def _begin(
    flight: Flight, config: MissionConfig, vehicle: Vehicle | None, recorder: Recorder | None
) -> Companion:
    """Connect the flight to the vehicle, pass it the briefing, and return its companion.

    Raises:
        MavfiError: the flight cannot begin. If the vehicle itself failed, its error is raised.
    """
    try:
        flight.connect()
        if vehicle is None:
            return flight.brief(config.briefing(flight.place_enu_m), recorder)
        briefing = vehicle.briefing()
        if config.link is not None:
            briefing = replace(briefing, start_enu_m=flight.place_enu_m)
        return flight.brief(briefing, recorder)
    except MavfiError:
        if vehicle is not None and (failure := vehicle.end()):
            raise failure from None
        raise


def _fly(flight: Flight, tlog: Path) -> str | None:
    """Fly until the mission ends. Return the traceback if the companion's software crashed."""
    try:
        flight.fly(tlog)
    except MavfiError:
        raise
    except Exception as error:  # the mission-process boundary: a crash is a result
        flight.end(Outcome.CRASH, described(error))
        return traceback.format_exc()
    return None


# Record -------------------------------------------------------------------------------------------


def _host(
    config: MissionConfig, flight: Flight | CompanionFlight, truth: FlightTruth | None
) -> Json:
    """Return the entries of the record's host section.

    They are properties and measurements of this machine, so they may differ between repetitions of
    a flight.
    """
    own_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    of_vehicle = {} if truth is None else truth.stage_wall_s
    walls = {"stage_wall_s": flight.wall.totals, "vehicle_stage_wall_s": of_vehicle}
    return {
        "machine": host_platform.machine(),
        "level": processor_level(),
        "cores": os.cpu_count(),
        "isolated": list(config.isolate),
        "memory_mb": {
            "companion": round(own_mb, 1),
            "vehicle": 0.0 if truth is None else round(truth.memory_mb, 1),
        },
        **{
            name: {stage: round(value, 4) for stage, value in stages.items()}
            for name, stages in walls.items()
        },
    }


def _write(
    config: MissionConfig,
    flight: Flight,
    companion: Companion,
    folder: RunFolder,
    host: Json,
    truth: FlightTruth | None,
    crash: str | None,
) -> None:
    log, goal = None if truth is None else truth.log, companion.pilot.goal_enu_m
    failures = dict(companion.plan_failures)
    measured, detection = companion.latency.summary(), companion.protection.summary()
    config = replace(config, goal_tolerance_m=flight.stack.goal_tolerance_m)
    result = {
        **_flown(config, flight, host, truth, goal),
        "pilot": asdict(companion.pilot.counters),
        "kernels": {name: asdict(use) for name, use in _kernels(companion).items()},
        "nodes": {name: asdict(ends) for name, ends in _nodes(companion).items()},
        "images": {"received": flight.images.received, "lost": flight.images.lost},
        "measured_platform": measured and asdict(measured),
        "response_time_s": asdict(response_times(companion.reactions)),
        "plans": [
            {"stamp_s": plan.stamp_s, "points_enu_m": np.round(plan.waypoints[:, 0:3], 3).tolist()}
            for plan in companion.plans
        ],
        "detection": detection and asdict(detection, dict_factory=_known),
        **({"plan_failures": failures} if failures else {}),
    }
    write_parquet(folder.trace, flight.trace.table(log))
    folder.write_plans(companion.plans)
    executor = companion.executor
    folder.write_timetable(executor.timetable, companion.reactions)
    tracebacks = [*(loss.traceback for loss in executor.losses), crash]
    if errors := [text for text in tracebacks if text]:
        write_text(folder.crash, "\n".join(errors))
    write_json(folder.result, result)


def _flown(
    config: MissionConfig,
    flight: Flight | CompanionFlight,
    host: Json,
    truth: FlightTruth | None,
    goal_enu_m: FloatArray,
) -> Json:
    """Return the sections that every record has, with mavfi's companion or a user's."""
    assert flight.outcome is not None
    fault, report = config.fault or config.instruction, {} if truth is None else truth.report
    flown = flight.trace.motion() if truth is None else truth.log
    files = {name: file_digest(name) for name in config.files}
    quality = quality_of(flown, flight.takeover_s, flight.end_s, goal_enu_m)
    return {
        "schema": SCHEMA,
        "outcome": flight.outcome.value,
        "reason": flight.reason,
        "config": config.to_dict(),
        "seeds": {"root": config.seed, "fault": fault.seed if fault else None},
        "simulated_s": flight.end_s - flight.begun_s,
        "quality_of_flight": asdict(quality),
        "events": [asdict(event) for event in flight.logger.events],
        "fault": flight.injection.finish(),
        "goal_enu_m": goal_enu_m.tolist(),
        "world": report.get("world"),
        "referee": {key: part for key, part in report.items() if key != "world"} or None,
        "versions": installed_versions(),
        "host": host,
        **({"files": files} if files else {}),
    }


def _known(items: list[tuple[str, Any]]) -> Json:
    return {key: value for key, value in items if value is not None}


def _kernels(companion: Companion) -> dict[str, KernelUse]:
    return {
        name: KernelUse(
            invocations=node.invocations,
            dropped_inputs=node.dropped,
            busy_s=round(node.busy_s, 9),
        )
        for name, node in companion.executor.nodes.items()
    }


def _nodes(companion: Companion) -> dict[str, NodeEnds]:
    losses = companion.executor.losses
    return {
        name: NodeEnds(
            crashes=[
                NodeCrash(stamp_s=round(loss.stamp_s, 9), how=loss.how)
                for loss in losses
                if loss.node == name and not loss.hung
            ],
            hangs=sum(loss.node == name and loss.hung for loss in losses),
            restarts=node.restarts,
        )
        for name, node in companion.executor.nodes.items()
    }


def response_times(reactions: Sequence[Reaction]) -> ResponseTime:
    """Return the median and 95th percentile of the response times in seconds, and their count.

    A response time runs from a depth frame to the first setpoint that depends on it.
    """
    times = np.array([r.setpoint_stamp_s - r.frame_stamp_s for r in reactions])
    times = times[np.isfinite(times)]
    if not len(times):
        return ResponseTime()
    return ResponseTime(
        median=round(float(np.median(times)), 9),
        p95=round(float(np.percentile(times, 95.0)), 9),
        count=len(times),
    )


# Repetition ---------------------------------------------------------------------------------------


def fly_to_end(config: MissionConfig, out: Path, **options: Any) -> Run:
    """Fly a mission and return its run. Unlike `fly_mission`, raise an error if it is interrupted.

    Args:
        out, options: As for `fly_mission`.

    Raises:
        Interrupted: The user interrupted the mission. Its run folder is deleted.
        MavfiError: As for `fly_mission`.
    """
    flown = load_run(fly_mission(config, out, Watcher(), **options).path)
    if flown.record.interrupted:
        shutil.rmtree(flown.folder.path)
        raise Interrupted("interrupted before the mission ended")
    return flown


def fly_golden(config: MissionConfig, out: Path, recorder: Recorder) -> Run:
    """Fly a golden run, and record the inputs of its nodes for later draws of faults or inputs.

    Raises:
        VehicleProcessError: The process of the vehicle died.
        MavfiError: As for `fly_to_end`.
    """
    flown = fly_to_end(config, out, recorder=recorder)
    if flown.record.referee is None:
        raise VehicleProcessError("the vehicle process died during the golden flight")
    return flown


def fly_again(
    run: Run,
    out: Path,
    *,
    with_fault: bool = True,
    firmware: str | None = None,
    **options: Any,
) -> Run:
    """Fly the mission of a recorded run again, or its golden run if `with_fault` is False.

    Args:
        firmware: as for `Run.mission`.
        out, options: as for `fly_mission`.

    Raises:
        RecordError: The run is not repeatable.
        MavfiError: As for `fly_to_end`.
    """
    from mavfi_cli.fi.tracer.record import read  # loads the tracer

    config = run.mission(with_fault=with_fault, firmware=firmware)
    repeat = read(run.folder.fault) if config.instruction is not None else None
    return fly_to_end(config, out, repeat=repeat, **options)


def watch_again(run: Run) -> tuple[Recorder, bool]:
    """Repeat a recorded run to capture the inputs of its nodes.

    Raises the same errors as `fly_again`.

    Returns:
        A recorder with the inputs of all nodes, and whether the repetition has the same trace as
        the run. The traces differ only if the software or the machine differs.
    """
    recorder = Recorder()
    with ScratchFolder("again") as scratch:
        again = fly_again(run, scratch, recorder=recorder)
        same = file_digest(again.folder.trace) == file_digest(run.folder.trace)
    return recorder, same


def paired_golden(run: Run, note: Callable[[str], None] = lambda _: None) -> Run:
    """Return the golden run that is paired with a run. If none is stored, fly and store it.

    The golden run is stored in the folder of the run.

    Args:
        run: Run with a fault.
        note: Called with a message before the golden run is flown.

    Raises:
        RecordError: The run is not repeatable, or its folder cannot be written.
        Interrupted: The user interrupted the golden run. Nothing of it is stored.
    """
    config = run.mission(with_fault=False)
    if (golden := run.golden) is not None:
        return golden
    kept = run.folder.golden
    note(f"flying the golden pair: {config.world}, seed {config.seed}")
    with writing(kept), ScratchFolder("golden", run.folder.path) as parent:
        flown = fly_to_end(config, parent)
        if kept.is_dir():
            shutil.rmtree(kept)  # follows no link
        shutil.move(flown.folder.path, kept)
    return load_run(kept)
