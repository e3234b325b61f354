"""Windows that markers cut a run into are the whole run, and a sample of them is a fair one."""

import subprocess
from collections import Counter

import numpy as np
import pytest

from mavfi_cli.attack.comparison import OutputComparison
from mavfi_cli.attack.profile import function_of, profile_calls, profile_run, started
from mavfi_cli.attack.program import ProgramTarget
from mavfi_cli.core.errors import TargetError, UnknownName
from mavfi_cli.fi.tracer.fault import FaultModel, Site, Strategy
from mavfi_cli.fi.tracer.sampling import WindowTooLong, record_window
from mavfi_cli.fi.tracer.spawn import Program
from mavfi_cli.fi.tracer.tracee import Mechanism

RECURSIVE = """
#include <stdio.h>
volatile long sink;
__attribute__((noinline)) void leaf(long i) { sink += i; }
__attribute__((noinline)) void tree(long depth) {
    sink++;
    if (depth) { tree(depth - 1); leaf(depth); tree(depth - 1); }
}
int main(void) { for (long i = 0; i < 4; i++) leaf(i); tree(3); printf("%ld\\n", sink); return 0; }
"""


# 40 windows of 7 to 163 instructions, and 20 of another function.
UNEVEN = """
#include <stdio.h>
volatile long sink;
__attribute__((noinline)) void few(long i) { sink += i; }
__attribute__((noinline)) void many(long i) { for (long k = 0; k < i; k++) sink += k; }
int main(void) {
    for (long i = 0; i < 40; i++) { many((i * 23) % 41); if (i % 2) few(i); }
    printf("%ld\\n", sink);
    return 0;
}
"""


@pytest.fixture
def place(native_program):
    """Function from a program's name to a place where it runs."""
    places = []

    def make(name, *arguments, **options):
        command = Program.of([str(native_program(name)), *arguments])
        target = ProgramTarget(command=command, comparison=OutputComparison(), **options)
        places.append(target.open())
        return places[-1]

    yield make
    for each in places:
        each.close()


@pytest.fixture
def recursive(place, native_program):
    """A place of a program whose functions call themselves and each other."""
    folder = native_program("counting").parent
    source = folder / "recursive.c"
    source.write_text(RECURSIVE)
    path = folder / "recursive"
    subprocess.run(["gcc", "-O1", "-o", str(path), str(source)], check=True)
    return place("recursive")


@pytest.fixture
def known_length(place, native_program):
    """A place of a short program, with the functions at which its windows begin."""
    folder = native_program("counting").parent
    source = folder / "uneven.c"
    source.write_text(UNEVEN)
    subprocess.run(["gcc", "-O1", "-o", str(folder / "uneven"), str(source)], check=True)
    where = place("uneven")
    return where, functions(where, "few", "many")


def functions(place, *names):
    tracee = place.start()
    image = place.image(tracee)
    found = tuple(image.function(name, [place.name]) for name in names)
    tracee.kill()
    return found


def in_order(profile):
    """All stepped windows as one trace, by where they begin."""
    whole = profile.strata[0]
    assert whole.marker is None
    traces = [segment.trace for segment in whole.segments]
    rest = [segment for stratum in profile.strata[1:] for segment in stratum.segments]
    return np.concatenate(traces), rest


@pytest.mark.parametrize("mechanism", list(Mechanism))
def test_all_windows_of_one_marker_are_the_whole_run(place, mechanism):
    where = place("counting", "25", mechanism=mechanism)
    rng = np.random.default_rng(1)
    whole, _ = in_order(profile_run(where, rng))
    cut = profile_run(where, rng, markers=functions(where, "body"), windows=25)
    assert cut.complete
    beginning, windows = in_order(cut)
    windows.sort(key=lambda segment: segment.start[0].count)
    assert [segment.start[0].count for segment in windows] == list(range(1, 26))
    traces = [segment.trace for segment in windows]
    assert np.array_equal(np.concatenate([beginning, *traces]), whole)
    assert len({len(trace) for trace in traces}) == 2  # the last one goes on to the end


def test_windows_of_several_markers_share_the_run_without_gap_or_overlap(recursive):
    rng = np.random.default_rng(1)
    whole = profile_run(recursive, rng)
    cut = profile_run(recursive, rng, markers=functions(recursive, "leaf", "tree"), windows=100)
    assert cut.complete
    counts = Counter()
    for stratum in cut.strata:
        counts[stratum.marker] += stratum.windows_in_run
    assert list(counts.values()) == [1, 4 + 7, 15]
    assert cut.instructions.value == cut.executed == whole.executed

    def addresses(profile):
        found = Counter()
        for stratum in profile.strata:
            for segment in stratum.segments:
                found.update(segment.trace.tolist())
        return found

    assert addresses(cut) == addresses(whole)


