"""`mavfi reproduce`: flights and runs of kernels, with one forecast and one time left."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from mavfi_cli.campaigns.progress import Progress, Spectator
from mavfi_cli.campaigns.run import Options
from mavfi_cli.core.errors import RecordError
from mavfi_cli.reproduction.flying import FlightsPlan, Forecast, fly_items
from mavfi_cli.reproduction.items import Source
from mavfi_cli.reproduction.kernels import PAPER_RUNS, KernelRuns


class _Ahead(Spectator):
    """Passes everything on; the time left includes what follows the missions."""

    def __init__(self, spectator: Spectator, beyond_s: float) -> None:
        self._spectator, self._beyond_s = spectator, beyond_s

    def on_progress(self, progress: Progress) -> None:
        self._spectator.on_progress(replace(progress, beyond_s=self._beyond_s))

    def on_end(self, progress: Progress) -> None:
        self._spectator.on_end(progress)

    def on_note(self, text: str) -> None:
        self._spectator.on_note(text)


def reproduce(
    plan: FlightsPlan,
    options: Options,
    spectator: Spectator,
    on_forecast: Callable[[Forecast], None],
) -> None:
    """Fly the missions of the items that the folder lacks, and run the kernels for Fig. 6.

    Args:
        on_forecast: hears what is left before it begins, after a little of it is measured.

    Raises:
        ConfigError: the folder holds another stack, more missions, or another campaign.
        RecordError: the disk has not enough room.
        MavfiError: a mission or a kernel cannot be run.
    """
    jobs = options.jobs or len(os.sched_getaffinity(0))
    kernels = KernelRuns(out=plan.out, runs=max(1, round(PAPER_RUNS * plan.scale)), jobs=jobs)
    missing = kernels.missing() if any(i.source is Source.KERNELS for i in plan.items) else 0
    kernels_s = 0.0
    if missing:
        spectator.on_note("measuring a few runs of a kernel")
        kernels_s = kernels.forecast_s()

    def forecast_all(flights: Forecast) -> None:
        """Tell the forecast of flights and kernels, and require room for both."""
        whole = replace(
            flights,
            seconds=flights.seconds + kernels_s,
            disk_bytes=flights.disk_bytes + (kernels.disk_bytes if missing else 0),
            runs=missing,
            jobs=jobs,
        )
        on_forecast(whole)
        _require_room(plan.out, whole)

    if any(item.preset for item in plan.items):
        fly_items(plan, options, _Ahead(spectator, kernels_s), forecast_all)
    else:
        forecast_all(Forecast())
    if missing:
        kernels.run(spectator, kernels_s)


def _require_room(out: Path, forecast: Forecast) -> None:
    place = next(each for each in (out.absolute(), *out.absolute().parents) if each.exists())
    free = shutil.disk_usage(place).free
    if forecast.disk_bytes > free:
        raise RecordError(
            f"{out}: needs about {forecast.disk_bytes / 1e9:.1f} GB, and {free / 1e9:.1f} GB "
            "are free"
        )
