"""Isolated campaigns on our own kernels: repeatable, resumable, tolerant, told in full."""

import csv
import json
import re
from functools import partial

import pytest

from mavfi_cli.attack.campaign import replay_runs
from mavfi_cli.attack.kernels import catalogue
from mavfi_cli.attack.kernels import target as kernel_target
from mavfi_cli.attack.kernels.catalogue import pack
from mavfi_cli.attack.kernels.inputs import load_inputs
from mavfi_cli.attack.place import digest
from mavfi_cli.attack.profile import profile_run
from mavfi_cli.core.errors import BuildMismatch, ConfigError, RecordError, UnknownName
from mavfi_cli.core.files import write_json
from mavfi_cli.report.attacks import KERNEL_COLUMNS, save_runs, summarise
from mavfi_cli.report.table import WIDTH

OUTCOMES = {"benign", "crash", "hang", "sdc", "not_injected"}


def untimed(runs):
    """Records without what only says how long things took."""
    records = json.loads(json.dumps(runs.records))
    for entry in records:
        del entry["run_s"]
        entry["injection"].pop("stop_s", None)
    return records


@pytest.mark.slow
def test_neither_workers_nor_another_kernel_change_anything(control_campaign, attack):
    _, (alone,) = control_campaign
    _, (together, other) = attack("control", "point_cloud", runs=10, jobs=2)
    assert untimed(together) == untimed(alone)[:10]
    for runs in (together, other):
        assert {entry["outcome"] for entry in runs.records} <= OUTCOMES
        assert any(entry["injection"]["applied"] for entry in runs.records)


def test_the_golden_run_is_the_kernel_itself(control_campaign, kernel_inputs):
    _, (runs,) = control_campaign
    inputs, _ = load_inputs(kernel_inputs)
    calls = [catalogue.find("control").prepare(each) for each in inputs]
    golden = [digest(pack(call())) for call in calls]
    assert [each.sha256 for each in runs.goldens] == golden
    assert len(set(golden)) == 5


def test_every_input_is_struck_equally_often(control_campaign):
    plan, (runs,) = control_campaign
    assert [entry["input"] for entry in runs.records] == [0, 1, 2, 3, 4] * 6
    (kernel,) = summarise(plan, [runs]).as_dict()["kernels"]
    assert [sum(each["outcomes"].values()) for each in kernel["inputs"]] == [6] * 5
    golden = {each["golden"]["sha256"] for each in kernel["inputs"]}
    assert {e["output_sha256"] for e in runs.records if e["outcome"] == "benign"} <= golden


def test_a_fault_depends_on_its_number_only(attack, control_campaign):
    _, (many,) = control_campaign
    _, (few,) = attack("control", runs=5)
    assert untimed(few) == untimed(many)[:5]


@pytest.mark.slow
def test_other_seeds_draw_other_faults(attack, control_campaign):
    _, (many,) = control_campaign
    _, (other,) = attack("control", runs=5, seed=6)
    assert [e["corruption"] for e in other.records] != [e["corruption"] for e in many.records[:5]]


@pytest.mark.slow
def test_a_campaign_that_was_cut_off_goes_on(attack, control_campaign, control_copy):
    _, (first,) = control_campaign
    lines = (control_copy / "runs.jsonl").read_text().splitlines(keepends=True)
    (control_copy / "runs.jsonl").write_text("".join(lines[:3]) + lines[3][:40])
    _, (second,) = attack("control", runs=8, folder=control_copy)
    assert [entry["run"] for entry in second.records] == list(range(8))
    assert untimed(second) == untimed(first)[:8]
    took = [entry["run_s"] for entry in first.records]
    assert [entry["run_s"] for entry in second.records[:3]] == took[:3]


def test_another_campaign_is_not_mixed_in(attack, control_copy):
    with pytest.raises(ConfigError, match=r"\['tolerance'\]"):
        attack("control", runs=1, folder=control_copy, tolerance=0.5)


@pytest.mark.parametrize(
    ("kernels", "runs", "problem"),
    [
        (("control",), 29, "30 runs.* at least 30, got 29"),
        (("point_cloud",), 30, "also holds runs of control"),
    ],
)
def test_what_was_measured_is_never_left_out(attack, control_copy, kernels, runs, problem):
    before = {path.name: path.read_bytes() for path in control_copy.iterdir()}
    with pytest.raises(ConfigError, match=problem):
        attack(*kernels, runs=runs, folder=control_copy)
    assert {path.name: path.read_bytes() for path in control_copy.iterdir()} == before


@pytest.mark.slow
def test_more_runs_and_kernels_go_on_from_fewer(attack, two_inputs, tmp_path):
    attack_some = partial(attack, folder=tmp_path, inputs=two_inputs)
    _, (first,) = attack_some("control", runs=10)
    _, (control, cloud) = attack_some("control", "point_cloud", runs=11)
    assert list(control.records[:10]) == list(first.records)
    assert (len(control.records), len(cloud.records)) == (11, 11)


