"""Faults in the planner node: one request is one invocation, straight or searched."""

import contextlib
import json
from collections import Counter
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from missions import POSTS

from mavfi_cli.attack.profile import profile_run
from mavfi_cli.attack.tracer_thread import TracerThread
from mavfi_cli.core.archive import unpack
from mavfi_cli.fi.tracer import record as records
from mavfi_cli.fi.tracer.linux import SUPPORTED
from mavfi_cli.mission.instruction.injection import GoldenOrders, draw_invocation
from mavfi_cli.mission.instruction.rehearsal import KernelInvocation, Rehearsal
from mavfi_cli.mission.instruction.server import Setup
from mavfi_cli.mission.machine import OK, check_tracing
from mavfi_cli.mission.progress import Watcher
from mavfi_cli.mission.run import fly_mission
from mavfi_cli.mission.run_folder import load_run
from mavfi_cli.spec.fault import InstructionConfig
from mavfi_cli.spec.mission import MissionConfig

traced = pytest.mark.skipif(
    not SUPPORTED or check_tracing().verdict != OK, reason="nothing can be traced here"
)
SEGMENT, PIECES, OMPL = "numba:segment_free", "numba:path_free", "libompl.so"
READER = "numba:decode_leaves"


def flown(folder):
    result = json.loads(folder.result.read_text())
    del result["host"]
    return folder.trace.read_bytes(), folder.tlog.read_bytes(), result


@pytest.fixture(scope="module")
def struck(fly_short):
    """Flies straight with a fault in its planner, once for each seed."""
    return cache(lambda seed: fly_short(instruction=InstructionConfig(target="planner", seed=seed)))


@pytest.mark.slow
@traced
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_flight_that_is_straight_takes_a_fault_in_its_planner(struck, seed):
    result = load_run(struck(seed).path).result
    fault = result["fault"]
    assert (fault["state"], fault["node"], fault["kernel"]) == ("applied", "planner", "rrtstar")
    assert fault["object"] in {SEGMENT, PIECES}
    assert fault["trigger"][0]["object"] == READER
    assert (fault["invocation"], fault["invocations"]) == (1, 1)
    assert fault["windows"] == "1 of 1"
    assert {SEGMENT, PIECES} < set(fault["scope"])
    (event,) = [e for e in result["events"] if e["kind"] == "fault"]
    assert f"{fault['object']}+{fault['offset']:#x}" in event["text"]


@pytest.mark.slow
@traced
def test_a_replay_of_a_fault_in_a_straight_request_is_the_same_to_the_byte(struck, tmp_path):
    first = struck(1)
    config, recorded = load_run(first.path).mission(), records.read(first.fault)
    assert flown(fly_mission(config, tmp_path, Watcher(), repeat=recorded)) == flown(first)


def test_a_node_gets_the_same_message_in_a_flight_and_in_its_replay(short_config, short_flight):
    asked = replace(short_config, v_max_mps=3)
    recorded = load_run(short_flight.path).mission()
    assert (asked.goal_tolerance_m, recorded.goal_tolerance_m) == (None, 1.0)
    assert Setup.of(asked, None, "planner") == Setup.of(recorded, None, "planner")


@pytest.mark.slow
@traced
def test_a_null_injection_in_a_straight_request_changes_nothing(fly_short, short_flight):
    folder = fly_short(instruction=InstructionConfig(target="planner", seed=1, null=True))
    assert folder.trace.read_bytes() == short_flight.trace.read_bytes()
    assert folder.tlog.read_bytes() == short_flight.tlog.read_bytes()
    assert load_run(folder.path).result["fault"]["state"] == "null"


@pytest.fixture(scope="module")
def searching(tmp_path_factory):
    """Setup of a planner node before whose goal a box stands, and its orders of the flight."""
    folder = tmp_path_factory.mktemp("box")
    world = folder / "box.toml"
    world.write_text(POSTS)
    config = MissionConfig(world=str(world), seed=2, planner="rrtconnect")
    attacked = replace(config, instruction=InstructionConfig(target="planner", seed=1))
    fly_mission(attacked, folder, Watcher())
    (kept,) = folder.glob(".profiles/*/orders.npz")
    golden = unpack(kept.read_bytes(), GoldenOrders)
    setup = Setup.of(config, golden.briefing, "planner")
    return setup, "planner", golden.of_process(["planner"])


@pytest.mark.slow
@traced
def test_the_instructions_of_a_search_stay_in_scope_and_windows_are_parts_of_the_request(searching):
    second = KernelInvocation(number=2, of=2, order=2, entry=2, earlier=1)

    def stepped(_):
        with contextlib.closing(Rehearsal(*searching)) as place:
            place.go_to(second)
            whole = profile_run(place, np.random.default_rng(1))
            sampled = place.profile(second, np.random.default_rng(1))
            return whole, replace(sampled, image=whole.image), place.scope_of_node.inner[1]

    whole, sampled, entry = TracerThread(stepped).result()
    trace = whole.strata[0].segments[0].trace
    assert whole.image.locate(int(trace[0])) == entry  # a test of the start comes first
    objects = Counter(whole.image.locate(int(address)).object for address in trace)
    assert set(objects) == {OMPL, SEGMENT, PIECES}
    assert objects[OMPL] > 1000

    assert not sampled.complete
    assert {stratum.marker.object for stratum in sampled.strata} == {OMPL, SEGMENT, PIECES}
    counts = Counter()
    for stratum in sampled.strata:
        counts[stratum.marker] += stratum.windows_in_run
        begins = np.flatnonzero(trace == whole.image.address(stratum.marker))
        for segment in stratum.segments:
            request, window = segment.start
            assert (request.location.object, request.count) == (READER, 2)
            begin = begins[window.count - 1]
            assert np.array_equal(segment.trace, trace[begin : begin + len(segment.trace)])
    for marker, count in counts.items():
        assert count == np.count_nonzero(trace == whole.image.address(marker))


def test_a_request_is_one_invocation_however_often_it_is_entered():
    drawn = [
        draw_invocation("planner", [1, 4, 4, 5], np.random.default_rng(seed)) for seed in range(60)
    ]
    assert {(each.number, each.order, each.entry, each.earlier) for each in drawn} == {
        (1, 1, 1, 0), (2, 2, 2, 1), (3, 4, 5, 4),
    }  # fmt: skip
    assert {each.of for each in drawn} == {3}


def test_every_entry_is_an_invocation_of_another_kernel():
    rngs = map(np.random.default_rng, range(60))
    drawn = [draw_invocation("collision_check", [0, 3, 5], rng) for rng in rngs]
    assert {(each.number, each.order, each.earlier) for each in drawn} == {
        (1, 2, 0), (2, 2, 0), (3, 2, 0), (4, 3, 3), (5, 3, 3),
    }  # fmt: skip
    assert all(each.entry == each.number and each.of == 5 for each in drawn)
