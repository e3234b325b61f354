from __future__ import annotations

import json
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

from sitl.world import load_world
from sitl.world.__main__ import main


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    code = main([str(a) for a in arguments])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_list_names_every_world(capsys: pytest.CaptureFixture[str]) -> None:
    _, text, _ = run(capsys, "list")
    _, data, _ = run(capsys, "list", "--json")
    names = [row["name"] for row in json.loads(data)]
    assert names[:4] == ["sparse", "dense", "factory", "farm"]
    assert all(line.split()[0] in text for line in names)


def test_make_writes_a_file_that_loads(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = tmp_path / "w.toml"
    code, out, _ = run(capsys, "make", "dense", "--seed", 2, "-o", path)
    assert code == 0
    assert str(path) in out
    made = load_world(str(path), seed=0)
    assert np.array_equal(made.boxes_enu_m, load_world("dense", seed=2).boxes_enu_m)
    assert [p.name for p in tmp_path.iterdir()] == ["w.toml"]


def test_make_without_a_file_prints_the_world(capsys: pytest.CaptureFixture[str]) -> None:
    _, out, _ = run(capsys, "make", "farm")
    assert out.startswith('name = "farm"\n')


def test_check_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, "check", "sparse", "--seed", 1, "--goal", "30,40,6", "--json")
    found = json.loads(out)
    assert code == 0
    assert found["check"]["path_exists"] is True
    assert found["goal"] == [30, 40, 6]


def test_no_path_is_a_result_unless_one_is_expected(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = tmp_path / "walled.toml"
    path.write_text(
        "bounds_enu_m = [-5, -5, 0, 25, 5, 20]\nstart_enu_m = [0, 0, 0]\ngoal_enu_m = [20, 0, 5]\n"
        "[[box]]\nmin_enu_m = [10, -5, 0]\nmax_enu_m = [11, 5, 20]\n"
    )
    code, out, _ = run(capsys, "check", path)
    assert (code, "path   none" in out) == (0, True)
    with pytest.raises(SystemExit) as ended:
        main(["check", str(path), "--expect", "path"])
    assert ended.value.code == 1


def test_draw_writes_a_whole_svg_and_the_same_one_again(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    files = [tmp_path / "a.svg", tmp_path / "b.svg"]
    for file in files:
        assert run(capsys, "draw", "dense", "--seed", 3, "--path", "-o", file)[0] == 0
    assert files[0].read_bytes() == files[1].read_bytes()
    texts = [node.text for node in ET.parse(files[0]).iter() if node.tag.endswith("text")]
    for expected in ("east, m", "north, m", "start", "goal, 5 m up", "dense, seed 3"):
        assert expected in texts


@pytest.mark.parametrize(
    ("arguments", "expected", "message"),
    [
        (["check", "dnse"], 2, "did you mean 'dense'"),
        (["check", "factory", "--goal", "30,50,5"], 2, "inside an obstacle"),
        (["draw", "dense", "-o", "/nonexistent/x.svg"], 2, "its folder does not exist"),
        (["draw", "dense", "-o", "x.png"], 2, "x.png: "),
        (["make", "/nonexistent/x.toml"], 1, "No such file"),
    ],
)
def test_a_known_error_is_one_line(
    capsys: pytest.CaptureFixture[str], arguments: list[str], expected: int, message: str
) -> None:
    code, out, err = run(capsys, *arguments)
    assert (code, out) == (expected, "")
    assert err.startswith("error: ")
    assert message in err
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    "arguments",
    [["check"], ["fly"], ["check", "dense", "--goal", "1,2"], ["check", "dense", "--seed", "-1"]],
)
def test_wrong_usage_is_exit_2(capsys: pytest.CaptureFixture[str], arguments: list[str]) -> None:
    assert run(capsys, *arguments)[0] == 2


def test_it_runs_as_a_module_without_loading_matplotlib_or_numba() -> None:
    code = (
        "import sys; from sitl.world.__main__ import main; main(['check', 'dense']); "
        "print([m for m in ('matplotlib', 'numba') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.endswith("[]\n")
    helped = subprocess.run(
        [sys.executable, "-m", "sitl.world", "--help"], capture_output=True, text=True, check=True
    )
    assert helped.stdout.startswith("Usage: mavfi world ")
