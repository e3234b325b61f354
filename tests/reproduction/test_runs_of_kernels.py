"""The runs of isolated kernels of a reproduction, with the quickest kernel alone."""

import pytest

from mavfi_cli.analysis.kernel_runs import KERNELS, kernel_summary
from mavfi_cli.attack.kernels import catalogue
from mavfi_cli.campaigns.progress import Spectator
from mavfi_cli.core.errors import RecordError
from mavfi_cli.reproduction import kernels
from mavfi_cli.reproduction.items import items_named
from mavfi_cli.reproduction.kernels import KernelRuns
from mavfi_cli.reproduction.layouts import of_kernels
from mavfi_cli.reproduction.plan import FlightsPlan
from mavfi_cli.reproduction.status import tables

RUNS = 6


@pytest.fixture(autouse=True)
def quickest_only(monkeypatch):
    monkeypatch.setattr(kernels, "select", lambda names: catalogue.select(["control"]))


class _Steps(Spectator):
    def __init__(self):
        self.texts = []

    def on_step(self, text, elapsed_s):
        self.texts.append(text)


def test_runs_are_made_once_and_become_the_table(tmp_path):
    asked, steps = KernelRuns(out=tmp_path, runs=RUNS, jobs=1), _Steps()
    assert asked.missing() == RUNS
    asked.run(steps, 60.0)
    assert steps.texts[0] == f"kernel 1 of 1, control: 0/{RUNS} runs, 1:00 min to go"
    assert steps.texts[-1] == f"kernel 1 of 1, control: {RUNS}/{RUNS} runs, 0:00 min to go"
    assert asked.missing() == asked.disk_bytes == 0
    (row,) = of_kernels(kernel_summary(tmp_path / "kernels" / KERNELS)).rows
    assert row.cells[0].count <= RUNS
    assert (tmp_path / "kernels" / "kernels.svg").is_file()
    more = KernelRuns(out=tmp_path, runs=RUNS + 2, jobs=1)
    assert more.missing() == 2
    more.run(steps, 60.0)
    assert steps.texts[-1].endswith(f"{RUNS + 2}/{RUNS + 2} runs, 0:00 min to go")
    assert f"{RUNS + 1}/{RUNS + 2} runs, 0:30 min to go" in steps.texts[-2]


def test_without_runs_the_command_that_makes_them_is_named(tmp_path):
    plan = FlightsPlan(items=items_named(["fig6"]), stack="mavbench", out=tmp_path)
    with pytest.raises(RecordError, match=r"no runs of kernels \(mavfi reproduce fig6\)"):
        list(tables(plan))
    (tmp_path / "kernels").mkdir()
    (tmp_path / "kernels" / KERNELS).write_text("{")
    with pytest.raises(RecordError, match="no summary of `mavfi kernels`"):
        list(tables(plan))
