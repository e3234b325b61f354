"""Bad input gets one clear line on stderr and exit code 1; nothing is flown, nothing is left."""

import contextlib
import errno
import os
import re
import resource
import socket
import subprocess
import sys

import pytest
import serial
from fake_autopilot import FakePX4
from missions import SHORT_LINE

from mavfi_cli.link import session
from mavfi_cli.mission import flight


@pytest.fixture
def refused(command_line, tmp_path, monkeypatch):
    """Run `mavfi fly`, which must end with one line; the line. Also without --quiet."""
    monkeypatch.setattr("mavfi_cli.autonomy.warm.is_compiled", lambda: True)  # else a line says so

    def run(*arguments, code=1):
        left, out, err = command_line("fly", *arguments)
        assert (left, out) == (code, "")
        (line,) = err.splitlines()
        assert line.startswith("error: ")
        assert not (tmp_path / "runs").exists()
        return line.removeprefix("error: ")

    return run


@pytest.mark.parametrize(
    ("option", "given", "kind", "nearest"),
    [
        ("--world", "denze", "world", "dense"),
        ("--planner", "rtstar", "planner", "rrtstar"),
        ("--vehicle", "sollo", "vehicle", "solo"),
        ("--platform", "x68", "platform", "x86"),
        ("--platform", "TX2", "platform", "tx2"),
        ("--stack", "hardend", "stack", "hardened"),
    ],
)
def test_an_unknown_name_gets_the_nearest(refused, option, given, kind, nearest):
    line = refused(option, given, code=2)
    assert line.startswith(f"{option}: unknown {kind} {given!r}; did you mean {nearest!r}? Known: ")


def test_a_name_like_no_other_gets_the_list(refused):
    assert re.match("--stack: .*'zzz'.* hardened, ", refused("--stack", "zzz", code=2))


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--world", "factory", "--goal=18,10,5"), "goal (18, 10, 5) is inside an obstacle"),
        (("--world", "factory", "--goal=18,10,99"), "goal (18, 10, 99) is outside"),
        (("--world", "farm", "--goal=-300,10,5"), "goal (-300, 10, 5) is outside"),
        (("--world", "factory", "--start=18,10,0"), "start (18, 10, 0) is blocked"),
        (("--world", "farm", "--start=500,0,0"), "start (500, 0, 0) is outside"),
        (("--world", "dense", "--goal=30,40,-1"), "goal (30, 40, -1) is outside"),
        (("--world", "dense", "--goal=1e6,0,5"), "must be at most 1000 m apart"),
    ],
)
def test_a_place_where_nobody_can_be(refused, arguments, said):
    line = refused(*arguments, code=2)
    assert said in line
    assert line.startswith(("world ", "start "))  # the name of the world is not blamed


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--v-max", "nan"), "--v-max: must be between 0.1 and 12"),
        (("--inject", "control", "--at", "time=99999"), "at time=99999: "),
        (("--inject", "control", "--at", "tick=15001"), "at tick=15001: "),
        (("--time-limit", "inf"), "--time-limit: must be between"),
        (("--seed", "-1"), "--seed: must be between 0 and 2147483647"),
        (("--inject", "planning", "--fault-seed", "-1"), "Invalid value for '--fault-seed'"),
        (("--inject", "planning", "--bit", "64"), "Invalid value for '--bit': 64 "),
        (("--restart", "soon"), "Invalid value for '--restart': 'soon' is not a valid"),
        (("--restart", "4000"), "Invalid value for '--restart': 4000.0 is not in the range"),
        (("--goal", "1e9,0,5"), "--goal: must be within 1e+07 m"),
        (("--goal", "nan,1,2"), "Invalid value for '--goal': must be three finite"),
        (("--start", "1,inf,2"), "Invalid value for '--start': must be three finite"),
        (("--stack", "mavbench:foo=3"), "foo: unknown key; known: "),
        (("--inject", "process.planner", "--at", "foreseen"), "process.planner: at "),
        (("--companion", "true", "--planner", "rrt"), "--planner: has no effect"),
        (("--companion", "true", "--restart", "2"), "--restart: has no effect"),
        (("--companion", "true", "--record", "mcap"), "--record cannot be combined"),
        (("--stack", "mavbench:guards_tracking=3"), "guards_tracking: "),
    ],
)
def test_a_number_out_of_its_range_names_the_option(refused, arguments, said):
    assert refused(*arguments, code=2).startswith(said)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--goal", "1,2"), "Invalid value for '--goal': "),
        (("--wrold", "x"), "no such option '--wrold'; did you mean '--world'?"),
        (("--xyz",), "no such option '--xyz'\n"),
    ],
)
def test_wrong_usage_is_one_line_and_exits_with_2(command_line, arguments, said):
    code, out, err = command_line("fly", *arguments)
    assert (code, out, len(err.splitlines())) == (2, "", 1)
    assert err.startswith(f"error: {said}")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("fly", "--world", "gen:nan,3"), "density must be between 0 and 1"),
        (("fly", "--world", "gen:3"), "--world: world must be gen:density,size"),
        (("kernels", "--program", "nope"), "nope: the program was not found"),
        (("sitl", "--link", "foo:bar"), "foo:bar: unknown kind of endpoint"),
        (("gate",), "gad needs --model"),
    ],
)
def test_a_value_that_no_option_type_checks_is_also_wrong_usage(command_line, arguments, said):
    code, _, err = command_line(*arguments)
    assert code == 2
    assert err.startswith(f"error: {said}")