@pytest.mark.slow
def test_recorded_runs_repeat(control_copy):
    replays = list(replay_runs(control_copy, ("control",)))
    assert [replay.differs for replay in replays] == [()] * 30
    line = json.loads((control_copy / "runs.jsonl").read_text().splitlines()[0])
    line["output_sha256"] = "0"
    (control_copy / "runs.jsonl").write_text(json.dumps(line) + "\n")
    (replay,) = replay_runs(control_copy)
    assert replay.differs == ("output_sha256",)


def test_runs_of_other_code_are_not_replayed(control_copy):
    plan = json.loads((control_copy / "plan.json").read_text())
    write_json(control_copy / "plan.json", plan | {"sources": "of another version"})
    with pytest.raises(BuildMismatch, match="own code differs"):
        list(replay_runs(control_copy))


@pytest.mark.parametrize(
    ("name", "value", "problem"),
    [
        ("build_ids", None, "build_ids: must be a table"),
        ("trigger", None, "trigger: must be an array"),
        ("corruption", {"register": "x"}, "it has no corruption.site"),
        ("injection", "theirs", "injection: must be a table"),
        ("input", "theirs", "input: must be a whole number"),
        ("input", 99, "a run has an unknown input number, 99"),
        ("run", [0], "holds no run that can be repeated"),  # skipped as an incomplete line is
    ],
)
def test_a_damaged_run_is_not_replayed(name, value, problem, control_copy):
    line = json.loads((control_copy / "runs.jsonl").read_text().splitlines()[0])
    (control_copy / "runs.jsonl").write_text(json.dumps(line | {name: value}) + "\n")
    with pytest.raises(RecordError, match=problem):
        list(replay_runs(control_copy, ("control",)))


def test_a_run_that_is_not_utf_8_is_skipped_as_an_incomplete_one_is(control_copy):
    path = control_copy / "runs.jsonl"
    path.write_bytes(path.read_bytes().replace(b'"kernel": "control"', b'"kernel": "contr\xff"', 1))
    assert len(list(replay_runs(control_copy, ("control",)))) == 29


def test_nothing_to_replay_is_an_error(tmp_path):
    with pytest.raises(RecordError, match=r"plan\.json"):
        list(replay_runs(tmp_path))


@pytest.mark.slow
def test_tolerance_makes_small_corruption_benign(attack, control_campaign):
    _, (strict,) = control_campaign
    _, (lenient,) = attack("control", runs=30, tolerance=1e300)
    changed = 0
    for before, after in zip(strict.records, lenient.records, strict=True):
        size = before["magnitude"]["relative"] if before["outcome"] == "sdc" else None
        if size is None:
            assert after["outcome"] == before["outcome"]
        else:
            changed += 1
            assert (after["outcome"], after["within_tolerance"]) == ("benign", True)
            assert after["magnitude"]["relative"] == size > 0.0
    assert changed


def test_null_injections_are_benign(attack):
    _, (runs,) = attack("control", runs=5, null=True)
    assert {entry["outcome"] for entry in runs.records} == {"benign"}
    assert {entry["injection"]["applied"] for entry in runs.records} == {False}


def test_time_rules_say_what_they_missed(attack, two_inputs):
    plan, (runs,) = attack("point_cloud", runs=6, rule="cpu-time", inputs=two_inputs)
    for entry in runs.records:
        assert (entry["outcome"] == "not_injected") == bool(entry["not_injected_reason"])
    (kernel,) = summarise(plan, [runs]).as_dict()["kernels"]
    assert {each["complete"] for each in kernel["inputs"]} == {None}


@pytest.mark.slow
def test_the_planner_is_attacked_in_its_own_library(attack, two_inputs):
    _, (runs,) = attack("rrtconnect", runs=10, inputs=two_inputs)
    assert {entry["object"] for entry in runs.records} <= {"libompl.so", "numba:segment_free"}
    assert all(each.complete for each in runs.profiles)


@pytest.mark.slow
def test_a_long_kernel_is_attacked_in_sampled_windows(attack, two_inputs, monkeypatch, tmp_path):
    monkeypatch.setattr(kernel_target, "profile_run", partial(profile_run, enough=0))
    (tmp_path / "inputs.npz").write_bytes(two_inputs.read_bytes())
    plan, (runs,) = attack("collision_check", runs=8, windows=3, folder=tmp_path, inputs=two_inputs)
    (kernel,) = summarise(plan, [runs]).as_dict()["kernels"]
    for number, profile in enumerate(runs.profiles):
        start, pilot, windows = profile.strata
        assert start.marker is None
        assert (len(pilot.segments), pilot.complete) == (2, True)
        assert (len(windows.segments), windows.complete) == (4, False)
        hit = {profile.window_of(entry) for entry in runs.records_of(number)} - {None}
        assert hit <= {(2, segment.start[0].count) for segment in windows.segments}
        told, count = kernel["inputs"][number], 2 + windows.windows_in_run
        assert f"6 of {count} windows from collide" in told["population"]
        low, high = told["instructions95"]
        assert profile.executed <= low < told["instructions"] < high
    assert all(not replay.differs for replay in replay_runs(tmp_path))


