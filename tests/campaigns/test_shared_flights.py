"""Missions forked from a shared flight have the records of missions flown alone."""

import json
import os
import signal
from collections import Counter
from dataclasses import replace
from functools import partial

import pytest
from killing import processes
from live_processes import none_left

from mavfi_cli.campaigns import workers
from mavfi_cli.campaigns.ledger import Ledger
from mavfi_cli.campaigns.missions import MissingMission, PlannedMission
from mavfi_cli.campaigns.progress import Spectator
from mavfi_cli.campaigns.run import MissionQueue, Options, run_campaign
from mavfi_cli.campaigns.specification import Keep, Stop
from mavfi_cli.core.fork_server import WORKER
from mavfi_cli.fi.tracer.linux import SUPPORTED
from mavfi_cli.mission.machine import OK, check_tracing
from mavfi_cli.spec.detector import DetectorConfig
from mavfi_cli.spec.fault import FaultConfig, InstructionConfig
from mavfi_cli.spec.mission import MissionConfig

traced = pytest.mark.skipif(
    not SUPPORTED or check_tracing().verdict != OK, reason="nothing can be traced here"
)
GAD = DetectorConfig(name="gad")
FAULTS = (
    FaultConfig(target="waypoint_position", at="time=1", together=True, field="exponent", seed=1),
    FaultConfig(target="command_vx", at="tick=40", persistence="stuck-at", duration_s=1.0, seed=2),
    FaultConfig(target="time_to_collision", at="invocation=3", bits=2, seed=3),
    FaultConfig(target="process.octomap", at="time=1.5"),
    FaultConfig(target="process.planner", at="tick=10"),
    FaultConfig(target="process.control", seed=4),
    FaultConfig(target="planning", at="time=200"),  # never due
)
MISSIONS = [
    {},
    *({"fault": fault} for fault in FAULTS),
    {"detector": GAD},
    {"detector": GAD, "fault": FAULTS[0]},
    {"detector": GAD, "fault": FaultConfig(target="detector", at="tick=5", seed=5)},
    {"node_restart_s": 0.1, "fault": FAULTS[3]},
    {"fault": FAULTS[0]},  # twice
]


@pytest.fixture(autouse=True)
def _fake_task_is_importable():
    """These flights are real."""


def files_of(folder):
    """Every file of a run folder, without the host section of the result and the time of a stop."""
    result = json.loads((folder / "result.json").read_text())
    host = result.pop("host")
    files = {path.name: path.read_bytes() for path in folder.iterdir()}
    if "level" in (result["fault"] or {}) and result["fault"]["level"] == "instruction":
        written = json.loads(files["fault.json"])
        written["injection"].pop("stop_s", None)
        files["fault.json"] = json.dumps(written)
    return {**files, "result.json": json.dumps(result)}, host


def rows_of(ledger):
    return [
        (row.number, row.outcome, row.injected, {**row.result, "host": None})
        for row in ledger.results()
    ]


@pytest.fixture(scope="module")
def missions(short_config):
    return [PlannedMission(config=replace(short_config, **changes)) for changes in MISSIONS]


@pytest.fixture(scope="module")
def flown_alone(missions, tmp_path_factory):
    """The missions, each flown alone; the folder of the campaign."""
    folder = tmp_path_factory.mktemp("alone") / "campaign"
    run_campaign(missions, folder, Options(jobs=2, keep=Keep.ALL, whole=True)).close()
    return folder


