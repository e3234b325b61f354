"""Flights of a user's own companion: the outcome, the record, and what becomes of bad ones."""

import math
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from live_processes import LONG_S, family, gone
from made_flights import companion_gate

from mavfi_cli import library
from mavfi_cli.analysis.scores import flown_samples
from mavfi_cli.campaigns import run as runner
from mavfi_cli.campaigns.missions import PlannedMission
from mavfi_cli.campaigns.progress import Spectator
from mavfi_cli.campaigns.run import Options, run_campaign
from mavfi_cli.campaigns.specification import Keep
from mavfi_cli.core.errors import ConfigError, MavfiError, ModelError, RecordError
from mavfi_cli.core.flight_record import ProgramEnds
from mavfi_cli.link.codec import Codec
from mavfi_cli.mission.companion_flight import CompanionFlight
from mavfi_cli.mission.crew import Crew
from mavfi_cli.mission.run import fly_again
from mavfi_cli.mission.run_folder import RunFolder
from mavfi_cli.mission.success import FlownPath, SuccessVerdict
from mavfi_cli.report.summary import summary_lines
from mavfi_cli.report.top_view import draw_top_view
from mavfi_cli.report.view.entries import ViewedFlight
from mavfi_cli.spec.companion import CompanionConfig, ProgramConfig, SuccessConfig
from mavfi_cli.spec.fault import FaultConfig, InstructionConfig
from mavfi_cli.spec.mission import MissionConfig

HOP = Path(__file__).with_name("hop.py")
SPEED = 4.0


@pytest.fixture
def fly(tmp_path):
    """A function that flies the hop in an empty scene; arguments are keys of the companion."""

    def flown(
        end, *, success="landed = true", program="", top="", limit_s=60.0, gated=False, **settings
    ):
        companion = tmp_path / "hop.toml"
        companion.write_text(
            f"{top}\n[program.hop]\ncommand = '{sys.executable} {HOP} {{link}} {SPEED} {end}'\n"
            f"{program}\n[success]\n{success}\n"
        )
        if gated:
            settings["detector"] = companion_gate(companion, 1e6)
        return library.fly(
            companion=str(companion), world="farm", speed=SPEED, time_limit_s=limit_s,
            out=tmp_path / "runs", **settings,
        )  # fmt: skip

    return flown


@pytest.mark.slow
def test_a_flight_leaves_a_record_as_any_other(fly):
    run = fly("lands", program='ready_line = "ready"')
    record, quality = run.record, run.record.quality_of_flight
    assert (record.outcome, record.reason) == ("success", "landed")
    assert record.programs == {"hop": ProgramEnds(starts=1)}
    assert 8.0 < quality.distance_m < 16.0
    assert quality.min_clearance_m > 0.0
    assert record.config["companion"].endswith("hop.toml")
    assert list(record.files.values()) != [""]
    assert (run.folder.programs / "hop" / "stdout").read_text() == "ready\n"
    columns = {name: run.trace[name].to_numpy() for name in run.trace.column_names}
    commanded = columns["command_vy"][columns["phase"] == "OFFBOARD"]
    assert {0.0, 2.0} <= set(np.round(commanded[~np.isnan(commanded)], 6))
    assert np.nanmax(np.abs(columns["x_m"] - columns["truth_x_m"])) < 0.2
    messages = Codec(0, 0).decode(run.folder.tlog.read_bytes())
    kinds = {m.get_type() for m in messages}
    assert {"HEARTBEAT", "LOCAL_POSITION_NED", "SET_POSITION_TARGET_LOCAL_NED"} <= kinds
    assert any("Program     hop: started 1x" in line for line in summary_lines(run.record))
    draw_top_view(run)
    assert ViewedFlight(name="flight", run=run, recorder=None).run is run
    with pytest.raises(RecordError, match="is not repeatable"):
        fly_again(run, run.folder.path.parent)


