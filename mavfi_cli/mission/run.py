"""Fly one mission and leave its record: the function behind `mavfi fly`."""

from __future__ import annotations

import contextlib
import datetime
import importlib.metadata
import json
import os
import platform as host_platform
import resource
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mavfi_cli import __version__
from mavfi_cli.autonomy import planners, warm_up
from mavfi_cli.core.errors import MavfiError, VehicleProcessError
from mavfi_cli.core.types import Outcome
from mavfi_cli.link.transport import Transport, open_transport
from mavfi_cli.mission import briefing, quality
from mavfi_cli.mission.config import MissionConfig
from mavfi_cli.mission.flight import Flight
from mavfi_cli.mission.instruction_config import InstructionConfig
from mavfi_cli.mission.instruction_injection import InstructionInjection, require_possible
from mavfi_cli.mission.instruction_plan import PlannedFault, Recorder, plan_fault, planned_of
from mavfi_cli.mission.plan_file import write_plans
from mavfi_cli.mission.platform import load_platform
from mavfi_cli.mission.progress import Watcher
from mavfi_cli.mission.response import response_times
from mavfi_cli.mission.run_folder import CRASH, RunFolder, new_run_folder, stem_of
from mavfi_cli.mission.spawned_node import SpawnedNode
from mavfi_cli.mission.statistics import mission_statistics, plan_lines
from mavfi_cli.mission.trace import write_trace
from mavfi_cli.mission.vehicle_process import VehicleProcess
from mavfi_cli.mission.vehicle_template import VehicleTemplate

_VERSIONS = ("numpy", "numba", "jsbsim", "pymavlink", "pyoctomap", "ompl", "python-fcl")


def fly_mission(
    config: MissionConfig,
    out: Path,
    watcher: Watcher,
    *,
    recorder: Recorder | None = None,
    repeat: Mapping[str, Any] | None = None,
    for_debugger: Callable[[int], None] | None = None,
    vehicles: VehicleTemplate | None = None,
) -> RunFolder:
    """Fly one mission from start to end and write its run folder.

    Whatever becomes of the flight, crash of the companion included, is a result and is recorded.

    Args:
        config: the mission.
        out: where the run folder goes.
        watcher: gets progress and events.
        recorder: keeps what the flight asks of its nodes.
        repeat: the record of an instruction-level fault to repeat, instead of drawing one.
        for_debugger: called when the node waits for a debugger at the injected instruction.
        vehicles: forks the simulated vehicle; None: it is started as a program.

    Raises:
        MavfiError: the mission could not begin (unknown names, blocked start, no autopilot ...),
            or its record could not be written.
    """
    started = datetime.datetime.now(datetime.UTC)
    begun = time.perf_counter()
    platform = load_platform(config.platform)
    planner = planners.find(config.planner)
    with (
        _injection(config, out, repeat, for_debugger, vehicles) as injection,
        interruptible() as interrupt,
        _vehicle(config, vehicles) as (transport, truth_folder, process),
    ):
        flight = Flight(config, transport, platform, planner, watcher, interrupt)
        if injection is not None:
            flight.injection = injection
        try:
            if truth_folder is None:  # before connecting: from then on the vehicle's clock runs
                flight.brief(briefing.of_config(config))
            flight.connect()
            if truth_folder is not None:
                flight.brief(briefing.of_simulation(truth_folder))
            if recorder is not None:
                flight.record(recorder)
        except MavfiError:
            transport.close()
            if process is not None and (failure := _failure(process)):
                raise failure from None
            raise
        name = stem_of(config.world) if config.link is None else "link"
        folder = new_run_folder(out, f"{name}-{config.seed}")
        flight.injection.begin(folder.fault)
        flight_begun = time.perf_counter()
        with flight.isolated_nodes():
            crash = _fly(flight, folder)
        flight_wall_s = time.perf_counter() - flight_begun
        transport.close()  # the vehicle sees the end and saves its truth
        if process is not None and (failure := _failure(process)):
            flight.explain(str(failure))
        host = {
            "started": started.isoformat(timespec="seconds"),
            "startup_s": round(flight_begun - begun, 3),
            "flight_wall_s": round(flight_wall_s, 3),
            "machine": host_platform.machine(),
            "cores": os.cpu_count(),
            "isolated": list(config.isolate),
            "memory_mb": _memory_mb(truth_folder),
            "stage_wall_s": _rounded(flight.wall.totals),
            "vehicle_stage_wall_s": _rounded(_vehicle_host(truth_folder).get("stage_wall_s", {})),
        }
        truth, referee = _read_truth(truth_folder)
        _write(flight, folder, config, host, truth, referee, crash)
    return folder


@contextlib.contextmanager
def _injection(
    config: MissionConfig,
    out: Path,
    repeat: Mapping[str, Any] | None,
    for_debugger: Callable[[int], None] | None,
    vehicles: VehicleTemplate | None,
) -> Iterator[InstructionInjection | None]:
    """The instruction-level fault of a mission, its node's process already starting."""
    if config.instruction is None:
        yield None
        return
    require_possible(config.link)
    if repeat is not None:
        planned = planned_of(repeat)
    else:
        planned = _plan(config, config.instruction, out, vehicles)
    injection = InstructionInjection(planned, SpawnedNode(), for_debugger)
    try:
        yield injection
    finally:
        injection.close()


