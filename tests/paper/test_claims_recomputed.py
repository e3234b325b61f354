"""The published verdicts against a second computation that shares no code with the first."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_another_program_finds_the_same_effects_and_verdicts():
    names = ("docs/results/paper-mavbench.parquet", "docs/results/kernels.json")
    done = subprocess.run(
        [sys.executable, "benchmarks/claims_recomputed.py", *names],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert "59 claims recomputed, 147 verdicts, 0 unequal" in done.stdout