@pytest.mark.slow
def test_no_process_outlives_a_killed_mavfi(tmp_path):
    script = tmp_path / "start.sh"
    script.write_text(f'setsid sleep 600 & exec {sys.executable} {HOP} "$1" 1 waits\n')
    (tmp_path / "hop.toml").write_text('[program.hop]\ncommand = "sh start.sh {link}"\n')
    line = ["fly", "--companion", "hop.toml", "--world", "farm", "--quiet", "--out", "runs"]
    mavfi = subprocess.Popen([sys.executable, "-m", "mavfi_cli", *line], cwd=tmp_path)
    until_s = time.monotonic() + LONG_S
    while not any(
        "ready" in own.read_text() for own in tmp_path.glob("runs/*/programs/hop/stdout")
    ):
        assert time.monotonic() < until_s
        time.sleep(0.1)
    processes = family(mavfi.pid)
    lines = [Path(f"/proc/{pid}/cmdline").read_bytes() for pid in processes]
    for word in (b"sitl", b"hop.py", b"sleep"):
        assert any(word in line for line in lines), word
    mavfi.kill()
    mavfi.wait()
    assert all(map(gone, processes[1:]))


@pytest.mark.slow
def test_a_detector_is_not_fitted_to_flights_of_other_commands(fly, tmp_path):
    run = fly("lands")
    mark = CompanionConfig.load(run.record.config["companion"]).mark
    flights, left_out, _ = flown_samples(tmp_path / "runs", mark)
    assert (len(flights), left_out) == (1, 0)
    file = tmp_path / "hop.toml"
    file.write_text(file.read_text().replace("lands", "leaves"))
    assert len(flown_samples(tmp_path / "runs", mark)[0]) == 1
    with pytest.raises(ModelError, match="none of the 1 runs"):
        flown_samples(tmp_path / "runs", CompanionConfig.load(str(file)).mark)


@pytest.mark.slow
@pytest.mark.parametrize("beats", [True, False])
def test_the_heartbeat_of_the_camera(fly, beats):
    run = fly("waits", limit_s=3.0, top=f"camera_heartbeat = {str(beats).lower()}")
    messages = Codec(0, 0).decode(run.folder.tlog.read_bytes())
    hearts = {m.get_srcComponent() for m in messages if m.get_type() == "HEARTBEAT"}
    assert hearts == ({1, 100} if beats else {1})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("end", "options", "outcome", "reason"),
    [
        ("crashes", {}, "collision", "ground"),
        ("dies", {"limit_s": 30.0}, "crash", "killed by SIGKILL"),
        ("waits", {"limit_s": 3.0}, "timeout", "never sent a MAVLink message"),
        ("hangs", {}, "failsafe", "a failsafe of the autopilot landed the vehicle"),
        ("waits", {"program": "ready_port = 1\nready_limit_s = 0.5"}, "crash",
         "hop was not ready within 0.5 s"),
    ],
)  # fmt: skip
def test_every_end_is_a_result(fly, end, options, outcome, reason):
    record = fly(end, **options).record
    assert record.outcome == outcome
    assert reason in record.reason


@pytest.mark.slow
@pytest.mark.parametrize("signs", [True, False])
def test_a_vehicle_with_a_key_obeys_only_a_companion_that_signs(fly, tmp_path, signs):
    (tmp_path / "key").write_text("horse\n")
    key = "environment = { HOP_KEY = 'horse', MAVLINK20 = '1' }" if signs else ""
    fault = FaultConfig(target="SET_POSITION_TARGET_LOCAL_NED", effect="twice", at="time=5")
    record = fly("lands", top="key_file = 'key'", program=key, fault=fault, limit_s=30.0).record
    assert record.outcome == ("success" if signs else "timeout")
    assert record.fault.state == ("applied" if signs else "not_injected")
    assert record.reason == ("landed" if signs else "the companion never armed the vehicle")


@pytest.mark.slow
@pytest.mark.parametrize(("gated", "component"), [(False, 190), (True, 190), (False, 191)])
def test_another_commander_is_told_once(fly, gated, component):
    hop = f"{sys.executable} {HOP} {{link}} {SPEED} lands {component}"
    second = f"[program.second]\ncommand = '{hop}'\n"
    run = fly("lands", program=second, gated=gated)
    kinds = [event.kind for event in run.record.events if "sends setpoints" in event.text]
    assert kinds == ["program"]


