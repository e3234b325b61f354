"""A kernel inside a running Python process: profiled, attacked, and left running."""

import json
import subprocess
import sys
import threading
from dataclasses import replace

import numpy as np
import pytest

from mavfi_cli.fi import record
from mavfi_cli.fi.isolated.profile import Stratum, TargetProfile
from mavfi_cli.fi.native import tracee
from mavfi_cli.fi.native.arch import decode
from mavfi_cli.fi.native.fault import InstructionFault, Role, Stage, explicit_corruption
from mavfi_cli.fi.native.image import Image, Location, executable_mapping
from mavfi_cli.fi.native.inject import Activation
from mavfi_cli.fi.native.node import (
    EntryCounter,
    attack,
    count_executions,
    profile_invocation,
)
from mavfi_cli.fi.native.profile import Profile
from mavfi_cli.fi.sampling import strategy

KERNEL = """
__attribute__((noinline)) double inner(double x) { return x * x; }
double kernel(const double *x, int n) {
    double s = 0; for (int i = 0; i < n; i++) s += inner(x[i]); return s;
}
"""
NODE = """
import ctypes, sys
library = ctypes.CDLL(sys.argv[1])
library.kernel.restype = ctypes.c_double
print("ready", flush=True)
for line in sys.stdin:
    numbers = [float(word) for word in line.split()]
    array = (ctypes.c_double * len(numbers))(*numbers)
    print(repr(library.kernel(array, len(numbers))), flush=True)
"""
COMPILED_NODE = """
import ctypes, sys
from numba import carray, cfunc, types
@cfunc(types.float64(types.CPointer(types.float64), types.int32))
def kernel(data, n):
    s = 0.0
    for x in carray(data, n):
        s += x * x
    return s
call = ctypes.CFUNCTYPE(ctypes.c_double, ctypes.c_void_p, ctypes.c_int)(kernel.address)
print(kernel.address, flush=True)
for line in sys.stdin:
    numbers = [float(word) for word in line.split()]
    array = (ctypes.c_double * len(numbers))(*numbers)
    print(repr(call(ctypes.addressof(array), len(numbers))), flush=True)
"""


