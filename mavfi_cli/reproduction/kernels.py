"""Runs of isolated kernels for Fig. 6, which depend on no stack."""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from mavfi_cli.analysis.kernel_runs import KERNELS, kernel_summary
from mavfi_cli.attack.campaign import Plan, run_campaign
from mavfi_cli.attack.kernels.catalogue import select
from mavfi_cli.campaigns.progress import Spectator, duration
from mavfi_cli.report.drawing import write_figure
from mavfi_cli.report.kernel_plot import draw_kernel_plot
from mavfi_cli.report.tables.attacks import KERNEL_COLUMNS, save_runs, summarise
from mavfi_cli.reproduction.plan import KERNELS_FOLDER

PAPER_RUNS = 5000  # of each kernel
_SEED = 1
# The forecast measures the quickest kernel and takes the others from docs/results/kernels.json.
_QUICKEST, _MEASURED = "control", 100
_QUICKEST_RUN_S = 35.0 / 5000  # there
_PREPARE_S, _RUN_OF_EACH_S = 738.0, 1965.0 / 5000  # of all kernels, there
_RUN_BYTES = 2000  # of the record of a run


@dataclass(frozen=True, slots=True, kw_only=True)
class KernelRuns:
    """The runs of all kernels in the folder of a reproduction.

    Attributes:
        out: folder of all stacks; the runs are in KERNELS_FOLDER beside those.
        runs: of each kernel.
        jobs: runs at the same time.
    """

    out: Path
    runs: int
    jobs: int

    @property
    def folder(self) -> Path:
        """The folder of the runs, as of `mavfi kernels --out`."""
        return self.out / KERNELS_FOLDER

    def missing(self) -> int:
        """Number of runs that the summary lacks."""
        path = self.folder / KERNELS
        if not path.is_file():
            return self.runs * len(select(()))
        done = {each["kernel"]: each["runs"] for each in kernel_summary(path)["kernels"]}
        return sum(max(0, self.runs - done.get(name, 0)) for name in select(()))

    @property
    def disk_bytes(self) -> int:
        """Space for the missing runs."""
        return self.missing() * _RUN_BYTES

    def forecast_s(self) -> float:
        """Wall time of the missing runs, from a few runs of the quickest kernel."""
        from mavfi_cli.studies.kernels import kernel_flight, kernel_targets  # loads the mission

        with tempfile.TemporaryDirectory(prefix="mavfi-kernels-") as scratch:
            targets = kernel_targets(select([_QUICKEST]), kernel_flight(), Path(scratch))
            (measured,) = run_campaign(Plan(runs=_MEASURED, seed=_SEED), targets)
        run_s = (measured.wall_s - measured.prepare_s) / _MEASURED
        of_each = self.missing() / len(select(()))
        there_s = _PREPARE_S + _RUN_OF_EACH_S * of_each / self.jobs
        return there_s * run_s / _QUICKEST_RUN_S

    def run(self, spectator: Spectator, forecast_s: float) -> None:
        """Make the missing runs, and write their summary.

        Raises:
            MavfiError: as `attack.campaign.run_campaign`.
        """
        from mavfi_cli.studies.kernels import kernel_flight, kernel_targets  # loads the mission

        plan = Plan(runs=self.runs, seed=_SEED)
        targets = kernel_targets(select(()), kernel_flight(), self.folder)
        names, begun = [target.name for target in targets], time.monotonic()
        whole, missing = self.runs * len(names), self.missing()

        def show(name: str, done: int) -> None:
            """Tell the runs of the kernel, and the time left from the forecast."""
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
        summary = summarise(plan, campaign)
        save_runs(self.folder, summary, campaign, KERNEL_COLUMNS)
        write_figure(draw_kernel_plot(summary), self.folder / "kernels.svg")