@pytest.mark.slow
def test_a_forked_mission_is_that_flown_alone(missions, flown_alone, tmp_path):
    with run_campaign(missions, tmp_path / "shared", Options(jobs=2, keep=Keep.ALL)) as ledger:
        flown = list(ledger.results())
    assert [row.number for row in flown] == list(range(len(missions)))
    forked = 0
    with Ledger(flown_alone) as ledger:
        every = list(ledger.results())
    for row, alone in zip(flown, every, strict=True):
        files, host = files_of(row.path)
        assert files == files_of(alone.path)[0], row.number
        assert row.injected is alone.injected
        forked += "forked_s" in host
    assert forked == len(missions) - 1  # one is left for a job


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["restores_counters=true", 'standby=["planner"]'])
def test_a_fork_restarts_or_replaces_a_lost_node_as_the_mission_flown_alone(variant, tmp_path):
    fault = FaultConfig(target="process.planner", at="time=18")  # between two plans
    base = MissionConfig(world="dense", seed=3, stack=f"mavbench:{variant}", time_limit_s=90.0)
    missions = [
        PlannedMission(config=replace(base, fault=fault, node_restart_s=after_s))
        for after_s in (0.5, 1.0)
    ]
    flown = {}
    for whole in (False, True):
        options = Options(jobs=1, keep=Keep.ALL, whole=whole)
        with run_campaign(missions, tmp_path / str(whole), options) as ledger:
            flown[whole] = list(ledger.results())
    for row, alone in zip(flown[False], flown[True], strict=True):
        files, host = files_of(row.path)
        assert files == files_of(alone.path)[0], row.number
        assert "forked_s" in host


STRUCK = {  # the faults of each stack, by the effect on the node
    "hardened": {
        "masked": {"target": "octomap", "seed": 1},
        "changed": {"target": "planner", "seed": 3},
        "ended": {"target": "control", "seed": 3},
        "hung": {"target": "planner", "seed": 23, "invocation_seed": 3},
    },
    "mavbench": {"changed": {"target": "control", "seed": 1}},
}


@pytest.mark.slow
@traced
@pytest.mark.parametrize("stack", STRUCK)
def test_a_node_struck_in_a_rehearsal_flies_as_if_struck_in_flight(short_config, tmp_path, stack):
    base, faults = replace(short_config, stack=stack), [*STRUCK[stack].values()]
    quick, guarded = replace(base, node_restart_s=0.1), replace(base, detector=GAD)
    null = InstructionConfig(target="point_cloud", null=True)
    cases = [(base, faults)]
    if stack == "hardened":
        cases += [(guarded, faults[1:2]), (quick, faults[2:])]
    configs = [
        *(unharmed for unharmed, _ in cases),
        *(replace(unharmed, instruction=null) for unharmed, _ in cases[1:2]),
        *(
            replace(unharmed, instruction=InstructionConfig(**fault))
            for unharmed, faults in cases
            for fault in faults
        ),
    ]
    flown = {}
    for whole in (False, True):
        options = Options(jobs=1, keep=Keep.ALL, whole=whole)
        missions = [PlannedMission(config=config) for config in configs]
        with run_campaign(missions, tmp_path / str(whole), options) as ledger:
            flown[whole] = list(ledger.results())
    effects = set()
    for row, alone in zip(flown[False], flown[True], strict=True):
        files, host = files_of(row.path)
        assert files == files_of(alone.path)[0], row.number
        assert row.injected is alone.injected
        effects.add(host.get("struck"))
    assert effects >= STRUCK[stack].keys()


@pytest.mark.slow
@traced
def test_faults_that_end_a_node_in_the_same_way_share_its_loss(short_config, tmp_path):
    struck = [  # of which the first and the last end the node, and the second changes it
        InstructionConfig(target="control", seed=seed, invocation_seed=3) for seed in (0, 1, 4)
    ]
    missions = [
        PlannedMission(config=replace(short_config, instruction=fault)) for fault in (None, *struck)
    ]
    flown = {}
    for whole in (False, True):
        options = Options(jobs=1, keep=Keep.ALL, whole=whole)  # all share a flight
        with run_campaign(missions, tmp_path / str(whole), options) as ledger:
            flown[whole] = list(ledger.results())
    losses, ends = [], set()
    for row, alone in zip(flown[False], flown[True], strict=True):
        files, host = files_of(row.path)
        assert files == files_of(alone.path)[0], row.number
        if host.get("struck") == "ended":
            losses.append(host["forked_s"])
            ends.add(json.loads(files["result.json"])["events"][-1]["stamp_s"])
    shared = Counter(losses).most_common(1)[0]
    assert shared[1] > 1
    assert shared[0] in ends  # they leave at the end, and not at the strike