def _plan(
    config: MissionConfig, asked: InstructionConfig, out: Path, vehicles: VehicleTemplate | None
) -> PlannedFault:
    def fly_golden(golden: MissionConfig, folder: Path, recorder: Recorder) -> None:
        flown = fly_mission(golden, folder, Watcher(), recorder=recorder, vehicles=vehicles)
        if json.loads(flown.result.read_text())["referee"] is None:  # nothing to draw from
            raise VehicleProcessError("the vehicle process of the golden flight died")

    return plan_fault(config, asked, out, installed_versions(), fly_golden)


def _fly(flight: Flight, folder: RunFolder) -> str | None:
    """Fly to the end. A crash of the companion's software is an outcome: returns its traceback."""
    try:
        flight.fly(folder.tlog)
    except MavfiError:
        raise
    except Exception as error:  # the mission-process boundary: a crash is a result
        flight.end(Outcome.CRASH, f"{type(error).__name__}: {error}")
        return traceback.format_exc()
    return None


@contextlib.contextmanager
def _vehicle(
    config: MissionConfig, vehicles: VehicleTemplate | None
) -> Iterator[tuple[Transport, Path | None, VehicleProcess | None]]:
    """The other end: a simulated vehicle of our own, or a foreign autopilot."""
    if config.link is not None:
        warm_up()  # first: what comes meanwhile would be stale, and the link full of it
        transport = open_transport(config.link)
        try:
            yield transport, None, None
        finally:
            transport.close()
        return
    with tempfile.TemporaryDirectory(prefix="mavfi-") as folder:
        process = VehicleProcess(config, Path(folder), vehicles)
        transport = open_transport(f"fd:{process.detach()}")
        try:
            warm_up()  # while the vehicle starts
            yield transport, Path(folder), process
        finally:
            transport.close()
            process.stop()
            process.close()


def _failure(process: VehicleProcess) -> MavfiError | None:
    process.stop()
    return process.failure()


@contextlib.contextmanager
def interruptible() -> Iterator[list[int]]:
    """Turn Ctrl-C and SIGTERM into a request, so that what runs ends with a whole record.

    Yields a list that is empty until then. Only the main thread can ask for this.
    """
    asked: list[int] = []
    previous: dict[signal.Signals, Any] = {}
    for number in (signal.SIGINT, signal.SIGTERM):
        with contextlib.suppress(ValueError):  # not the main thread
            previous[number] = signal.signal(number, lambda n, _frame: asked.append(n))
    try:
        yield asked
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _read_truth(folder: Path | None) -> tuple[quality.Truth | None, dict[str, Any] | None]:
    """The referee's log and report; None for a foreign autopilot, or a vehicle that died."""
    if folder is None or not (folder / "truth.json").is_file():
        return None, None
    with np.load(folder / "truth.npz") as data:
        truth = {name: data[name] for name in data.files}
    return truth, json.loads((folder / "truth.json").read_text())


def _memory_mb(folder: Path | None) -> dict[str, float]:
    """Peak resident memory of this process and of the vehicle's, MB."""
    own = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    vehicle = _vehicle_host(folder).get("memory_mb", 0.0)
    return {"companion": round(own / 1024, 1), "vehicle": round(vehicle, 1)}


def _vehicle_host(folder: Path | None) -> dict[str, Any]:
    """What the vehicle's process tells of itself: stages, s, and memory, MB."""
    if folder is None or not (folder / "host.json").is_file():
        return {}
    told: dict[str, Any] = json.loads((folder / "host.json").read_text())
    return told


def _rounded(stages: Mapping[str, float]) -> dict[str, float]:
    return {name: round(value, 4) for name, value in stages.items()}


def _write(
    flight: Flight,
    folder: RunFolder,
    config: MissionConfig,
    host: dict[str, Any],
    truth: quality.Truth | None,
    referee: dict[str, Any] | None,
    crash: str | None,
) -> None:
    companion = flight.companion
    goal = flight.goal_enu_m
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
        "config": config.to_dict(),
        "seeds": {"root": config.seed, "fault": asked.seed if asked else None},
        "simulated_s": flight.end_s,
        "quality_of_flight": qof.to_dict(),
        **mission_statistics(companion, flight.images),
        "response_time_s": response_times(companion.reactions if companion else []),
        "events": flight.log.to_list(),
        "plans": plan_lines(companion),
        "fault": flight.injection.finish(),
        "detection": companion.protection.summary() if companion else None,
        "goal_enu_m": None if goal is None else goal.tolist(),
        "world": None if referee is None else referee["world"],
        "referee": None if referee is None else {k: v for k, v in referee.items() if k != "world"},
        "versions": installed_versions(),
        "host": host,
    }
    write_trace(folder.trace, flight.trace.table(truth))
    write_plans(folder.plans, companion.plans if companion else [])
    told = [loss.traceback for loss in companion.executor.losses] if companion else []
    if errors := [text for text in (*told, crash) if text]:
        (folder.path / CRASH).write_text("\n".join(errors))
    folder.write_result(result)


def installed_versions() -> dict[str, str]:
    """Versions that a record depends on."""
    versions = {"mavfi": __version__, "python": sys.version.split()[0]}
    for name in _VERSIONS:
        versions[name] = importlib.metadata.version(name)
    return versions
