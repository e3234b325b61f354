"""Runs without a flip come first, by turns from every counting method, and must repeat."""

import shutil
from types import SimpleNamespace

import numpy as np
import pytest

from mavfi_cli.attack import program as programs
from mavfi_cli.attack.campaign import Plan, run_campaign
from mavfi_cli.attack.comparison import OutputComparison
from mavfi_cli.attack.null_runs import NULL_RUNS, make_null_runs
from mavfi_cli.attack.program import ProgramTarget
from mavfi_cli.attack.target import RunLimits, RunOutcome
from mavfi_cli.core.errors import TargetError
from mavfi_cli.fi.tracer.counted import Counting
from mavfi_cli.fi.tracer.spawn import Program
from mavfi_cli.report.attacks import summarise

FAR, NEAR, BREAKPOINT = (method.value for method in Counting)


@pytest.fixture
def target(native_program):
    def make(name, *arguments):
        command = Program.of([str(native_program(name)), *arguments])
        limits = RunLimits(cpu_grace_s=0.1, wall_grace_s=3.0)
        return ProgramTarget(command=command, comparison=OutputComparison(), limits=limits)

    return make


def test_every_counting_method_is_tried_and_the_bound_stands_beside_the_sdc(target):
    plan = Plan(runs=2, seed=1)
    (runs,) = run_campaign(plan, [target("counting", "300")])
    assert set(runs.null_runs.counting) == {NEAR, BREAKPOINT}
    assert min(runs.null_runs.counting.values()) >= 5
    summary = summarise(plan, [runs])
    assert summary.counts.null_runs.reached == NULL_RUNS == 20
    lines = summary.text().splitlines()
    (sdc,) = (line for line in lines if line.startswith("SDC"))
    assert sdc.endswith("(without a flip: 0.0 to 13.9 %)")
    (null,) = (line for line in lines if line.startswith("null runs: 20 equal ("))
    assert null.endswith("at most 13.9 % differ (95 % bound)")


@pytest.mark.skipif(shutil.which("valgrind") is None, reason="valgrind is missing")
@pytest.mark.parametrize(
    ("name", "counted", "unused"),
    [
        ("beside", True, (FAR,)),
        ("introspective", True, (FAR, NEAR)),
        ("introspective", False, (FAR, NEAR)),
    ],
)
def test_a_detour_that_changes_the_output_is_not_used(target, monkeypatch, name, counted, unused):
    if counted:
        monkeypatch.setattr(programs, "_SHORT", 0)
    program, notices, plan = target(name, "600"), [], Plan(runs=20, seed=2, null=True)
    place = program.open()
    assert bool(place.profile(np.random.default_rng(1)).counted) == counted
    place.close()
    (runs,) = run_campaign(plan, [program], notice=notices.append)
    assert runs.null_runs.unused == unused
    assert len(notices) == len(unused)
    for text, method in zip(notices, unused, strict=True):
        assert text.startswith(f"{name} ")
        assert f"a {method} counts" in text
    assert {entry["outcome"] for entry in runs.records} == {"benign"}
    stages = [stage for entry in runs.records for stage in entry["trigger"]]
    assert max(stage["count"] for stage in stages) > 100
    assert f": {', '.join(unused)}" in summarise(plan, [runs]).text()


@pytest.fixture
def echoing(target, tmp_path):
    """A program whose output is a file's, with that file."""
    path = tmp_path / "printed"
    path.write_text("before")
    return target("echoing", str(path)), path


@pytest.mark.parametrize("rule", ["instruction-uniform", "cpu-time"])
def test_a_difference_before_the_first_fault_is_refused(echoing, tmp_path, rule):
    program, path = echoing
    method = {"instruction-uniform": NEAR, "cpu-time": "timer"}[rule]

    def change(text):
        if text == "null runs":
            path.write_text("after")

    with pytest.raises(TargetError, match=rf" {method}: \d+ of \d+ \(SDC"):
        run_campaign(
            Plan(runs=3, seed=1, rule=rule), [program], folder=tmp_path / "out", stage=change
        )
    assert not (tmp_path / "out" / "runs.jsonl").exists()


def test_a_difference_after_the_faults_is_refused_and_not_resumed(echoing, tmp_path):
    program, path = echoing
    plan, folder = Plan(runs=6, seed=1), tmp_path / "out"

    def change(_, done):
        if done == 3:
            path.write_text("after")

    with pytest.raises(TargetError, match="no longer ends as the golden run"):
        run_campaign(plan, [program], folder=folder, progress=change)
    path.write_text("later")
    (runs,) = run_campaign(plan, [program], folder=folder)
    assert len((folder / "runs.jsonl").read_text().splitlines()) == 12  # all are made again
    assert {entry["golden_sha256"] for entry in runs.records} == {runs.golden.sha256}
    run_campaign(plan, [program], folder=folder)
    assert len((folder / "runs.jsonl").read_text().splitlines()) == 12


def test_a_program_that_prints_the_second_is_refused_however_short_the_campaign(target):
    """Golden runs, null runs and runs would end within one second, so the last null run waits."""
    with pytest.raises(TargetError, match=r"^seconds: .* (differ|no longer ends)"):
        run_campaign(Plan(runs=1, seed=1), [target("seconds")])


def test_a_time_rule_leaves_out_flips_too(target):
    plan = Plan(runs=6, seed=6, rule="cpu-time", null=True)
    (runs,) = run_campaign(plan, [target("counting", "4000000")])
    assert any(entry.get("instruction") for entry in runs.records)
    assert not any(entry["injection"]["applied"] for entry in runs.records)
    # A run that ended before its moment came is `not_injected`.
    outcomes = {entry["outcome"] for entry in runs.records}
    assert "benign" in outcomes
    assert outcomes <= {"benign", "not_injected"}


def test_an_output_that_differs_by_chance_is_not_put_down_to_a_detour(target):
    """The null run that differed is repeated: a detour would change its output every time."""
    place = target("counting", "300").open()
    profile = place.profile(np.random.default_rng(1))
    place.close()
    plan, made = Plan(runs=1, seed=1), []

    def run(tasks):
        for number, fault in tasks:
            made.append(number)
            unlike = len(made) == 1
            outcome = RunOutcome.SDC if unlike else RunOutcome.BENIGN
            verdict = SimpleNamespace(outcome=outcome)
            yield number, SimpleNamespace(verdict=verdict, fault=fault, reason="")

    def draw(_, number):
        return profile.draw(plan.strategy(), np.random.default_rng(number))

    with pytest.raises(TargetError, match=rf"{NEAR}: 1 of \d+ \(SDC 1\); {BREAKPOINT}: 0 of \d+"):
        make_null_runs("guest", (profile,), draw, run)
    assert len(made) == NULL_RUNS + 3
