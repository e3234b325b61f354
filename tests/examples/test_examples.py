"""Every example runs as a program, and says what it promises."""

import json
import runpy
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


@pytest.fixture
def run(tmp_path, monkeypatch, capfd):
    """Run a file as the main program, in an empty folder; what it prints."""
    monkeypatch.chdir(tmp_path)

    def run(path):
        monkeypatch.setattr(sys, "argv", [str(path)])
        runpy.run_path(str(path), run_name="__main__")
        return capfd.readouterr().out

    return run


def test_every_example_is_tested():
    assert {path.stem for path in EXAMPLES.glob("*.py")} == set(SAYS)


@pytest.mark.parametrize("name", SAYS)
def test_an_example_runs(name, run):
    assert SAYS[name] in run(EXAMPLES / f"{name}.py")


@pytest.mark.parametrize("path", list(EXAMPLES.glob("*.ipynb")), ids=lambda path: path.stem)
def test_the_code_of_a_notebook_runs(path, run, tmp_path):
    cells = json.loads(path.read_text())["cells"]
    code = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    (tmp_path / "notebook.py").write_text(code)
    assert "success" in run("notebook.py")
