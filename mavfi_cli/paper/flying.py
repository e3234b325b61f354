"""Forecasts and flies the missions that items need, and runs the kernels of Fig. 6."""

from __future__ import annotations

import os
import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean

import numpy as np

from mavfi_cli.analysis.kernels import KERNELS, KernelSummary
from mavfi_cli.attack.campaign import Plan, run_campaign
from mavfi_cli.attack.kernels.catalogue import select
from mavfi_cli.attack.kernels.target import KernelTarget
from mavfi_cli.campaigns.begin import check_kinds
from mavfi_cli.campaigns.ledger import LEDGER, RUNS, Ledger
from mavfi_cli.campaigns.missions import MissionResult
from mavfi_cli.campaigns.progress import Progress, Spectator, duration
from mavfi_cli.campaigns.run import PROFILES, Options, fly_missing, require_unchanged, store_plan
from mavfi_cli.campaigns.specification import SAMPLE, Keep
from mavfi_cli.core.errors import ConfigError, RecordError
from mavfi_cli.core.files import ScratchFolder
from mavfi_cli.paper.items import KERNELS_FOLDER, FlightsPlan, Source
from mavfi_cli.report.attacks import save_runs, summarise

_UNMEASURED = 12  # largest number of missing missions that are not measured
_MEASURED = 100  # missions to measure for a forecast if too few have finished
_OF_A_KIND = 4  # a kind with this many finished missions needs no measurement
_NEWEST = 2000  # maximum number of finished missions in a forecast: the last ones
_ROW_BYTES, _FOLDER_BYTES = 20_000, 2_000_000  # per mission in the ledger; per kept run
_PROFILES_BYTES = 10_000_000  # profiles of one golden flight
_OVERLAP = 2  # repetitions whose profiles are on the disk at once


@dataclass(frozen=True, slots=True, kw_only=True)
class Forecast:
    """The missions and kernel runs that are left, and the time and disk space that they will need.

    Attributes:
        missions, over: number of missions of the items, and how many of them are finished.
        seconds: wall time of the rest, in seconds; excludes missions if none has been measured.
        disk_bytes: disk space for the rest, including profiles that are removed later.
        measured: number of missions on which the forecast is based; may be 0 if few are left.
        jobs: number of concurrent missions or runs.
        runs: number of missing runs of isolated kernels.
    """

    missions: int = 0
    over: int = 0
    seconds: float = 0.0
    disk_bytes: float = 0.0
    measured: int = 0
    jobs: int = 1
    runs: int = 0

    @property
    def summary(self) -> str:
        """The forecast in one line."""
        left = self.missions - self.over
        parts = [f"{self.missions} missions, {self.over} of them flown"] if self.missions else []
        parts += [f"{self.runs} runs of kernels"] if self.runs else []
        done = "; ".join(parts) or "nothing to fly: the model computes the items"
        if not (left or self.runs):
            return done
        if left and not self.measured:
            return f"{done}; what is left takes about {self.disk_bytes / 1e6:.0f} MB"
        measured = f", from {self.measured} missions" if left else ""
        return (
            f"{done}; what is left takes about {duration(self.seconds)} on this machine "
            f"({self.jobs} at a time{measured}) and {self.disk_bytes / 1e6:.0f} MB"
        )


