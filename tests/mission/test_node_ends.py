"""Nodes that die or hang: counted, restarted with fresh state, and the record repeats."""

import json
import os
import signal
import time

import pytest

from mavfi_cli.autonomy import planners, point_cloud, tracking
from mavfi_cli.autonomy.occupancy import OccupancyMap
from mavfi_cli.companion import node_process
from mavfi_cli.companion.executor import Executor, Node
from mavfi_cli.mission.run_folder import load_run


def record(folder):
    result = json.loads(folder.result.read_text())
    del result["host"]
    return folder.trace.read_bytes(), result


@pytest.fixture
def at_invocation(monkeypatch):
    """Does something in the n-th call of a kernel, in the first process that serves it only."""
    here = os.getpid()

    def patch(owner, name, number, action):
        real, calls = getattr(owner, name), []
        token, theirs = os.pipe()
        os.write(theirs, b"1")
        os.set_blocking(token, False)

        def kernel(*arguments, **named):
            if os.getpid() != here:
                calls.append(1)
                if len(calls) == number and taken(token):
                    action()
            return real(*arguments, **named)

        monkeypatch.setattr(owner, name, kernel)

    def taken(token):
        try:
            return os.read(token, 1) == b"1"
        except BlockingIOError:
            return False

    return patch


def crash():
    signal.signal(signal.SIGSEGV, signal.SIG_DFL)
    os.kill(os.getpid(), signal.SIGSEGV)


def hang():
    while True:
        pass


KERNELS = {
    "point_cloud": (point_cloud, "generate"),
    "octomap": (OccupancyMap, "insert"),
    "control": (tracking, "step"),
}


def test_crashed_nodes_are_restarted_and_the_mission_goes_on(fly_short, at_invocation):
    records = []
    for _ in range(2):
        for kernel in KERNELS.values():
            at_invocation(*kernel, 5, crash)
        records.append(record(fly_short(isolate=tuple(KERNELS))))
    assert records[0] == records[1]
    result = records[0][1]
    crashed = [result["nodes"].pop(node) for node in KERNELS]
    for ends in crashed:
        assert [c["how"] for c in ends["crashes"]] == ["killed by SIGSEGV"]
        assert (ends["hangs"], ends["restarts"]) == (0, 1)
    assert all(n == {"crashes": [], "hangs": 0, "restarts": 0} for n in result["nodes"].values())
    told = {e["text"] for e in result["events"] if e["kind"] == "node"}
    assert told == {f"node {node} crashed: killed by SIGSEGV" for node in KERNELS}
    assert result["outcome"] == "success"


def test_a_planner_that_dies_over_the_first_plan_is_asked_again(fly_short, at_invocation):
    at_invocation(planners, "plan", 1, crash)
    _, result = record(fly_short(isolate=("planner",)))
    assert (result["nodes"]["planner"]["restarts"], result["outcome"]) == (1, "success")
    assert result["pilot"]["plans_requested"] == 2
    assert result["pilot"]["plans_failed"] == 0  # it never answered


def broken():
    raise IndexError("no such voxel \udc80")


def test_an_error_in_an_isolated_kernel_ends_its_node_only(fly_short, at_invocation):
    records = []
    for _ in range(2):
        at_invocation(*KERNELS["octomap"], 12, broken)
        folder = fly_short(isolate=("octomap",))
        records.append(record(folder))
    assert records[0] == records[1]
    result = records[0][1]
    ends = result["nodes"]["octomap"]
    assert [crash["how"] for crash in ends["crashes"]] == [r"IndexError: no such voxel \udc80"]
    assert (ends["restarts"], result["outcome"]) == (1, "success")
    assert "Traceback" in (folder.path / "crash.txt").read_text()


def test_a_hung_node_is_killed_by_the_watchdog(fly_short, at_invocation, monkeypatch, mavfi):
    monkeypatch.setattr(node_process, "HANG_CPU_S", 0.3)
    records, folder = [], None
    for _ in range(2):
        at_invocation(*KERNELS["octomap"], 5, hang)
        folder = fly_short(isolate=("octomap",), node_watchdog_s=1.0)
        records.append(record(folder))
    assert records[0] == records[1]
    result = load_run(folder.path).result
    ends = result["nodes"]["octomap"]
    assert (ends["crashes"], ends["hangs"], ends["restarts"]) == ([], 1, 1)
    assert result["kernels"]["octomap"]["busy_s"] > result["config"]["node_watchdog_s"]
    shown = mavfi("show", folder.path)
    assert "octomap: hung once; restarted 1x" in shown.stdout


def test_every_node_can_be_isolated_without_a_trace(fly_short, short_flight):
    folder = fly_short(isolate=("point_cloud", "collision_check", "control"))
    assert record(folder) == record(short_flight)


def dying(value, _stamp_s):
    if value == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    return value


class Nodes(Executor):
    """An executor of one core whose nodes die over "die", and the outputs of its nodes."""

    def __init__(self, names):
        super().__init__(draw_latency_s=lambda _name: 0.1, cores=1, restart_s=1.0)
        self.published = []
        for name in names:
            self.add(Node(name, dying))

    def submit(self, name, value):
        async def turn():
            output = await self.nodes[name].run(value)
            self.published.append((name, output, round(self.now_s, 9)))

        self.start(turn())