@pytest.mark.slow
def test_the_end_of_a_program_is_seen_while_the_vehicle_lands(fly):
    run = fly("leaves", success='exit = "hop"')
    assert (run.record.outcome, run.record.reason) == ("success", "hop ended with code 0")
    assert run.trace["z_m"].to_numpy()[-1] > 1.0


@pytest.mark.slow
def test_a_vehicle_that_stands_near_the_goal_has_not_reached_it(fly):
    run = fly("waits", success="goal_m = 50.0", limit_s=3.0, goal=(10.0, 6.0, 5.0))
    assert run.record.outcome == "timeout"


@pytest.mark.slow
def test_a_vehicle_at_rest_near_the_goal_has_reached_it(fly):
    run = fly("lands", success="goal_m = 4.0", start=(2.0, 2.0, 0.0), goal=(2.0, 10.0, 2.0))
    assert run.record.outcome == "success"
    assert run.record.reason == "at rest within 4 m of the goal"
    assert run.trace["y_m"].to_numpy()[-1] > 6.0


@pytest.mark.slow
def test_a_program_starts_once_the_port_of_the_one_before_is_open(fly, free_port):
    late_s = 2.0
    serve = f'sh -c "sleep {late_s}; exec {sys.executable} -m http.server {free_port}"'
    run = fly("lands", top=f"[program.server]\ncommand = '{serve}'\nready_port = {free_port}\n")
    assert run.record.outcome == "success"
    begun_s = {event.text: event.stamp_s for event in run.record.events}
    assert begun_s["hop starts"] >= begun_s["server starts"] + 0.9 * late_s * SPEED


@pytest.mark.slow
def test_the_spread_of_golden_flights_is_printed(fly, mavfi, tmp_path):
    fly("waits", limit_s=3.0)  # writes the companion's file
    companion = tmp_path / "hop.toml"
    companion.write_text(companion.read_text().replace("waits", "lands"))
    line = ["fly", "--companion", companion, "--world", "farm", "--speed", SPEED]
    run = mavfi(*line, "--golden", 2, "--out", tmp_path / "golden", "--no-picture")
    assert run.returncode == 0, run.stderr
    assert "success 2, of 2" in run.stdout
    assert len(list((tmp_path / "golden").glob("farm-*"))) == 2


@pytest.mark.slow
def test_a_corridor_around_the_golden_path(fly):
    golden = fly("lands")
    near = f"landed = true\ncorridor_m = 3.0\ngolden = '{golden.folder.path}'"
    assert fly("lands", success=near).record.outcome == "success"
    strayed = fly("lands", success=near, world_seed=9)  # starts elsewhere
    assert strayed.record.outcome == "timeout"
    assert strayed.record.reason.endswith("m from the golden path")


@pytest.mark.parametrize(("limit_s", "span_s"), [(300.0, 15.0), (5.0, 5.0)])
def test_a_random_time_is_drawn_within_the_time_limit(limit_s, span_s):
    flight = SimpleNamespace(
        _companion=CompanionConfig(program={"a": ProgramConfig(command="true")}),
        _config=MissionConfig(v_max_mps=3.0), _golden_s=None, _time_limit_s=limit_s,
    )  # fmt: skip
    way = SimpleNamespace(start_enu_m=np.zeros(3), goal_enu_m=np.array([45.0, 0.0, 0.0]))
    assert CompanionFlight._shortest_flight_s(flight, way) == span_s


def test_a_flight_that_stops_early_misses_a_part_of_the_golden_path(tmp_path):
    places = np.linspace(0.0, 10.0, 21)
    table = pa.table({"x_m": places, "y_m": 0.0 * places, "z_m": 0.0 * places})
    pq.write_table(table, RunFolder(tmp_path).trace)
    success = SuccessConfig(landed=True, corridor_m=3.0, golden=str(tmp_path))
    verdict = SuccessVerdict(success, crew=None)
    verdict.goal_enu_m = np.zeros(3)
    for x_m, text in ((4.0, "part of the golden path was missed by 6.0 m"), (7.0, ""),
                      (math.nan, ""), (14.0, "up to 4.0 m from the golden path")):  # fmt: skip
        for passed_m in np.linspace(0.0, x_m, 21):
            verdict.see(SimpleNamespace(position_enu_m=np.array([passed_m, 0.0, 0.0])))
        assert verdict.deviation() == text


