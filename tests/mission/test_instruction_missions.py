"""Instruction-level faults in whole missions: drawn, struck, recorded, repeated."""

import json
import os
import pickle
import re
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from mavfi_cli.attack.live import mission_strategy
from mavfi_cli.attack.served import ServedProcess
from mavfi_cli.autonomy import tracking
from mavfi_cli.cli.runs import replay
from mavfi_cli.core.config import structure
from mavfi_cli.core.errors import BuildMismatch, FaultError, FaultSpecError, UnknownName
from mavfi_cli.fi.tracer import record as records
from mavfi_cli.fi.tracer.fault import Rule
from mavfi_cli.fi.tracer.linux import SUPPORTED
from mavfi_cli.mission.instruction import PROGRAM
from mavfi_cli.mission.instruction.server import Setup
from mavfi_cli.mission.machine import OK, check_tracing
from mavfi_cli.mission.progress import Watcher
from mavfi_cli.mission.run import fly_mission
from mavfi_cli.mission.run_folder import RunFolder, load_run
from mavfi_cli.spec.detector import DetectorConfig
from mavfi_cli.spec.fault import InstructionConfig
from mavfi_cli.spec.mission import MissionConfig

traced = pytest.mark.skipif(
    not SUPPORTED or check_tracing().verdict != OK, reason="nothing can be traced here"
)
OF_THE_FAULT = ("host", "fault", "config", "seeds")


def flown(folder, *, without=("host",)):
    result = json.loads(folder.result.read_text())
    for name in without:
        del result[name]
    return folder.trace.read_bytes(), folder.tlog.read_bytes(), result


@pytest.fixture(scope="module")
def attacked(fly_short):
    """One flight with a fault in its control node."""
    return fly_short(instruction=InstructionConfig(target="control", seed=2))


@pytest.fixture
def repeat(attacked, tmp_path):
    """Flies the attacked mission again from its record, which may be changed."""
    recorded = records.read(attacked.fault)
    config = load_run(attacked.path).mission()

    def fly(change=lambda recorded: recorded, restart_s=config.node_restart_s, **options):
        changed = change(json.loads(json.dumps(recorded)))
        mission = replace(config, node_restart_s=restart_s)
        return fly_mission(mission, tmp_path, Watcher(), repeat=changed, **options)

    return fly


@traced
@pytest.mark.parametrize(
    "node", ["control", pytest.param("collision_check", marks=pytest.mark.slow)]
)
def test_a_null_injection_changes_nothing(fly_short, short_flight, node):
    folder = fly_short(instruction=InstructionConfig(target=node, seed=3, null=True))
    assert flown(folder, without=OF_THE_FAULT) == flown(short_flight, without=OF_THE_FAULT)
    fault = load_run(folder.path).result["fault"]
    assert (fault["state"], fault["node"], fault["corruption"]) == ("null", node, None)


@pytest.mark.slow
@traced
def test_the_record_says_what_was_hit(attacked):
    result = load_run(attacked.path).result
    fault, written = result["fault"], records.read(attacked.fault)
    assert fault["state"] == "applied"
    assert written["state"] == "completed"
    assert fault["kernel"] == "control"
    assert fault["object"] == "numba:track"
    assert 1 <= fault["invocation"] <= fault["invocations"]
    assert fault["invocations"] == result["kernels"]["control"]["invocations"]
    assert fault["sampling"] == "instruction-uniform"
    assert fault["scope"] == ["numba:track"]
    assert "stop_s" in written["injection"]
    assert "stop_s" not in fault["injection"]
    (event,) = [e for e in result["events"] if e["kind"] == "fault"]
    assert event["stamp_s"] == pytest.approx(fault["stamp_s"], abs=0.021)
    before, after = (int(fault["injection"][name], 16) for name in ("before", "after"))
    assert before ^ after == sum(1 << bit for bit in fault["corruption"]["bits"])


@traced
def test_a_replay_is_the_same_to_the_byte(attacked, repeat):
    assert flown(repeat()) == flown(attacked)


@traced
def test_a_wild_jump_kills_the_node_and_the_mission_goes_on(repeat):
    def wild(recorded):
        recorded["corruption"] = {
            "site": "instruction-pointer", "role": "destination", "register": "rip",
            "operand": "rip", "bits": [45], "memory_operand": 0,
        }  # fmt: skip
        return recorded

    first, second = repeat(wild, 0.1), repeat(wild, 0.1)
    assert flown(first) == flown(second)
    result = load_run(first.path).result
    ends = result["nodes"]["control"]
    assert [crash["how"] for crash in ends["crashes"]] == ["killed by SIGSEGV"]
    assert ends["restarts"] == 1
    assert {"success", "collision", "timeout", "no_path"} >= {result["outcome"]}


