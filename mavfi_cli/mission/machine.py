"""Checks whether this machine can run mavfi. Each check has a finding and, if needed, a remedy."""

from __future__ import annotations

import functools
import importlib
import importlib.metadata
import importlib.util
import os
import platform
import shutil
import socket
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from mavfi_cli.core.compiled import TARGET, processor_level
from mavfi_cli.core.errors import MavfiError
from mavfi_cli.core.files import ScratchFolder
from mavfi_cli.core.processes import PYTHON

if TYPE_CHECKING:
    from mavfi_cli.fi.tracer.tracee import Mechanism

OK = "ok"
LIMITED = "limited"  # missions work, but another feature does not
FAILED = "failed"  # missions do not work


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """The result of one check of this machine, with a remedy unless the verdict is OK."""

    name: str
    verdict: str
    finding: str
    remedy: str = ""


def _check(name: str, finding: str, *, remedy: str = "", failed: bool = False) -> Check:
    verdict = FAILED if failed else LIMITED if remedy else OK
    return Check(name=name, verdict=verdict, finding=finding, remedy=remedy)


_WHEELS = {
    "numpy": "numpy", "numba": "numba", "jsbsim": "jsbsim", "pymavlink": "pymavlink",
    "pyoctomap": "pyoctomap", "ompl": "ompl", "python-fcl": "fcl", "pyarrow": "pyarrow",
    "matplotlib": "matplotlib", "click": "click", "rich": "rich", "cattrs": "cattrs",
    "pyserial": "serial", "capstone": "capstone", "pyelftools": "elftools",
    "scipy": "scipy", "tomli-w": "tomli_w",
}  # fmt: skip
_EXTRAS = {
    "train": "torch", "cluster": "distributed", "pandas": "pandas", "report": "jinja2",
    "view": "rerun", "mcap": "mcap",
}  # fmt: skip
_LOAD_VEHICLE = """
from sitl.vehicle.profile import load_profile
from sitl.vehicle.vehicle import Quadrotor
import numpy, sys
vehicle = Quadrotor(load_profile("solo"), position_enu_m=numpy.zeros(3), yaw_enu_rad=0.0)
target = numpy.full(19, numpy.nan)
target[3:6] = 0.0, 0.0, -1.0
for _ in range(500):
    vehicle.step(target, True)
height_m = -vehicle.truth.position_ned_m[2]
print(f"the simulated quadrotor climbs ({height_m:.1f} m in 2 s)")
sys.exit(0 if height_m > 1.0 else 1)
"""
_ALLOW_PTRACE = (
    "allow ptrace: sysctl kernel.yama.ptrace_scope=1; in a container --cap-add SYS_PTRACE"
)
_PERF_REMEDY = (
    "perf_event_open needs Linux 5.13, kernel.perf_event_paranoid at most 2, and in a container a "
    "seccomp profile that allows it"
)
_COUNTING = "counted breakpoints"
_INSTALL = "pip install -e . in the project's folder"


def check_machine() -> Iterator[Check]:
    """Run all checks of this machine in sequence, and yield their results."""
    yield _check("Python", platform.python_version())
    yield _processor()
    yield _wheels()
    have = [extra for extra, module in _EXTRAS.items() if importlib.util.find_spec(module)]
    lack = [extra for extra in _EXTRAS if extra not in have]
    finding = f"installed: {', '.join(have) or 'none'}; not installed: {', '.join(lack) or 'none'}"
    yield _check("Extras", finding)
    free = shutil.disk_usage(Path.cwd()).free / 1e9
    remedy = "a campaign wants more room; name another folder with --out" if free <= 1.0 else ""
    yield _check("Disk", f"{free:.1f} GB free here", remedy=remedy)
    yield _loopback()
    yield _physics()
    from mavfi_cli.fi.tracer.linux import SUPPORTED

    if SUPPORTED:
        yield check_tracing()
        yield _counting()
    else:
        remedy = "instruction-level injection is not available here"
        yield _check("Tracing", "not Linux on x86-64", remedy=remedy)


