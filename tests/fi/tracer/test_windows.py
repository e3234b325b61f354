"""The profile is the truth about what executed, and every trigger drawn from it is exact."""

import os
import signal
from collections import Counter

import numpy as np
import pytest

from mavfi_cli.core.errors import FaultError, UnknownName
from mavfi_cli.core.processes import Ended
from mavfi_cli.fi.tracer.fault import FaultModel, Site, Strategy
from mavfi_cli.fi.tracer.image import Image
from mavfi_cli.fi.tracer.inject import clean_step, instruction_at
from mavfi_cli.fi.tracer.sampling import (
    Segment,
    Stratum,
    WindowTooLong,
    draw_fault,
    record_window,
)
from mavfi_cli.fi.tracer.tracee import ExecutionCounter, Mechanism


def profile_of(start, name, *arguments, limit=100_000, reads_own_code=True):
    tracee = start(name, *arguments)
    image = Image(tracee.pid)
    scope = image.scope([name])
    trace = record_window(tracee, scope, limit=limit, program=name, reads_own_code=reads_own_code)
    return trace, image, scope


def whole(trace):
    """The population of a run that is one window."""
    return Stratum(segments=(Segment(start=(), trace=trace),), windows_in_run=1)


def stepped_in_python(start, name, *arguments):
    """The slow twin: every instruction of the process, also out of scope, one by one."""
    tracee = start(name, *arguments)
    scope = Image(tracee.pid).scope([name])
    trace = []
    while True:
        here = tracee.registers.ip
        if here in scope:
            trace.append(here)
        if clean_step(tracee, instruction_at(tracee, here)) is not None:
            return trace


@pytest.mark.parametrize("reads_own_code", [True, False])
@pytest.mark.parametrize("name", ["sorting", "destinations", "jumps"])
def test_the_profile_equals_stepping_everything(start, tmp_path, name, reads_own_code):
    trace, _, _ = profile_of(start, name, reads_own_code=reads_own_code)
    output = (tmp_path / "stdout").read_text()
    assert trace.tolist() == stepped_in_python(start, name)
    assert (tmp_path / "stdout").read_text() == output != ""