def test_an_unknown_command_gets_the_nearest(command_line):
    code, _, err = command_line("fyl")
    assert code == 2
    assert re.search("'fyl'.* 'fly'", err)


# Files ---------------------------------------------------------------------------------------

PLATFORM = 'name = "mine"\ncores = 4\n'
WORLD = (
    'name = "w"\nbounds_enu_m = [-10.0, -10.0, 0.0, 40.0, 20.0, 20.0]\n'
    "start_enu_m = [0.0, 0.0, 0.0]\ngoal_enu_m = [20.0, 0.0, 5.0]\n"
)


@pytest.mark.parametrize(
    ("option", "text", "line", "said"),
    [
        ("--platform", 'name = "mine"\ncores = \n', 2, "Invalid value"),
        ("--platform", f"{PLATFORM}\n[kernels.octomap]\nlatensy_s = 1.0\n", 5, "'latency_s'"),
        ("--platform", 'name = "mine"\ncores = "many"\n', 2, "cores: "),
        ("--platform", f"{PLATFORM}\n[kernels.planner]\nlatency_s = -1.0\n", 4, "kernels.planner"),
        ("--world", f"{WORLD}[[box]\n", 5, ""),
        ("--world", f"{WORLD}goal_m = 3\n", 5, "'goal_enu_m'"),
        ("--vehicle", 'name = "v"\nmass_kg = 1.0.0\n', 2, ""),
        ("--vehicle", 'name = "v"\nmas_kg = 1.0\n', 2, "'mass_kg'"),
    ],
)
def test_a_malformed_file_is_named_with_line_and_key(refused, tmp_path, option, text, line, said):
    path = tmp_path / "bad.toml"
    path.write_text(text)
    told = refused(option, "bad.toml")
    assert told.startswith(f"bad.toml:{line}: ")
    assert said in told


@pytest.mark.parametrize("option", ["--platform", "--world", "--vehicle"])
def test_a_file_that_is_not_there(refused, option):
    assert "nowhere.toml" in refused(option, "nowhere.toml")


# Links ---------------------------------------------------------------------------------------


def test_a_link_that_is_no_url(refused):
    assert refused("--link", "udpx:1", "--goal", "1,2,3", code=2).startswith("udpx:1: unknown kind")


def test_a_serial_device_without_permission(refused, monkeypatch):
    def deny(*_args, **_options):
        raise serial.SerialException(errno.EACCES, "could not open port")

    monkeypatch.setattr(serial, "Serial", deny)
    line = refused("--link", "serial:/dev/ttyACM0:57600", "--goal", "1,2,3")
    assert line.startswith("serial:/dev/ttyACM0:57600: ")
    assert "permission" in line


