"""Kernels whose outcome is known are told right, every time."""

import shutil
import subprocess
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from native_programs import register_corruption

from mavfi_cli.attack import served
from mavfi_cli.attack.attacker import Attacker, golden_run
from mavfi_cli.attack.campaign import Plan, run_campaign
from mavfi_cli.attack.kernels import catalogue
from mavfi_cli.attack.kernels.target import KernelTarget
from mavfi_cli.attack.target import RunOutcome
from mavfi_cli.core.errors import TargetError
from mavfi_cli.fi.tracer.counted import CountedStop
from mavfi_cli.fi.tracer.decode import decode
from mavfi_cli.fi.tracer.fault import InstructionFault, Role

TAKING = """
import numpy as np
from mavfi_cli.attack.kernels.catalogue import Kernel
from mavfi_cli.attack.kernels.scope import compiled_scope
from mavfi_cli.autonomy.octree import decode_leaves

def prepare(_inputs):
    decode_leaves(np.zeros(0, np.uint8), np.empty((0, 4), np.int64))
    return lambda: {{"size": np.array([np.empty(300 << 20, np.uint8).size])}}

KERNEL = Kernel(
    name="taking", title="Taking", prepare=prepare, memory_mb={memory_mb},
    code=lambda: compiled_scope("taking", decode_leaves),
)
"""
KNOWN = Path(__file__).parent / "known_kernel.py"
# In each, r10 is set once: corrupted after that, it is never read, dereferenced, waited for or
# returned.
BODIES = {
    RunOutcome.BENIGN: 'long r = 7; __asm__ volatile("mov $1, %%r10" ::: "r10"); return r;',
    RunOutcome.CRASH: 'static long v = 7; long r, *p = &v; __asm__ volatile('
    '"mov %1, %%r10; mov (%%r10), %0" : "=r"(r) : "r"(p) : "r10"); return r;',
    RunOutcome.HANG: 'long r = 7; __asm__ volatile('
    '"mov $0, %%r10; 1: test %%r10, %%r10; jne 1b" ::: "r10", "cc"); return r;',
    RunOutcome.SDC: 'long r; __asm__ volatile('
    '"mov $7, %%r10; mov %%r10, %0" : "=r"(r) :: "r10"); return r;',
}  # fmt: skip


@pytest.fixture
def known_target(tracing, kernel_inputs, tmp_path):
    """Function from a C body to a kernel in a file of its own."""
    compiler = shutil.which("gcc")
    if compiler is None:
        pytest.skip("gcc is not installed")

    def build(body):
        library, source = tmp_path / "libvictim.so", tmp_path / "victim.c"
        source.write_text(f"long victim(void) {{ {body} }}")
        subprocess.run([compiler, "-O1", "-shared", "-fPIC", "-o", library, source], check=True)
        kernel = shutil.copy(KNOWN, tmp_path / "known.py")
        return KernelTarget(kernel=str(kernel), inputs=kernel_inputs)

    return build


@pytest.fixture
def known(known_target):
    """Function from a C body to a place where it runs as a kernel."""
    places = []

    def build(body):
        places.append(known_target(body).open())
        return places[-1]

    yield build
    for place in places:
        place.close()


def fault_in_r10(place, profile, bit):
    """After the instruction that sets r10."""
    (segment,) = profile.strata[0].segments
    for address in map(int, segment.trace):
        instruction = decode(profile.code_at(address), address)
        if instruction.text.startswith("mov r10,"):
            return InstructionFault(
                trigger=(CountedStop(place.image(None).locate(address), 1),),
                execution=1,
                instruction=instruction.text,
                instruction_bytes=instruction.raw,
                corruption=register_corruption("r10", bit, Role.DESTINATION),
            )
    raise AssertionError("r10 is not set")


@pytest.mark.slow
@pytest.mark.parametrize("expected", BODIES)
def test_known_outcomes(known, expected):
    place = known(BODIES[expected])
    attacker = Attacker(place=place, golden=golden_run(place))
    profile = place.profile(np.random.default_rng(0), windows=4)
    assert profile.complete
    for bit in (43, 44, 45, 46):
        result = attacker.run(fault_in_r10(place, profile, bit))
        assert result.outcome is expected, result
        assert result.injection.applied
        assert (result.signal == 11) == (expected is RunOutcome.CRASH)
        if expected is RunOutcome.SDC:
            assert result.verdict.details["magnitude"]["absolute"] == 2.0**bit


