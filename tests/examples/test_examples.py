"""Every example runs as a program, and says what it promises."""

import runpy
import sys
from pathlib import Path

import nbclient
import nbformat
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
    assert {path.stem for path in EXAMPLES.glob("*.py")} == {*SAYS, "depth_client"}


@pytest.mark.slow
@pytest.mark.parametrize("name", SAYS)
def test_an_example_runs(name, run):
    assert SAYS[name] in run(EXAMPLES / f"{name}.py")


def prints(notebook):
    """What the cells print, and the kinds of what they show."""
    outputs = [each for cell in notebook.cells for each in cell.get("outputs", ())]
    texts = [each.text for each in outputs if each.output_type == "stream"]
    return texts, [sorted(each.data) for each in outputs if "data" in each]


@pytest.mark.slow
@pytest.mark.parametrize("path", list(EXAMPLES.glob("*.ipynb")), ids=lambda path: path.stem)
def test_a_notebook_prints_what_it_is_stored_with(path, tmp_path, monkeypatch):
    for name in ("JUPYTER_RUNTIME_DIR", "JUPYTER_CONFIG_DIR", "IPYTHONDIR"):
        monkeypatch.setenv(name, str(tmp_path / name))
    stored = nbformat.read(path, as_version=4)
    flown = nbformat.read(path, as_version=4)
    nbclient.NotebookClient(
        flown, timeout=300, resources={"metadata": {"path": str(tmp_path)}}
    ).execute()
    assert prints(flown) == prints(stored)
    texts, shown = prints(stored)
    assert any("success" in text for text in texts)
    assert shown == [["image/png", "text/plain"], ["text/html", "text/plain"]]
