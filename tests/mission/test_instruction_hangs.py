"""A flip in a planner's loop that makes its node hang: the watchdog ends it, every time alike."""

import contextlib
import json
import os

import pytest
from missions import POSTS
from native_programs import register_corruption

from mavfi_cli.attack.kernels.scope import kernel_scope
from mavfi_cli.attack.tracer_thread import TracerThread
from mavfi_cli.autonomy.warm import warm_up
from mavfi_cli.companion import node_process
from mavfi_cli.fi.tracer import record as records
from mavfi_cli.fi.tracer.counted import CountedStop
from mavfi_cli.fi.tracer.decode import decode
from mavfi_cli.fi.tracer.fault import InstructionFault, Role
from mavfi_cli.fi.tracer.image import Image, Location
from mavfi_cli.fi.tracer.linux import SUPPORTED
from mavfi_cli.mission.instruction import rehearsal
from mavfi_cli.mission.instruction.injection import GoldenOrders
from mavfi_cli.mission.instruction.rehearsal import KernelInvocation, NodeEffect
from mavfi_cli.mission.instruction.server import Setup
from mavfi_cli.mission.machine import OK, check_tracing
from mavfi_cli.mission.progress import Recorder, Watcher
from mavfi_cli.mission.run import fly_golden, fly_mission
from mavfi_cli.mission.run_folder import load_run
from mavfi_cli.spec.fault import InstructionConfig
from mavfi_cli.spec.mission import MissionConfig

SEGMENT = "numba:segment_free"
EXECUTION = 150  # in a segment whose prolongation misses the box
SEARCHES = {"kernel": "rrtconnect", "node": "planner", "invocation": 1, "invocations": 1}
UNKNOWN = {"stamp_s": 0.0, "sampling": "chosen", "windows": "none", "seed": 0, "request": {},
           "profiled_instructions": 0}  # fmt: skip

pytestmark = pytest.mark.skipif(
    not SUPPORTED or check_tracing().verdict != OK, reason="nothing can be traced here"
)


def countdown(code, start):
    """The first instruction that counts a 64-bit register down by one."""
    at = 0
    while at < len(code):
        found = decode(code[at : at + 16], start + at)
        if found is not None and found.mnemonic == "dec" and found.writes[0].mask == 2**64 - 1:
            return found
        at += 1 if found is None else len(found.raw)
    raise AssertionError("this build of segment_free does not count down")


@pytest.fixture
def endless(world_to_search):
    """A record: the steps that are left of a tested segment become 2^49 more, once."""
    warm_up()
    scope = kernel_scope("rrtconnect")
    image, span = Image(os.getpid(), scope.regions), scope.regions[SEGMENT].span
    with open("/proc/self/mem", "rb", buffering=0) as memory:
        memory.seek(span.start)
        found = countdown(memory.read(len(span)), span.start)
    register = next(use.register for use in found.writes if use.register != "rflags")
    fault = InstructionFault(
        trigger=(
            CountedStop(scope.entry, 1),
            CountedStop(Location(SEGMENT, found.address - span.start), EXECUTION),
        ),
        execution=EXECUTION,
        instruction=found.text,
        instruction_bytes=found.raw,
        corruption=register_corruption(register, 49, Role.DESTINATION),
    )
    return records.planned(
        fault, image, node_invocation=world_to_search[1], scope=[], **SEARCHES, **UNKNOWN
    )


@pytest.fixture
def world_to_search(tmp_path):
    """A world in whose middle a box stands; the order with which the planner first searches."""
    world = tmp_path / "box.toml"
    world.write_text(POSTS)
    config = MissionConfig(
        world=str(world), seed=2, planner="rrtconnect", node_watchdog_s=1.0, time_limit_s=12.0,
        instruction=InstructionConfig(target="planner"),
    )  # fmt: skip
    return config, 2


@pytest.mark.slow
def test_a_flip_that_hangs_a_node_is_ended_by_the_watchdog(
    endless, world_to_search, monkeypatch, tmp_path
):
    monkeypatch.setattr(node_process, "HANG_CPU_S", 1.0)
    config, flown = world_to_search[0], []
    for _ in range(2):
        folder = fly_mission(config, tmp_path, Watcher(), repeat=endless)
        result = load_run(folder.path).result
        del result["host"]
        flown.append((folder.trace.read_bytes(), json.dumps(result)))
    assert flown[0] == flown[1]
    assert result["fault"]["state"] == "applied"
    ends = result["nodes"]["planner"]
    assert (ends["crashes"], ends["hangs"], ends["restarts"]) == ([], 1, 1)
    assert result["kernels"]["planner"]["busy_s"] > config.node_watchdog_s


@pytest.mark.slow
def test_a_flip_hangs_a_rehearsed_node_in_the_same_way(
    endless, world_to_search, monkeypatch, tmp_path
):
    monkeypatch.setattr(rehearsal, "HANG_CPU_S", 1.0)
    config, recorder = world_to_search[0].golden, Recorder()
    fly_golden(config, tmp_path, recorder)
    orders = GoldenOrders.of(recorder)
    setup = Setup.of(config, orders.briefing, "planner")
    invocation = KernelInvocation(number=1, of=1, order=world_to_search[1], entry=1, earlier=0)

    def strike(_):
        place = rehearsal.Rehearsal(setup, "planner", orders.of_process(["planner"]))
        with contextlib.closing(place):
            return place.strike(records.fault_of(endless), invocation, {})

    struck = TracerThread(strike).result()
    assert struck.effect is NodeEffect.HUNG
    assert struck.record["injection"]["applied"]
    assert struck.how == "hung: killed by the watchdog"
    with pytest.raises(node_process.NodeLost) as lost:
        struck.process.take(struck.process.order("planner", None, 0.0))
    assert lost.value.hung
