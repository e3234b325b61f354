"""Recorded faults of the injector do the same in an emulator that shares no code with it."""

import shutil
import sys
from pathlib import Path

import pytest

pytest.importorskip("unicorn")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc is not installed"),
    pytest.mark.skipif(shutil.which("valgrind") is None, reason="valgrind is missing"),
]
BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
FAULTS = 36


@pytest.fixture
def count(monkeypatch):
    monkeypatch.syspath_prepend(BENCHMARKS)
    import independent_count

    yield independent_count
    del sys.modules["independent_count"], sys.modules["emulator"]


def test_recorded_faults_do_the_same_in_an_emulator(count, tracing, tmp_path):
    program = count.build(count.SOURCES / "sorting.c", tmp_path)
    records = count.inject(program, tmp_path / "faults", runs=FAULTS, jobs=1)
    work = count.Work(bench=count.Bench.of(program), seed=1)
    repeated = [work.repeated(record) for record in records]
    assert len({each["outcome"] for each in repeated}) > 1
    assert {each["run"]: each["differs"] for each in repeated if each["differs"]} == {}


def test_an_own_fault_strikes_where_it_is_drawn(count, tmp_path):
    bench = count.Bench.of(count.build(count.SOURCES / "stencil.c", tmp_path))
    drawn = [bench.draw(1, number) for number in range(300)]
    assert all(bench.code.written(fault.address) for fault in drawn)
    fault = next(each for each in drawn if each.struck.operand == "rax")
    struck = bench.strike(fault)
    assert (struck.before ^ struck.after).bit_count() == 1
