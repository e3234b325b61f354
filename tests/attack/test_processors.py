"""Campaigns that run at the same time do not share a processor while another is free."""

import contextlib
import os
import socket
import subprocess
import sys

import pytest

from mavfi_cli.attack import campaign
from mavfi_cli.attack.campaign import Plan, one_processor, run_campaign
from mavfi_cli.attack.comparison import OutputComparison
from mavfi_cli.attack.program import ProgramTarget
from mavfi_cli.fi.tracer.spawn import Program

HOLDER = """
import os, sys
from mavfi_cli.attack.campaign import one_processor
with one_processor():
    print(*os.sched_getaffinity(0), flush=True)
    sys.stdin.read()
"""


@contextlib.contextmanager
def another_campaign():
    """The processors of another process, while that is attacking."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        yield set(map(int, process.stdout.readline().split()))
    finally:
        process.communicate("")


def test_two_campaigns_stay_on_different_processors():
    before = os.sched_getaffinity(0)
    if len(before) < 2:
        pytest.skip("one processor")
    with another_campaign() as theirs, one_processor():
        ours = os.sched_getaffinity(0)
        assert len(ours) == len(theirs) == 1
        if any(map(is_free, before)):  # else other campaigns use all that are left
            assert ours != theirs
    assert os.sched_getaffinity(0) == before


def is_free(processor):
    with contextlib.closing(socket.socket(socket.AF_UNIX)) as claim:
        try:
            claim.bind(f"\0mavfi-processor-{processor}")
        except OSError:
            return False
    return True


def test_a_campaign_stays_where_it_began_until_it_is_over(native_program):
    program = ProgramTarget(
        command=Program.of([str(native_program("counting")), "9"]), comparison=OutputComparison()
    )
    with one_processor():
        ours = os.sched_getaffinity(0)
    with one_processor():
        assert os.sched_getaffinity(0) == ours
    with another_campaign() as theirs:
        assert theirs != ours or not any(map(is_free, os.sched_getaffinity(0)))
    (claim,) = campaign._claims
    if claim.getsockname():  # else other campaigns had claimed all, and this one shares
        assert not any(is_free(processor) for processor in ours)
    run_campaign(Plan(runs=1, seed=1), [program])
    assert not campaign._claims
