"""Outcomes that are known, faults that repeat, records that refuse another build."""

import csv
import json
import re
from dataclasses import replace
from operator import itemgetter
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from native_programs import register_corruption

from mavfi_cli.attack.attacker import Attacker, golden_run
from mavfi_cli.attack.campaign import Plan, replay_runs, run_campaign
from mavfi_cli.attack.comparison import OutputComparison
from mavfi_cli.attack.journal import read_runs
from mavfi_cli.attack.place import digest
from mavfi_cli.attack.program import ProgramTarget
from mavfi_cli.attack.target import RunLimits, RunOutcome
from mavfi_cli.core.errors import BuildMismatch, ConfigError, FaultError, RecordError, TargetError
from mavfi_cli.core.seeds import Stream
from mavfi_cli.fi.tracer import record
from mavfi_cli.fi.tracer.counted import CountedStop
from mavfi_cli.fi.tracer.decode import decode
from mavfi_cli.fi.tracer.fault import DATA_REGISTERS, FaultModel, InstructionFault, Role, Site
from mavfi_cli.fi.tracer.image import Image
from mavfi_cli.fi.tracer.inject import BitActivation
from mavfi_cli.fi.tracer.spawn import Program
from mavfi_cli.fi.tracer.tracee import Mechanism
from mavfi_cli.report.attacks import PROGRAM_COLUMNS, summarise

QUICK = RunLimits(cpu_grace_s=0.1, wall_grace_s=3.0)


def attacked(program, jobs=1, folder=None, **plan):
    """All runs of a campaign on one program."""
    (runs,) = run_campaign(Plan(**plan), [program], jobs=jobs, folder=folder)
    return runs


@pytest.fixture
def target(native_program):
    def make(name, *arguments, **options):
        command = Program.of([str(native_program(name)), *arguments])
        options.setdefault("comparison", OutputComparison())
        return ProgramTarget(command=command, limits=QUICK, **options)

    return make


@pytest.fixture
def workplace():
    places = []

    def make(target):
        places.append(target.open())
        return places[-1]

    yield make
    for place in places:
        place.close()


def victim_fault(place, target, bit):
    """Bit of r10 right after the victim's `mov ..., %r10`."""
    tracee = place.start()
    image = Image(tracee.pid)
    here = image.function("victim", [target.name])
    address = image.address(here)
    while True:
        instruction = decode(tracee.memory.read(address, 16), address)
        if any(use.register == "r10" for use in instruction.writes):
            break
        address = instruction.next_address
    tracee.kill()
    return InstructionFault(
        trigger=(CountedStop(image.locate(address), 1),),
        execution=1,
        instruction=instruction.text,
        instruction_bytes=instruction.raw,
        corruption=register_corruption("r10", bit, Role.DESTINATION),
    )


@pytest.mark.parametrize(
    ("name", "bit", "outcome"),
    [
        ("benign", 5, RunOutcome.BENIGN),
        ("crash", 62, RunOutcome.CRASH),
        ("hang", 3, RunOutcome.HANG),
        ("sdc", 4, RunOutcome.SDC),
    ],
)
def test_programs_of_known_outcome(target, workplace, name, bit, outcome):
    program = target(name)
    place = workplace(program)
    attacker = Attacker(place=place, golden=golden_run(place))
    fault = victim_fault(place, program, bit)
    for _ in range(2 if outcome is RunOutcome.HANG else 5):
        result = attacker.run(fault)
        assert result.outcome is outcome
        assert result.injection.applied
        assert result.injection.before ^ result.injection.after == 1 << bit
    if outcome is RunOutcome.CRASH:
        assert result.signal == 11
    if outcome is RunOutcome.SDC:
        assert result.verdict.details["magnitude"] == pytest.approx((23 - 7) / 7)