class _KillsWorker(Spectator):
    struck = False

    def __init__(self, mark):
        self._mark = mark

    def on_progress(self, progress):
        workers = processes(self._mark).get(WORKER, ())
        if not self.struck and len(workers) > 1 and progress.over:  # the flight and its fork
            os.kill(min(workers), signal.SIGKILL)
            self.struck = True


@pytest.mark.slow
def test_a_killed_shared_flight_costs_no_mission(missions, flown_alone, tmp_path, monkeypatch):
    mark = str(tmp_path)
    monkeypatch.setenv("MAVFI_TEST_CAMPAIGN", mark)
    monkeypatch.setattr("mavfi_cli.campaigns.run._LOOK_S", 0.02)
    killer = _KillsWorker(mark)
    with run_campaign(missions[:8], tmp_path / "killed", Options(jobs=1), killer) as ledger:
        rows = rows_of(ledger)
    assert killer.struck
    with Ledger(flown_alone) as ledger:
        assert rows == rows_of(ledger)[:8]
    none_left(partial(processes, mark))


class _Notes(Spectator):
    def __init__(self):
        self.notes, self.most_flights = [], 0

    def on_note(self, text):
        self.notes.append(text)

    def on_progress(self, progress):
        self.most_flights = max(self.most_flights, progress.running)


def flown_both_ways(configs, tmp_path, *, stop=None, **options):
    """Notes about the missions of one flight, and their results; they equal those flown alone."""
    listed, watcher = [PlannedMission(config=config) for config in configs], _Notes()
    shared, whole = Options(jobs=1, **options), Options(jobs=1, whole=True)
    with run_campaign(listed, tmp_path / "shared", shared, watcher, stop=stop) as ledger:
        rows, results = rows_of(ledger), [row.result for row in ledger.results()]
    with run_campaign(listed, tmp_path / "whole", whole, stop=stop) as ledger:
        assert rows == rows_of(ledger)
    assert watcher.most_flights == 1
    return watcher.notes, results


@pytest.fixture
def task(monkeypatch):
    """Make a module of this folder the task whose missions share flights; return its name."""

    def use(name):
        paths = [os.path.dirname(__file__), os.environ.get("PYTHONPATH", "")]
        monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, paths)))
        monkeypatch.setattr("mavfi_cli.campaigns.run.TASK", name)
        return name

    return use


@pytest.mark.slow
@traced
def test_a_node_whose_memory_cannot_be_compared_is_struck_in_flight_and_says_so(
    short_config, tmp_path, task
):
    fault = InstructionConfig(target="octomap", null=True)  # another may end its node
    configs = [short_config, replace(short_config, instruction=fault)]
    notes, results = flown_both_ways(configs, tmp_path, task=task("incomparable_task"))
    assert [note.endswith("its memory cannot be read") for note in notes] == [True]
    assert results[1]["host"]["alone"].endswith("its memory cannot be read")


@pytest.mark.slow
def test_a_fault_that_cannot_be_drawn_says_why(short_config, tmp_path):
    guarded = replace(short_config, detector=GAD)
    lost = replace(guarded, fault=FaultConfig(target="detector.nothing", at="tick=5"))
    notes, results = flown_both_ways([guarded, lost], tmp_path)
    assert " alone: 1; unknown array in the detector's memory 'nothing'; known: " in notes[0]
    assert results[1] == {}


@pytest.mark.slow
def test_a_stop_rule_ends_a_setting_after_the_same_missions(short_config, tmp_path):
    fault = FaultConfig(target="waypoint_position", together=True, field="exponent")
    base = replace(short_config, time_limit_s=20.0)
    configs = [replace(base, fault=replace(fault, seed=seed)) for seed in range(12)]
    stop = Stop(margin=0.3, batch=4)
    _, results = flown_both_ways(configs, tmp_path, stop=stop)
    assert 4 <= len(results) < 12


@pytest.mark.slow
def test_a_mission_that_cannot_be_forked_is_flown_alone_and_says_so(short_config, tmp_path, task):
    configs = [replace(short_config, fault=fault) for fault in (None, *FAULTS[:2])]
    notes, results = flown_both_ways(configs, tmp_path, task=task("unforkable_task"))
    reason = "cannot fork: Resource temporarily unavailable"
    (note,) = notes
    assert note.endswith(f" alone: 1; {reason}")
    said = [result["host"].get("alone") for result in results]
    forked = ["forked_s" in result["host"] for result in results]
    assert said == [None, None, reason] or said == [None, reason, None]
    assert forked == [text is None for text in said]


