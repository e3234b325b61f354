"""Programs that are counted by callgrind instead of being stepped."""

import re
import shutil
from collections import Counter

import numpy as np
import pytest

from mavfi_cli.attack import profile as profiles
from mavfi_cli.attack import program as programs
from mavfi_cli.attack.campaign import Plan, run_campaign
from mavfi_cli.attack.comparison import OutputComparison
from mavfi_cli.attack.program import ProgramTarget
from mavfi_cli.core.errors import TargetError
from mavfi_cli.fi.tracer import record
from mavfi_cli.fi.tracer.spawn import Program
from mavfi_cli.report.attacks import summarise, table

pytestmark = pytest.mark.skipif(shutil.which("valgrind") is None, reason="valgrind is missing")


@pytest.fixture
def place(native_program):
    places = []

    def make(name, *arguments):
        command = Program.of([str(native_program(name)), *arguments])
        places.append(ProgramTarget(command=command, comparison=OutputComparison()).open())
        return places[-1]

    yield make
    for each in places:
        each.close()


@pytest.mark.parametrize(
    ("name", "arguments"), [("counting", ("300",)), ("flows", ()), ("sorting", ())]
)
def test_callgrind_counts_what_is_stepped(place, monkeypatch, name, arguments):
    where = place(name, *arguments)
    stepped = where.profile(np.random.default_rng(1))
    monkeypatch.setattr(programs, "_SHORT", 0)
    counted = where.profile(np.random.default_rng(1))
    (window,), run = stepped.strata[0].segments, counted.counted
    assert stepped.counted is None
    assert Counter(window.trace.tolist()) == dict(zip(run.addresses, run.counts, strict=True))


def test_a_long_program_is_attacked_whole(native_program):
    command = Program.of([str(native_program("counting")), "300000"])
    target = ProgramTarget(command=command, comparison=OutputComparison())
    plan = Plan(runs=12, seed=3)
    (runs,) = run_campaign(plan, [target])
    assert runs.profile.instructions.value > 1e6
    assert max(entry["k"] for entry in runs.records) > 100_000
    assert not any(entry["not_injected_reason"] for entry in runs.records)
    again = [record.fault_of(entry) for entry in runs.records]
    assert [fault.trigger[-1].location.offset for fault in again] == [
        entry["offset"] for entry in runs.records
    ]
    summary = summarise(plan, [runs])
    assert summary["counted"]
    assert summary["not_reached"] < 0.02
    assert "counted by callgrind; 0 % of the executions are not reached" in table(summary)


def test_it_tells_how_long_callgrind_counts_and_may_count(native_program, monkeypatch):
    monkeypatch.setattr(programs, "_TOLD_EVERY_S", 0.01)
    told = []
    command = Program.of([str(native_program("counting")), "300000"])
    target = ProgramTarget(command=command, comparison=OutputComparison())
    run_campaign(Plan(runs=1, seed=1), [target], stage=told.append)
    waiting = [text for text in told if "callgrind" in text]
    assert len(waiting) > 5
    form = re.compile(r"profile, counted by callgrind, \d+ s of at most (\d+) s")
    limits = {form.fullmatch(text)[1] for text in waiting}
    assert len(limits) == 1
    stepped = next(text for text in told if text.endswith("instructions stepped"))
    assert told.index(stepped) < told.index(waiting[0])


def test_counts_that_are_not_those_of_a_run_are_refused(place, monkeypatch):
    where = place("counting", "60000")
    true_counts = programs._read_counts
    monkeypatch.setattr(
        programs,
        "_read_counts",
        lambda *given: {
            path: {at: n - (n > 50_000) for at, n in found.items()}
            for path, found in true_counts(*given).items()
        },
    )
    with pytest.raises(TargetError, match="more often than the 59999 times that callgrind counts"):
        where.profile(np.random.default_rng(1))


def test_without_valgrind_a_long_program_is_refused_by_advice(place, monkeypatch):
    monkeypatch.setattr(programs, "_callgrind", lambda: None)
    monkeypatch.setattr(profiles, "STEPS", 1000)
    where = place("counting", "60000")
    where.limits = programs.RunLimits(profile_steps=1000)
    with pytest.raises(TargetError, match="counted whole where valgrind is installed"):
        where.profile(np.random.default_rng(1))