def test_a_tolerance_makes_small_differences_benign(target, workplace):
    program = target("sdc", comparison=OutputComparison(tolerance=3.0))
    place = workplace(program)
    attacker = Attacker(place=place, golden=golden_run(place))
    result = attacker.run(victim_fault(place, program, 4))
    assert result.outcome is RunOutcome.BENIGN
    assert result.verdict.details["magnitude"] > 0.0


def test_the_same_fault_gives_the_same_output_20_times(target, workplace):
    program = target("counting", "60")
    place = workplace(program)
    attacker = Attacker(place=place, golden=golden_run(place))
    campaign = attacked(program, runs=12, seed=8)
    entry = next(entry for entry in campaign.records if entry["outcome"] == "sdc")
    results = [attacker.run(record.fault_of(entry)) for _ in range(20)]
    assert {r.verdict.output_sha256 for r in results} == {entry["output_sha256"]}
    assert {(hex(r.injection.before), hex(r.injection.after)) for r in results} == {
        (entry["injection"]["before"], entry["injection"]["after"])
    }


@pytest.mark.parametrize("sites", [DATA_REGISTERS, frozenset((Site.MEMORY,))])
def test_what_was_overwritten_before_it_was_read_is_benign(target, sites):
    """The fate that is told and the outcome that is seen are found out independently."""
    model = FaultModel(roles=frozenset((Role.DESTINATION,)), sites=sites)
    campaign = attacked(target("sorting"), runs=80, seed=3, model=model)
    fates = {
        (BitActivation(entry["activation"]["activation"]), RunOutcome(entry["outcome"]))
        for entry in campaign.records
        if entry["activation"]["activation"] == BitActivation.OVERWRITTEN.value
    }
    expected = (
        set() if sites != DATA_REGISTERS else {(BitActivation.OVERWRITTEN, RunOutcome.BENIGN)}
    )
    assert fates - {(BitActivation.OVERWRITTEN, RunOutcome.BENIGN)} == set()
    assert fates >= expected
    assert {entry["outcome"] for entry in campaign.records} > {"benign"}


def test_a_null_injection_changes_nothing(target):
    campaign = attacked(target("counting", "60"), runs=10, seed=2, null=True)
    assert {entry["outcome"] for entry in campaign.records} == {"benign"}
    golden = digest(campaign.golden.output)
    assert {entry["output_sha256"] for entry in campaign.records} == {golden}


@pytest.mark.slow
def test_workers_draw_disjoint_streams_and_do_not_change_the_result(target):
    program = target("counting", "30")
    alone, together = (attacked(program, jobs=jobs, runs=24, seed=4) for jobs in (1, 2))

    def essence(campaign):
        return [
            (entry["run"], record.fault_of(entry), entry["outcome"], entry["output_sha256"])
            for entry in campaign.records
        ]

    assert essence(alone) == essence(together)
    assert len({record.fault_of(entry) for entry in alone.records}) > 20


def test_a_program_that_ends_before_the_trigger_is_not_injected(target, workplace):
    program = target("counting", "5")
    place = workplace(program)
    attacker = Attacker(place=place, golden=golden_run(place))
    (entry,) = attacked(target("counting", "60"), runs=1, seed=1).records
    fault = record.fault_of(entry)
    late = InstructionFault(
        trigger=(CountedStop(fault.target, 100_000),),
        execution=100_000,
        instruction=fault.instruction,
        instruction_bytes=fault.instruction_bytes,
        corruption=fault.corruption,
    )
    result = attacker.run(late)
    assert result.outcome is RunOutcome.NOT_INJECTED
    assert "ended before execution 100000 of counting+0x" in result.reason
    assert result.followed.activation is BitActivation.NOT_INJECTED


def test_a_program_that_is_stopped_on_its_way_to_the_trigger_is_told_as_such(target, workplace):
    program = target("sleeper")
    place = workplace(replace(program, limits=RunLimits(factor=0.0, wall_grace_s=0.0)))
    (entry,) = attacked(program, runs=1, seed=1).records
    drawn = record.fault_of(entry)
    never = replace(drawn, trigger=(CountedStop(drawn.target, 2),))
    for fault, outcome in (
        (never, RunOutcome.NOT_INJECTED),
        (replace(never, corruption=None), RunOutcome.HANG),
    ):
        result = Attacker(place=place, golden=golden_run(place)).run(fault)
        assert result.outcome is outcome
        assert result.reason.endswith("in time")


