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
from mavfi_cli.attack.campaign import _claims, one_processor
with one_processor():
    print(*os.sched_getaffinity(0), int(bool(_claims[-1].getsockname())), flush=True)
    sys.stdin.read()
"""


@contextlib.contextmanager
def another_campaign():
    """The processors of another process while that is attacking, and whether it has claimed one.

    It has none of its own if the campaigns of other tests have claimed all of them.
    """
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        *processors, claimed = map(int, process.stdout.readline().split())
        yield set(processors), bool(claimed)
    finally:
        process.communicate("")


def test_two_campaigns_stay_on_different_processors():
    before = os.sched_getaffinity(0)
    if len(before) < 2:
        pytest.skip("one processor")
    with another_campaign() as (theirs, they_claimed), one_processor():
        ours = os.sched_getaffinity(0)
        assert len(ours) == len(theirs) == 1
        if they_claimed and campaign._claims[-1].getsockname():
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
    (claim,) = campaign._claims
    if claim.getsockname():  # else the campaigns of other tests have claimed all
        with another_campaign() as (theirs, they_claimed):
            assert not they_claimed or theirs != ours
        assert not any(map(is_free, ours))
    run_campaign(Plan(runs=1, seed=1), [program])
    assert not campaign._claims