def test_the_distance_of_two_paths_is_the_same_in_both_directions():
    short, long = (
        FlownPath(np.linspace((0.0, 0.0, 0.0), (end_m, 0.0, 0.0), 5)) for end_m in (4.0, 10.0)
    )
    assert short.apart_m(long) == long.apart_m(short) == 6.0


@pytest.mark.parametrize(
    ("text", "error", "problem"),
    [
        ("[program.a]\ncommand = 'no-such-program'", ConfigError, "program' was not found"),
        ("[program.a]\ncommand = ''", ConfigError, "must name a program"),
        ("[program.a]\ncommand = \"'\"", ConfigError, "cannot be split"),
        ("[program.a]\ncomand = 'true'", ConfigError, "did you mean 'command'"),
        ("[program.a]\ncommand = 'true'\nrestart = 'allways'", ConfigError, "always"),
        ("[program.a]\ncommand = 'true'\nfolder = 'none'", ConfigError, "no such folder"),
        ("[program.a]\ncommand = 'true'\nready_line = '('", ConfigError, "be a regular expression"),
        ("[program.a]\ncommand = 'true'\nready_line = '\\u00e9'", ConfigError, "bad escape"),
        ("[program.a]\ncommand = 'true'\nready_port = 70000", ConfigError, "1 and 65535"),
        ('[program.a]\ncommand = "true\\u0000"', ConfigError, "must not contain NUL"),
        ("[program.a]\ncommand = 'true'\nenvironment = {'' = '1'}", ConfigError, "the variable ''"),
        ("[program.a]\ncommand = 'true {lnk}'", ConfigError, "did you mean 'link'"),
        ("[program.a]\ncommand = 'true'\nrestart = 'always'", ConfigError, "always restarts"),
        ("key_file = 'none'\n[program.a]\ncommand = 'true'", ConfigError, "read the passphrase"),
        ("link = 'foo'\n[program.a]\ncommand = 'true'", ConfigError, "udpin"),
        ("link = 'udpin:0.0.0.0:1'\n[program.a]\ncommand = 'true'", ConfigError, "on 127.0.0.1"),
        ("link = 'tcp:127.0.0.1:1'\n[program.a]\ncommand = 'true'", ConfigError, "or tcpin:"),
        ("flight_s = 9.0\ntime_limit_s = 8.0\n[program.a]\ncommand = 'true'", ConfigError,
         "at most time_limit_s"),
        (f"a = {'9' * 5000}", ConfigError, "too many digits"),
        (f"a = {'[' * 9000}", ConfigError, "nested too deeply"),
        ("[program.a]\ncommand = 'true'\n[success]\nexit = 'b'", ConfigError, "unknown program"),
        ("[program.a]\ncommand = 'true'\n[success]\ncorridor_m = 1", ConfigError, "golden"),
        ("link = 'udpin:127.0.0.1:0'\n[program]", ConfigError, "at least one program"),
        ("[program.a]\ncommand = 'su'", ConfigError, "set-uid"),
    ],
)  # fmt: skip
def test_a_companion_that_cannot_fly_is_refused_before_the_flight(tmp_path, text, error, problem):
    path = tmp_path / "companion.toml"
    path.write_text(text)
    with pytest.raises(error, match=problem):
        CompanionConfig.load(str(path))


def test_a_corridor_alone_does_not_say_when_the_flight_is_over():
    program = {"a": ProgramConfig(command="true")}
    near = SuccessConfig(corridor_m=1.0, golden="golden")
    assert CompanionConfig(program=program, success=near).success == replace(near, exit="a")