def reproduce(
    plan: FlightsPlan,
    options: Options,
    spectator: Spectator,
    on_forecast: Callable[[Forecast], None],
) -> None:
    """Fly the plan's missing missions, and run the isolated kernels if its items include Fig. 6.

    Args:
        on_forecast: called once with the forecast, after the missions and runs that it measures and
            before the rest.

    Raises:
        ConfigError: the folder holds another campaign, or a reproduction that was begun with
            another stack, other worlds, another rule, a larger scale or other program versions.
        RecordError: the disk has too little free space.
        MavfiError: a mission or a kernel cannot be run.
    """
    jobs = options.jobs or len(os.sched_getaffinity(0))
    kernels = _KernelRuns(out=plan.out, runs=max(1, round(_PAPER_RUNS * plan.scale)), jobs=jobs)
    left = Forecast(jobs=jobs)
    if any(item.source is Source.KERNELS for item in plan.items) and (runs := kernels.missing()):
        spectator.on_note("measuring a few runs of a kernel")
        seconds = kernels.forecast_s()
        left = replace(left, runs=runs, seconds=seconds, disk_bytes=runs * _RECORD_BYTES)
    if any(item.preset for item in plan.items):
        with opened(plan) as ledger:
            wanted = frozenset(plan.numbers(ledger))
            kept = frozenset(plan.kept(ledger))
            options = replace(options, only=wanted, planned=wanted, kept=kept)
            measured = _measured(ledger, wanted, options, spectator)
            whole = _with_flights(left, ledger, wanted, options, measured)
            on_forecast(whole)
            _require_room(plan.out, whole)
            fly_missing(ledger, options, _Ahead(spectator, left.seconds))
    else:
        on_forecast(left)
        _require_room(plan.out, left)
    if left.runs:
        kernels.run(spectator, left.seconds)


class _Ahead(Spectator):
    """Forwards the events of missions, and adds the time of later kernel runs to the time left."""

    def __init__(self, spectator: Spectator, beyond_s: float) -> None:
        self._spectator, self._beyond_s = spectator, beyond_s

    def on_progress(self, progress: Progress) -> None:
        self._spectator.on_progress(replace(progress, beyond_s=self._beyond_s))

    def on_end(self, progress: Progress) -> None:
        self._spectator.on_end(progress)

    def on_note(self, text: str) -> None:
        self._spectator.on_note(text)


def opened(plan: FlightsPlan) -> Ledger:
    """Open the ledger of the plan's stack for writing, and store the planned missions of all items.

    Raises:
        ConfigError: the folder holds another campaign, or was begun with another stack, other
            worlds, another rule, a larger scale or other program versions.
    """
    if (plan.folder / LEDGER).is_file():
        with Ledger(plan.folder) as ledger:
            _require_same(plan, FlightsPlan.stored(ledger))
    else:
        check_kinds(plan.kinds(*plan.every))
    ledger = Ledger(plan.folder, writing=True)
    try:
        require_unchanged(ledger)
        ledger.set_meta(plan.meta)
        store_plan(ledger, plan.missions(*plan.every), append=True)
    except BaseException:
        ledger.close()
        raise
    return ledger


def _require_same(plan: FlightsPlan, stored: FlightsPlan | None) -> None:
    if stored is None:
        problem = "holds a campaign that is not a reproduction"
    elif stored.stack != plan.stack:
        problem = f"holds a reproduction on the stack {stored.stack}, not {plan.stack}"
    elif stored.worlds != plan.worlds:
        problem = f"holds a reproduction with --worlds {stored.worlds}, not {plan.worlds}"
    elif plan.rule != stored.rule:
        rules = [own.rule or "the usual restart rule and injector" for own in (stored, plan)]
        problem = "holds a reproduction under {}, not {}".format(*rules)
    elif plan.scale < stored.scale:
        problem = f"was begun with --scale {stored.scale:g}, which cannot shrink to {plan.scale:g}"
    else:
        return
    raise ConfigError(f"{problem}; choose another --out", path=plan.folder)


def _missing(ledger: Ledger, wanted: frozenset[int]) -> dict[int, str]:
    """Return the kind of each wanted mission that has no result, keyed by mission number."""
    return {
        mission.number: _kind(mission.config.instruction, mission.config.fault)
        for mission in ledger.missing()
        if mission.number in wanted
    }


