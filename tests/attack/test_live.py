"""A kernel inside a running Python process: profiled in others, attacked, and left running."""

import json
import subprocess
import sys
import threading
from dataclasses import replace

import numpy as np
import pytest
from native_programs import register_corruption

from mavfi_cli.attack.live import attack_live
from mavfi_cli.attack.profile import profile_call, profile_calls
from mavfi_cli.attack.tracer_thread import EntryCounter
from mavfi_cli.core.errors import TargetError
from mavfi_cli.fi.tracer import linux, record, tracee
from mavfi_cli.fi.tracer.counted import CountedStop
from mavfi_cli.fi.tracer.decode import decode
from mavfi_cli.fi.tracer.fault import InstructionFault, Role, Strategy
from mavfi_cli.fi.tracer.image import Image, Location, executable_mapping
from mavfi_cli.fi.tracer.inject import BitActivation
from mavfi_cli.fi.tracer.tracee import Tracee

KERNEL = """
__attribute__((noinline)) double inner(double x) { return x * x; }
__attribute__((noinline)) double seldom(double x) { return x * x; }
__attribute__((noinline)) double never(double x) { return x * x; }
double kernel(const double *x, int n) {
    double s = 0; for (int i = 0; i < n; i++) s += inner(x[i]);
    return n > 0 ? s - seldom(0.0) : s;
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


def started(*arguments):
    return subprocess.Popen(
        [sys.executable, "-c", *map(str, arguments)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


@pytest.fixture
def library(native_program, tmp_path):
    native_program("counting")  # skips where there is no compiler or no tracing
    source, library = tmp_path / "kernel.c", tmp_path / "libkernel.so"
    source.write_text(KERNEL)
    subprocess.run(["gcc", "-O1", "-shared", "-fPIC", "-o", library, source], check=True)
    return library


@pytest.fixture
def node(library):
    process = started(NODE, library)
    assert process.stdout.readline() == "ready\n"
    yield process
    process.kill()
    process.communicate()


class FreshNodes:
    """A place of one's own: every run is a node of its own, stopped at the kernel's entry."""

    name = kind = "node"

    def __init__(self, *arguments):
        self._arguments = arguments
        self._processes = []

    def start(self):
        with linux.fixed_addresses():
            process = started(*self._arguments)
        self._processes.append(process)
        self._told = process.stdout.readline().strip()
        run = Tracee.attach(process.pid)
        process.stdin.write("1 2 3\n")
        process.stdin.close()  # it ends when it has answered
        assert run.run_to(self.image(run).address(self.entry(run)))
        return run

    def image(self, run):
        return Image(run.pid, self._regions(run))

    def _regions(self, run):
        if self._told == "ready":
            return {}
        return {"numba:kernel": executable_mapping(run.pid, int(self._told))}

    def entry(self, run):
        regions = self._regions(run)
        if not regions:
            return Image(run.pid).function("kernel", ["libkernel.so"])
        return Location("numba:kernel", int(self._told) - regions["numba:kernel"].start)

    def scope(self, image):
        return image.scope(["libkernel.so" if self._told == "ready" else "numba:kernel"])

    def close(self):
        for process in self._processes:
            process.stdout.close()
            process.wait()


@pytest.fixture
def nodes(library):
    place = FreshNodes(NODE, library)
    yield place
    place.close()


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


@pytest.fixture
def profiled(nodes, node):
    """What one call of the kernel executes; the first of the node that is attacked."""
    return profile_call(nodes).after(CountedStop(entry_of(node), 1))


def test_a_call_is_profiled_from_its_entry_to_its_return(profiled, node):
    (stratum,) = profiled.strata
    (segment,) = stratum.segments
    assert segment.start == (CountedStop(entry_of(node), 1),)
    texts = {profiled.image.symbol(profiled.image.locate(int(a))) for a in segment.trace}
    assert {text.split("+")[0] for text in texts} >= {"kernel", "inner"}
    assert len(segment.trace) > 3 * 4


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
def test_a_large_kernel_is_profiled_by_sample(nodes, node):
    """One of two functions, drawn by how often each is called, and some of its calls."""
    inner, seldom = (Image(node.pid).function(n, ["libkernel.so"]) for n in ("inner", "seldom"))
    drawn = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        found = profile_calls(nodes, rng, [inner, seldom], windows=2)
        (stratum,) = found.strata
        assert stratum.windows_in_run == 3 + 1
        for segment in stratum.segments:
            assert segment.start[0].location == stratum.marker
            assert len(segment.trace) == 2  # mulsd, ret
        drawn.append((stratum.marker, len(stratum.segments)))
    assert set(drawn) == {(inner, 2), (seldom, 1)}


def test_functions_that_are_never_called_cannot_be_sampled(nodes, node):
    never = Image(node.pid).function("never", ["libkernel.so"])
    with pytest.raises(TargetError, match="never calls never"):
        profile_calls(nodes, np.random.default_rng(0), [never], windows=2)


def test_a_fault_hits_exactly_its_invocation(profiled, node, tmp_path):
    image, entry = profiled.image, entry_of(node)
    instruction_bytes = profiled.code_at(image.address(entry))
    first = decode(instruction_bytes, image.address(entry))
    fault = InstructionFault(
        trigger=(CountedStop(entry, 3),),
        execution=1,
        instruction=first.text,
        instruction_bytes=first.raw,
        corruption=register_corruption("rsi", 0, Role.SOURCE),  # n: 3 becomes 2
    )
    path = tmp_path / "fault.json"
    tracer = Tracer(attack_live, node.pid, fault, path=path, kernel="test")
    assert json.loads(path.read_text())["state"] == "planned"
    assert [ask(node, 1, 2, 3) for _ in range(5)] == [14.0, 14.0, 5.0, 14.0, 14.0]
    done = tracer.result()
    assert done.ended is None
    assert (done.injection.before & 0xFF, done.injection.after & 0xFF) == (3, 2)
    written = record.read(path)
    assert (written["state"], written["kernel"]) == ("completed", "test")
    assert record.fault_of(written) == fault


def test_drawn_faults_repeat_in_the_node(profiled, node, tmp_path):
    plan = Strategy.of("instruction-uniform")
    rng = np.random.default_rng(21)
    for _ in range(40):
        fault = profiled.draw(plan, rng)
        if fault.corruption.register.startswith(("xmm", "ymm", "zmm")):
            break
    answers = []
    for _ in range(3):
        tracer = Tracer(attack_live, node.pid, fault, path=tmp_path / "fault.json")
        answers.append(ask(node, 1, 2, 3))
        done = tracer.result()
        assert done.injection.applied
        assert done.followed.activation is not BitActivation.NOT_INJECTED
    assert len({repr(answer) for answer in answers}) == 1
    assert ask(node, 1, 2, 3) == 14.0


def test_a_node_that_crashes_is_reported(profiled, node, tmp_path):
    fault = profiled.draw(Strategy.of("instruction-uniform"), np.random.default_rng(0))
    wild = replace(fault, corruption=register_corruption("rip", 45, Role.DESTINATION))
    tracer = Tracer(attack_live, node.pid, wild, path=tmp_path / "fault.json")
    node.stdin.write("1 2 3\n")
    node.stdin.flush()
    done = tracer.result()
    assert done.injection.applied
    assert node.stdout.readline() == ""
    assert node.wait() == -11


def test_a_null_injection_leaves_the_answers(profiled, node, tmp_path):
    fault = profiled.draw(Strategy.of("instruction-uniform"), np.random.default_rng(0))
    tracer = Tracer(
        attack_live, node.pid, replace(fault, corruption=None), path=tmp_path / "f.json"
    )
    assert ask(node, 1, 2, 3) == 14.0
    assert tracer.result().reason == ""


@pytest.fixture
def compiled_nodes():
    place = FreshNodes(COMPILED_NODE)
    yield place
    place.close()


@pytest.mark.slow
def test_a_kernel_without_a_file_is_a_region(library, compiled_nodes, tmp_path):
    found = profile_call(compiled_nodes)
    assert len(found.strata[0].segments[0].trace) > 6
    process = started(COMPILED_NODE)
    try:
        address = int(process.stdout.readline())
        span = executable_mapping(process.pid, address)
        regions = {"numba:kernel": span}
        entry = Location("numba:kernel", address - span.start)
        at = found.image.address(entry)
        first = decode(found.code_at(at), at)
        fault = InstructionFault(
            trigger=(CountedStop(entry, 2),),
            execution=1,
            instruction=first.text,
            instruction_bytes=first.raw,
            corruption=register_corruption("rsi", 0, Role.SOURCE),
        )
        path = tmp_path / "fault.json"
        tracer = Tracer(attack_live, process.pid, fault, path=path, regions=regions)
        assert [ask(process, 1, 2, 3) for _ in range(3)] == [14.0, 5.0, 14.0]
        assert tracer.result().record["object"] == "numba:kernel"
        assert record.read(path)["build_ids"]["numba:kernel"].startswith("sha256:")
    finally:
        process.kill()
        process.communicate()