def test_a_key_file_without_permission(refused, tmp_path, monkeypatch):
    (tmp_path / "key").write_text("horse")
    open_ = os.open

    def deny(path, *args, **options):
        if os.path.basename(path) == "key":
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        return open_(path, *args, **options)

    monkeypatch.setattr(os, "open", deny)
    line = refused(*LINK, "--key-file", "key")
    assert re.fullmatch("key: .*: Permission denied", line)


@pytest.mark.parametrize("key", ["/dev/zero", "pipe"])
def test_a_key_file_that_never_ends_is_refused(refused, tmp_path, key):
    os.mkfifo(tmp_path / "pipe")
    line = refused(*LINK, "--key-file", key)
    assert line.endswith("is not a regular file")


def test_a_camera_that_cannot_start_says_why(refused):
    line = refused(*LINK, "--eyes", "--world", "farm", "--goal", "900,0,5", code=2)
    assert "goal (900, 0, 5) is outside the world" in line


def test_a_port_in_use_for_the_companion(refused):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        url = f"udpin:127.0.0.1:{taken.getsockname()[1]}"
        assert refused("--link", url, "--goal", "1,2,3").startswith(f"{url}: ")


def test_a_port_in_use_for_the_vehicle(mavfi):
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        url = f"tcpin:127.0.0.1:{taken.getsockname()[1]}"
        done = mavfi("sitl", "--world", "farm", "--link", url)
    assert (done.returncode, done.stdout) == (1, "")
    *_, line = done.stderr.splitlines()  # the first start says that it compiles
    assert line.startswith(f"error: {url}: ")
    assert "in use" in line


def test_no_autopilot_at_the_url(refused, free_port, monkeypatch):
    settings = session.SessionSettings
    monkeypatch.setattr(flight, "SessionSettings", lambda **o: settings(connect_timeout_s=0.2, **o))
    url = f"udpin:127.0.0.1:{free_port}"
    line = refused("--link", url, "--goal", "20,2,3")
    assert line.startswith(f"no autopilot at {url}: ")
    assert "0.2 s" in line


def test_an_autopilot_that_refuses_to_arm_in_its_own_words(command_line, autopilot_on_udp):
    autopilot = FakePX4()
    autopilot.refuse_arming = "Preflight Fail: No valid data from Accel 0\t"
    _, url = autopilot_on_udp(autopilot)
    code, out, err = command_line("fly", "--link", url, "--goal", "20,2,3", "--quiet")
    assert (code, out) == (1, "")
    (line,) = err.splitlines()
    assert "arming" in line
    assert line.endswith(f"({autopilot.refuse_arming.strip()})")


# The disk ------------------------------------------------------------------------------------