def _measured(
    ledger: Ledger, wanted: frozenset[int], options: Options, spectator: Spectator
) -> list[int]:
    """Fly some missions if a kind has few results, so that times can be forecast.

    Whole shared flights are drawn, because a mission that is forked from one takes much less time.

    Returns:
        Numbers of the finished missions on which the forecast should be based.
    """
    missing = _missing(ledger, wanted)
    over = sorted(wanted.difference(missing))[-_NEWEST:]
    known = Counter(kind for kind, _ in _kinds(ledger.results(over)))
    left = Counter(missing.values())
    if len(missing) <= _UNMEASURED or all(
        known[kind] >= min(_OF_A_KIND, left[kind]) for kind in left
    ):
        return over
    groups: dict[object, list[int]] = {}
    for mission in ledger.missing():
        if (number := mission.number) in missing:
            groups.setdefault(mission.config.shared_flight or number, []).append(number)
    flights, measured = list(groups.values()), list[int]()
    for place in np.random.default_rng(_SEED).permutation(len(flights)):
        measured += flights[place]
        if len(measured) >= min(_MEASURED, len(missing) / 4):
            break
    spectator.on_note(f"measuring {len(measured)} missions")
    fly_missing(ledger, replace(options, only=frozenset(measured)), spectator)
    return over + measured


def _kind(instruction: object, fault: object) -> str:
    """Return what affects a mission's wall time most: the level of its fault, or `golden`."""
    return "instruction" if instruction else "source" if fault else "golden"


def _kinds(results: Iterable[MissionResult]) -> list[tuple[str, float]]:
    """Return the kind, and the wall time in seconds, of each finished mission."""
    configs = [(result.mission.config, result.wall_s) for result in results]
    return [(_kind(config.instruction, config.fault), wall_s) for config, wall_s in configs]


def remaining_s(measured: Iterable[tuple[str, float]], missing: Mapping[str, int]) -> float:
    """Estimate the wall time, in seconds, of flying the missing missions one after another.

    Args:
        measured: kind, and wall time in seconds, of each finished mission.
        missing: number of missing missions of each kind. Each takes the mean time of its kind,
            or of all measured missions if its kind was not measured.
    """
    times: dict[str, list[float]] = {}
    for kind, wall_s in measured:
        times.setdefault(kind, []).append(wall_s)
    every = [wall_s for own in times.values() for wall_s in own] or [0.0]
    return sum(count * fmean(times.get(kind, every)) for kind, count in missing.items())


def _with_flights(
    forecast: Forecast,
    ledger: Ledger,
    wanted: frozenset[int],
    options: Options,
    measured: Sequence[int],
) -> Forecast:
    """Return a forecast that includes the missing missions, estimated from the measured ones."""
    missing = _missing(ledger, wanted)
    flown = list(ledger.results(measured))
    left_s = remaining_s(_kinds(flown), Counter(missing.values()))
    losses = sum(result.outcome != "success" for result in flown) / max(1, len(flown))
    rows = sum(path.stat().st_size for path in ledger.folder.glob(f"{LEDGER}*"))
    row_bytes = rows / ledger.over() if flown else _ROW_BYTES
    run_bytes = _mean_size(ledger.folder / RUNS, _FOLDER_BYTES)
    failures = losses * len(missing) / (SAMPLE if options.keep is Keep.FEW else 1)
    kept = len(missing.keys() & options.kept) + failures
    profiled = {
        mission.config.golden
        for mission in ledger.missing()
        if mission.number in missing and mission.config.instruction is not None
    }
    most = max(Counter(golden.seed for golden in profiled).values(), default=0)
    profiles = _OVERLAP * most * _mean_size(ledger.folder / PROFILES, _PROFILES_BYTES)
    return replace(
        forecast,
        missions=len(wanted),
        over=len(wanted) - len(missing),
        seconds=forecast.seconds + left_s / forecast.jobs,
        disk_bytes=forecast.disk_bytes + len(missing) * row_bytes + kept * run_bytes + profiles,
        measured=len(flown),
    )


def _mean_size(parent: Path, unknown: float) -> float:
    """Return the mean size in bytes of up to 20 subfolders of `parent`; `unknown` without any."""
    folders = sorted(path for path in parent.glob("*") if path.is_dir())[-20:]
    files = (path for folder in folders for path in folder.rglob("*") if path.is_file())
    return sum(path.stat().st_size for path in files) / len(folders) if folders else unknown