def test_calls_of_a_function_that_calls_itself_are_whole_calls(recursive):
    """Stepped in one run where they follow each other, in another where one holds the next."""
    profile = profile_calls(
        recursive, np.random.default_rng(1), functions(recursive, "tree"), windows=15
    )
    (stratum,) = profile.strata
    by_depth = Counter(len(segment.trace) for segment in stratum.segments)
    assert sorted(by_depth.values()) == [1, 2, 4, 8]
    assert [segment.start[0].count for segment in stratum.segments] == list(range(1, 16))


@pytest.mark.slow
def test_a_sample_estimates_the_run(known_length):
    """Over many seeds: on the average the true length, and in the interval as often as it says."""
    where, markers = known_length
    length = profile_run(where, np.random.default_rng(0)).executed
    samples = [
        profile_run(where, np.random.default_rng(seed), markers=markers, windows=4, enough=300)
        for seed in range(60)
    ]
    assert len({sample.executed for sample in samples}) > 30
    found = [sample.instructions for sample in samples]
    estimates = np.array([each.value for each in found])
    error = estimates.std(ddof=1) / np.sqrt(len(estimates))
    assert error < 0.05 * length
    assert abs(estimates.mean() - length) < 3.0 * error
    assert np.mean([each.low <= length <= each.high for each in found]) >= 0.85


def test_short_windows_are_stepped_until_it_is_enough(place):
    where = place("counting", "400")
    marker = functions(where, "body")
    profile = profile_run(where, np.random.default_rng(2), markers=marker, windows=3)
    assert profile.complete
    assert sum(stratum.windows_in_run for stratum in profile.strata) == 1 + 400


def test_windows_are_reached_by_the_detour_that_fits_at_their_marker(place):
    where = place("counting", "400")
    marker = functions(where, "body")
    _, *strata = profile_run(where, np.random.default_rng(2), markers=marker, windows=3).strata
    starts = [segment.start[0] for stratum in strata for segment in stratum.segments]
    detours = {start.detour for start in starts}
    assert detours == {starts[0].detour} != {None}
    address = {}
    for how in (starts[0].detour, None):
        with started(where) as tracee:
            at = where.image(tracee).address(marker[0])
            assert tracee.run_to(at, 321, how)
            address[how] = tracee.registers.read("rdi")
    assert set(address.values()) == {320}


def test_faults_are_drawn_evenly_over_all_windows(recursive):
    """Chi-square of the drawn instructions against what the whole run executes."""
    from scipy.stats import chisquare

    rng = np.random.default_rng(7)
    (whole,) = profile_run(recursive, rng).strata
    counts = Counter(whole.segments[0].trace.tolist())
    markers = functions(recursive, "leaf", "tree")
    profile = profile_run(recursive, rng, markers=markers, windows=100)
    plan = Strategy.of("instruction-uniform", FaultModel(sites=frozenset((Site.OPCODE,))))
    drawn = Counter(profile.image.address(profile.draw(plan, rng).target) for _ in range(3000))
    assert set(drawn) <= set(counts)
    frequent = [address for address, count in counts.items() if count >= 5]
    observed = np.array([drawn[address] for address in frequent], float)
    expected = np.array([counts[address] for address in frequent], float)
    assert chisquare(observed, expected * observed.sum() / expected.sum()).pvalue > 1e-3


def test_a_trigger_of_a_window_stops_before_its_execution(recursive):
    markers = functions(recursive, "leaf", "tree")
    rng = np.random.default_rng(11)
    (only,) = profile_run(recursive, rng).strata
    whole = only.segments[0].trace
    profile = profile_run(recursive, rng, markers=markers, windows=100)
    image, plan = profile.image, Strategy.of("instruction-uniform")
    for _ in range(12):
        fault = profile.draw(plan, rng)
        first, begin = fault.trigger[0], 0
        if first.location in markers:
            begin = np.flatnonzero(whole == image.address(first.location))[first.count - 1]
        executions = np.flatnonzero(whole[begin:] == image.address(fault.target))
        tracee = recursive.start()
        for stage in fault.trigger:
            assert tracee.run_to(image.address(stage.location), stage.count, stage.detour)
        scope = recursive.scope(image)
        rest = record_window(tracee, scope, limit=100_000, program="recursive")
        assert np.array_equal(rest, whole[begin + executions[fault.execution - 1] :])


def test_windows_that_are_too_long_and_functions_that_are_not_there_are_refused(place):
    where = place("counting", "50")
    rng = np.random.default_rng(1)
    with pytest.raises(WindowTooLong):
        profile_run(where, rng, limit=20)
    with pytest.raises(UnknownName, match="did you mean 'body'"):
        function_of(where, "bodi")
    idle = place("counting", "0")
    with pytest.raises(TargetError, match="never calls body"):
        profile_calls(idle, rng, functions(idle, "body"), windows=3)
