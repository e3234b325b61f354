"""Help, `show`, `world`, `doctor`."""

import importlib.metadata
import json
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET

import pytest

from mavfi_cli.core.compiled import processor_level
from mavfi_cli.core.errors import Interrupted
from mavfi_cli.mission.measures import FlightRecord
from mavfi_cli.report.summary import event_lines, summary_lines
from sitl.world.world import CLEAR_RADIUS_M

HEAVY = ("numba", "numpy", "torch", "matplotlib", "scipy", "pyarrow", "ompl", "fcl", "pymavlink")


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["fly", "--help"], ["bogus"]])
def test_help_loads_nothing_heavy(arguments):
    """What makes `mavfi --help` quick; how quick is measured in benchmarks/startup.py."""
    program = (
        "import sys, mavfi_cli.cli as c\nsys.argv = ['mavfi', *sys.argv[1:]]\n"
        "c.leave = sys.exit\n"
        "try: c.main()\n"
        f"finally: print([m for m in {HEAVY} if m in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, *arguments], capture_output=True, text=True, check=False
    )
    assert done.stderr.splitlines()[-1] == "[]"


def test_help_names_every_command(command_line):
    code, out, _ = command_line("--help")
    assert code == 0
    for name in ("fly", "show", "world", "sitl", "doctor"):
        assert f"\n  {name} " in out
        sub_code, told, _ = command_line(name, "--help")
        assert sub_code == 0
        assert told.startswith(f"Usage: mavfi {name} ")  # also of the vehicle's own program
        if name in ("fly", "sitl"):
            assert_help_says_what_another_goal_does(told)


def assert_help_says_what_another_goal_does(told):
    """To a generated world."""
    assert f"towers within {CLEAR_RADIUS_M:g} m of " in " ".join(told.split())


def test_help_says_what_another_goal_does_to_a_world(command_line):
    assert_help_says_what_another_goal_does(command_line("world", "make", "--help")[1])


def test_help_has_a_plan_in_groups(command_line):
    told = command_line("campaign", "plan", "--help")[1].splitlines()
    heads = [line for line in told if line.endswith(":") and not line.startswith(" ")]
    assert heads == ["Missions:", "Sample size:", "Output:"]


def test_who_interrupts_is_told_how_to_go_on(command_line, monkeypatch):
    def flying(*_):
        raise Interrupted("interrupted; run again to go on")

    monkeypatch.setattr("mavfi_cli.studies.compare.compare", flying)
    code, out, err = command_line("compare", "--quiet")
    assert (code, out, err) == (130, "", "interrupted; run again to go on\n")


# show ----------------------------------------------------------------------------------------


def test_show_says_what_fly_said(command_line, short_flight):
    result = json.loads(short_flight.result.read_text())
    code, out, err = command_line("show", short_flight.path)
    assert (code, err) == (0, "")
    assert out.splitlines()[:-2] == summary_lines(FlightRecord.of(result))
    assert out.splitlines()[-1] == f"Run folder  {short_flight.path}"
    assert command_line("show", short_flight.result)[1] == out


def test_show_draws_a_run_that_has_no_picture(command_line, short_flight, tmp_path):
    path = tmp_path / "above.svg"
    code, out, err = command_line("show", short_flight.path, "--picture", path)
    assert (code, err) == (0, "")
    assert path.read_text().startswith("<?xml")
    assert out.endswith(f"Run folder  {short_flight.path}\nPicture     {path}\n")


def test_show_refuses_a_picture_of_no_known_format(command_line, short_flight, tmp_path):
    code, out, err = command_line("show", short_flight.path, "--picture", "above.jpg")
    assert (code, out) == (2, "")
    assert "'--picture': above.jpg: " in err
    assert not (tmp_path / "above.jpg").exists()


def test_show_of_a_golden_run_has_no_pair(command_line, short_flight):
    code, out, err = command_line("show", short_flight.path, "--pair")
    assert (code, out) == (2, "")
    assert err.startswith("error: --pair needs ")


