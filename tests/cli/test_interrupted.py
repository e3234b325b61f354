"""Ctrl-C while a run is repeated: nothing cut off is kept, compared, or drawn from."""

import json
import re
import signal

import pyarrow as pa
import pytest

from mavfi_cli.campaigns.missions import canonical, changes_of
from mavfi_cli.core.errors import Interrupted
from mavfi_cli.core.files import write_parquet
from mavfi_cli.fi.tracer.linux import SUPPORTED
from mavfi_cli.mission import run as run_module
from mavfi_cli.mission.machine import OK, check_tracing
from mavfi_cli.mission.progress import Watcher
from mavfi_cli.mission.run import paired_golden
from mavfi_cli.mission.run_folder import load_run
from mavfi_cli.spec.fault import FaultConfig, InstructionConfig

CUT_OFF = "interrupted before the mission ended"
traced = pytest.mark.skipif(
    not SUPPORTED or check_tracing().verdict != OK, reason="nothing can be traced here"
)


class CtrlC(Watcher):
    """Presses it once, in flight."""

    def on_event(self, event):
        if event.text == "flies a plan":
            signal.raise_signal(signal.SIGINT)


@pytest.fixture
def cut_once(monkeypatch):
    """Ctrl-C in the next flight that a module starts, and in no later one."""

    def cut(module):
        real, waiting = run_module.fly_mission, [CtrlC()]

        def fly(config, out, watcher, **options):
            return real(config, out, waiting.pop() if waiting else watcher, **options)

        monkeypatch.setattr(f"{module}.fly_mission", fly)

    return cut


@pytest.fixture(scope="module")
def sideways(fly_short):
    return fly_short(fault=FaultConfig(target="command_vx", at="time=3", exact_bits=(63,)))


def test_an_interrupted_golden_pair_is_not_kept(command_line, sideways, cut_once):
    before = {path.name for path in sideways.path.iterdir()}
    cut_once("mavfi_cli.mission.run")
    code, out, err = command_line("show", "--pair", sideways.path)
    assert (code, out) == (130, "")
    assert err.splitlines()[1:] == [CUT_OFF]
    assert {path.name for path in sideways.path.iterdir()} == before
    code, out, err = command_line("show", sideways.path)
    assert (code, err, "Effect      unknown; `mavfi show --pair`" in out) == (0, "", True)
    code, out, err = command_line("show", "--pair", sideways.path)
    assert (code, "Effect      first at" in out) == (0, True)
    assert "golden pair: farm, seed 5" in err
    for options in ([], ["--pair"]):  # kept, so not flown again
        assert command_line("show", *options, sideways.path) == (0, out, "")


def test_an_interrupted_golden_pair_of_an_older_version_is_flown_anew(sideways):
    run = load_run(sideways.path)
    kept = paired_golden(run).folder.result
    result = json.loads(kept.read_text())
    kept.write_text(json.dumps(result | {"outcome": "interrupted"}))
    assert paired_golden(run).result["outcome"] == result["outcome"] == "success"


@pytest.mark.parametrize("options", [[], ["--without-fault"], ["--json"]])
def test_an_interrupted_repetition_is_neither_equal_nor_different(
    command_line, sideways, cut_once, tmp_path, options
):
    cut_once("mavfi_cli.mission.run")
    code, out, err = command_line("replay", sideways.path, "--out", "again", *options)
    assert (code, out) == (130, "")
    flying, cut_off = err.splitlines()
    assert ("without its fault" in flying) == ("--without-fault" in options)
    assert cut_off == CUT_OFF
    assert not list((tmp_path / "again").iterdir())


def test_an_interrupted_mission_of_a_campaign_leaves_nothing(
    command_line, short_flight, cut_once, tmp_path
):
    changes = canonical(changes_of(load_run(short_flight.path).mission()))
    columns = {
        "number": [0], "pair": ["0"], "world": ["farm"], "seed": [5], "stack": ["mavbench"],
        "state": ["flown"], "outcome": ["success"], "injected": ["golden"], "reason": [""],
        "wall_s": [1.0], "attempts": [1], "changes": [changes],
    }  # fmt: skip
    write_parquet(tmp_path / "campaign.parquet", pa.table(columns))
    cut_once("mavfi_cli.mission.run")
    asked = ("replay", "campaign.parquet", "--mission", "0", "--out", "again")
    code, out, err = command_line(*asked)
    assert (code, out, err.splitlines()[-1]) == (130, "", CUT_OFF)
    assert not list((tmp_path / "again").iterdir())
    code, out, _ = command_line(*asked)
    assert (code, "identical in every measure" in out) == (0, True)


def test_an_interrupted_repetition_is_not_looked_at(command_line, short_flight, cut_once, tmp_path):
    pytest.importorskip("mcap_protobuf")
    cut_once("mavfi_cli.mission.run")
    code, out, err = command_line("view", short_flight.path, "--save", "flight.mcap")
    assert (code, out) == (130, "")
    assert err.splitlines()[-1] == CUT_OFF
    assert not list(tmp_path.glob("*.mcap"))


@pytest.mark.parametrize("command", [["show", "--pair"], ["replay"]])
def test_an_interrupted_flight_does_not_repeat(command_line, fly_short, command):
    folder = fly_short(CtrlC(), fault=FaultConfig(target="command_vx", at="time=9"))
    code, out, err = command_line(*command, folder.path)
    assert (code, out) == (1, "")
    assert re.match(f"error: {folder.path}: .*interrupted", err)
    assert command_line("show", folder.path)[0] == 0


@traced
def test_no_fault_is_drawn_from_an_interrupted_golden_flight(fly_short, cut_once):
    cut_once("mavfi_cli.mission.run")
    with pytest.raises(Interrupted):
        fly_short(seed=6, instruction=InstructionConfig(target="control", seed=2))