def test_a_program_is_gone_if_it_failed_or_has_succeeded_or_none_runs():
    programs = dict.fromkeys("ab", ProgramConfig(command="true"))
    landed = SuccessConfig(landed=True)
    crew = Crew(CompanionConfig(program=programs, success=landed), lambda *_: None)
    a, b = SimpleNamespace(codes=[0], pid=None), SimpleNamespace(codes=[], pid=7)
    crew.running = {"a": a, "b": b}
    assert crew.ended() == ""
    a.codes = [-11]
    assert crew.ended() == "the program a is gone"
    a.codes, b.codes, b.pid = [0], [0], None
    assert crew.ended() == "the program a is gone"
    named = Crew(
        CompanionConfig(program=programs, success=replace(landed, exit="a")), lambda *_: None
    )
    named.running = {"a": a, "b": SimpleNamespace(codes=[], pid=7)}
    assert named.ended() == "the program a is gone"


def test_only_a_heartbeat_that_was_not_heard_before_makes_a_program_ready():
    """A program that started earlier may repeat its heartbeat at any time."""
    started = []

    def start(name, _task):
        started.append(name)
        return SimpleNamespace(poll=lambda: True, starts=1, codes=[], pid=7, ready=False)

    config = ProgramConfig(command="true", ready_heartbeat=True)
    crew = Crew(CompanionConfig(program={"a": config, "b": config}), lambda *_: None)
    crew.prepare(SimpleNamespace(start=start), {})
    for sender, names, ready in (
        (None, ["a"], False),
        ((1, 191), ["a", "b"], False),
        ((1, 191), ["a", "b"], False),
        ((1, 195), ["a", "b"], True),
    ):
        if sender is not None:
            crew.hear(*sender)
        crew.manage(0.0, None)
        assert (started, crew.ready) == (names, ready)


def test_the_vehicle_makes_a_depth_socket_for_a_companion_that_uses_it():
    programs = {
        "a": ProgramConfig(command="true {link}"),
        "b": ProgramConfig(command="true {camera}"),
    }
    assert CompanionConfig(program=programs).uses("camera")
    assert not CompanionConfig(program={"a": programs["a"]}).uses("camera")


def test_placeholders_and_text_in_braces():
    with pytest.raises(ConfigError, match=r"did you mean 'goal'.*write {{gaol}}"):
        CompanionConfig.load("true {gaol}")
    given = "true {goal} {{goal}} '{\"a\": 1}' ${home} a{3}"
    program = CompanionConfig.load(given).program["companion"]
    words = ["true", "1,2,3", "{goal}", '{"a": 1}', "${home}", "a{3}"]
    assert program.argv({"goal": "1,2,3"}) == words