def test_another_instruction_at_the_place_is_refused(target, workplace):
    program = target("sdc")
    place = workplace(program)
    attacker = Attacker(place=place, golden=golden_run(place))
    fault = victim_fault(place, program, 1)
    other = InstructionFault(
        trigger=fault.trigger,
        execution=1,
        instruction="nop",
        instruction_bytes=b"\x90",
        corruption=fault.corruption,
    )
    with pytest.raises(FaultError, match="must hold 'nop'"):
        attacker.run(other)


def test_sampled_invocations_say_that_they_are_a_sample(target, workplace):
    program = target("counting", "50", function="body")
    profiled = workplace(program).profile(np.random.default_rng(3), windows=4)
    (stratum,) = profiled.strata
    assert (len(stratum.segments), stratum.windows_in_run, stratum.complete) == (4, 50, False)
    campaign = attacked(program, runs=6, seed=5, windows=4)
    assert campaign.profile.windows == "4 of 50"
    hit = {campaign.profile.window_of(entry) for entry in campaign.records}
    starts = {segment.start[0].count for segment in campaign.profile.strata[0].segments}
    assert hit <= {(0, number) for number in starts}
    assert len(hit) > 1
    assert {entry["symbol"].split("+")[0] for entry in campaign.records} == {"body"}


def test_debug_registers_give_the_same_faults_and_outcomes(target):
    """Where counted breakpoints are forbidden nothing but the time changes."""

    def essence(mechanism):
        program = target("counting", "12", function="body", mechanism=mechanism)
        campaign = attacked(program, runs=10, seed=5, windows=3)
        return [
            (record.fault_of(entry), entry["outcome"], entry["output_sha256"])
            for entry in campaign.records
        ]

    assert essence(Mechanism.PERF) == essence(Mechanism.DEBUG)


@pytest.mark.parametrize("options", [{"rule": "cpu-time"}, {"compat": "rosfi-2021"}])
def test_time_rules_name_themselves_and_count_what_they_miss(target, options):
    campaign = attacked(target("counting", "400000"), runs=8, seed=6, **options)
    summary = summarise(Plan(runs=8, seed=6, **options), [campaign]).as_dict()
    assert summary["sampling"].startswith(next(iter(options.values())))
    assert sum(row["count"] for row in summary["outcomes"].values()) == 8
    for entry in campaign.records:
        injected = entry["outcome"] != "not_injected"
        assert injected == (not entry["not_injected_reason"])
        if injected and "compat" in options:
            assert set(entry["corruption"]["bits"]) <= set(range(8))
            assert entry["corruption"]["operand"] not in ("rax", "eax", "rsp", "rip")


def test_a_program_that_does_not_repeat_itself_is_refused(tmp_path, native_program):
    native_program("counting")
    script = tmp_path / "random"
    script.write_text("od -An -N8 -tx8 /dev/urandom\n")
    program = ProgramTarget(command=Program.of(["sh", str(script)]), comparison=OutputComparison())
    place = program.open()
    with pytest.raises(TargetError, match="fault-free runs differ"):
        golden_run(place)
    place.close()


# -- records


def test_a_record_survives_and_gives_the_fault_back(target, tmp_path):
    plan = Plan(runs=5, seed=9)
    (campaign,) = run_campaign(plan, [target("counting", "30")], folder=tmp_path)
    planned = [json.loads(line) for line in (tmp_path / "faults.jsonl").read_text().splitlines()]
    for before, entry in zip(planned, campaign.records, strict=True):
        assert before["state"] == "planned"
        path = tmp_path / "fault.json"
        record.write(path, entry)
        again = record.read(path)
        rng = Stream.FAULT.generator(9, entry["run"])
        drawn = campaign.profile.draw(plan.strategy(), rng)
        assert record.fault_of(again) == record.fault_of(before) == drawn
        assert again["object"] == "counting"
        assert again["symbol"]
        assert again == entry


