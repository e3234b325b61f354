"""Flies one mission and writes its record. This is the function behind `mavfi fly`."""

from __future__ import annotations

import contextlib
import functools
import importlib.metadata
import json
import os
import platform as host_platform
import resource
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mavfi_cli import __version__
from mavfi_cli.autonomy import planners
from mavfi_cli.core.errors import Interrupted, MavfiError, VehicleProcessError
from mavfi_cli.core.types import Outcome
from mavfi_cli.mission import briefing
from mavfi_cli.mission.branching import Branching
from mavfi_cli.mission.companion.response import response_times
from mavfi_cli.mission.config import MissionConfig, stack_of
from mavfi_cli.mission.flight import Flight
from mavfi_cli.mission.injection import NoInjection
from mavfi_cli.mission.orders import Recorder
from mavfi_cli.mission.platform import load_platform
from mavfi_cli.mission.progress import Watcher
from mavfi_cli.mission.record import quality
from mavfi_cli.mission.record.plan_file import write_plans
from mavfi_cli.mission.record.run_folder import CRASH, RunFolder
from mavfi_cli.mission.record.statistics import mission_statistics, plan_lines
from mavfi_cli.mission.record.timetable import timetable_of, write_timetable
from mavfi_cli.mission.record.trace import write_trace
from mavfi_cli.mission.sortie import Sortie, other_end
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
    branching: Branching | None = None,
) -> RunFolder:
    """Fly one mission from start to end and write its run folder.

    Every end of the flight, including a crash of the companion, is a result and is recorded.

    Args:
        config: the mission.
        out: where the run folder goes.
        watcher: gets progress and events.
        recorder: keeps what the flight asks of its nodes.
        repeat: the record of an instruction-level fault to repeat, instead of drawing one.
        for_debugger: called when the node waits for a debugger at the injected instruction.
        vehicles: forks the simulated vehicle; None: it is started as a program.
        branching: other missions that begin as this one; see `fly_together`.

    Raises:
        MavfiError: the mission could not begin (unknown names, blocked start, no autopilot ...),
            or its record could not be written.
    """
    platform, stack = load_platform(config.platform), stack_of(config)
    planner = planners.find(config.planner)
    begun_s = time.perf_counter()
    with (
        _injection(config, out, repeat, for_debugger, vehicles) as injection,
        interruptible() as interrupt,
        other_end(config, vehicles, watcher, patient=branching is not None) as end,
    ):
        flight = Flight(config, stack, end.transport, platform, planner, watcher, interrupt)
        sortie = Sortie(config, out, end, flight, branching, begun_s=begun_s)
        sortie.prepare_to_branch()
        if injection is not None:
            flight.injection = injection
        try:
            if end.truth_folder is None:  # before connecting: then the vehicle's clock runs
                flight.brief(briefing.of_config(config))
            flight.connect()
            if end.truth_folder is not None:
                flight.brief(briefing.of_simulation(end.truth_folder))
            if recorder is not None:
                flight.record(recorder)
        except MavfiError:
            end.transport.close()
            if failure := end.failure():
                raise failure from None
            raise
        sortie.begin()
        sortie.flight_begun_s = time.perf_counter()
        with flight.isolated_nodes():
            crash = _fly(sortie)
        sortie.note_end()
        end.transport.close()  # the vehicle sees the end and saves its truth
        if failure := end.failure():
            flight.explain(str(failure))
        truth, referee = _read_truth(end.truth_folder)
        vehicle = _vehicle_host(end.truth_folder)
        sortie.branch_rest()
        _write(sortie, _host(sortie, vehicle), truth, referee, crash)
    return sortie.folder


def fly_together(branching: Branching, place: Path, vehicles: VehicleTemplate) -> RunFolder:
    """Fly missions that differ in their fault only, as one flight until each fault strikes.

    Args:
        branching: the missions; every one that branches off returns from here as well, in a process
            of its own.
        place: of what the flight leaves while it is none of the missions.
        vehicles: forks the simulated vehicles.

    Returns:
        The run folder of the mission that the process has become.

    Raises:
        MavfiError: as `fly_mission`.
    """
    config = replace(branching.members[0].config, fault=None)
    out = place if branching.me is None else branching.members[branching.me].out
    return fly_mission(config, out, Watcher(), vehicles=vehicles, branching=branching)