@pytest.mark.slow
def test_the_writing_of_the_tree_is_not_attacked_but_the_whole_tree_is_compared(
    attack, two_inputs, monkeypatch
):
    monkeypatch.setattr(kernel_target, "profile_run", partial(profile_run, enough=0))
    plan, (runs,) = attack("octomap", runs=15, windows=3, inputs=two_inputs)
    profile = runs.profiles[0]
    addresses = {
        int(address)
        for stratum in profile.strata
        for segment in stratum.segments
        for address in segment.trace
    }
    symbols = {profile.image.symbol(profile.image.locate(address)) for address in addresses}
    assert any("computeRayKeys" in symbol for symbol in symbols)
    assert not any("write" in symbol for symbol in symbols)
    corrupted = [e["magnitude"] for e in runs.records if e["outcome"] == "sdc"]
    assert corrupted
    assert all(size["parts"]["nodes"] > 0 or size["noticeable"] for size in corrupted)
    (kernel,) = summarise(plan, [runs]).as_dict()["kernels"]
    assert kernel["sdc_parts"]["nodes"]["runs"] <= len(corrupted)
    assert kernel["sdc_noticeable"]["count"] <= len(corrupted)


def test_the_summary_has_what_numbers_depend_on(control_campaign, tmp_path):
    plan, campaign = control_campaign
    summary = summarise(plan, campaign)
    plain = summary.as_dict()
    assert json.loads(json.dumps(plain, allow_nan=False)) == plain
    (kernel,) = plain["kernels"]
    assert set(kernel["outcomes"]) == OUTCOMES
    assert sum(row["count"] for row in kernel["outcomes"].values()) == kernel["runs"] == 30
    assert sum(kernel["crashes"].values()) == kernel["outcomes"]["crash"]["count"]
    for row in kernel["outcomes"].values():
        low, high = row["wilson95"]
        assert 0.0 <= low <= row["share"] <= high <= 1.0
    text = summary.text()
    assert "sampling: instruction-uniform" in text
    assert "input 4: all" in text
    assert max(len(line) for line in text.split("\n") if line.startswith("  ")) <= WIDTH  # notes
    files = save_runs(tmp_path, summary, campaign)
    first = {name: (tmp_path / name).read_bytes() for name in files}
    save_runs(tmp_path, summary, campaign)
    assert {name: (tmp_path / name).read_bytes() for name in files} == first
    assert json.loads((tmp_path / "kernels.json").read_text()) == plain
    rows = list(csv.reader((tmp_path / "kernels.csv").read_text().splitlines()))
    assert rows[0] == KERNEL_COLUMNS
    assert len(rows) == 31
    assert b"PID" in first["kernels.svg"]


def test_an_unknown_kernel_names_the_nearest():
    with pytest.raises(UnknownName, match="did you mean 'octomap'"):
        catalogue.select(["octomp"])


def test_kernels_come_in_the_order_of_the_pipeline():
    assert catalogue.select(["control", "point_cloud"]) == ("point_cloud", "control")
    assert len(catalogue.select([])) == 7


def test_inputs_of_something_else_are_refused(tmp_path):
    path = tmp_path / "inputs.npz"
    path.write_bytes(b"nothing of the kind")
    with pytest.raises(RecordError, match="not a file of"):
        load_inputs(path)


def test_the_command_line_refuses_what_makes_no_sense(mavfi):
    asked = mavfi("kernels", "--kernel", "contrl", "--runs", "1")
    assert asked.returncode == 2
    assert re.match(r"error: --kernel: .*'contrl'.*'control'\?", asked.stderr)
    assert mavfi("kernels", "--args", "5").returncode == 2
    assert mavfi("kernels", "--program", "/bin/true", "--kernel", "rrt").returncode == 2
    for option in (["--json"], ["--seed", "1"], ["--jobs", "2"]):
        asked = mavfi("kernels", "--replay", ".", *option)
        assert asked.returncode == 2
        assert re.search(f"error: {option[0]} .* --replay", asked.stderr)
    asked = mavfi("kernels", "--compat", "pinfi", "--field", "sign")
    assert asked.returncode == 2
    assert re.search("--field .* --compat", asked.stderr)
    asked = mavfi("kernels", "--kernel", "control", "--sampling", "instruction")
    assert asked.returncode == 2
    assert "instruction-uniform" in asked.stderr