@pytest.fixture
def replayed(native_program, tmp_path):
    """A campaign's folder, and what `mavfi kernels --replay` prints about it."""
    from mavfi_cli.cli.kernels import kernels

    folder = tmp_path / "out"
    line = ["--program", str(native_program("counting")), "--args", "9000"]
    done = CliRunner().invoke(kernels, [*line, "--runs", "12", "--out", str(folder)])
    assert done.exit_code == 0, done.output

    def replay(*options, program=line):
        return CliRunner().invoke(kernels, ["--replay", str(folder), *program, *options])

    return folder, replay


@pytest.mark.slow
def test_the_runs_of_a_program_are_repeated_bit_by_bit(replayed):
    folder, replay = replayed
    assert replay().output == "12 of 12 replays identical\n"
    assert replay("--runs", "5").output == "5 of 5 replays identical\n"
    runs = folder / "runs.jsonl"
    entries = [json.loads(line) for line in runs.read_text().splitlines()]
    entries[3]["injection"]["before"] = "0x17"
    entries[3]["output_sha256"] = "0"
    runs.write_text("".join(json.dumps(entry) + "\n" for entry in entries))
    done = replay()
    assert done.exit_code == 1
    differing, total = done.output.splitlines()
    assert re.fullmatch("counting 3: .* output_sha256, before", differing)
    assert total.startswith("11 of 12 ")


@pytest.mark.slow
def test_runs_that_cannot_be_repeated_are_refused(replayed):
    _, replay = replayed
    assert "not of octomap" in str(replay("--kernel", "octomap").exception)


def test_a_folder_does_not_choose_the_program_that_is_executed(replayed, tmp_path):
    folder, replay = replayed
    plan, struck = json.loads((folder / "plan.json").read_text()), tmp_path / "struck"

    def hostile(**changes):
        (folder / "plan.json").write_text(json.dumps(plan | changes))

    hostile(program=["/usr/bin/touch", str(struck)])
    assert "which would be executed" in str(replay(program=()).exception)
    assert "it differs in ['program']" in str(replay().exception)
    hostile(environment={"LD_PRELOAD": "/tmp/theirs.so"})
    assert "it differs in ['environment']" in str(replay().exception)
    hostile(stdin="/dev/zero")
    assert "it differs in ['stdin']" in str(replay().exception)
    assert not struck.exists()


def test_a_campaign_that_was_cut_off_goes_on(target, tmp_path):
    def go_on(runs, seed=9):
        return attacked(target("counting", "30"), folder=tmp_path, runs=runs, seed=seed).records

    first = go_on(6)
    lines = (tmp_path / "runs.jsonl").read_text().splitlines(keepends=True)
    (tmp_path / "runs.jsonl").write_text("".join(lines[:3]) + lines[3][:40])
    second = go_on(8)
    assert [entry["run"] for entry in second] == list(range(8))
    assert sorted(read_runs(tmp_path), key=itemgetter("run")) == list(second)
    assert second[:3] == first[:3]
    assert [entry["outcome"] for entry in second[:6]] == [entry["outcome"] for entry in first]
    with pytest.raises(ConfigError, match=r"already holds 8 runs.* got 7"):
        go_on(7)
    with pytest.raises(ConfigError, match=r"\['seed'\]"):
        go_on(8, seed=10)


def test_every_run_is_on_the_disk_at_its_end(target, tmp_path):
    kept = []

    def stop_at_the_fourth(_name, done):
        kept.append(len(read_runs(tmp_path)))
        if done == 4:
            raise KeyboardInterrupt

    plan = Plan(runs=12, seed=9)
    with pytest.raises(KeyboardInterrupt):
        run_campaign(plan, [target("counting", "30")], folder=tmp_path, progress=stop_at_the_fourth)
    assert kept == [0, 1, 2, 3, 4]