def test_a_command_line_may_end_in_toml_and_names_the_files_that_it_depends_on(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    for name in ("fly.py", "settings.toml", "my hop.toml"):
        Path(name).write_text("[program.a]\ncommand = 'true'\n")
    given = "python -u fly.py {link} --log out.csv settings.toml"
    assert CompanionConfig.load(given).files == ("fly.py",)
    assert MissionConfig(companion=given).files == ("fly.py",)
    assert MissionConfig(companion=f"{sys.executable} fly.py").files == ("fly.py",)
    assert MissionConfig(companion="my hop.toml").files == ("my hop.toml",)
    assert CompanionConfig.load(f"python -c '{'x' * 400}' a.toml").files == ()
    with pytest.raises(ConfigError, match="No such file"):
        CompanionConfig.load("hopp.toml")


def test_a_companions_flight_on_a_real_autopilot_may_have_a_fault_in_an_instruction():
    fault = InstructionConfig(target="companion")
    MissionConfig(companion="true {link}", autopilot="px4", instruction=fault)
    with pytest.raises(ConfigError, match="do not repeat exactly"):
        MissionConfig(autopilot="px4", instruction=fault)


def test_the_golden_folder_lies_beside_the_companions_file(tmp_path):
    path = tmp_path / "hop.toml"
    path.write_text(
        "[program.a]\ncommand = 'true'\n[success]\ncorridor_m = 1\ngolden = 'golden/farm-3-001'"
    )
    golden = CompanionConfig.load(str(path)).success.golden
    assert golden == str(tmp_path / "golden" / "farm-3-001")


@pytest.mark.parametrize(
    "settings",
    [{"link": "udpin:127.0.0.1:0", "goal": (1.0, 1.0, 5.0)}, {"realtime": True}, {"land": True}],
)
def test_settings_that_a_users_companion_cannot_have(settings):
    with pytest.raises(ConfigError, match="cannot be combined with --companion"):
        MissionConfig(companion="true", **settings)
    with pytest.raises(ConfigError, match="needs --companion"):
        MissionConfig(speed=2.0)


def test_the_port_of_another_program_is_told(tmp_path):
    import socket

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        path = tmp_path / "companion.toml"
        path.write_text(
            f"link = 'udpin:127.0.0.1:{taken.getsockname()[1]}'\n[program.a]\ncommand = 'true'"
        )
        with pytest.raises(MavfiError, match="is in use"):
            library.fly(companion=str(path), world="farm", out=tmp_path)


class Notes(Spectator):
    """Keeps what a campaign tells its user."""

    def __init__(self):
        self.texts = []

    def on_note(self, text):
        self.texts.append(text)


@pytest.mark.slow
def test_a_machine_without_network_namespaces_is_told_once(tmp_path, monkeypatch):
    monkeypatch.setattr(runner, "_may_leave_network", lambda: False)
    notes = Notes()
    config = MissionConfig(companion="true", world="farm", speed=SPEED)
    missions = [PlannedMission(config=replace(config, seed=seed)) for seed in (1, 2)]
    run_campaign(missions, tmp_path / "campaign", Options(jobs=2), notes).close()
    [told] = notes.texts
    assert told.endswith("a companion with a fixed port needs --jobs 1")


BINDS = """
import socket, time
with socket.create_server(("127.0.0.1", {port})):
    time.sleep(3.0)
"""


@pytest.mark.slow
@pytest.mark.parametrize("key", ["own_network = false\n", ""])
def test_missions_that_share_a_fixed_port_fly_one_at_a_time(tmp_path, monkeypatch, free_port, key):
    monkeypatch.setattr(runner, "_may_leave_network", lambda: False)
    (tmp_path / "binds.py").write_text(BINDS.format(port=free_port))
    companion = tmp_path / "binds.toml"
    companion.write_text(
        f"{key}[program.binds]\ncommand = '{sys.executable} binds.py'\nready_port = {free_port}\n"
    )
    config = MissionConfig(companion=str(companion), world="farm", speed=SPEED)
    missions = [PlannedMission(config=replace(config, seed=seed)) for seed in (1, 2, 3)]
    notes = Notes()
    with run_campaign(missions, tmp_path / "campaign", Options(jobs=3), notes) as ledger:
        assert [row.outcome for row in ledger.results()] == ["success"] * 3
    [told] = notes.texts
    why = "binds.toml sets own_network = false" if key else "no network namespaces are allowed here"
    assert f"{why}, so missions that use port {free_port} of this machine fly one at a time" in told


@pytest.mark.slow
@pytest.mark.skipif(not runner._may_leave_network(), reason="no network namespaces here")
@pytest.mark.parametrize("own", [True, False])
def test_missions_of_a_campaign_have_networks_of_their_own(tmp_path, own):
    companion, here = tmp_path / "looks.toml", os.readlink("/proc/self/ns/net")
    key = "" if own else "own_network = false\n"
    companion.write_text(f"{key}[program.looks]\ncommand = 'readlink /proc/self/ns/net'\n")
    config = MissionConfig(companion=str(companion), world="farm", speed=SPEED)
    missions = [PlannedMission(config=replace(config, seed=seed)) for seed in (1, 2)]
    options, notes = Options(jobs=2, keep=Keep.ALL), Notes()
    with run_campaign(missions, tmp_path / "campaign", options, notes) as ledger:
        results = list(ledger.results())
    assert notes.texts == []
    assert [row.outcome for row in results] == ["success", "success"]
    networks = [(row.path / "programs/looks/stdout").read_text().strip() for row in results]
    assert len({here, *networks}) == (3 if own else 1)
