"""`mavfi compare` as a user calls it: flown, resumed, extended, and every bad input in one line."""

import csv
import json
import os
import re
import signal
import xml.etree.ElementTree as ET
from dataclasses import asdict

import pytest
from missions import LAWN

from mavfi_cli.campaigns.ledger import Ledger
from mavfi_cli.campaigns.progress import Spectator
from mavfi_cli.campaigns.run import Options
from mavfi_cli.core.errors import Interrupted
from mavfi_cli.core.files import plain
from mavfi_cli.studies.compare import ComparePlan, compare

FEW = ("--platform", "x86", "--platform", "tx2", "--inject", "waypoint_position", "--detector",
       "none,gad", "--missions", "2", "--first-seed", "2", "--out", "out")  # fmt: skip
SETTINGS = ("golden", "none", "gad")


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    folder = tmp_path_factory.mktemp("compare")
    (folder / "lawn.toml").write_text(LAWN)
    return folder


@pytest.fixture(scope="module")
def flown(home, mavfi):
    """The run of the small comparison; its folder is home / "out"."""
    run = mavfi("compare", "--world", "lawn.toml", *FEW, "--json", cwd=home)
    assert run.returncode == 0, run.stderr
    return run


@pytest.fixture(scope="module")
def told(flown):
    return json.loads(flown.stdout)


@pytest.mark.slow
def test_every_platform_flies_every_setting(told):
    rows = {(r["platform"], r["setting"]): r for r in told["settings"]}
    assert set(rows) == {(p, s) for p in ("x86", "tx2") for s in SETTINGS}
    assert all(row["flown"] == 2 for row in rows.values())
    assert told["errors"] == []
    missions = {(f["platform"], f["setting"]): [] for f in told["flights"]}
    for each in told["flights"]:
        missions[each["platform"], each["setting"]].append((each["seed"], each["fault_seed"]))
    for setting in SETTINGS:
        assert missions["x86", setting] == missions["tx2", setting]


@pytest.mark.slow
def test_the_slower_platform_responds_later(told):
    (golden,) = [r for r in told["ratios"] if r["setting"] == "golden"]
    assert golden["quantities"]["response_median_s"]["value"] > 3.0
    x86, tx2 = told["timeline"]["platforms"]
    assert (x86["platform"], tx2["platform"]) == ("x86", "tx2")
    assert tx2["response_s"] > 2.0 * x86["response_s"]
    for row in (x86, tx2):
        start, end = row["chain_s"]["octomap"]
        assert end - start > 0.5 * row["response_s"]  # because of this kernel


@pytest.mark.slow
def test_the_folder_holds_tables_and_pictures(flown, told, home):
    out = home / "out"
    assert json.loads((out / "compare.json").read_text()) == told
    with (out / "compare.csv").open() as file:
        assert len(list(csv.DictReader(file))) > 50
    for name in ("compare.svg", "timeline.svg"):
        root = ET.parse(out / name).getroot()
        said = ["".join(e.itertext()) for e in root.iter("{http://www.w3.org/2000/svg}text")]
        for wanted in ("x86: ", "tx2: "):
            assert any(text.startswith(wanted) for text in said), (name, wanted)
    for kernel in ("point cloud", "OctoMap", "collision check", "planner", "control"):
        assert kernel in said
    assert "12/12 missions" in flown.stderr


@pytest.mark.slow
def test_called_again_it_flies_nothing_and_says_the_same(flown, told, home, mavfi):
    again = mavfi("compare", "--world", "lawn.toml", *FEW, "--json", cwd=home)
    assert json.loads(again.stdout) == told
    assert "flying, " not in again.stderr
    text = mavfi("compare", "--world", "lawn.toml", *FEW, "--quiet", cwd=home)
    assert (text.returncode, text.stderr) == (0, "")
    assert "tx2 over x86" in text.stdout


@pytest.mark.slow
def test_other_settings_in_the_same_folder_are_refused_with_the_difference(flown, home, mavfi):
    other = [*FEW[:5], "command_velocity", *FEW[6:]]
    run = mavfi("compare", "--world", "lawn.toml", *other, cwd=home)
    assert (run.returncode, run.stdout) == (1, "")
    assert run.stderr.startswith("error: out: ")
    assert "site waypoint_position there, command_velocity here; " in run.stderr
    fewer = mavfi("compare", "--world", "lawn.toml", *FEW, "--missions", "1", cwd=home)
    assert "missions 2 there, 1 here" in fewer.stderr


class Stopper(Spectator):
    """Asks to stop, as Ctrl-C does, once the first mission is over."""

    def __init__(self):
        self.asked = False

    def on_progress(self, progress):
        if progress.over and not self.asked:
            self.asked = True
            os.kill(os.getpid(), signal.SIGINT)


@pytest.mark.slow
def test_interrupted_and_extended_it_comes_to_the_same(flown, told, home, monkeypatch):
    monkeypatch.chdir(home)
    plan = ComparePlan(world="lawn.toml", inject=("waypoint_position",),
                       detectors=("none", "gad"), missions=1, first_seed=2)  # fmt: skip
    folder, options = home / "resumed", Options(jobs=2)
    with pytest.raises(Interrupted):
        compare(plan, folder, options, Stopper())
    with Ledger(folder) as ledger:
        assert 0 < ledger.over() < 6
    whole = ComparePlan(world="lawn.toml", inject=("waypoint_position",),
                        detectors=("none", "gad"), missions=2, first_seed=2)  # fmt: skip
    assert plain(asdict(compare(whole, folder, options, Spectator()))) == told


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--missions", "0"], ".*'--missions': 0 "),
        (["--missions", "1000000"], "--missions: .*at most 100000, got 1000000"),
        (["--platform", "tx3"], "--platform: .*'tx3'.* 'tx2'"),
        (["--platform", "x86", "--platform", "x86"], "--platform: .*x86 twice"),
        (["--platform", "mine.toml"], r"mine.toml: no such file \(in setting=golden "),
        (["--detector", "gda"], "--detector: .*'gda'.* 'gad'"),
        (["--detector", ","], "--detector: .*at least one"),
        (["--inject", ""], "--inject: .*at least one target or be `none`, got ''"),
        (["--inject", "plannin"], "--inject: .*'plannin'.* 'planning'"),
        (["--world", "sparze"], "--world: .*'sparze'.* 'sparse'"),
        (["--field", "exponnt"], "--field: .*'exponnt'.* 'exponent'"),
    ],
)  # fmt: skip
def test_bad_input_is_one_line_and_leaves_nothing(mavfi, tmp_path, arguments, told):
    run = mavfi("compare", *arguments, cwd=tmp_path)
    code = 1 if told.startswith("mine.toml") else 2
    assert (run.returncode, run.stdout) == (code, "")
    assert re.match(f"error: {told}", run.stderr)
    assert run.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_two_formats_at_once_are_a_usage_error(mavfi, tmp_path):
    run = mavfi("compare", "--json", "--csv", cwd=tmp_path)
    assert run.returncode == 2
    assert "--json cannot be combined with --csv" in run.stderr
