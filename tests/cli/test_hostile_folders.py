"""A folder of somebody else's: no command executes what it names, or writes through its links."""

import hashlib
import json
import os
import pickle
import shutil
import socket
import sqlite3
import subprocess
import sys
import zlib
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from mavfi_cli.analysis.kernels import KernelSummary
from mavfi_cli.campaigns import ledger as ledgers
from mavfi_cli.campaigns.begin import SPEC
from mavfi_cli.campaigns.ledger import LEDGER, LOCK, Ledger
from mavfi_cli.campaigns.missions import ResultState
from mavfi_cli.campaigns.specification_file import parse_spec
from mavfi_cli.core.errors import RecordError
from mavfi_cli.fi.tracer.record import read as read_fault
from mavfi_cli.link.tlog import tlog_messages
from mavfi_cli.mission.instruction import kept_in
from mavfi_cli.mission.instruction.injection import _golden_orders
from mavfi_cli.mission.run_folder import FAULT, RESULT
from mavfi_cli.spec.fault import FaultConfig
from mavfi_cli.spec.mission import MissionConfig

_TEXT = "mine"


class _Bomb:
    """Pickles as a call that leaves a file."""

    def __init__(self, struck):
        self.struck = struck

    def __reduce__(self):
        return os.system, (f"touch {self.struck}",)


@pytest.fixture
def precious(tmp_path):
    """A folder of the user's."""
    folder = tmp_path / "precious"
    (folder / "000000-kept").mkdir(parents=True)
    (folder / "000000-kept" / "file").write_text(_TEXT)
    (folder / "file").write_text(_TEXT)
    return folder


@pytest.fixture(scope="module")
def faulty_flight(fly_short):
    return fly_short(fault=FaultConfig(target="planning", seed=1))


@pytest.fixture
def hostile(faulty_flight, precious, tmp_path):
    """A folder that is a run, a campaign, one of kernels, and the parent of such folders."""
    folder, struck = tmp_path / "hostile", tmp_path / "struck"
    shutil.copytree(faulty_flight.path, folder)
    script = tmp_path / "firmware"
    script.write_text(f"#!/bin/sh\ntouch {struck}\n")
    script.chmod(0o755)
    firmware = {"autopilot": "ardupilot", "firmware": str(script)}
    _make_run(folder / RESULT, firmware)
    _make_campaign(folder, firmware)
    pickled = pickle.dumps(_Bomb(struck))
    for name in ("inputs.npz", "inputs.pickle", "orders.pickle"):
        (folder / name).write_bytes(pickled)
    plan = {"program": ["/usr/bin/touch", str(struck)], "environment": {}, "scope": ["touch"]}
    (folder / "plan.json").write_text(json.dumps(plan))
    names = ("runs", "work", "profiles", ".profiles", "golden", "world-search", "protected")
    for name in names:
        (folder / name).symlink_to(precious)
    os.unlink(folder / LOCK)
    written = ("dataset.parquet", "gad.json", "vpm.json", "vpm.csv", "flights.csv", "host.json")
    for name in (LOCK, *written, "runs.jsonl", "kernels.json", f".{RESULT}.{os.getpid()}.partial"):
        (folder / name).symlink_to(precious / "file")
    for name in ("mavbench", "bare", "kernels"):
        shutil.copytree(folder, folder / name, symlinks=True)
    return folder


def _make_run(path, firmware):
    result = json.loads(path.read_text())
    result["config"] |= firmware
    digest = hashlib.sha256(Path(firmware["firmware"]).read_bytes()).hexdigest()
    result["files"] = {firmware["firmware"]: digest}
    path.write_text(json.dumps(result))


def _make_campaign(folder, firmware):
    mission = "".join(f"{name} = {json.dumps(value)}\n" for name, value in firmware.items())
    text = f'name = "theirs"\nrepetitions = 2\n[mission]\nworld = "farm"\n{mission}'
    spec = parse_spec(text, Path(SPEC))
    (folder / SPEC).write_text(text)
    result = json.loads((folder / RESULT).read_text())
    with Ledger(folder, writing=True) as ledger:
        ledger.plan(spec.missions())
        ledger.set_meta({"spec": spec.to_toml(), "name": spec.name})
        ledger.add(
            0, state=ResultState.FLOWN, result=result, reason="", injected=None, wall_s=1.0,
            attempts=1, path="../precious",
        )  # fmt: skip


