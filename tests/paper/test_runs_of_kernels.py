"""The runs of isolated kernels of a reproduction, with the quickest kernel alone."""

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from mavfi_cli.analysis.kernels import KERNELS, KernelSummary
from mavfi_cli.attack.campaign import run_campaign
from mavfi_cli.attack.kernels import catalogue
from mavfi_cli.campaigns.progress import Spectator, duration
from mavfi_cli.campaigns.run import Options
from mavfi_cli.core.errors import RecordError
from mavfi_cli.mission import kernel_inputs
from mavfi_cli.paper import flying
from mavfi_cli.paper.items import FlightsPlan, items_named
from mavfi_cli.paper.status import of_kernels, tables

RESULTS = Path(__file__).parents[2] / "docs/results"
RUNS = 6
MEASURED = SimpleNamespace(wall_s=1.7, prepare_s=1.0)  # of the runs for the forecast


@pytest.fixture(autouse=True)
def quickest_only(monkeypatch):
    """Run one kernel, and nothing for the forecast."""
    monkeypatch.setattr(flying, "select", lambda names: catalogue.select(["control"]))

    def run(plan, *given, **named):
        return run_campaign(plan, *given, **named) if plan.runs < 100 else [MEASURED]

    monkeypatch.setattr(flying, "run_campaign", run)


class _Steps(Spectator):
    def __init__(self):
        self.texts = []

    def on_step(self, text, elapsed_s):
        self.texts.append(text)


def plan(out, runs=RUNS):
    """Of Fig. 6, which has 5,000 runs at full scale."""
    items = items_named(["fig6"])
    return FlightsPlan(items=items, stack="mavbench", scale=runs / 5000, out=out)


def made(asked):
    """Make the runs; the forecast, and what was told of the steps."""
    told, steps = [], _Steps()
    flying.reproduce(asked, Options(jobs=1), steps, told.append)
    (forecast,) = told
    return forecast, steps.texts


@pytest.mark.slow
def test_runs_are_made_once_and_become_the_table(tmp_path):
    forecast, texts = made(plan(tmp_path))
    assert forecast.runs == RUNS
    assert forecast.disk_bytes > 0
    assert f"control: 0/{RUNS} runs, " in texts[0]
    assert f"control: {RUNS}/{RUNS} runs, 0:00 min" in texts[-1]
    (row,) = of_kernels(KernelSummary.read(tmp_path / "kernels" / KERNELS).kernels).rows
    assert row.cells[0].count <= RUNS
    assert (tmp_path / "kernels" / "kernels.svg").is_file()
    again, texts = made(plan(tmp_path))
    assert (again.runs, again.seconds, texts) == (0, 0.0, [])
    grown, texts = made(plan(tmp_path, RUNS + 2))
    assert grown.runs == 2
    whole, left = (text.rpartition(" runs, ")[2] for text in (texts[0], texts[-2]))
    assert whole == f"{duration(grown.seconds)} to go"
    assert left == f"{duration(grown.seconds / 2)} to go"  # one of two


class _Forecast(Exception):
    pass


def test_the_forecast_is_of_what_is_left(tmp_path, monkeypatch):
    monkeypatch.setattr(kernel_inputs, "kernel_flight", lambda: None)
    monkeypatch.setattr(kernel_inputs, "kernel_targets", lambda *given: [])

    def stop(forecast):
        raise _Forecast(forecast)

    found = []
    (tmp_path / "kernels").mkdir()
    for done in (0, 1000, 3000):
        summary = json.loads((RESULTS / KERNELS).read_text())
        summary["kernels"] = [x | {"runs": done} for x in summary["kernels"]]
        (tmp_path / "kernels" / KERNELS).write_text(json.dumps(summary))
        with pytest.raises(_Forecast) as told:
            flying.reproduce(plan(tmp_path, 5000), Options(jobs=2), Spectator(), stop)
        found.append(told.value.args[0])
    assert [each.runs for each in found] == [5000, 4000, 2000]
    first, second, third = (each.seconds for each in found)
    assert second - third == pytest.approx(2 * (first - second))
    assert first > second


def test_without_runs_the_command_that_makes_them_is_named(tmp_path):
    with pytest.raises(RecordError, match="mavfi reproduce fig6"):
        list(tables(plan(tmp_path)))
    (tmp_path / "kernels").mkdir()
    (tmp_path / "kernels" / KERNELS).write_text("{")
    with pytest.raises(RecordError, match="not a summary"):
        list(tables(plan(tmp_path)))