@contextlib.contextmanager
def full_disk():
    """The system refuses to let any file of this process grow beyond 256 KiB."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 18, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk_in_flight(command_line):
    with full_disk():
        code, out, err = command_line(*SHORT_LINE, "--quiet")
    assert (code, out) == (1, "")
    (line,) = err.splitlines()
    assert re.match("error: runs/farm-5-001/flight.tlog: .*: File too large", line)
    assert "cut off before its end" in command_line("show", "runs/farm-5-001")[2]


def test_a_folder_that_cannot_be_made(refused, tmp_path):
    (tmp_path / "file").write_text("")
    line = refused(*SHORT_LINE[1:], "--quiet", "--out", "file/runs", code=2)
    assert "'--out': file/runs: this folder cannot be created or written" in line


@pytest.mark.parametrize(
    ("out", "why"),
    [
        ("/dev/null", "/dev/null: this folder cannot be created or written"),
        (b"caf\xe9".decode(errors="surrogateescape"), r"'caf\udce9': not a UTF-8 name"),
    ],
)
def test_a_folder_that_could_not_be_read_again_is_refused_before_the_flight(refused, out, why):
    assert f"'--out': {why}" in refused(*SHORT_LINE[1:], "--quiet", "--out", out, code=2)


@pytest.mark.parametrize("arguments", ["states", "states --json", "--help", "world list"])
def test_an_output_that_cannot_be_written_is_one_line(tmp_path, arguments):
    line = f"{sys.executable} -m mavfi_cli {arguments} > /dev/full"
    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True, check=False)
    assert (done.returncode, len(done.stderr.splitlines())) == (1, 1)
    assert "No space left" in done.stderr


def test_output_into_a_closed_pipe_is_no_traceback(tmp_path):
    line = f"{sys.executable} -m mavfi_cli world list | true; echo ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True, check=True)
    assert "Traceback" not in done.stderr


LINK = ["--link", "udpin:127.0.0.1:14540", "--goal", "1,2,3"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--bits", "3"], "--bits needs --inject"),
        (["--loss-limit", "3"], "--loss-limit: needs --link"),
        (["--firmware", "px4"], "--firmware needs --autopilot px4 or ardupilot"),
        (["--field", "sign"], "--field needs --inject"),
        (["--level", "instruction"], "--level instruction needs --inject NODE"),
        (["--inject", "planning", "--restart", "5"], "--restart has no effect unless a node"),
        (["--inject", "planning", "--duration", "5"], "--duration needs --persistence stuck-at"),
        (["--inject", "planning", "--bit", "3", "--bits", "2"], "--bits has no effect with --bit"),
        (["--inject", "planning", "--bit", "3", "--field", "sign"], "--field has no effect with"),
        (["--inject", "planning", "--bit", "3", "--bit", "3"], "--bit must not name a bit twice"),
        (["--inject", "planning", "--effect", "zero", "--bits", "2"], "--bits has no effect with"),
        (["--inject", "detector"], "--inject detector needs --detector NAME"),
        (["--link", "udpin:127.0.0.1:14540"], "--link: needs --goal X,Y,Z"),
        (["--platform", "measured:2"], "--platform: measured:2 needs --realtime"),
        ([*LINK, "--world", "dense"], "--world has no effect with --link unless --eyes"),
        ([*LINK, "--vehicle", "solo"], "--vehicle has no effect with --link unless --eyes"),
        ([*LINK, "--start", "1,2,0"], "--start has no effect with --link unless --eyes"),
        ([*LINK, "--world-seed", "4"], "--world-seed has no effect with --link unless --eyes"),
        ([*LINK, "--eyes", "--realtime"], "--realtime: cannot be combined with --link"),
        (["--eyes"], "--eyes: needs --link"),
        ([*LINK, "--origin", "1,2,0"], "--origin: needs --eyes"),
        (["--inject", "planning", "--site", "flags"], "--site needs --level instruction"),
        (["--level", "instruction", "--inject", "octomap", "--at", "tick=3"], "--at needs --level"),
    ],
)
def test_an_option_that_would_do_nothing_is_refused(command_line, arguments, said):
    code, out, err = command_line("fly", *arguments)
    assert (code, out) == (2, "")
    assert said in err


@pytest.fixture
def no_firmware(tmp_path, monkeypatch):
    """Paths that are no firmware, by what they are."""
    monkeypatch.delenv("PX4_SITL", raising=False)
    files = {kind: tmp_path / kind for kind in ("folder", "text", "program")}
    files["folder"].mkdir()
    files["text"].write_text("no program")
    files["program"].symlink_to("/bin/true")
    return files | {"nothing": tmp_path / "nothing"}


@pytest.mark.parametrize(
    ("autopilot", "kind", "said"),
    [
        ("px4", "nothing", "cannot start the firmware, which is not a file: {path}"),
        ("px4", "folder", "cannot start the firmware, which is not a file: {path}"),
        ("px4", "text", "cannot start the firmware, which is not executable: {path}"),
        ("px4", "program", "{path} is not PX4"),
        ("ardupilot", "program", "true ended with code 0"),
    ],
)
def test_a_path_that_is_no_firmware(refused, no_firmware, autopilot, kind, said):
    path = no_firmware[kind]
    line = refused(*SHORT_LINE[1:], "--quiet", "--autopilot", autopilot, "--firmware", path)
    assert said.format(path=path) in line


def test_a_real_autopilot_without_a_binary(refused, no_firmware):
    line = refused(*SHORT_LINE[1:], "--quiet", "--autopilot", "px4", code=2)
    assert re.match("--firmware: px4 .*--firmware PATH, or PX4_SITL", line)