def _host(sortie: Sortie, vehicle: Mapping[str, Any]) -> dict[str, Any]:
    """Return the host's cost of the mission, which is not repeatable."""
    own_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {
        "started": sortie.started.isoformat(timespec="seconds"),
        "startup_s": round(sortie.flight_begun_s - sortie.begun_s, 3),
        "flight_wall_s": round(sortie.flight_wall_s, 3),
        "branched_s": sortie.branched_s,
        "machine": host_platform.machine(),
        "cores": os.cpu_count(),
        "isolated": list(sortie.config.isolate),
        "memory_mb": {
            "companion": round(own_mb, 1),
            "vehicle": round(vehicle.get("memory_mb", 0.0), 1),
        },
        "stage_wall_s": _rounded(sortie.flight.wall.totals),
        "vehicle_stage_wall_s": _rounded(vehicle.get("stage_wall_s", {})),
    }


@contextlib.contextmanager
def _injection(
    config: MissionConfig,
    out: Path,
    repeat: Mapping[str, Any] | None,
    for_debugger: Callable[[int], None] | None,
    vehicles: VehicleTemplate | None,
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
        functools.partial(fly_golden, vehicles=vehicles),
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
    vehicles: VehicleTemplate | None = None,
) -> dict[str, Any]:
    """Fly a golden run, from which faults or inputs are drawn.

    Returns:
        Contents of its result.json.

    Raises:
        Interrupted: The run was cut off, so other faults would be drawn.
        VehicleProcessError: The vehicle died, so there is nothing to draw from.
    """
    flown = fly_mission(config, out, Watcher(), recorder=recorder, vehicles=vehicles)
    result: dict[str, Any] = json.loads(flown.result.read_text())
    if result["outcome"] == Outcome.INTERRUPTED.value:
        raise Interrupted("interrupted")
    if result["referee"] is None:
        raise VehicleProcessError("the vehicle process of the golden flight died")
    return result


def _fly(sortie: Sortie) -> str | None:
    """Fly to the end. Return the traceback if the companion's software crashes, else None."""
    flight = sortie.flight
    try:
        flight.fly(sortie.folder.tlog)
    except MavfiError:
        raise
    except Exception as error:  # the mission-process boundary: a crash is a result
        flight.end(Outcome.CRASH, f"{type(error).__name__}: {error}")
        return traceback.format_exc()
    return None


@contextlib.contextmanager
def interruptible() -> Iterator[list[int]]:
    """Turn Ctrl-C and SIGTERM into a request, so that a mission ends with a complete record.

    Yields a list that is empty until a signal arrives. Has no effect outside the main thread.
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
    """Read the referee's log and report; None for a foreign autopilot or a dead vehicle."""
    if folder is None or not (folder / "truth.json").is_file():
        return None, None
    with np.load(folder / "truth.npz") as data:
        truth = {name: data[name] for name in data.files}
    return truth, json.loads((folder / "truth.json").read_text())


def _vehicle_host(folder: Path | None) -> dict[str, Any]:
    """Read the statistics of the vehicle's process: stages, s, and memory, MB."""
    if folder is None or not (folder / "host.json").is_file():
        return {}
    told: dict[str, Any] = json.loads((folder / "host.json").read_text())
    return told


def _rounded(stages: Mapping[str, float]) -> dict[str, float]:
    return {name: round(value, 4) for name, value in stages.items()}


def _write(
    sortie: Sortie,
    host: dict[str, Any],
    truth: quality.Truth | None,
    referee: dict[str, Any] | None,
    crash: str | None,
) -> None:
    flight, folder, config = sortie.flight, sortie.folder, sortie.config
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
        "config": replace(config, goal_tolerance_m=flight.goal_tolerance_m).to_dict(),
        "seeds": {"root": config.seed, "fault": asked.seed if asked else None},
        "simulated_s": flight.end_s,
        "quality_of_flight": qof.to_dict(),
        **mission_statistics(companion, flight.images),
        "measured_platform": companion.measured if companion else None,
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
    write_timetable(folder.kernels, timetable_of(companion))
    told = [loss.traceback for loss in companion.executor.losses] if companion else []
    if errors := [text for text in (*told, crash) if text]:
        (folder.path / CRASH).write_text("\n".join(errors))
    folder.write_result(result)


def installed_versions() -> dict[str, str]:
    """Return the versions of all libraries that a record depends on."""
    versions = {"mavfi": __version__, "python": sys.version.split()[0]}
    for name in _VERSIONS:
        versions[name] = importlib.metadata.version(name)
    return versions
