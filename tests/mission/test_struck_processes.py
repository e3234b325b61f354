"""The end of a struck process of a user's companion: a death by the fault, or an ordinary end."""

import os
import platform
import re
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
from live_processes import gone

from mavfi_cli.core import processes
from mavfi_cli.core.processes import Ended
from mavfi_cli.fi.injector import Moment
from mavfi_cli.mission.instruction import companion
from mavfi_cli.mission.instruction.companion import ProcessInjection
from mavfi_cli.mission.programs import RunningProgram
from mavfi_cli.spec.fault import InstructionConfig

# Starts a sleeping process, prints its number, and reads its status or does not.
LEADER = """
import subprocess, sys, time
child = subprocess.Popen(["sleep", "60"])
print(child.pid, flush=True)
child.wait() if sys.argv[1] == "reads" else None
time.sleep(60)
"""


RELEASE = tuple(map(int, re.findall(r"\d+", platform.release())[:2]))
keeps_status = pytest.mark.skipif(
    RELEASE < (6, 15), reason="this kernel forgets how a process ended that has been reaped"
)


@pytest.fixture
def leader(request):
    """A program, and the number of the process that it has started."""
    command = [sys.executable, "-c", LEADER, request.param]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as program:
        yield program, int(program.stdout.readline())
        os.killpg(program.pid, signal.SIGKILL)


def struck(monkeypatch, tmp_path, pid, executable):
    """An injection that has struck a process of a program, and the program."""
    monkeypatch.setattr(companion, "attack_moment", lambda *_, **__: None)
    program, usual_s = SimpleNamespace(pid=pid, codes=[], poll=bool), sys.getswitchinterval()
    program.process = partial(RunningProgram.process, program)
    request = InstructionConfig(target=f"fly{executable}", at="time=1", seed=1)
    injection = ProcessInjection(request, None)
    injection.running = {"fly": program}
    injection.aim_at(10.0)
    injection.begin(tmp_path / "fault.json")
    assert sys.getswitchinterval() < usual_s  # the link's thread waits less for the tracer's
    assert not deaths(injection, 1.5)
    return injection, program


def deaths(injection, stamp_s):
    """The deaths that are known after a tick, with their stamps."""
    injection.tick(Moment(stamp_s=stamp_s, flight_s=stamp_s, tick=0, phase="OFFBOARD"))
    return [(crash.stamp_s, crash.how) for end in injection.ends.values() for crash in end.crashes]


@pytest.mark.parametrize(
    ("leader", "number", "how", "at_once"),
    [
        ("does not read", signal.SIGSEGV, "killed by SIGSEGV", True),
        ("does not read", signal.SIGKILL, "killed by SIGKILL", False),
        pytest.param("reads", signal.SIGSEGV, "killed by SIGSEGV", True, marks=keeps_status),
        pytest.param("reads", signal.SIGKILL, "killed by SIGKILL", False, marks=keeps_status),
        ("reads", signal.SIGSEGV, "ended", False),
    ],
    indirect=["leader"],
)
def test_a_process_without_which_its_program_goes_on_is_dead(
    monkeypatch, tmp_path, leader, number, how, at_once
):
    program, pid = leader
    reads = "reads" in program.args
    if how == "ended":
        monkeypatch.setattr(processes, "_GET_INFO", 0)  # before Linux 6.15
    injection, _ = struck(monkeypatch, tmp_path, program.pid, "/sleep")
    os.kill(pid, number)
    assert gone(pid)
    while reads and Path(f"/proc/{pid}").exists():
        time.sleep(0.01)
    assert deaths(injection, 2.0) == deaths(injection, 3.9) == [(2.0, how)] * at_once
    assert deaths(injection, 4.1) == [(2.0, how)]
    injection.close()
    assert sys.getswitchinterval() > 1e-3


@keeps_status
@pytest.mark.parametrize("leader", ["reads"], indirect=True)
def test_a_process_whose_crash_ends_its_program_too_is_dead(monkeypatch, tmp_path, leader):
    started, pid = leader
    injection, program = struck(monkeypatch, tmp_path, started.pid, "/sleep")
    os.kill(pid, signal.SIGSEGV)
    while Path(f"/proc/{pid}").exists():
        time.sleep(0.01)
    program.pid, program.codes = None, [1]
    assert deaths(injection, 2.0) == [(2.0, "killed by SIGSEGV")]
    injection.close()


@pytest.mark.parametrize("leader", ["does not read"], indirect=True)
def test_a_process_that_its_program_ends_before_its_own_end_is_not_dead(
    monkeypatch, tmp_path, leader
):
    started, pid = leader
    injection, program = struck(monkeypatch, tmp_path, started.pid, "/sleep")
    os.kill(pid, signal.SIGKILL)
    assert gone(pid)
    assert not deaths(injection, 2.0)
    program.pid, program.codes = None, [0]
    assert not deaths(injection, 9.0)
    injection.close()


@pytest.mark.parametrize("leader", ["does not read"], indirect=True)
@pytest.mark.parametrize(
    ("end", "codes", "usual"),
    [
        (Ended.of(1), [0], True),  # as MAVProxy ends when its input does
        (Ended.of(1), [1], False),
        (Ended.of(1), [], False),
        (Ended.of(-signal.SIGSEGV), [0], False),
        (Ended(exit_code=None, signal=None), [0], False),
    ],
)
def test_an_exit_code_is_no_death_if_the_program_ends_without_an_error(
    monkeypatch, tmp_path, leader, end, codes, usual
):
    injection, program = struck(monkeypatch, tmp_path, leader[0].pid, "/sleep")
    injection._end, program.codes = (2.0, end), codes
    assert injection._ended_as_usual() is usual
    injection.close()


@pytest.mark.parametrize("leader", ["does not read"], indirect=True)
@pytest.mark.parametrize(
    ("code", "how"),
    [
        (-signal.SIGABRT, "killed by SIGABRT"),
        (1, "ended with code 1"),
        (-40, "killed by 40"),
        (0, ""),
    ],
)
def test_the_status_of_a_programs_own_process_may_come_from_its_worker(
    monkeypatch, tmp_path, leader, code, how
):
    started, _ = leader
    monkeypatch.setattr(processes, "_GET_INFO", 0)  # before Linux 6.15
    injection, program = struck(monkeypatch, tmp_path, started.pid, "")
    started.kill()
    started.wait()
    assert not deaths(injection, 2.0)
    program.pid, program.codes = None, [code]
    assert deaths(injection, 2.5) == ([(2.5, how)] if how else [])
    assert deaths(injection, 9.0) == ([(2.5, how)] if how else [])
    injection.close()
