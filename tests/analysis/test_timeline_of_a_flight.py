"""The way of a frame through the kernels, found again in a time table."""

from types import SimpleNamespace

import pytest

from mavfi_cli.analysis.timeline import timelines
from mavfi_cli.core.errors import RecordError
from mavfi_cli.core.flight_record import Event
from mavfi_cli.core.types import Invocation, Reaction
from mavfi_cli.mission.run_folder import RunFolder, load_run


def ran(node, start_s, end_s):
    return Invocation(node=node, start_s=start_s, end_s=end_s)


def reaction(frame_s, setpoint_s):
    return Reaction(frame_stamp_s=frame_s, setpoint_stamp_s=setpoint_s)


def test_a_time_table_is_read_as_it_was_written(tmp_path):
    table = [ran("octomap", 1.0, 1.3), ran("control", 1.02, 1.0205)], [reaction(1.0, 1.4)]
    folder = RunFolder(tmp_path)
    folder.write_timetable(*table)
    assert folder.read_timetable() == table
    first = folder.kernels.read_bytes()
    folder.write_timetable(*table)
    assert folder.kernels.read_bytes() == first


@pytest.mark.parametrize("bad", [None, b"", b"PAR1 and nothing more"])
def test_a_damaged_time_table_is_one_line(tmp_path, bad):
    folder = RunFolder(tmp_path)
    if bad is not None:
        folder.kernels.write_bytes(bad)
    with pytest.raises(RecordError, match="cannot be read"):
        folder.read_timetable()


def flight(invocations, reactions, events=()):
    """What a timeline reads of a run."""
    folder = SimpleNamespace(read_timetable=lambda: (invocations, reactions))
    record = SimpleNamespace(events=[Event(kind="slow", stamp_s=s, text="?") for s in events])
    return {"x86": SimpleNamespace(folder=folder, record=record, trace=None)}


def test_the_chain_takes_the_newest_output_that_was_there():
    """The frame of 1.1 waits for the map; that of 1.0 was overtaken, that of 1.2 came too late."""
    table = [
        ran("point_cloud", 1.0, 1.01), ran("octomap", 0.7, 1.15), ran("point_cloud", 1.1, 1.11),
        ran("octomap", 1.15, 1.6), ran("point_cloud", 1.2, 1.21),
        ran("collision_check", 1.15, 1.2), ran("collision_check", 1.6, 1.65),
        ran("control", 1.64, 1.641), ran("control", 1.66, 1.661), ran("control", 1.68, 1.681),
    ]  # fmt: skip
    (line,) = timelines(flight(table, [reaction(1.1, 1.66)]))
    assert line.chain_s == {
        node: pytest.approx((start_s - 1.1, end_s - 1.1))
        for node, start_s, end_s in (
            ("point_cloud", 1.1, 1.11), ("octomap", 1.15, 1.6),
            ("collision_check", 1.6, 1.65), ("control", 1.66, 1.661),
        )
    }  # fmt: skip


def test_the_typical_reaction_is_near_the_median_and_one_that_did_something():
    slow, middle, acted = reaction(1.0, 1.9), reaction(2.0, 2.4), reaction(3.0, 3.5)
    reactions = [slow, middle, acted, reaction(4.0, 4.1)]
    (line,) = timelines(flight([], reactions))
    assert line.frame_stamp_s == middle.frame_stamp_s
    (line,) = timelines(flight([], reactions, events=(3.5,)))
    assert line.frame_stamp_s == acted.frame_stamp_s
    assert timelines(flight([], [])) == []


def test_a_flight_with_an_obstacle_tells_what_led_to_its_slowing_down(troubled_flight):
    run = load_run(troubled_flight.path)
    (line,) = timelines({"x86": run})
    stamp_s = line.frame_stamp_s + line.response_s
    acted = {round(e["stamp_s"], 6): e["text"] for e in run.result["events"]
             if e["kind"] in ("slow", "stop")}  # fmt: skip
    assert line.answer == acted[round(stamp_s, 6)]
    chain = line.chain_s
    order = ("point_cloud", "octomap", "collision_check", "control", "planner")
    assert tuple(chain) == order
    ends = [0.0]
    for kernel in order:
        start, end = chain[kernel]
        assert start >= ends[-1 if kernel != "planner" else -2] - 1e-9
        assert (start, end) in line.lanes_s[kernel]
        ends.append(end)
    assert chain["control"][0] == pytest.approx(line.response_s)
    assert line.plan_setpoint_s >= chain["planner"][1]
    assert line.shown_s[1] >= 1.0
    again = timelines({"x86": run, "other": run})
    assert [row.platform for row in again] == ["x86", "other"]
    assert again[0].shown_s == again[1].shown_s


def test_latencies_of_the_table_are_those_that_the_nodes_were_busy_for(troubled_flight):
    run = load_run(troubled_flight.path)
    invocations, reactions = run.folder.read_timetable()
    for kernel, work in run.result["kernels"].items():
        spans = [each for each in invocations if each.node == kernel]
        assert len(spans) == work["invocations"]
        assert sum(s.end_s - s.start_s for s in spans) == pytest.approx(work["busy_s"], abs=1e-6)
    assert len(reactions) == run.result["response_time_s"]["count"]