@pytest.mark.slow
@traced
def test_a_trigger_that_comes_in_another_invocation_than_planned_is_told_when_it_comes(
    attacked, repeat
):
    """A detector may change the flight before the fault, and with it the invocations."""

    def earlier(recorded):
        return {**recorded, "node_invocation": 1}

    assert flown(repeat(earlier), without=OF_THE_FAULT) == flown(attacked, without=OF_THE_FAULT)


@traced
def test_a_trigger_that_never_comes_is_no_fault_and_stops_no_mission(repeat, short_flight):
    def later(recorded):
        recorded["trigger"][0]["count"] += 1_000_000
        return recorded

    folder = repeat(later)
    assert flown(folder, without=OF_THE_FAULT) == flown(short_flight, without=OF_THE_FAULT)
    fault = load_run(folder.path).result["fault"]
    assert (fault["state"], fault["injection"]["applied"]) == ("not_injected", False)
    assert "ended before execution" in fault["reason"]


@traced
def test_a_record_of_another_build_is_refused(repeat):
    def other(recorded):
        recorded["build_ids"]["numba:track"] = "sha256:0"
        return recorded

    with pytest.raises(BuildMismatch, match=r"numba:track .* sha256:0"):
        repeat(other)


@traced
@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("build_ids", None), ("build_ids", "theirs"), ("trigger", [{"offset": "64"}]),
        ("corruption", {"register": "x"}), ("node", "theirs"), ("node", []), ("kernel", {}),
        ("stamp_s", "theirs"), ("request", []), ("windows", None),
    ],
)  # fmt: skip
def test_a_damaged_record_is_refused_in_one_line(name, value, attacked, mavfi, tmp_path):
    folder = RunFolder(Path(shutil.copytree(attacked.path, tmp_path / "theirs")))
    recorded = json.loads(folder.fault.read_text())
    folder.fault.write_text(json.dumps(recorded | {name: value}))
    done = mavfi("replay", folder.path, "--out", tmp_path / "again")
    (error,) = [line for line in done.stderr.splitlines() if not line.startswith("flying ")]
    assert (done.returncode, error[:7]) == (1, "error: ")


@pytest.mark.slow
@traced
def test_the_node_waits_for_a_debugger_with_the_fault_in_place(repeat):
    states = []

    def look(pid):
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
        states.extend(line.split()[1] for line in lines if line.startswith("State"))
        os.kill(pid, signal.SIGCONT)

    folder = repeat(for_debugger=look)
    assert states == ["T"]
    assert load_run(folder.path).result["fault"]["state"] == "applied"


@pytest.mark.slow
@traced
def test_a_replay_under_a_debugger_is_compared_without_what_it_cannot_follow(
    fly_short, tmp_path, monkeypatch
):
    written = InstructionConfig(target="control", seed=2, roles=("destination",))
    attacked = fly_short(instruction=written)
    assert records.read(attacked.fault)["activation"]["activation"] == "read"
    waited = []

    def go_on(pid):
        waited.append(pid)
        os.kill(pid, signal.SIGCONT)

    monkeypatch.setattr("mavfi_cli.cli.runs._announce_stop", go_on)
    line = [str(attacked.path), "--gdb", "--json", "--out", str(tmp_path)]
    shown = CliRunner().invoke(replay, line)
    assert len(waited) == 1
    comparison = json.loads(shown.stdout)
    assert comparison["identical"]
    assert shown.exit_code == 0
    again = records.read(load_run(Path(comparison["again"])).folder.fault)
    assert again["activation"]["activation"] == "not_followed"


def test_a_stage_draws_one_of_its_nodes():
    drawn = {InstructionConfig(target="perception", seed=seed).node() for seed in range(40)}
    assert drawn == {"point_cloud", "octomap", "collision_check"}
    assert InstructionConfig(target="planning").node() == "planner"


