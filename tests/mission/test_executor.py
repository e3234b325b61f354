from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from mavfi_cli.mission.companion.executor import Executor


def make(latencies: dict[str, float], cores: int = 8) -> tuple[Executor, list[tuple[Any, ...]]]:
    """An executor whose nodes publish what they got, into a list of (name, value, stamp)."""
    published: list[tuple[Any, ...]] = []
    executor = Executor(draw_latency_s=latencies.__getitem__, cores=cores)
    for name in latencies:

        def publish(value: Any, stamp: float, name: str = name) -> None:
            published.append((name, value, round(stamp, 9)))

        executor.add(name, lambda value, start: (value, round(start, 9)), publish)
    return executor, published


def test_output_takes_effect_only_after_the_latency():
    executor, published = make({"a": 0.289})
    executor.advance(1.0)
    executor.submit("a", "x")
    executor.advance(1.28)
    assert published == []
    executor.advance(1.30)
    assert published == [("a", ("x", 1.0), 1.289)]


def test_a_busy_node_keeps_the_newest_input_only():
    executor, published = make({"a": 0.1})
    for stamp, value in [(0.0, "first"), (0.02, "old"), (0.04, "new")]:
        executor.advance(stamp)
        executor.submit("a", value)
    executor.advance(1.0)
    assert published == [("a", ("first", 0.0), 0.1), ("a", ("new", 0.1), 0.2)]
    assert executor.nodes["a"].dropped == 1
    assert executor.nodes["a"].invocations == 2


def test_nodes_work_side_by_side():
    executor, published = make({"slow": 0.3, "quick": 0.1})
    executor.submit("slow", 1)
    executor.submit("quick", 2)
    executor.advance(1.0)
    assert published == [("quick", (2, 0.0), 0.1), ("slow", (1, 0.0), 0.3)]


def test_one_core_makes_them_take_turns():
    executor, published = make({"slow": 0.3, "quick": 0.1}, cores=1)
    executor.submit("slow", 1)
    executor.submit("quick", 2)
    executor.advance(1.0)
    assert published == [("slow", (1, 0.0), 0.3), ("quick", (2, 0.3), 0.4)]


def test_a_chain_runs_at_its_own_stamps_not_at_the_ticks():
    executor = Executor(draw_latency_s={"a": 0.002, "b": 0.01}.__getitem__, cores=2)
    seen: list[float] = []
    executor.add("a", lambda v, _s: v, lambda v, _s: executor.submit("b", v))
    executor.add("b", lambda v, _s: v, lambda _v, stamp: seen.append(round(stamp, 9)))
    executor.submit("a", 1)
    executor.advance(0.02)
    assert seen == [0.012]


def test_what_asked_for_the_core_first_has_it_first():
    """Neither the next node of a chain nor the node's own newer input overtakes who waits."""
    executor = Executor(draw_latency_s=lambda _name: 0.1, cores=1)
    for name, follower in (("a", "b"), ("b", None), ("c", None)):

        def publish(value: Any, _stamp: float, follower: str | None = follower) -> None:
            if follower:
                executor.submit(follower, value)

        executor.add(name, lambda value, _start: value, publish)
    for stamp, name in [(0.0, "a"), (0.02, "c"), (0.04, "a")]:
        executor.advance(stamp)
        executor.submit(name, stamp)
    executor.advance(1.0)
    order = [job.node for job in executor.timetable]
    assert order == ["a", "c", "b", "a", "b"]


def test_a_called_node_takes_nothing_while_it_is_at_work():
    executor, _ = make({"control": 0.046})
    given = [executor.call("control", tick, 0.02 * tick) is not None for tick in range(6)]
    assert given == [True, False, False, True, False, False]
    assert executor.nodes["control"].dropped == 4
    first, second = executor.timetable
    assert first.end_s <= second.start_s
    assert executor.call("control", 5, 0.1, again=True) is not None  # its newest work, anew


inputs = st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, 30)), max_size=25)


@given(inputs, st.integers(1, 3))
def test_when_the_work_is_really_done_changes_nothing(plan, cores):
    """Computing early, late or never before the result is due gives the same story."""
    stories = []
    for eager in (False, True):
        executor, published = make({"a": 0.05, "b": 0.11, "c": 0.23}, cores)
        for name, tick in sorted(plan, key=lambda p: p[1]):
            executor.advance(tick * 0.02)
            executor.submit(name, tick)
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
        executor.submit(name, tick)
    executor.advance(100.0)
    for job in executor.timetable:
        middle = (job.start_s + job.end_s) / 2
        at_work = [j for j in executor.timetable if j.start_s <= middle < j.end_s]
        assert len(at_work) <= cores
        assert len({j.node for j in at_work}) == len(at_work)
