"""Bad beginnings: known errors are one line and 1, misuse is 2."""

import re
import signal
import socket
import subprocess
import sys

import pytest

from sitl.server import main, warm_up


@pytest.fixture(scope="module", autouse=True)
def _compiled():
    """Else the first start also tells that it compiles."""
    warm_up()


@pytest.fixture
def run(capfd):
    """Start the vehicle in this process, which keeps its own answer to signals."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def run(*arguments):
        return main(arguments), *capfd.readouterr()

    yield run
    for number, handler in handlers.items():
        signal.signal(number, handler)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--world", "dence"], "did you mean 'dense'"),
        (["--world", "farm", "--vehicle", "sollo"], "did you mean 'solo'"),
        (["--world", "farm", "--goal", "900,0,5"], "goal (900, 0, 5) is outside"),
        (["--world", "farm", "--start", "6.4,10,0"], "start (6.4, 10, 0) is blocked"),
        (["--world", "/nowhere/at/all.toml"], "/nowhere/at/all.toml"),
        (["--world", "farm", "--link", "carrier:pigeon"], "unknown kind"),
        (["--world", "farm", "--link", "udpin:0.0.0.0:14777"], "sign"),
        (["--world", "farm", "--camera-rate", "1000"], "camera rate"),
        (["--world", "farm", "--key-file", "/nowhere/key"], "/nowhere/key"),
        (["--hil", "px4", "--firmware", "/nowhere/px4"], "is not a file: /nowhere/px4"),
        (["--json", "ardupilot", "--firmware", "/etc/passwd"], "is not executable"),
    ],
)
def test_known_error_is_one_line(run, arguments, words):
    code, out, errors = run(*arguments)
    usage = ("did you mean", "is outside", "is blocked", "unknown kind")
    assert (code, out) == (2 if any(each in words for each in usage) else 1, "")
    assert errors.startswith("error: ")
    assert errors.count("\n") == 1
    assert words in errors


def test_a_truth_that_cannot_be_written_starts_no_firmware(run, tmp_path, monkeypatch):
    program, folder = tmp_path / "arducopter", tmp_path / "folder"
    program.write_text("#!/bin/sh\nsleep 600\n")
    program.chmod(0o755)
    folder.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    code, _, errors = run(
        "--json", "ardupilot", "--firmware", str(program), "--truth", "/dev/null/truth"
    )
    assert code == 2
    assert "'--truth': /dev/null/truth: this folder cannot be created or written" in errors
    assert list(folder.iterdir()) == []


def test_a_descriptor_that_is_no_socket_is_named():
    """In a process of its own, whose descriptor 1 it may close."""
    done = subprocess.run(
        [sys.executable, "-m", "sitl", "--world", "farm", "--fd", "1", "--lockstep"],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
    assert "fd:1" in done.stderr


def test_port_in_use_is_named(run):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        code, _, errors = run("--world", "farm", "--link", f"tcpin:127.0.0.1:{port}")
    assert code == 1
    assert re.fullmatch(f"error: tcpin:127.0.0.1:{port}: .* in use\n", errors)


@pytest.mark.parametrize(
    "arguments",
    [
        ["--lockstep"],
        ["--start", "1,2"],
        ["--goal", "a,b,c"],
        ["--camera-size", "64"],
        ["--speed", "0"],
        ["--speed", "nan"],
        ["--sysid", "256"],
        ["--realtime", "--speed", "2"],
        ["--link", "best=udpin:127.0.0.1:1"],
        ["--lockstep", "--fd", "3", "--link", "udpin:127.0.0.1:1"],
        ["--no-such-option"],
        ["--hil", "ardupilot"],
        ["--hil", "px4", "--json", "ardupilot"],
        ["--firmware", "/bin/true"],
        ["--hil", "px4", "--lockstep", "--fd", "3"],
    ],
)
def test_misuse_is_one_line_and_exit_2(run, arguments):
    code, out, errors = run(*arguments)
    assert (code, out) == (2, "")
    assert errors.startswith("error: ")
    assert errors.count("\n") == 1


def test_defaults_are_those_of_a_px4_sitl():
    from sitl.options import parse

    options = parse([])
    assert [(preset.value, url) for preset, url in options.links] == [
        ("onboard", "udpout:127.0.0.1:14540"),
        ("gcs", "udpout:127.0.0.1:14550"),
        ("gcs", "tcpin:127.0.0.1:5760"),
    ]
    assert options.speed == 1.0
    assert parse(["--lockstep", "--fd", "5"]).speed is None
    assert not parse(["--lockstep", "--fd", "5"]).links