def test_what_makes_no_sense_is_refused(fly_short, short_config):
    with pytest.raises(UnknownName, match="octomap"):
        InstructionConfig(target="octmap").node()
    with pytest.raises(UnknownName, match="vector"):
        mission_strategy(InstructionConfig(target="octomap", sites=("vektor",)))
    with pytest.raises(FaultSpecError, match="cannot be repeated"):
        mission_strategy(InstructionConfig(target="octomap", sampling="wall-clock"))
    link = MissionConfig(link="udpin:127.0.0.1:1", goal=(20.0, 0.0, 5.0))
    config = replace(link, instruction=InstructionConfig(target="control"))
    with pytest.raises(FaultError, match="leave out --link"):
        fly_mission(config, Path("."), Watcher())


def test_the_habits_of_another_injector_keep_a_moment_that_repeats():
    config = InstructionConfig(target="control", compat="rosfi-2021")
    assert mission_strategy(config).imitates is not None
    assert config.sampling_name().startswith("instruction-uniform with")
    pinfi = InstructionConfig(target="control", compat="pinfi")
    assert mission_strategy(pinfi).rule is Rule.INSTRUCTION
    assert re.fullmatch("instruction-uniform with .* pinfi", pinfi.sampling_name())
    with pytest.raises(FaultSpecError, match=r"pinfi .*sites, roles"):
        mission_strategy(InstructionConfig(target="control", compat="pinfi", bits=3))


@pytest.fixture
def without_perf(tmp_path):
    """Run the command line where perf_event_open is refused."""
    script = Path(__file__).parents[1] / "without_perf.py"

    def run(*arguments):
        line = [sys.executable, script, sys.executable, "-m", "mavfi_cli", *arguments]
        return subprocess.run(
            line, capture_output=True, text=True, timeout=120.0, check=False, cwd=tmp_path
        )

    return run


@pytest.mark.slow
@traced
def test_debug_registers_count_where_the_kernel_may_not(without_perf, attacked, tmp_path):
    told = json.loads(without_perf("doctor", "--json").stdout)
    (counting,) = [check for check in told if check["name"] == "counted breakpoints"]
    assert counting["verdict"] == "limited"
    assert "by debug registers" in counting["found"]

    config = load_run(attacked.path).result["config"]
    place = [f"--{n}={','.join(map(str, config[n]))}" for n in ("start", "goal")]
    fault = ["--level", "instruction", "--inject", "control", "--fault-seed", "2"]
    where = ["--world", "farm", "--seed", "5", "--stack", "hardened"]
    done = without_perf("fly", *where, *place, *fault, "--json")
    assert done.returncode == 0, done.stderr
    (folder,) = (tmp_path / "runs").glob("farm-5-*")
    assert flown(load_run(folder).folder) == flown(attacked)


def test_the_nodes_of_a_pair_get_the_same_bytes(short_config):
    """The memory of a node depends on them: also on which objects of a message are identical."""
    briefing = replace(short_config, goal=(20.0, 0.0, 5.0)).briefing(np.zeros(3))
    protected = replace(
        short_config,
        detector=DetectorConfig(name="gad"),
        instruction=InstructionConfig(target="control", seed=3),
    )
    from_a_record = structure(json.loads(json.dumps(short_config.to_dict())), MissionConfig)
    messages = [
        pickle.dumps(Setup.of(config, told, "control"))
        for config in (short_config, protected, from_a_record)
        for told in (briefing, pickle.loads(pickle.dumps(briefing)))
    ]
    assert len(set(messages)) == 1
    own_m = short_config.loaded_stack().goal_tolerance_m  # the node gets the value itself
    assert pickle.loads(messages[0]).config == replace(short_config, goal_tolerance_m=own_m)


@pytest.mark.slow
def test_a_node_that_has_filled_a_cache_is_started_again(short_config):
    """A program that compiles its modules has another memory than one that finds bytecode."""
    briefing = replace(short_config, goal=(20.0, 0.0, 5.0)).briefing(np.zeros(3))
    setup = Setup.of(short_config, briefing, "control")
    restarted = []
    for compiles in (True, False, False, False):
        spawned = ServedProcess(PROGRAM)
        first = spawned.pid
        if compiles:
            cache = Path(tracking.__spec__.cached).parent
            (cache / "added").touch()
            (cache / "added").unlink()
        try:
            assert spawned.begin(setup, "node").kernel == "control"
            restarted.append(spawned.pid != first)
        finally:
            spawned.kill()
    assert restarted[0]
    assert not all(restarted)  # tests that run beside this one may fill caches too
