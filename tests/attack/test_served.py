"""A served program: one that was started early belongs to the next that needs it."""

import os
from pathlib import Path

import pytest

from mavfi_cli.attack import served

MODULE = "mavfi_cli.attack.kernels.template"


@pytest.fixture
def started(monkeypatch):
    """The programs in the order of their start."""
    programs = []

    class Noted(served.ServedProcess):
        def __init__(self, module):
            super().__init__(module)
            programs.append(self)

    monkeypatch.setattr(served, "ServedProcess", Noted)
    yield programs
    for each in programs:
        each.kill()


def test_a_program_that_was_started_early_is_taken_once(started):
    served.ServedProcess.start_early(MODULE)
    served.ServedProcess.start_early(MODULE)  # it runs already
    assert len(started) == 1
    assert [served.ServedProcess.of(MODULE) for _ in range(2)] == started
    assert len({each.pid for each in started}) == 2


def test_a_program_is_killed_once(started, monkeypatch):
    program = served.ServedProcess.of(MODULE)
    program.kill()
    killed = []
    monkeypatch.setattr(served.os, "kill", lambda *asked: killed.append(asked))
    program.kill()
    assert killed == []


def environment(pid):
    while not (found := Path(f"/proc/{pid}/environ").read_bytes()):
        os.sched_yield()  # empty until the program has its own memory
    return found


def test_the_shell_leaves_no_traces_in_a_program(started, monkeypatch):
    for name, value in (("PATH", "/elsewhere"), ("LANG", "C"), ("VIRTUAL_ENV", "/v"), ("X", "y")):
        served.ServedProcess.of(MODULE)
        monkeypatch.setenv(name, value)
    served.ServedProcess.of(MODULE)
    found = {environment(each.pid) for each in started}
    assert len(started) == 5
    assert len(found) == 1
    assert b"PYTHONHASHSEED=0" in found.pop()


def test_the_caches_are_chosen_before_the_first_program_starts(started, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")

    def choose():
        os.environ["NUMBA_CACHE_DIR"] = "/chosen"

    monkeypatch.setattr(served, "choose_caches", choose)
    served.ServedProcess.of(MODULE)
    assert b"NUMBA_CACHE_DIR=/chosen" in environment(started[0].pid)