def _require_room(out: Path, forecast: Forecast) -> None:
    place = next(path for path in (out.absolute(), *out.absolute().parents) if path.exists())
    free = shutil.disk_usage(place).free
    if forecast.disk_bytes > free:
        raise RecordError(
            f"{out}: needs about {forecast.disk_bytes / 1e9:.1f} GB, but only {free / 1e9:.1f} GB "
            "is free"
        )


# Isolated kernels, which depend on no stack -------------------------------------------------------

_PAPER_RUNS = 5000  # per kernel
_SEED = 1
# The forecast times the quickest kernel here, and scales the times in docs/results/kernels.json
# in proportion.
_QUICKEST, _QUICK_RUNS = "control", 100
_QUICKEST_RUN_S = 35.0 / 5000  # from that file
_PREPARE_S, _RUN_OF_EACH_S = 738.0, 1965.0 / 5000  # of all kernels together, from that file
_RECORD_BYTES = 2000  # record of one run


@dataclass(frozen=True, slots=True, kw_only=True)
class _KernelRuns:
    """The runs of all isolated kernels that a reproduction needs.

    Attributes:
        out: folder of all stacks; its subfolder KERNELS_FOLDER holds the runs.
        runs: number of runs of each kernel.
        jobs: number of concurrent runs.
    """

    out: Path
    runs: int
    jobs: int

    @property
    def folder(self) -> Path:
        """The folder of the runs, with the same contents as that of `mavfi kernels --out`."""
        return self.out / KERNELS_FOLDER

    def missing(self) -> int:
        """Return the number of runs, over all kernels, that the stored summary lacks."""
        path = self.folder / KERNELS
        if not path.is_file():
            return self.runs * len(select(()))
        done = {kernel.name: kernel.runs for kernel in KernelSummary.read(path).kernels}
        return sum(max(0, self.runs - done.get(name, 0)) for name in select(()))

    def forecast_s(self) -> float:
        """Estimate the wall time of the missing runs, in seconds, by timing the quickest kernel."""
        with ScratchFolder("kernels") as scratch:
            targets = _targets([_QUICKEST], scratch)
            (measured,) = run_campaign(Plan(runs=_QUICK_RUNS, seed=_SEED), targets)
        run_s = (measured.wall_s - measured.prepare_s) / _QUICK_RUNS
        runs = self.missing() / len(select(()))
        there_s = _PREPARE_S + _RUN_OF_EACH_S * runs / self.jobs
        return there_s * run_s / _QUICKEST_RUN_S

    def run(self, spectator: Spectator, forecast_s: float) -> None:
        """Execute the missing runs, and write their summary.

        Raises:
            MavfiError: as for `attack.campaign.run_campaign`.
        """
        plan = Plan(runs=self.runs, seed=_SEED)
        targets = _targets((), self.folder)
        names, begun = [target.name for target in targets], time.monotonic()
        whole, missing = self.runs * len(names), self.missing()

        def show(name: str, done: int) -> None:
            """Report a kernel's finished runs, and the time left according to the forecast."""
            place = names.index(name)
            left = min(1.0, (whole - place * self.runs - done) / missing)
            text = f"kernel {place + 1} of {len(names)}, {name}: {done}/{self.runs} runs"
            spectator.on_step(
                f"{text}, {duration(forecast_s * left)} to go", time.monotonic() - begun
            )

        campaign = run_campaign(
            plan,
            targets,
            jobs=self.jobs,
            folder=self.folder,
            progress=show,
            notice=lambda text: spectator.on_note(f"warning: {text}"),
        )
        save_runs(self.folder, summarise(plan, campaign), campaign)


def _targets(names: Sequence[str], folder: Path) -> list[KernelTarget]:
    from mavfi_cli.mission.kernel_inputs import kernel_flight, kernel_targets  # loads the mission

    return kernel_targets(select(names), kernel_flight(), folder)