COMMANDS = [
    "show HOSTILE",
    "show HOSTILE --pair",
    "show HOSTILE --picture picture.svg",
    "replay HOSTILE",
    "replay HOSTILE --without-fault",
    "replay HOSTILE --mission 0",
    "view HOSTILE --save view.rrd",
    "report HOSTILE --output report.html",
    "campaign plan HOSTILE",
    "campaign status HOSTILE --full",
    "campaign export HOSTILE -",
    "campaign report HOSTILE",
    "campaign draw HOSTILE --output pair.svg",
    "campaign run HOSTILE --quiet",
    "campaign run HOSTILE --missing-only --quiet",
    "kernels --kernel control --runs 1 --out HOSTILE",
    "kernels --replay HOSTILE",
    "kernels --program /bin/true --runs 1 --out HOSTILE",
    "reproduce fig9 --scale 0.001 --out HOSTILE",
    "reproduce --settle --hours 0.001 --out HOSTILE",
    "train --flown HOSTILE --out models",
    "train --flown . --out models",
    pytest.param(
        "train --kind gad --world farm --flights 10 --quiet --out HOSTILE", marks=pytest.mark.slow
    ),
    "train --kind gad --out HOSTILE --from" + 10 * " HOSTILE/flight.tlog",
    "vpm --overhead HOSTILE",
    "vpm --out HOSTILE",
    pytest.param("vpm --fly --missions 1 --quiet --out HOSTILE", marks=pytest.mark.slow),
    "detect evaluate --world farm --flights 1 --golden-flights 1 --quiet --out HOSTILE",
    "compare --world farm --missions 1 --quiet --out HOSTILE",
    "fly --world farm --start=2,2,0 --goal=10,6,5 --quiet --out HOSTILE",
    "fly --world farm --level instruction --inject control --quiet --out HOSTILE",
    "fly --companion true --world farm --replay HOSTILE",
]


@pytest.mark.parametrize("line", COMMANDS)
def test_a_command_neither_executes_nor_removes_what_a_folder_names(
    line, hostile, precious, command_line, monkeypatch
):
    monkeypatch.delenv("ARDUCOPTER_SITL", raising=False)
    before = sorted(path.relative_to(precious) for path in precious.rglob("*"))
    code, _, err = command_line(*line.replace("HOSTILE", str(hostile)).split())
    assert code in (0, 1, 2)
    assert "Traceback" not in err
    assert not (hostile.parent / "struck").exists()
    assert sorted(path.relative_to(precious) for path in precious.rglob("*")) == before
    assert {path.read_text() for path in precious.rglob("file")} == {_TEXT}


def test_the_truth_of_a_vehicle_overwrites_nothing_behind_a_link(hostile, precious):
    for name in ("truth.json", "truth.parquet", "briefing.json"):
        (hostile / name).unlink(missing_ok=True)
        (hostile / name).symlink_to(precious / "file")
    ours, theirs = socket.socketpair()
    ours.close()
    with theirs:
        line = f"sitl --world farm --lockstep --fd {theirs.fileno()} --truth {hostile}"
        run = subprocess.run(
            [sys.executable, "-m", "mavfi_cli", *line.split()],
            pass_fds=[theirs.fileno()], capture_output=True, text=True, check=False,
        )  # fmt: skip
    assert (run.returncode, run.stderr) == (0, "")
    assert json.loads((hostile / "truth.json").read_text())["collision"] is None
    assert {path.read_text() for path in precious.rglob("file")} == {_TEXT}


def test_the_firmware_of_a_record_flies_only_if_the_user_names_it(hostile, command_line):
    (hostile / LEDGER).unlink()  # else it is a campaign, whose missions `replay` asks for
    code, _, err = command_line("replay", hostile)
    script = hostile.parent / "firmware"
    assert code == 2
    assert f"would execute the program {script}" in err
    code, _, err = command_line("replay", hostile, "--firmware", script)
    assert (hostile.parent / "struck").exists()
    assert code == 1
    assert "the firmware" in err