def test_a_record_that_is_none_says_so(command_line, short_flight, tmp_path):
    (tmp_path / "result.json").write_text("[1, 2]")
    code, _, err = command_line("show", tmp_path)
    assert code == 1
    assert "result.json: " in err


def test_show_events_and_json(command_line, troubled_flight):
    result = json.loads(troubled_flight.result.read_text())
    _, out, _ = command_line("show", troubled_flight.path, "--events")
    for line in event_lines(FlightRecord.of(result)):
        assert line in out.splitlines()
    _, out, _ = command_line("show", troubled_flight.path, "--json")
    assert json.loads(out) == result


def test_show_json_is_the_record_alone(command_line, short_flight):
    code, out, err = command_line("show", short_flight.path, "--json", "--pair")
    assert (code, out) == (2, "")
    assert "--pair or --events" in err


@pytest.mark.parametrize("options", [(), ("--without-fault",)])
def test_a_replay_waits_for_a_debugger_at_an_instruction_only(command_line, short_flight, options):
    code, out, err = command_line("replay", short_flight.path, "--gdb", *options)
    assert (code, out) == (2, "")
    assert "--gdb needs " in err


@pytest.fixture
def copied(short_flight, tmp_path):
    folder = tmp_path / "copy"
    shutil.copytree(short_flight.path, folder)
    return folder


def test_a_replay_names_what_differs_from_the_record(command_line, copied):
    result = json.loads((copied / "result.json").read_text())
    del result["config"]["node_restart_s"]  # an older version did not record it
    (copied / "result.json").write_text(json.dumps(result))
    code, out, _ = command_line("replay", copied)
    assert (code, out.splitlines()[0]) == (0, "identical")
    result["pilot"]["replans"] += 1
    (copied / "result.json").write_text(json.dumps(result))
    code, out, _ = command_line("replay", copied)
    assert (code, out.splitlines()[0]) == (1, "DIFFERENT in pilot")
    assert "nothing else ever differs" not in out


def _change(folder, section, value):
    path = folder / "result.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {section: value}))


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda f: (f / "result.json").write_text('{"schema": 1, '), "damaged"),
        (lambda f: (f / "result.json").write_bytes(b"\xff\xfe"), "damaged"),
        (lambda f: (f / "result.json").write_text("[]"), "not a JSON object"),
        (lambda f: (f / "result.json").write_text("[" * 100_000), "nested too deeply"),
        (lambda f: _change(f, "config", 5), "damaged ("),
        (lambda f: _change(f, "detection", 5), "detection: "),
        (lambda f: _change(f, "events", 5), "damaged (events"),
        (
            lambda f: _change(f, "quality_of_flight", {"distance_m": "x"}),
            "distance_m: ",
        ),
        (lambda f: (f / "result.json").write_text('{"schema": 99}'), "another version"),
        (lambda f: (f / "result.json").write_text('{"schema": 1}'), "damaged"),
        (lambda f: (f / "trace.parquet").write_bytes(b"PAR1 not"), "the trace cannot be read"),
        (lambda f: (f / "result.json").unlink(), "cut off before its end"),
        (lambda f: [path.unlink() for path in f.iterdir()], "not a run folder"),
        (shutil.rmtree, "no such run folder"),
    ],
)
def test_show_says_in_one_line_what_is_wrong_with_a_run(command_line, copied, damage, said):
    damage(copied)
    code, out, err = command_line("show", copied)
    assert (code, out) == (1, "")
    (line,) = err.splitlines()
    assert line.startswith("error: ")
    assert said in line


def test_a_newline_in_a_text_of_a_record_begins_no_line(command_line, copied):
    events = json.loads((copied / "result.json").read_text())["events"]
    lines = command_line("show", copied, "--events")[1].count("\n")
    _change(copied, "events", [event | {"text": "a\nb"} for event in events])
    code, out, _ = command_line("show", copied, "--events")
    assert code == 0
    assert out.count("a\ufffdb\n") == len(events)
    assert out.count("\n") == lines


def test_no_text_of_a_record_commands_the_terminal(command_line, copied):
    _change(copied, "reason", "\x1b[2J\x1b]0;title\x07")
    code, out, _ = command_line("show", copied)
    assert code == 0
    assert "\ufffd[2J\ufffd]0;title\ufffd" in out
    assert "\x1b" not in out


