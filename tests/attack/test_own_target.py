"""The driver attacks whatever fulfils its protocol."""

from dataclasses import dataclass

import pytest
from own_target import OwnPlace, OwnTarget

from mavfi_cli.attack.campaign import Plan, run_campaign
from mavfi_cli.attack.comparison import OutputComparison
from mavfi_cli.attack.program import ProgramTarget
from mavfi_cli.core.errors import TargetError
from mavfi_cli.fi.tracer.spawn import Program

DRAWN = ("object", "offset", "k", "corruption")


def records(target, jobs=1, folder=None):
    (runs,) = run_campaign(Plan(runs=30, seed=4), [target], jobs=jobs, folder=folder)
    return runs.records


@pytest.fixture
def own(native_program, tmp_path):
    return OwnTarget(program=native_program("counting"), scratch=tmp_path)


def test_a_target_of_ones_own_gets_the_faults_that_a_program_gets(own):
    command = Program.of([str(own.program), "30"])
    program = records(
        ProgramTarget(command=command, comparison=OutputComparison(), limits=OwnPlace.limits)
    )
    ours = records(own)
    assert [[e[key] for key in DRAWN] for e in ours] == [[e[key] for key in DRAWN] for e in program]
    ends = {
        (theirs["outcome"], mine["outcome"]) for theirs, mine in zip(program, ours, strict=True)
    }
    assert ("crash", "crash") in ends
    assert {theirs for theirs, mine in ends if theirs != mine} <= {"sdc"}  # in the last digit


@pytest.mark.slow
def test_workers_and_folders_serve_it_as_well(own, tmp_path):
    alone = records(own)
    together = records(own, jobs=2, folder=tmp_path / "folder")
    assert [e["outcome"] for e in together] == [e["outcome"] for e in alone]
    assert records(own, folder=tmp_path / "folder") == together


def test_a_target_that_is_no_plain_value_is_refused_by_name(own):
    @dataclass(frozen=True, kw_only=True)
    class Local(OwnTarget):
        """A worker process cannot find this class."""

    local = Local(program=own.program, scratch=own.scratch)
    assert records(local)
    with pytest.raises(TargetError, match=r"^own: .*Local"):
        records(local, jobs=2)