def test_counts_equal_the_kernels_own(start):
    trace, _, _ = profile_of(start, "sorting")
    counts = Counter(trace.tolist())
    for address in list(counts)[:: max(1, len(counts) // 8)]:
        tracee = start("sorting")
        tracee.registers.rearm()
        try:
            counter = ExecutionCounter(tracee.tid, address)
        except OSError as error:
            pytest.skip(f"perf_event_open is not allowed here: {error}")
        tracee.resume()
        assert counter.read() == counts[address]
        counter.close()


@pytest.mark.parametrize("reads_own_code", [True, False])
def test_a_function_window_ends_with_its_return(start, reads_own_code):
    tracee = start("counting", "50")
    image = Image(tracee.pid)
    body = image.address(image.function("body", ["counting"]))
    assert tracee.run_to(body, 7)
    window = record_window(
        tracee, image.scope(["counting"]), limit=1000, program="", until_return=True,
        reads_own_code=reads_own_code,
    )  # fmt: skip
    assert window[0] == body
    assert (window == body).sum() == 1
    assert image.symbol(image.locate(tracee.registers.ip)).startswith("main+")
    assert tracee.run_to(body, 1)
    assert tracee.registers.read("rdi") == 7


@pytest.mark.parametrize("reads_own_code", [True, False])
@pytest.mark.parametrize("mechanism", list(Mechanism))
def test_a_function_called_from_foreign_code_ends_there_too(start, mechanism, reads_own_code):
    tracee = start("sorting", mechanism=mechanism)
    image = Image(tracee.pid)
    compare = image.address(image.function("compare", ["sorting"]))
    assert tracee.run_to(compare, 2)
    window = record_window(
        tracee, image.scope(["sorting"]), limit=1000, program="", until_return=True,
        reads_own_code=reads_own_code,
    )  # fmt: skip
    assert window[0] == compare
    assert image.locate(tracee.registers.ip).object.startswith("libc")
    assert tracee.run_to(compare, 1)


@pytest.mark.parametrize("reads_own_code", [True, False])
def test_a_program_that_is_killed_in_its_window_ends_the_window(start, reads_own_code):
    tracee = start("counting", "1000")

    def kill(recorded):
        if recorded:
            os.kill(tracee.pid, signal.SIGKILL)

    window = record_window(
        tracee, Image(tracee.pid).scope(["counting"]), limit=100_000, program="", watch=kill,
        reads_own_code=reads_own_code,
    )  # fmt: skip
    assert 0 < len(window) < 10_000
    assert tracee.ended == Ended(exit_code=None, signal=signal.SIGKILL)


def test_a_window_that_is_too_long_is_refused(start):
    with pytest.raises(WindowTooLong, match="more than 100 instructions"):
        profile_of(start, "counting", "1000", limit=100)


@pytest.mark.parametrize(("name", "arguments"), [("counting", ("60",)), ("flows", ())])
def test_every_trigger_stops_before_its_execution(start, name, arguments):
    trace, image, _ = profile_of(start, name, *arguments)
    stratum = whole(trace)
    code = start(name, *arguments).memory
    indices = np.random.default_rng(5).integers(len(trace), size=24)
    detours = 0
    for index in map(int, indices):
        trigger, k = stratum.trigger(index, image.locate, lambda at: code.read(at, 16))
        assert k == int((trace[: index + 1] == trace[index]).sum())
        tracee = start(name, *arguments)
        for stage in trigger:
            assert tracee.run_to(image.address(stage.location), stage.count, stage.detour)
        detours += any(stage.detour is not None for stage in trigger)
        rest = record_window(
            tracee, image.scope([name]), limit=100_000, program=name, reads_own_code=False
        )
        assert np.array_equal(rest, trace[index:])
    assert detours > 4


def test_a_two_level_trigger_counts_less():
    """An outer instruction every 1000 executions of an inner one."""
    trace = np.array(([1] + [2, 3] * 1000) * 20, np.int64)
    index = 2001 * 15 + 9
    trigger, k = whole(trace).trigger(index, lambda address: address, lambda _: b"")
    assert k == 15 * 1000 + int(np.sum(trace[2001 * 15 : index + 1] == trace[index]))
    assert [(stage.location, stage.count) for stage in trigger] == [(1, 16), (int(trace[index]), 5)]


def test_ranks_count_executions():
    trace = np.random.default_rng(2).integers(0, 5, 300)
    seen = Counter()
    expected = []
    for address in trace.tolist():
        seen[address] += 1
        expected.append(seen[address])
    assert Segment(start=(), trace=trace).ranks.tolist() == expected


def test_faults_are_uniform_over_executed_instructions(start):
    """Chi-square of the drawn addresses against the profile's counts."""
    from scipy.stats import chisquare

    trace, image, _ = profile_of(start, "counting", "40")
    tracee = start("counting", "40")
    plan = Strategy.of("instruction-uniform", FaultModel(sites=frozenset((Site.OPCODE,))))
    profile = whole(trace)
    rng = np.random.default_rng(11)
    drawn = Counter(
        image.address(
            draw_fault(
                profile,
                plan,
                rng,
                code_at=lambda address: tracee.memory.read(address, 16),
                locate=image.locate,
            ).target
        )
        for _ in range(3000)
    )
    counts = Counter(trace.tolist())
    frequent = [address for address, count in counts.items() if count >= 40]
    observed = [drawn[address] for address in frequent]
    expected = np.array([counts[address] for address in frequent], float)
    expected *= sum(observed) / expected.sum()
    assert chisquare(observed, expected).pvalue > 1e-3
    share = sum(counts[a] for a in frequent) / len(trace)
    assert abs(sum(observed) / 3000 - share) < 5 * np.sqrt(share * (1 - share) / 3000)


def test_unknown_rules_objects_and_functions_name_the_nearest(start):
    with pytest.raises(UnknownName, match="did you mean 'cpu-time'"):
        Strategy.of("cpu-tim")
    with pytest.raises(UnknownName, match="did you mean 'rosfi-2021'"):
        Strategy.of("wall-clock", compat="rosfi-2020")
    image = Image(start("counting").pid)
    with pytest.raises(UnknownName, match="did you mean 'counting'"):
        image.scope(["countin"])
    with pytest.raises(UnknownName, match="did you mean 'body'"):
        image.function("bodi", ["counting"])


def test_a_scope_without_a_matching_operand_is_an_error(start):
    trace, image, _ = profile_of(start, "sorting")
    tracee = start("sorting")
    profile = whole(trace)
    plan = Strategy.of("instruction-uniform", FaultModel(sites=frozenset((Site.MASK,))))
    with pytest.raises(FaultError, match="none of 10,000 drawn instructions"):
        draw_fault(
            profile,
            plan,
            np.random.default_rng(0),
            code_at=lambda address: tracee.memory.read(address, 16),
            locate=image.locate,
        )
