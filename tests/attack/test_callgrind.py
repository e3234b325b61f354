"""Programs that are counted by callgrind instead of being stepped."""

import re
import shutil
from collections import Counter

import numpy as np
import pytest

from mavfi_cli.attack import callgrind
from mavfi_cli.attack import profile as profiles
from mavfi_cli.attack import program as programs
from mavfi_cli.attack.campaign import Plan, run_campaign
from mavfi_cli.attack.comparison import OutputComparison
from mavfi_cli.attack.place import Golden
from mavfi_cli.attack.program import ProgramTarget
from mavfi_cli.core.errors import TargetError
from mavfi_cli.fi.tracer import record
from mavfi_cli.fi.tracer.spawn import Program
from mavfi_cli.report.attacks import summarise

pytestmark = pytest.mark.skipif(shutil.which("valgrind") is None, reason="valgrind is missing")


@pytest.fixture
def place(native_program):
    places = []

    def make(name, *arguments, options=()):
        command = Program.of([str(native_program(name, *options)), *arguments])
        places.append(ProgramTarget(command=command, comparison=OutputComparison()).open())
        return places[-1]

    yield make
    for each in places:
        each.close()


BARE = ("-nostdlib", "-static")


@pytest.mark.parametrize(
    ("name", "arguments", "options", "blocks", "last"),
    [
        ("counting", ("300",), (), callgrind._BLOCKS, 0),
        ("counting", ("300",), (), 200, 0),  # by many files
        ("flows", (), (), callgrind._BLOCKS, 0),
        ("sorting", (), (), callgrind._BLOCKS, 0),
        ("bare", (), BARE, callgrind._BLOCKS, 5),
    ],
)
def test_callgrind_counts_what_is_stepped(
    place, monkeypatch, name, arguments, options, blocks, last
):
    """But for the last instructions in scope, if the exit system call ends their block."""
    where = place(name, *arguments, options=options)
    stepped = where.profile(np.random.default_rng(1))
    monkeypatch.setattr(programs, "_SHORT", 0)
    monkeypatch.setattr(callgrind, "_BLOCKS", blocks)
    counted = where.profile(np.random.default_rng(1))
    (window,), run = stepped.strata[0].segments, counted.counted
    assert stepped.counted is None
    trace = window.trace[: len(window.trace) - last].tolist()
    assert Counter(trace) == dict(zip(run.addresses, run.counts, strict=True))
    assert list(where._counts.parent.glob("counts*")) == []


def test_code_that_callgrind_cannot_name_is_refused_with_the_reason(place, monkeypatch):
    where = place("counting", "300")
    unnamed = {callgrind.UNNAMED: {0x109100: 70_000}, "/elsewhere": {0x100: 1}}
    with pytest.raises(TargetError, match="no writable data"):
        profiles.profile_counted(where, np.random.default_rng(1), unnamed, begun=0.0)


@pytest.mark.slow
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
    assert summary.as_dict()["counted"]
    assert summary.as_dict()["not_reached"] < 0.02
    assert "callgrind; 0 % of the executions" in summary.text()


def test_it_tells_how_fast_callgrind_counts_and_when_it_ends(native_program, monkeypatch):
    monkeypatch.setattr(callgrind, "_REPORT_EVERY_S", 0.01)
    monkeypatch.setattr(callgrind, "_BLOCKS", 50_000)
    told = []
    command = Program.of([str(native_program("counting")), "100000"])
    target = ProgramTarget(command=command, comparison=OutputComparison())
    run_campaign(Plan(runs=1, seed=1), [target], stage=told.append)
    waiting = [text for text in told if "callgrind" in text]
    assert len(waiting) > 5
    assert len({re.search(r" \d+ s of at most (\d+) s", text)[1] for text in waiting}) == 1
    assert re.search(r"; [\d.e+]+ million .*; about \d+ s left$", waiting[-1])
    stepped = next(text for text in told if text.endswith("instructions stepped"))
    assert told.index(stepped) < told.index(waiting[0])


def test_the_native_time_is_of_a_run_that_executes_as_much(place):
    where = place("counting", "60000")
    path = where.target.command.argv[0]
    with profiles.started(where) as tracee:
        body = where.image(tracee).function("body", where.target.scope_objects).offset
    assert profiles.native_time_s(where, {path: {body: 30_000}}) > 0
    assert profiles.native_time_s(where, {path: {body: 60_001}}) is None
    assert profiles.native_time_s(where, {"/elsewhere": {body: 30_000}}) is None


def test_the_time_left_follows_from_the_native_time(tmp_path, monkeypatch):
    golden = Golden(output=b"", cpu_s=8.0, wall_s=9.0)
    now_s = iter((10.0, 12.0, 15.0, 15.0))
    monkeypatch.setattr(callgrind.time, "monotonic", lambda: next(now_s))
    count = callgrind._Count(
        counts=tmp_path / "counts", golden=golden, native_s=lambda _: 2.0, begun_s=0.0
    )
    (tmp_path / "counts.1").write_text("ob=/a\n0x10 0 30000000\n0x14 0 5000000\ntotals: 35000000\n")
    (tmp_path / "counts.2").write_text("ob=/a\n0x10 0 30000000\n")  # not finished
    told = count.update()
    assert re.findall(r"[\d.]+", told) == ["12", "1860", "3.5", "28"]  # s, s, million a second, s
    assert " 25 s left" in count.update()


@pytest.mark.slow
def test_counts_that_are_not_those_of_a_run_are_refused(place, monkeypatch):
    where = place("counting", "60000")
    true_counts = callgrind._read_counts
    monkeypatch.setattr(
        callgrind,
        "_read_counts",
        lambda *given: {
            path: {at: n - (n > 50_000) for at, n in found.items()}
            for path, found in true_counts(*given).items()
        },
    )
    with pytest.raises(TargetError, match=r"59999 times .*callgrind"):
        where.profile(np.random.default_rng(1))


def test_without_valgrind_a_long_program_is_refused_by_advice(place, monkeypatch):
    monkeypatch.setattr(programs, "find_valgrind", lambda: None)
    monkeypatch.setattr(profiles, "STEPS", 1000)
    where = place("counting", "60000")
    where.limits = programs.RunLimits(profile_steps=1000)
    with pytest.raises(TargetError, match="install valgrind"):
        where.profile(np.random.default_rng(1))