def _processor() -> Check:
    system, machine, remedy = platform.system(), platform.machine(), ""
    if system != "Linux" or machine not in ("x86_64", "aarch64"):
        remedy = "wheels exist for Linux on x86-64"
    elif machine == "aarch64":
        remedy = "jsbsim and pyoctomap have no wheel here: build them"
    level = processor_level()
    if machine == "x86_64" and not level >= TARGET:
        remedy = f"records are equal from {TARGET} up: compare with flights of this computer only"
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    finding = f"{system} {level or machine}, {cores} core{'s' if cores != 1 else ''} usable"
    return _check("Processor", finding, remedy=remedy)


def _wheels() -> Check:
    missing, finding = [], []
    for name, module in _WHEELS.items():
        try:
            importlib.import_module(module)
            finding.append(f"{name} {importlib.metadata.version(name)}")
        except (ImportError, OSError) as error:
            missing.append(f"{name} ({error})")
    if missing:
        return _check("Libraries", "missing: " + "; ".join(missing), remedy=_INSTALL, failed=True)
    return _check("Libraries", ", ".join(finding))


def _loopback() -> Check:
    udp = functools.partial(socket.socket, socket.AF_INET, socket.SOCK_DGRAM)
    try:
        with udp() as there, udp() as here:
            there.bind(("127.0.0.1", 0))
            there.settimeout(2.0)
            here.sendto(b"mavfi", there.getsockname())
            there.recv(16)
    except OSError as error:
        remedy = "`mavfi fly` does not need it; ground stations do"
        return _check("Loopback", f"UDP fails: {error}", remedy=remedy)
    return _check("Loopback", "UDP on 127.0.0.1 works")


def _physics() -> Check:
    """Fly the vehicle for 2 s in a separate process, which loads JSBSim and compiled kernels."""
    with ScratchFolder("doctor") as folder:
        run = subprocess.run(
            [*PYTHON, "-c", _LOAD_VEHICLE], capture_output=True, text=True, cwd=folder,
            timeout=120.0, check=False,
        )  # fmt: skip
    if run.returncode == 0:
        return _check("Vehicle", run.stdout.strip())
    last = ((run.stderr or run.stdout).strip().splitlines() or ["no message"])[-1]
    return _check("Vehicle", last, remedy=_INSTALL, failed=True)


def check_tracing(mechanism: Mechanism | None = None) -> Check:
    """Check that mavfi can stop a program and change its registers, as faults require.

    Args:
        mechanism: How executions of an instruction are counted. By default, it is the best
            mechanism available.
    """
    from mavfi_cli.fi.tracer.registers import widest_vector
    from mavfi_cli.fi.tracer.spawn import Program, run_to_entry, spawn

    with ScratchFolder("doctor") as folder:
        output = folder / "output"
        try:
            command = Program.of(["true"], environment=dict(os.environ))
            tracee = spawn(command, stdout=output, stderr=output, mechanism=mechanism)
            try:
                hit = run_to_entry(tracee)
                problem = "" if hit else "a hardware breakpoint never hit"
                for register in ("rbx", f"{widest_vector()}15") if hit else ():
                    before = tracee.registers.read(register)
                    tracee.registers.write(register, before ^ 1)
                    if tracee.registers.read(register) != before ^ 1:
                        problem = f"a flip of {register} did not stick"
                    tracee.registers.write(register, before)
            finally:
                tracee.kill()
        except (MavfiError, OSError) as error:
            problem = str(error)
    if problem:
        return _check("ptrace", problem, remedy=_ALLOW_PTRACE)
    return _check("ptrace", "a program was stopped, a register flipped and read back")


def _counting() -> Check:
    """Check how executions of an instruction are counted: by the kernel, or by the slower fallback.

    The fallback is tested only if the kernel refuses.
    """
    from mavfi_cli.fi.tracer.tracee import Mechanism, perf_allowed

    refused = perf_allowed()
    if refused is None:
        return _check(_COUNTING, "by the kernel (perf_event_open)")
    tried = check_tracing(Mechanism.DEBUG)
    if tried.verdict != OK:
        finding = f"perf_event_open: {refused}; debug registers: {tried.finding}"
        return _check(_COUNTING, finding, remedy=_ALLOW_PTRACE)
    slower = "by debug registers, about three times slower a hit"
    finding = f"{slower}: perf_event_open is refused ({refused})"
    return _check(_COUNTING, finding, remedy=_PERF_REMEDY)
