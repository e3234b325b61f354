"""Missions that branch off each other in a slot: each has its own end, limit and report."""

import os
import signal
import time

import pytest
from test_run import alive

from mavfi_cli.campaign.slots.keeper import UNBORN
from mavfi_cli.campaign.slots.local import Slots
from mavfi_cli.campaign.slots.seats import Assignment


@pytest.fixture
def slots():
    with Slots(1, "fake_task") as seats:
        yield seats


@pytest.fixture
def start(slots, tmp_path):
    """Start missions of these worlds together; what was heard, in the order of hearing."""

    def fly(*worlds, limit_s=60.0):
        work = tmp_path / "campaign" / "work"
        work.mkdir(parents=True, exist_ok=True)
        missions = []
        for number, world in enumerate(worlds):
            out = work / f"{number}-{time.monotonic_ns()}"
            out.mkdir()
            missions.append(
                Assignment(number=number, changes={"world": world, "seed": number}, out=str(out))
            )
        slots.start(missions, limit_s)
        return missions

    return fly


def ends(slots, count):
    found = []
    while len(found) < count:
        found += slots.wait(60.0)
    return found


def test_each_has_its_own_end_and_report(slots, start):
    worlds = ("fly", "fly", f"signal:{int(signal.SIGSEGV)}", "exit:3", "blocked", "defect")
    start(*worlds)
    by_number = {ended.number: ended for ended in ends(slots, len(worlds))}
    assert [by_number[n].report["folder"] for n in (0, 1)] == ["fly-0-001", "fly-1-001"]
    assert by_number[2].signal == signal.SIGSEGV
    assert by_number[3].exit == 3
    assert by_number[4].report["text"] == "the start is blocked"
    assert by_number[5].report["traceback"].endswith("ZeroDivisionError: a defect\n")
    assert [by_number[n].exit for n in (0, 1, 4, 5)] == [0, 0, 1, 1]
    assert slots.free == 1


def test_a_branch_that_ends_well_is_reported_before_the_flight_that_it_left(slots, start):
    start("fly", "fly", "fly")
    assert [ended.number for ended in ends(slots, 3)] == [1, 2, 0]


def test_what_runs_out_of_time_is_killed_alone_and_pauses_do_not_count(slots, start):
    start("sleep:1.2", "sleep:600", "sleep:1.2", limit_s=2.0)
    by_number = {ended.number: ended for ended in ends(slots, 3)}
    assert [by_number[n].timeout for n in range(3)] == [False, True, False]
    assert [by_number[n].exit for n in range(3)] == [0, None, 0]
    assert all(ended.wall_s < 4.0 for ended in by_number.values())


def test_what_never_branched_off_is_lost(slots, start):
    start("fly", "left-out", "fly")
    by_number = {ended.number: ended for ended in ends(slots, 3)}
    assert by_number[1].lost == UNBORN
    assert by_number[1].exit is None
    assert by_number[1].signal is None
    assert [by_number[n].exit for n in (0, 2)] == [0, 0]


def test_a_killed_flight_leaves_its_branch_flying_and_the_rest_lost(slots, start):
    start("fly", "sleep:2.0", "fly")
    while not slots.running.get(1):
        slots.wait(0.05)
    os.kill(slots.running[0], signal.SIGKILL)
    by_number = {ended.number: ended for ended in ends(slots, 3)}
    assert by_number[0].signal == signal.SIGKILL
    assert by_number[1].exit == 0
    assert by_number[2].lost == UNBORN


def test_nothing_of_a_branch_is_left(slots, start, tmp_path):
    start("fly", "orphan")
    ends(slots, 2)
    assert not alive(int((tmp_path / "campaign" / "orphan.pid").read_text()))


def test_closing_ends_all_of_them(slots, start):
    start("fly", "sleep:600")
    while not slots.running.get(1):
        slots.wait(0.05)
    pids = list(slots.running.values())
    slots.close()
    assert not any(map(alive, pids))
