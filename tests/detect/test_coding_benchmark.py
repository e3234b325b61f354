"""The comparison of codings in docs/results/detectors.md, on runs in which nothing happens."""

import sys
from pathlib import Path

import numpy as np
import pytest

from mavfi_cli.detect.preprocess import DETECTED

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def modules(monkeypatch):
    monkeypatch.syspath_prepend(BENCHMARKS)
    import detector_coding
    import golden_runs

    yield detector_coding, golden_runs
    del sys.modules["detector_coding"], sys.modules["golden_runs"]


def calm_run(golden_runs, world):
    """A flight in which no state ever changes, so all of its reports are one sample."""
    columns = {
        state.name: np.ma.masked_array(np.ones(20), mask=np.zeros(20, bool)) for state in DETECTED
    }
    return golden_runs.Run(world, 1, {**columns, "stamp_s": np.arange(20) * 0.02})


def test_a_training_flight_of_one_report_is_compared(modules, capsys):
    coding, golden = modules
    coding.coding([calm_run(golden, world) for world in ("train-0.05-3", "sparse")])
    row = next(line for line in capsys.readouterr().out.splitlines() if "12 bits" in line)
    assert row.split() == ["12", "bits", "0", "0", "0", "0.0%"]


def test_runs_of_one_kind_alone_are_refused(modules):
    coding, golden = modules
    with pytest.raises(SystemExit, match=r"0 in training worlds and 1 in others"):
        coding.coding([calm_run(golden, "sparse")])
