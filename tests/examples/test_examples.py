"""Every example runs as a user runs it, and says what it promises."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"
SAYS = {
    "campaign_table": "'label_fault': 'planning', 'seed': 6",
    "detector": "success with 1 alarm",
    "fault_and_golden_pair": "golden: success",
    "golden_flight": "success after",
    "read_trace": "top speed",
    "stack_ablation": "hardened: success",
}


def run(program, folder):
    done = subprocess.run(
        [sys.executable, *program], cwd=folder, capture_output=True, text=True, timeout=120,
        env={**os.environ, "PYTHONWARNINGS": "error"}, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_every_example_is_tested():
    assert {path.stem for path in EXAMPLES.glob("*.py")} == set(SAYS)


@pytest.mark.slow
@pytest.mark.parametrize("name", SAYS)
def test_an_example_runs(name, tmp_path):
    assert SAYS[name] in run([EXAMPLES / f"{name}.py"], tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("path", list(EXAMPLES.glob("*.ipynb")), ids=lambda path: path.stem)
def test_the_code_of_a_notebook_runs(path, tmp_path):
    cells = json.loads(path.read_text())["cells"]
    code = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    assert "success" in run(["-c", code], tmp_path)