@pytest.fixture
def node(native_program, tmp_path):
    native_program("counting")  # skips where there is no compiler or no tracing
    source, library = tmp_path / "kernel.c", tmp_path / "libkernel.so"
    source.write_text(KERNEL)
    subprocess.run(["gcc", "-O1", "-shared", "-fPIC", "-o", library, source], check=True)
    process = subprocess.Popen(
        [sys.executable, "-c", NODE, library],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout.readline() == "ready\n"
    yield process
    process.kill()
    process.communicate()


def ask(process, *numbers):
    process.stdin.write(" ".join(map(str, numbers)) + "\n")
    process.stdin.flush()
    return float(process.stdout.readline())


class Tracer:
    """Runs a function in its own thread and waits until it is armed."""

    def __init__(self, function, *arguments, **options):
        self._armed = threading.Event()
        self._result = None

        def work():
            try:
                self._result = function(*arguments, armed=self._armed.set, **options)
            except BaseException as error:
                self._result = error
            finally:
                self._armed.set()

        self._thread = threading.Thread(target=work)
        self._thread.start()
        self._armed.wait()

    def result(self):
        self._thread.join()
        if isinstance(self._result, BaseException):
            raise self._result
        return self._result


def entry_of(process):
    return Image(process.pid).function("kernel", ["libkernel.so"])


def profiled(process, invocation=1):
    tracer = Tracer(
        profile_invocation, process.pid, entry_of(process), invocation, objects=("libkernel.so",)
    )
    for _ in range(invocation):
        assert ask(process, 1, 2, 3) == 14.0
    return tracer.result()


def to_draw_from(found):
    profile = Profile(segments=(found.segment,), windows_in_run=1, cost_s=0.0)
    stratum = Stratum(marker=None, profile=profile)
    return TargetProfile(strata=(stratum,), image=found.image, code=found.code, cost_s=0.0)


def test_an_invocation_is_profiled_and_the_node_goes_on(node):
    found = profiled(node, 3)
    assert found.segment.start == (Stage(entry_of(node), 3),)
    texts = {found.image.symbol(found.image.locate(int(a))) for a in found.segment.trace}
    assert {text.split("+")[0] for text in texts} >= {"kernel", "inner"}
    assert len(found.segment.trace) > 3 * 4
    assert ask(node, 3, 4) == 25.0


@pytest.fixture(params=[None, "refused"])
def counting(request, monkeypatch):
    """Executions are counted by the kernel, then by debug registers."""
    if request.param is not None:
        monkeypatch.setattr(tracee, "perf_allowed", lambda: request.param)


@pytest.mark.usefixtures("counting")
def test_entries_are_counted_while_the_node_works(node):
    inner = Image(node.pid).function("inner", ["libkernel.so"])
    counter = EntryCounter(node.pid, Image(node.pid).address(inner))
    counts = []
    for numbers in [(1, 2, 3), (1,), (4, 5, 6, 7)]:
        ask(node, *numbers)
        counts.append(counter.read())
    counter.close()
    assert counts == [3, 4, 8]


@pytest.mark.usefixtures("counting")
def test_a_large_kernel_is_profiled_by_sample(node):
    entry = entry_of(node)
    inner = Image(node.pid).function("inner", ["libkernel.so"])
    tracer = Tracer(count_executions, node.pid, entry, 2, [inner, entry])
    assert [ask(node, 1, 2, 3), ask(node, 1, 2, 3, 4)] == [14.0, 30.0]
    assert tracer.result() == [4, 1]
    stages = (Stage(inner, 3),)
    tracer = Tracer(profile_invocation, node.pid, entry, 1, objects=("libkernel.so",), inner=stages)
    assert ask(node, 1, 2, 3) == 14.0
    found = tracer.result()
    assert found.segment.start == (Stage(entry, 1), *stages)
    assert len(found.segment.trace) == 2  # mulsd, ret
    assert ask(node, 1, 2) == 5.0


def test_a_fault_hits_exactly_its_invocation(node, tmp_path):
    found = profiled(node)
    image, entry = found.image, entry_of(node)
    instruction_bytes = to_draw_from(found).code_at(image.address(entry))
    first = decode(instruction_bytes, image.address(entry))
    fault = InstructionFault(
        trigger=(Stage(entry, 3),),
        execution=1,
        instruction=first.text,
        instruction_bytes=first.raw,
        corruption=explicit_corruption("rsi", 0, Role.SOURCE),  # n: 3 becomes 2
    )
    path = tmp_path / "fault.json"
    tracer = Tracer(attack, node.pid, fault, path=path, kernel="test")
    assert json.loads(path.read_text())["state"] == "planned"
    assert [ask(node, 1, 2, 3) for _ in range(5)] == [14.0, 14.0, 5.0, 14.0, 14.0]
    done = tracer.result()
    assert done.ended is None
    assert (done.injection.before & 0xFF, done.injection.after & 0xFF) == (3, 2)
    written = record.read(path)
    assert (written["state"], written["kernel"]) == ("completed", "test")
    assert record.fault_of(written) == fault


def test_drawn_faults_repeat_in_the_node(node, tmp_path):
    found = profiled(node)
    plan = strategy("instruction-uniform")
    rng = np.random.default_rng(21)
    for _ in range(40):
        fault = to_draw_from(found).draw(plan, rng)
        if fault.corruption.register.startswith(("xmm", "ymm", "zmm")):
            break
    answers = []
    for _ in range(3):
        tracer = Tracer(attack, node.pid, fault, path=tmp_path / "fault.json")
        answers.append(ask(node, 1, 2, 3))
        done = tracer.result()
        assert done.injection.applied
        assert done.followed.activation is not Activation.NOT_INJECTED
    assert len({repr(answer) for answer in answers}) == 1
    assert ask(node, 1, 2, 3) == 14.0


def test_a_node_that_crashes_is_reported(node, tmp_path):
    found = profiled(node)
    fault = to_draw_from(found).draw(strategy("instruction-uniform"), np.random.default_rng(0))
    wild = replace(fault, corruption=explicit_corruption("rip", 45, Role.DESTINATION))
    tracer = Tracer(attack, node.pid, wild, path=tmp_path / "fault.json")
    node.stdin.write("1 2 3\n")
    node.stdin.flush()
    done = tracer.result()
    assert done.injection.applied
    assert node.stdout.readline() == ""
    assert node.wait() == -11


def test_a_null_injection_leaves_the_answers(node, tmp_path):
    found = profiled(node)
    fault = to_draw_from(found).draw(strategy("instruction-uniform"), np.random.default_rng(0))
    tracer = Tracer(attack, node.pid, replace(fault, corruption=None), path=tmp_path / "f.json")
    assert ask(node, 1, 2, 3) == 14.0
    assert tracer.result().reason == ""


def test_a_kernel_without_a_file_is_a_region(native_program, tmp_path):
    native_program("counting")  # skips where there is no tracing
    process = subprocess.Popen(
        [sys.executable, "-c", COMPILED_NODE],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        address = int(process.stdout.readline())
        span = executable_mapping(process.pid, address)
        regions = {"numba:kernel": span}
        entry = Location("numba:kernel", address - span.start)
        tracer = Tracer(
            profile_invocation, process.pid, entry, 2, objects=tuple(regions), regions=regions
        )
        assert [ask(process, 1, 2, 3) for _ in range(3)] == [14.0] * 3
        found = tracer.result()
        assert len(found.segment.trace) > 6
        first = decode(to_draw_from(found).code_at(address), address)
        fault = InstructionFault(
            trigger=(Stage(entry, 2),),
            execution=1,
            instruction=first.text,
            instruction_bytes=first.raw,
            corruption=explicit_corruption("rsi", 0, Role.SOURCE),
        )
        path = tmp_path / "fault.json"
        tracer = Tracer(attack, process.pid, fault, path=path, regions=regions)
        assert [ask(process, 1, 2, 3) for _ in range(3)] == [14.0, 5.0, 14.0]
        assert tracer.result().record["object"] == "numba:kernel"
        assert record.read(path)["build_ids"]["numba:kernel"].startswith("sha256:")
    finally:
        process.kill()
        process.communicate()