@pytest.fixture
def executor_of():
    made = []

    def make(*names):
        made.append(Nodes(names))
        return made[-1]

    yield make
    for each in made:
        each.close()


def test_the_input_is_lost_and_the_newest_waits_for_the_restart(executor_of):
    executor = executor_of("a")
    executor.isolate("a")
    for stamp_s, value in [(0.0, "first"), (0.2, "die"), (0.4, "old"), (0.5, "new")]:
        executor.advance(stamp_s)
        executor.submit("a", value)
    executor.advance(5.0)
    # Due at 0.3, up again 1 s later, and then 0.1 s of work.
    assert executor.published == [("a", "first", 0.1), ("a", "new", 1.4)]
    assert executor.nodes["a"].dropped == 1
    assert [(loss.stamp_s, loss.how) for loss in executor.losses] == [
        (pytest.approx(0.3), "killed by SIGKILL")
    ]


def test_a_node_that_is_down_leaves_its_core_to_others(executor_of):
    executor = executor_of("a", "b")
    executor.isolate("a")
    executor.submit("a", "die")
    executor.submit("b", "other")
    executor.advance(0.5)
    assert executor.published == [("b", "other", 0.2)]


def test_a_call_of_a_node_that_is_down_gives_nothing(executor_of):
    executor = executor_of("a")
    executor.isolate("a")
    given = []
    for stamp_s, value in [(0.0, 1), (0.2, "die"), (0.5, 2), (1.0, 3), (1.2, 4), (1.4, 5)]:
        executor.advance(stamp_s)
        given.append(executor.call(executor.nodes["a"], value))
    assert given == [(1, 0.1), None, None, None, (4, 0.1), (5, 0.1)]


def test_settling_waits_for_work_whose_output_is_not_due_yet(tmp_path):
    """What happens to a node must not depend on how fast the host gets to the mission's end."""
    done = tmp_path / "done"

    def run(_value, _stamp_s):
        time.sleep(0.3)
        done.touch()

    executor = Executor(draw_latency_s=lambda _name: 1.0, cores=1)
    slow = executor.add(Node("slow", run))
    executor.isolate("slow")

    async def turn():
        await slow.run(1)

    try:
        executor.start(turn())
        executor.compute()
        assert not done.exists()
        executor.settle()
        assert done.exists()
    finally:
        executor.close()


def test_nodes_that_share_a_process_take_turns_and_end_together(executor_of):
    executor = executor_of("map", "check", "plan")
    executor.share_process(("map", "check", "plan"))
    executor.isolate("check")
    for value, name in enumerate(("plan", "map", "check", "map")):
        executor.submit(name, value)
    executor.advance(1.0)
    # After the planner comes the map again, as in a loop over the three.
    assert executor.published == [("plan", 0, 0.1), ("map", 3, 0.2), ("check", 2, 0.3)]
    executor.submit("check", "die")
    executor.submit("plan", "waits")
    executor.advance(1.5)
    executor.submit("map", "while down")
    executor.advance(5.0)
    assert executor.published[3:] == [("map", "while down", 2.2)]
    assert [node.restarts for node in executor.nodes.values()] == [1, 1, 1]
    assert [loss.node for loss in executor.losses] == ["check"]


def test_a_kill_loses_the_work_under_way_and_a_newer_input_replaces_what_waits(executor_of):
    executor = executor_of("a")
    executor.isolate("a")
    executor.submit("a", "under way")
    executor.submit("a", "waiting")
    executor.advance(0.05)
    executor.kill("a")
    executor.kill("a")  # nothing is left to kill
    executor.advance(0.5)
    executor.submit("a", "newer")
    executor.advance(3.0)
    assert executor.published == [("a", "newer", 1.15)]
    assert [(loss.stamp_s, loss.how) for loss in executor.losses] == [(0.05, "killed by SIGKILL")]


@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize(
    ("standby", "sums"),
    [
        ((), {0: 1, 1: 11, 3: 1000}),  # the input is lost, and the successor has seen nothing
        (("b",), {0: 1, 1: 11, 2: 111, 3: 1111}),
    ],
)
def test_a_hot_standby_answers_for_a_process_that_dies(executor_of, standby, sums, late):
    """It has worked on every input, so it answers at the same time and with the same state."""
    executor, here = executor_of("a", "b"), os.getpid()

    def adder():
        seen = []

        def add(value, _stamp_s):
            if value == 100 and os.getpid() != here and len(seen) == 2:
                crash()
            seen.append(value)
            return sum(seen)

        return add

    executor.nodes["b"].kernel = adder()
    executor.share_process(("a", "b"))
    executor.stand_by(standby)
    if not late:
        executor.isolate("a")
    for number in range(4):
        if late and number == 2:
            executor.isolate_late("a", {"b": adder()})
        executor.submit("b", 10**number)
        executor.advance(2.0 * (number + 1))
    expected = [("b", total, pytest.approx(2.0 * number + 0.1)) for number, total in sums.items()]
    assert executor.published == expected
    assert [loss.how for loss in executor.losses] == ["killed by SIGSEGV"]
    assert executor.nodes["b"].restarts == (0 if standby else 1)
