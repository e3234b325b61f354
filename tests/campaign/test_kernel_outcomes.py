"""Kernels whose outcome is known are told right, every time."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from mavfi_cli.campaign.kernels.attack import attacker_of, golden_run
from mavfi_cli.campaign.kernels.catalogue import Kernel
from mavfi_cli.campaign.kernels.place import Place, Template, load
from mavfi_cli.campaign.kernels.profile import profile_kernel
from mavfi_cli.core.errors import TargetError
from mavfi_cli.fi.isolated.outcome import Outcome
from mavfi_cli.fi.native.arch import decode
from mavfi_cli.fi.native.fault import InstructionFault, Role, Stage, explicit_corruption

TEMPLATE = Path(__file__).parent / "known_template.py"
# In each, r10 is set once: corrupted after that, it is never read, dereferenced, waited for or
# returned.
BODIES = {
    Outcome.BENIGN: 'long r = 7; __asm__ volatile("mov $1, %%r10" ::: "r10"); return r;',
    Outcome.CRASH: 'static long v = 7; long r, *p = &v; __asm__ volatile('
    '"mov %1, %%r10; mov (%%r10), %0" : "=r"(r) : "r"(p) : "r10"); return r;',
    Outcome.HANG: 'long r = 7; __asm__ volatile('
    '"mov $0, %%r10; 1: test %%r10, %%r10; jne 1b" ::: "r10", "cc"); return r;',
    Outcome.SDC: 'long r; __asm__ volatile('
    '"mov $7, %%r10; mov %%r10, %0" : "=r"(r) :: "r10"); return r;',
}  # fmt: skip
KNOWN = Kernel(name="known", title="known", prepare=lambda _: None)


@pytest.fixture
def known(tracing, tmp_path):
    """Function from a C body to a place where it runs as a kernel."""
    compiler = shutil.which("gcc")
    if compiler is None:
        pytest.skip("gcc is not installed")
    places = []

    def build(body):
        library, source = tmp_path / "libvictim.so", tmp_path / "victim.c"
        source.write_text(f"long victim(void) {{ {body} }}")
        subprocess.run([compiler, "-O1", "-shared", "-fPIC", "-o", library, source], check=True)
        template = Template(arguments=(str(TEMPLATE),), data=str(library).encode())
        places.append(Place("known", template))
        return places[-1]

    yield build
    for place in places:
        place.close()


def fault_in_r10(place, profile, bit):
    """After the instruction that sets r10."""
    (segment,) = profile.strata[0].profile.segments
    for address in map(int, segment.trace):
        instruction = decode(profile.code_at(address), address)
        if instruction.text.startswith("mov r10,"):
            return InstructionFault(
                trigger=(Stage(place.layout.image.locate(address), 1),),
                execution=1,
                instruction=instruction.text,
                instruction_bytes=instruction.raw,
                corruption=explicit_corruption("r10", bit, Role.DESTINATION),
            )
    raise AssertionError("r10 is not set")


@pytest.mark.parametrize("expected", BODIES)
def test_known_outcomes(known, expected):
    place = known(BODIES[expected])
    attacker = attacker_of(KNOWN, place, golden_run(place))
    profile = profile_kernel(place, np.random.default_rng(0), windows=4)
    assert profile.complete
    for bit in (43, 44, 45, 46):
        result = attacker.run(fault_in_r10(place, profile, bit))
        assert result.outcome is expected, result
        assert result.injection.applied
        assert (result.signal == 11) == (expected is Outcome.CRASH)
        if expected is Outcome.SDC:
            assert result.verdict.difference.absolute == 2.0**bit


def test_a_kernel_that_does_not_repeat_itself_is_refused(known):
    place = known('unsigned a, d; __asm__ volatile("rdtsc" : "=a"(a), "=d"(d)); return a;')
    with pytest.raises(TargetError, match="fault-free runs differ"):
        golden_run(place)


def test_a_kernel_that_fails_without_a_fault_is_refused(known):
    with pytest.raises(TargetError, match="fails without a fault"):
        known("static int calls; if (++calls > 2) __builtin_trap(); return 7;")


def test_a_template_that_does_not_load_says_why(tracing):
    with pytest.raises(TargetError, match=r"does not load: .*no-such-library"):
        Place("known", Template(arguments=(str(TEMPLATE),), data=b"/no-such-library.so"))


def test_a_run_that_is_given_up_disturbs_no_other(known):
    place = known(BODIES[Outcome.SDC])
    golden = golden_run(place)
    for _ in range(3):
        tracee = place.start()
        tracee.kill()
        assert golden_run(place).output == golden.output


IMPORTING = """
import os
import beside
from mavfi_cli.campaign.kernels import template
template.receive_inputs()
os.write(template.CONTROL, template.RUN)
os.read(template.CONTROL, 1)
"""


def test_the_bytecode_that_an_attacked_process_finds_is_always_there(tmp_path, monkeypatch):
    """Else its memory would depend on what else has run here, and on the user's settings."""
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    (tmp_path / "beside.py").write_text("")
    script = tmp_path / "importing.py"
    script.write_text(IMPORTING)
    template = Template(arguments=(str(script),), data=b"")
    Place("importing", template, look_up=False).close()
    assert not (tmp_path / "__pycache__").exists()
    load("importing", template)
    assert [path.name.partition(".")[0] for path in (tmp_path / "__pycache__").iterdir()] == [
        "beside"
    ]