@pytest.mark.slow
def test_the_companion_of_a_campaign_flies_only_if_the_user_names_it(
    faulty_flight, precious, tmp_path, command_line
):
    folder, struck = tmp_path / "theirs", tmp_path / "struck"
    shutil.copytree(faulty_flight.path, folder)
    companion = folder / "companion.toml"
    companion.write_text(f'[program.theirs]\ncommand = "touch {struck}"\n')
    _make_campaign(folder, {"companion": str(companion)})
    for line in ("replay FOLDER --mission 0", "campaign run FOLDER --quiet"):
        code, _, err = command_line(*line.replace("FOLDER", str(folder)).split())
        assert code in (1, 2)
        assert "companion" in err
        assert not struck.exists()
    command_line("campaign", "run", folder, "--quiet", "--companion", companion)
    assert struck.exists()


def test_hostile_orders_of_a_golden_mission_are_made_again(tmp_path):
    golden, struck = MissionConfig(goal=(20.0, 0.0, 5.0)), tmp_path / "struck"
    folder = kept_in(tmp_path / "profiles", golden)
    folder.mkdir(parents=True)
    for name in ("orders.npz", "orders.pickle"):
        (folder / name).write_bytes(pickle.dumps(_Bomb(struck)))
    briefing = golden.briefing(np.zeros(3))
    recorder = SimpleNamespace(briefing=briefing, orders={}, sequence=[])
    flown = []
    for _ in range(2):
        _golden_orders(golden, tmp_path / "profiles", lambda at: flown.append(at) or recorder)
    assert flown == [folder]
    assert not struck.exists()


def test_a_record_that_inflates_beyond_bounds_is_refused(hostile, command_line, monkeypatch):
    monkeypatch.setattr(ledgers, "_LARGEST_RECORD", 1 << 20)
    with sqlite3.connect(hostile / LEDGER) as database:
        bomb = zlib.compress(b'"' + bytes(8 << 20) + b'"')
        database.execute("UPDATE records SET result = ?", (bomb,))
    code, out, err = command_line("campaign", "export", hostile, "-")
    assert (code, out) == (1, "")
    assert "must have at most 1 MB" in err


@pytest.mark.parametrize(
    ("change", "commands"),
    [
        ("UPDATE cells SET labels = '[1]'", ["status", "export", "report"]),
        ("DELETE FROM cells", ["status", "report"]),
        ("UPDATE missions SET changes = '5'", ["export"]),
        ("UPDATE results SET state = 'theirs'", ["export"]),
    ],
)
def test_a_damaged_ledger_is_an_error_of_one_line(change, commands, hostile, command_line):
    with sqlite3.connect(hostile / LEDGER) as database:
        database.execute(change)
    for command in commands:
        output = ["-"] if command == "export" else []
        code, _, err = command_line("campaign", command, hostile, *output)
        assert code == 1
        (line,) = err.splitlines()
        assert f"{LEDGER}: damaged (" in line


def test_the_lock_of_a_campaign_is_no_link(hostile, precious, command_line, monkeypatch):
    monkeypatch.setenv("ARDUCOPTER_SITL", str(hostile.parent / "firmware"))
    code, _, err = command_line("campaign", "run", hostile, "--quiet")
    assert code == 1
    assert f"{LOCK}: is a link" in err
    assert (precious / "file").read_text() == _TEXT


@pytest.mark.parametrize(
    ("name", "read"),
    [
        (FAULT, lambda folder: read_fault(folder / FAULT)),
        ("kernels.json", lambda folder: KernelSummary.read(folder / "kernels.json")),
        ("flight.tlog", lambda folder: list(tlog_messages(folder / "flight.tlog"))),
    ],
)
def test_a_record_is_neither_a_pipe_nor_a_link(name, read, precious, tmp_path):
    os.mkfifo(tmp_path / name)
    with pytest.raises(RecordError, match=f"{name}: is not a regular file"):
        read(tmp_path)
    (tmp_path / name).unlink()
    (tmp_path / name).symlink_to(precious / "file")
    with pytest.raises(RecordError, match=name):
        read(tmp_path)
