import os
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavfi_cli.companion.executor import Executor, Node, TurnOver


class Story(Executor):
    """An executor with a list of the outputs: name of the node, output, stamp."""

    def __init__(self, latencies: dict[str, float], cores: int = 8) -> None:
        super().__init__(draw_latency_s=latencies.__getitem__, cores=cores)
        self.published: list[tuple[Any, ...]] = []
        for name in latencies:
            self.add(Node(name, lambda value, start: (value, round(start, 9))))

    def submit(self, value: Any, *names: str) -> None:
        """Begin a turn: the nodes one after the other, each with the same value."""
        self.start(self._turn(value, names))

    async def _turn(self, value: Any, names: tuple[str, ...]) -> None:
        for name in names:
            output = await self.nodes[name].run(value)
            self.published.append((name, output, round(self.now_s, 9)))


def make(latencies: dict[str, float], cores: int = 8) -> tuple[Story, list[tuple[Any, ...]]]:
    story = Story(latencies, cores)
    return story, story.published


def test_output_takes_effect_only_after_the_latency():
    executor, published = make({"a": 0.289})
    executor.advance(1.0)
    executor.submit("x", "a")
    executor.advance(1.28)
    assert published == []
    executor.advance(1.30)
    assert published == [("a", ("x", 1.0), 1.289)]


def test_a_busy_node_keeps_the_newest_input_only():
    executor, published = make({"a": 0.1})
    for stamp, value in [(0.0, "first"), (0.02, "old"), (0.04, "new")]:
        executor.advance(stamp)
        executor.submit(value, "a")
    executor.advance(1.0)
    assert published == [("a", ("first", 0.0), 0.1), ("a", ("new", 0.1), 0.2)]
    assert executor.nodes["a"].dropped == 1
    assert executor.nodes["a"].invocations == 2


def test_nodes_work_side_by_side():
    executor, published = make({"slow": 0.3, "quick": 0.1})
    executor.submit(1, "slow")
    executor.submit(2, "quick")
    executor.advance(1.0)
    assert published == [("quick", (2, 0.0), 0.1), ("slow", (1, 0.0), 0.3)]


def test_one_core_makes_them_take_turns():
    executor, published = make({"slow": 0.3, "quick": 0.1}, cores=1)
    executor.submit(1, "slow")
    executor.submit(2, "quick")
    executor.advance(1.0)
    assert published == [("slow", (1, 0.0), 0.3), ("quick", (2, 0.3), 0.4)]


def test_a_chain_runs_at_its_own_stamps_not_at_the_ticks():
    executor, published = make({"a": 0.002, "b": 0.01}, cores=2)
    executor.submit(1, "a", "b")
    executor.advance(0.02)
    assert published == [("a", (1, 0.0), 0.002), ("b", (1, 0.002), 0.012)]


def test_a_turn_whose_input_was_replaced_or_that_ended_early_does_not_go_on():
    executor, published = make({"a": 0.1, "b": 0.1})
    for value in ("first", "replaced", "newest"):
        executor.submit(value, "a", "b")

    async def ends() -> None:
        await executor.nodes["b"].run("early")
        raise TurnOver

    executor.start(ends())
    executor.advance(1.0)
    assert [(name, output[0]) for name, output, _ in published] == [
        ("a", "first"), ("a", "newest"), ("b", "first"), ("b", "newest"),
    ]  # fmt: skip
    assert executor.nodes["b"].invocations == 3


def test_what_asked_for_the_core_first_has_it_first():
    """Neither the next node of a chain nor the node's own newer input overtakes who waits."""
    executor, _ = make({"a": 0.1, "b": 0.1, "c": 0.1}, cores=1)
    for stamp, names in [(0.0, "ab"), (0.02, "c"), (0.04, "ab")]:
        executor.advance(stamp)
        executor.submit(stamp, *names)
    executor.advance(1.0)
    order = [job.node for job in executor.timetable]
    assert order == ["a", "c", "b", "a", "b"]


def test_a_called_node_takes_nothing_while_it_is_at_work():
    executor, _ = make({"control": 0.046})
    control = executor.nodes["control"]
    given = []
    for tick in range(6):
        executor.advance(0.02 * tick)
        given.append(executor.call(control, tick) is not None)
    assert given == [True, False, False, True, False, False]
    assert control.dropped == 4
    first, second = executor.timetable
    assert first.end_s <= second.start_s
    assert executor.call(control, 5, again=True) is not None  # its newest work, anew


inputs = st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, 30)), max_size=25)


@given(inputs, st.integers(1, 3))
def test_when_the_work_is_really_done_changes_nothing(plan, cores):
    """Computing early, late or never before the result is due gives the same story."""
    stories = []
    for eager in (False, True):
        executor, published = make({"a": 0.05, "b": 0.11, "c": 0.23}, cores)
        for name, tick in sorted(plan, key=lambda p: p[1]):
            executor.advance(tick * 0.02)
            executor.submit(tick, name)
            if eager:
                executor.compute()
        executor.advance(100.0)
        stories.append((published, executor.timetable))
        assert not any(node.busy or node.pending is not None for node in executor.nodes.values())
    assert stories[0] == stories[1]


@given(inputs, st.integers(1, 3))
def test_never_more_nodes_at_work_than_cores(plan, cores):
    executor, _ = make({"a": 0.05, "b": 0.11, "c": 0.23}, cores)
    for name, tick in sorted(plan, key=lambda p: p[1]):
        executor.advance(tick * 0.02)
        executor.submit(tick, name)
    executor.advance(100.0)
    for job in executor.timetable:
        middle = (job.start_s + job.end_s) / 2
        at_work = [j for j in executor.timetable if j.start_s <= middle < j.end_s]
        assert len(at_work) <= cores
        assert len({j.node for j in at_work}) == len(at_work)


@pytest.mark.parametrize("end", ["crash", "kill"])
def test_a_node_that_ends_loses_its_present_input_and_keeps_the_waiting_one(end):
    executor, published = make({"a": 0.2})
    node = executor.nodes["a"]
    if end == "crash":
        node.kernel = lambda value, start: os.abort() if value == "first" else (value, start)
    executor.isolate("a")
    try:
        executor.submit("first", "a")
        executor.compute()
        executor.advance(0.1)
        executor.submit("second", "a")
        if end == "kill":
            executor.kill("a")
        executor.advance(5.0)
    finally:
        executor.close()
    restarted_s = {"crash": 1.2, "kill": 1.1}[end]  # the end of a crash is when output was due
    ((_, (value, begun_s), _),) = published
    assert (value, round(begun_s, 9), node.restarts) == ("second", restarted_s, 1)
