"""The server that forks workers: fresh ones, which nothing outlives."""

import json
import os
import signal
from pathlib import Path

import pytest
from live_processes import LONG_S, children, gone

from mavfi_cli.core.errors import MavfiError
from mavfi_cli.core.fork_server import PACKET, SERVER, ForkServer, _isolate_streams
from mavfi_cli.core.processes import fork


@pytest.fixture
def server(monkeypatch):
    paths = [str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, paths)))
    started = ForkServer("forked_task")
    yield started
    started.close()


def name_of(pid):
    return Path(f"/proc/{pid}/comm").read_text().strip()


def heard(channel):
    """Everything that a guard says until it closes."""
    channel.settimeout(LONG_S)
    said = []
    with channel:
        while packet := channel.recv(PACKET):
            said.append(json.loads(packet))
    return said


@pytest.mark.parametrize(
    ("task", "end", "report"),
    [
        ({}, {"exit": 0}, {"folder": "left"}),
        ({"error": "blocked"}, {"exit": 1}, {"error": "WorldError", "text": "blocked"}),
        ({"signal": int(signal.SIGSEGV)}, {"signal": int(signal.SIGSEGV)}, None),
        ({"orphan": True}, {"exit": 0}, {"folder": "left"}),
    ],
)
def test_a_worker_has_its_own_end_report_and_surroundings(server, tmp_path, task, end, report):
    begun, ended = heard(server.start(task, tmp_path, LONG_S))
    assert 0.0 < ended.pop("wall_s") < LONG_S
    assert ended == {**end, "report": report}
    assert gone(begun["pid"])
    assert (tmp_path / "left" / "scratch").read_text() == str(tmp_path / "tmp")
    assert (tmp_path / "stderr.txt").read_text().startswith("words\n")
    if "orphan" in task:
        assert gone((tmp_path / "left" / "orphan").read_text())


def test_a_module_of_the_user_is_not_imported(server, tmp_path, monkeypatch):
    (tmp_path / "tempfile.py").write_text("raise RuntimeError('imported')")
    monkeypatch.chdir(tmp_path)
    _, ended = heard(server.start({}, tmp_path, LONG_S))
    assert ended["exit"] == 0


def test_a_defect_is_reported_with_its_traceback(server, tmp_path):
    _, ended = heard(server.start({"defect": True}, tmp_path, LONG_S))
    assert ended["report"]["traceback"].endswith("ZeroDivisionError\n")


def test_what_takes_too_long_is_killed(server, tmp_path):
    _, ended = heard(server.start({"sleep_s": 600.0}, tmp_path, 0.2))
    assert ended["timeout"]
    assert ended["report"] is None


def test_the_worker_ends_when_its_channel_is_closed(server, tmp_path):
    channel = server.start({"sleep_s": 600.0}, tmp_path, LONG_S)
    begun = json.loads(channel.recv(PACKET))
    channel.close()
    assert gone(begun["pid"])


def test_workers_are_fresh_and_a_killed_server_is_started_again(server, tmp_path):
    others = set(children(os.getpid()))
    (one, _), (two, _) = (
        heard(server.start({}, tmp_path / name, LONG_S)) for name in ("one", "two")
    )
    assert one["pid"] != two["pid"]
    started = set(children(os.getpid())) - others
    (server_pid,) = (pid for pid in started if name_of(pid) == SERVER)
    os.kill(server_pid, signal.SIGKILL)
    os.waitid(os.P_PID, server_pid, os.WEXITED | os.WNOWAIT)
    assert heard(server.start({}, tmp_path / "three", LONG_S))[-1]["exit"] == 0


def test_a_worker_works_in_the_folder_in_which_its_client_is_then(server, tmp_path, monkeypatch):
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        monkeypatch.chdir(tmp_path / name)
        assert heard(server.start({}, Path("out"), LONG_S))[-1]["exit"] == 0
        assert (tmp_path / name / "out" / "left").is_dir()


def test_a_kernel_that_does_not_list_children_is_enough(server, tmp_path, monkeypatch):
    monkeypatch.setenv("MAVFI_TEST_CHILDLESS", "1")
    _, ended = heard(server.start({}, tmp_path, LONG_S))
    assert (ended["exit"], ended["report"]) == (0, {"folder": "left"})


def test_a_server_that_cannot_load_its_module_says_so(server, tmp_path, monkeypatch):
    monkeypatch.setenv("MAVFI_TEST_UNPREPARED", "1")
    with pytest.raises(MavfiError, match="could not start"):
        server.start({}, tmp_path, LONG_S)


def test_a_folder_that_the_client_has_removed_is_not_made_again(tmp_path):
    gone_folder = tmp_path / "gone"
    pid = fork(lambda: _isolate_streams(gone_folder) or 0)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 1
    assert not gone_folder.exists()
