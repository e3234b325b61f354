"""Checks of this machine, each with its finding and the remedy for a failure."""

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
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from mavfi_cli.core.processes import PYTHON

OK = "ok"
LIMITED = "limited"  # flying works, but something else does not
FAILED = "failed"  # flying does not work


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """One line of the report; it has a remedy unless the verdict is OK."""

    name: str
    verdict: str
    found: str
    remedy: str = ""


def _check(name: str, found: str, *, remedy: str = "", failed: bool = False) -> Check:
    verdict = FAILED if failed else LIMITED if remedy else OK
    return Check(name=name, verdict=verdict, found=found, remedy=remedy)


_WHEELS = {
    "numpy": "numpy", "numba": "numba", "jsbsim": "jsbsim", "pymavlink": "pymavlink",
    "pyoctomap": "pyoctomap", "ompl": "ompl", "python-fcl": "fcl", "pyarrow": "pyarrow",
    "matplotlib": "matplotlib", "click": "click", "rich": "rich", "cattrs": "cattrs",
    "pyserial": "serial",
}  # fmt: skip
_LOAD_VEHICLE = """
from sitl.vehicle.profile import load_profile
from sitl.vehicle.vehicle import Quadrotor
import numpy, sys
vehicle = Quadrotor(load_profile("solo"), position_enu_m=numpy.zeros(3), yaw_enu_rad=0.0)
target = numpy.full(11, numpy.nan)
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
_INSTALL = "pip install -e . in the project's folder"
_EXTRAS = {
    "train": "torch", "cluster": "distributed", "pandas": "pandas", "report": "jinja2",
    "view": "rerun", "mcap": "mcap",
}  # fmt: skip


def check_machine() -> Iterator[Check]:
    """Run all checks in sequence and yield their results."""
    yield _python()
    yield _processor()
    yield _wheels()
    yield _extras()
    yield _disk()
    yield _loopback()
    yield _physics()
    yield from _injection()


def _python() -> Check:
    old = sys.version_info < (3, 11)
    remedy = "install Python 3.11 or newer" if old else ""
    return _check("Python", platform.python_version(), remedy=remedy, failed=old)


def _processor() -> Check:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    system, machine = platform.system(), platform.machine()
    remedy = ""
    if system != "Linux" or machine not in ("x86_64", "aarch64"):
        remedy = "wheels exist for Linux on x86-64"
    elif machine == "aarch64":
        remedy = "jsbsim and pyoctomap have no wheel here: build them"
    found = f"{system} {machine}, {cores} core{'s' if cores != 1 else ''} usable"
    return _check("Processor", found, remedy=remedy)


def _wheels() -> Check:
    missing, found = [], []
    for distribution, module in _WHEELS.items():
        try:
            importlib.import_module(module)
            found.append(f"{distribution} {importlib.metadata.version(distribution)}")
        except (ImportError, importlib.metadata.PackageNotFoundError, OSError) as error:
            missing.append(f"{distribution} ({error})")
    if missing:
        return _check("Libraries", "missing: " + "; ".join(missing), remedy=_INSTALL, failed=True)
    return _check("Libraries", ", ".join(found))


def _extras() -> Check:
    have = [extra for extra, module in _EXTRAS.items() if importlib.util.find_spec(module)]
    lack = [extra for extra in _EXTRAS if extra not in have]
    found = f"installed: {', '.join(have) or 'none'}; not installed: {', '.join(lack) or 'none'}"
    return _check("Extras", found)


def _disk() -> Check:
    free = shutil.disk_usage(Path.cwd()).free / 1e9
    remedy = "a campaign wants more room; name another folder with --out" if free <= 1.0 else ""
    return _check("Disk", f"{free:.1f} GB free here", remedy=remedy)


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
    """Start the vehicle's process, which loads JSBSim and its compiled kernels."""
    with tempfile.TemporaryDirectory() as folder:
        run = subprocess.run(
            [*PYTHON, "-c", _LOAD_VEHICLE], capture_output=True, text=True, cwd=folder,
            timeout=120.0, check=False,
        )  # fmt: skip
    if run.returncode == 0:
        return _check("Vehicle", run.stdout.strip())
    last = ((run.stderr or run.stdout).strip().splitlines() or ["no message"])[-1]
    return _check("Vehicle", last, remedy=_INSTALL, failed=True)


def _injection() -> Iterator[Check]:
    """Test tracing and counted breakpoints on a real program."""
    from mavfi_cli.fi.tracer.arch import SUPPORTED
    from mavfi_cli.fi.tracer.doctor import check_counting, check_tracing

    if not SUPPORTED:
        remedy = "instruction-level injection is not available here"
        yield _check("Tracing", "not Linux on x86-64", remedy=remedy)
        return
    for capability in (check_tracing(), check_counting()):
        failed = capability.problem is not None
        yield _check(
            capability.name,
            capability.problem or capability.found,
            remedy=capability.remedy or (_ALLOW_PTRACE if failed else ""),
        )