def test_show_does_without_a_trace(command_line, copied):
    (copied / "trace.parquet").unlink()
    assert command_line("show", copied)[0] == 0


# world ---------------------------------------------------------------------------------------


def test_world_list(command_line):
    code, out, _ = command_line("world", "list")
    assert code == 0
    for name in ("sparse", "dense", "factory", "farm"):
        assert any(line.startswith(name) for line in out.splitlines())


def test_world_make_check_draw_a_file_of_ones_own(command_line, tmp_path):
    assert command_line("world", "make", "dense", "--seed", "4", "-o", "mine.toml")[0] == 0
    code, out, _ = command_line("world", "check", "mine.toml")
    assert code == 0
    assert out
    assert command_line("world", "draw", "mine.toml", "-o", "mine.svg")[0] == 0
    assert ET.parse(tmp_path / "mine.svg").getroot().tag.endswith("svg")


def test_world_errors_pass_through(command_line):
    code, out, err = command_line("world", "check", "denze")
    assert (code, out) == (2, "")
    assert re.match("error: .*'denze'.* 'dense'", err)


def test_sitl_errors_pass_through(command_line):
    code, out, err = command_line("sitl", "--vehicle", "sollo")
    assert (code, out) == (2, "")
    assert re.search("error: .*'sollo'.* 'solo'", err)
    assert command_line("sitl", "--speed", "-1")[0] == 2


def test_modules_of_the_user_are_not_imported(command_line, tmp_path):
    for name in ("attrs", "click", "numpy"):
        (tmp_path / f"{name}.py").write_text("raise RuntimeError('imported')")
    for line in (("world", "list"), ("sitl", "--help")):
        code, _, err = command_line(*line)
        assert (code, err) == (0, "")


# doctor --------------------------------------------------------------------------------------


def test_doctor(command_line):
    code, out, _ = command_line("doctor", "--json")
    checks = {check["name"]: check for check in json.loads(out)}
    assert {"Python", "Processor", "Libraries", "Vehicle"} <= set(checks)
    failed = [check for check in checks.values() if check["verdict"] == "failed"]
    assert code == (1 if failed else 0)
    assert checks["Vehicle"]["verdict"] == "ok"
    assert processor_level() in checks["Processor"]["found"]
    needed = [each for each in importlib.metadata.requires("mavfi") if "extra ==" not in each]
    for each in needed:
        assert re.match(r"[\w-]+", each)[0] in checks["Libraries"]["found"]
    for check in checks.values():
        assert check["verdict"] == "ok" or check["remedy"]


def test_doctor_exits_with_1_where_flying_would_not_work(command_line, monkeypatch):
    from mavfi_cli.mission import machine

    finding = "missing: ompl, " + ", ".join(f"library-{number} 1.0" for number in range(20))
    broken = machine.Check(name="Libraries", verdict=machine.FAILED, finding=finding, remedy="pip")
    monkeypatch.setattr(machine, "check_machine", lambda: iter([broken]))
    code, out, _ = command_line("doctor")
    assert code == 1
    assert max(map(len, out.splitlines())) <= 100
    assert "missing: ompl" in out
    assert "-> pip" in out


def test_sitl_is_the_process_that_was_started_so_signals_reach_it():
    line = [sys.executable, "-m", "mavfi_cli", "sitl", "--link", "udpout:127.0.0.1:9"]
    with subprocess.Popen(line, stderr=subprocess.PIPE, text=True) as process:
        told = []
        for text in process.stderr:
            told.append(text.split())
            if text == "Ctrl-C ends it.\n":
                break
        process.terminate()
        assert process.wait(20) == 0
    assert told[1:] == [
        ["takes", "commands", "from", "anyone"],
        ["onboard", "udpout:127.0.0.1:9", "MAVSDK", "udpin://127.0.0.1:9"],
        ["MAVProxy", "--master=udpin:127.0.0.1:9"],
        ["Ctrl-C", "ends", "it."],
    ]