def test_runs_of_a_program_that_was_built_anew_replace_the_earlier_ones(target, tmp_path):
    program = target("counting", "30")
    path = Path(program.command.argv[0])
    copy = tmp_path / "counting"
    copy.write_bytes(path.read_bytes())
    copy.chmod(0o755)
    built = replace(program, command=Program.of([str(copy), "30"]))
    folder = tmp_path / "out"
    attacked(built, folder=folder, runs=3, seed=9)
    runs = folder / "runs.jsonl"
    ours = '"build_ids": {"counting": "'
    runs.write_text(runs.read_text().replace(ours, f"{ours}0"))
    again = attacked(built, folder=folder, runs=3, seed=9).records
    assert len(runs.read_text().splitlines()) == 6
    assert read_runs(folder) == list(again)
    assert [replay.differs for replay in replay_runs(folder, program=built)] == [()] * 3


def test_a_record_of_another_build_is_refused(target, start):
    campaign = attacked(target("counting", "30"), runs=1, seed=9)
    written = campaign.records[0]
    image = Image(start("counting").pid)
    record.require_same_build(written, image)
    changed = {**written, "build_ids": {"counting": "0123", "libgone.so": "45"}}
    with pytest.raises(BuildMismatch) as caught:
        record.require_same_build(changed, image)
    assert "counting has build id" in str(caught.value)
    assert "libgone.so is not loaded" in str(caught.value)


@pytest.mark.parametrize("text", ["", "{", "[]", '{"a": 1}'])
def test_a_file_that_is_no_record_is_a_clear_error(tmp_path, text):
    path = tmp_path / "fault.json"
    path.write_text(text)
    with pytest.raises(RecordError, match=r"fault\.json"):
        record.read(path)


def test_a_damaged_record_is_a_clear_error():
    with pytest.raises(RecordError, match="damaged"):
        record.fault_of({"version": record.VERSION, "trigger": [{}], "corruption": None})
    with pytest.raises(RecordError, match="version 2"):
        record.fault_of({"version": 1})  # of masks that were whole registers


# -- command


def test_the_command_writes_a_table_json_and_csv(native_program, tmp_path):
    from mavfi_cli.cli.kernels import kernels

    arguments = ["--program", str(native_program("counting")), "--args", "30", "--runs", "8"]
    result = CliRunner().invoke(kernels, [*arguments, "--out", str(tmp_path), "--json"])
    assert result.exit_code == 0, result.output
    saved = json.loads((tmp_path / "kernels.json").read_text())
    assert len(saved["runs"]) == 8
    assert saved["summary"]["sampling"] == "instruction-uniform"
    rows = list(csv.reader((tmp_path / "kernels.csv").read_text().splitlines()))
    assert len(rows) == 9
    assert rows[0] == PROGRAM_COLUMNS
    assert {len(row) for row in rows} == {len(PROGRAM_COLUMNS)}
    assert all(row[rows[0].index("instruction")] for row in rows)
    assert [row[1] for row in rows[1:]] == [run["outcome"] for run in saved["runs"]]


def test_the_table_names_outcomes_and_signals(native_program, tmp_path):
    from mavfi_cli.cli.kernels import kernels

    arguments = ["--program", str(native_program("counting")), "--args", "30", "--runs", "8"]
    result = CliRunner().invoke(kernels, [*arguments, "--out", str(tmp_path)])
    assert result.exit_code == 0, result.output
    lines = result.stdout.splitlines()
    assert [line[:14].rstrip() for line in lines[:6]] == [
        "outcome", "benign", "crash", "hang", "SDC", "not injected",
    ]  # fmt: skip
    (crashes,) = (line for line in lines if line.startswith("crashes: "))
    assert re.search(r"\bSIG[A-Z]+ \d+", crashes)
    assert lines[-1] == f"Files  {tmp_path}: kernels.json, kernels.csv, runs.jsonl"