def test_a_flight_that_ended_without_forking_a_mission_has_a_reason():
    usual = {"report": {"traceback": "Traceback\n  ...\nSystemExit: node planner: why\n"}}
    assert workers._end_of_flight(usual) == "node planner: why"
    assert "ValueError: 3" in workers._end_of_flight({"report": {"traceback": "ValueError: 3\n"}})


@pytest.mark.slow
def test_a_golden_flight_that_ends_before_the_fault(short_config, tmp_path):
    """The missions of a flight that runs out of time, or hits something, before their faults."""
    fault = FaultConfig(target="command_vx", at="invocation=400")  # at 50 per second
    late = replace(short_config, time_limit_s=2.0)
    notes, results = flown_both_ways([late, replace(late, fault=fault)], tmp_path)
    assert notes == []
    assert [result["outcome"] for result in results] == ["timeout", "timeout"]
    assert all("forked_s" in result["host"] for result in results)
    assert results[1]["fault"]["state"] == "not_injected"


@pytest.mark.slow
def test_a_golden_flight_that_cannot_begin(short_config, tmp_path):
    """Each of its missions is tried alone and reports why."""
    blocked = replace(short_config, goal=(1e4, 0.0, 2.5))
    notes, results = flown_both_ways([blocked, replace(blocked, fault=FAULTS[0])], tmp_path)
    assert " alone: 2; " in notes[0]
    assert results == [{}, {}]


def test_missions_that_may_begin_now_share_a_flight():
    golden = MissionConfig()
    configs = [
        golden,
        replace(golden, fault=FAULTS[0]),
        replace(golden, seed=9),
        replace(golden, fault=FAULTS[1], detector=GAD),
        replace(golden, fault=FAULTS[2]),
        replace(golden, fault=FAULTS[3]),
    ]
    listed = [MissingMission(number, 0, config) for number, config in enumerate(configs)]
    queue = MissionQueue(iter(listed), None, shares=True)
    flights = []
    while (first := queue.next()) is not None:
        flights.append([mission.number for mission in (first, *queue.mates(first, 2))])
    assert flights == [[0, 1, 4], [2], [3], [5]]


def test_a_stop_rule_admits_the_missions_of_a_flight():
    faulty = [replace(MissionConfig(), fault=replace(FAULTS[0], seed=n)) for n in range(30)]
    listed = [MissingMission(number, 0, config) for number, config in enumerate(faulty)]
    queue = MissionQueue(iter(listed), Stop(margin=0.1, batch=10), [0] * 30, shares=True)
    first = queue.next()
    assert [mission.number for mission in queue.mates(first, 15)] == list(range(1, 10))
    assert queue.next() is None
    for number in range(10):
        queue.record(number, ("success" if number % 2 else "collision", "active"))
    assert queue.next().number == 10


@pytest.mark.parametrize(
    "changes",
    [
        {"isolate": ("control",)},
        {"realtime": True},
        {"link": "udpin:127.0.0.1:14550", "goal": (9.0, 0.0, 5.0)},
    ],
)
def test_missions_that_other_processes_affect_are_flown_alone(changes):
    assert replace(MissionConfig(), **changes).shared_flight is None


@pytest.mark.slow
def test_a_flight_that_ends_after_its_missions_ends_no_campaign(
    short_config, tmp_path, monkeypatch
):
    """All missions of a flight have ended before its process has; others of the list follow."""
    monkeypatch.setattr("mavfi_cli.campaigns.run.SHARING", 2)
    golden, fault = short_config, FAULTS[0]
    configs = [replace(golden, fault=replace(fault, seed=seed)) for seed in range(4)]
    with run_campaign(
        [PlannedMission(config=config) for config in (golden, *configs)],
        tmp_path / "several",
        Options(jobs=1, keep=Keep.NONE),
    ) as ledger:
        assert [row.number for row in ledger.results()] == [0, 1, 2, 3, 4]