def test_a_kernel_that_does_not_repeat_itself_is_refused(known):
    place = known('unsigned a, d; __asm__ volatile("rdtsc" : "=a"(a), "=d"(d)); return a;')
    with pytest.raises(TargetError, match="fault-free runs differ"):
        golden_run(place)


def test_a_kernel_that_fails_without_a_fault_is_refused(known):
    with pytest.raises(TargetError, match="fails without a fault"):
        known("static int calls; if (++calls > 10) __builtin_trap(); return 7;")


def test_a_kernel_that_does_not_load_says_why(known_target):
    target = known_target("return 7;")
    Path(target.kernel).with_name("libvictim.so").unlink()
    with pytest.raises(TargetError, match=r"libvictim\.so"):
        target.open()
    Path(target.kernel).with_name("broken.py").write_text("import nothing_of_that_name")
    with pytest.raises(TargetError, match=r"cannot be loaded: .*nothing_of_that_name"):
        KernelTarget(kernel=str(Path(target.kernel).with_name("broken.py")), inputs=KNOWN).open()


def test_a_kernel_may_have_dataclasses_with_postponed_annotations(known_target):
    """They look for their module among those that are imported."""
    path = Path(known_target("return 7;").kernel)
    record = "@dataclass\nclass Record:\n    name: str\n"
    begin = "from __future__ import annotations\nfrom dataclasses import dataclass\n"
    path.write_text(f"{begin}{path.read_text()}\n{record}")
    assert catalogue.select([str(path)]) == (str(path),)


def test_two_kernels_of_one_name_are_refused(known_target):
    path = Path(known_target("return 7;").kernel)
    other = path.with_name("other.py")
    other.write_text(path.read_text())
    with pytest.raises(TargetError, match=r"^known: more than one"):
        catalogue.select([str(path), str(other)])
    other.write_text(path.read_text().replace('"known"', '"control"'))
    catalogue.find.cache_clear()
    with pytest.raises(TargetError, match=r"^control: more than one"):
        catalogue.select(["control", str(other)])


def test_a_run_that_is_given_up_disturbs_no_other(known):
    place = known(BODIES[RunOutcome.SDC])
    golden = golden_run(place)
    for _ in range(3):
        tracee = place.start()
        tracee.kill()
        assert golden_run(place).output == golden.output


@pytest.mark.slow
def test_a_kernel_of_ones_own_is_attacked_by_the_name_of_its_file(known_target, tmp_path):
    target = known_target(BODIES[RunOutcome.SDC])
    plan = Plan(runs=12, seed=3)
    (alone,), (together,) = (run_campaign(plan, [target], jobs=jobs) for jobs in (1, 2))
    outcomes = [entry["outcome"] for entry in alone.records]
    assert outcomes == [entry["outcome"] for entry in together.records]
    assert {entry["kernel"] for entry in alone.records} == {"known"}
    assert {entry["object"] for entry in alone.records} == {"libvictim.so"}


@pytest.mark.slow
@pytest.mark.parametrize(("memory_mb", "enough"), [(128, False), (512, True)])
def test_a_run_may_take_what_its_kernel_allows(tmp_path, kernel_inputs, memory_mb, enough):
    kernel = tmp_path / "taking.py"
    kernel.write_text(TAKING.format(memory_mb=memory_mb))
    target = KernelTarget(kernel=str(kernel), inputs=kernel_inputs)
    if not enough:
        with pytest.raises(TargetError, match=r"fails without a fault: .*MemoryError"):
            target.open()
        return
    with closing(target.open()) as place:
        assert place.limits.cpu_grace_s == 1.0
        assert place.fault_free().exit_code == 0


def test_the_bytecode_that_an_attacked_process_finds_is_always_there(known_target, monkeypatch):
    """Else its memory would depend on what else has run here, and on the user's settings."""
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    target = known_target("return 7;")
    path = Path(target.kernel)
    path.with_name("beside.py").write_text("")
    path.write_text(path.read_text().replace("library =", "import beside; library ="))
    begun = []
    ask = served.ServedProcess._ask

    def counted(process, *arguments):
        begun.append(len(list((path.parent / "__pycache__").glob("beside.*"))))
        return ask(process, *arguments)

    monkeypatch.setattr(served.ServedProcess, "_ask", counted)
    target.open().close()
    assert begun == [0, 1]  # the process that compiled it was ended, the next one found it
