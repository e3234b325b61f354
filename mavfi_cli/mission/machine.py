"""Checks of this machine, each with its finding and the remedy for a failure."""

from __future__ import annotations

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
from dataclasses import asdict, dataclass
from enum import Enum
from pathlib import Path
from typing import Any


class CheckResult(Enum):
    """Result of a check."""

    OK = "ok"
    LIMITED = "limited"  # flying works, but something else does not
    FAILED = "failed"  # flying does not work


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """One line of the report."""

    name: str
    verdict: CheckResult
    found: str
    remedy: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for --json."""
        return {**asdict(self), "verdict": self.verdict.value}


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
_EXTRAS = {"train": "torch", "cluster": "distributed"}


def check_machine() -> Iterator[Check]:
    """Run all checks in sequence and yield their results."""
    yield _python()
    yield _processor()
    yield from _wheels()
    yield _extras()
    yield _disk()
    yield _loopback()
    yield _physics()
    yield from _injection()


def _python() -> Check:
    version = platform.python_version()
    good = sys.version_info >= (3, 11)
    return Check(
        name="Python", verdict=CheckResult.OK if good else CheckResult.FAILED, found=version,
        remedy="" if good else "install Python 3.11 or newer",
    )  # fmt: skip


def _processor() -> Check:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    system, machine = platform.system(), platform.machine()
    found = f"{system} {machine}, {cores} core{'s' if cores != 1 else ''} usable"
    if system != "Linux" or machine not in ("x86_64", "aarch64"):
        return Check(name="Processor", verdict=CheckResult.LIMITED, found=found,
                     remedy="wheels exist for Linux on x86-64")  # fmt: skip
    if machine == "aarch64":
        return Check(name="Processor", verdict=CheckResult.LIMITED, found=found,
                     remedy="jsbsim and pyoctomap have no wheel here: build them")  # fmt: skip
    return Check(name="Processor", verdict=CheckResult.OK, found=found)


def _wheels() -> Iterator[Check]:
    missing, found = [], []
    for distribution, module in _WHEELS.items():
        try:
            importlib.import_module(module)
            found.append(f"{distribution} {importlib.metadata.version(distribution)}")
        except (ImportError, importlib.metadata.PackageNotFoundError, OSError) as error:
            missing.append(f"{distribution} ({error})")
    if missing:
        problem = "missing: " + "; ".join(missing)
        yield Check(name="Libraries", verdict=CheckResult.FAILED, found=problem,
                    remedy="pip install -e . in the project's folder")  # fmt: skip
    else:
        yield Check(name="Libraries", verdict=CheckResult.OK, found=", ".join(found))


def _extras() -> Check:
    have = [extra for extra, module in _EXTRAS.items() if importlib.util.find_spec(module)]
    lack = [extra for extra in _EXTRAS if extra not in have]
    found = f"installed: {', '.join(have) or 'none'}; not installed: {', '.join(lack) or 'none'}"
    return Check(name="Extras", verdict=CheckResult.OK, found=found)


def _disk() -> Check:
    free = shutil.disk_usage(Path.cwd()).free / 1e9
    good = free > 1.0
    return Check(
        name="Disk", verdict=CheckResult.OK if good else CheckResult.LIMITED,
        found=f"{free:.1f} GB free here",
        remedy="" if good else "a campaign wants more room; name another folder with --out",
    )  # fmt: skip


def _loopback() -> Check:
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as there:
            there.bind(("127.0.0.1", 0))
            there.settimeout(2.0)
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as here:
                here.sendto(b"mavfi", there.getsockname())
            good = there.recv(16) == b"mavfi"
    except OSError as error:
        return Check(name="Loopback", verdict=CheckResult.LIMITED, found=f"UDP fails: {error}",
                     remedy="`mavfi fly` does not need it; ground stations do")  # fmt: skip
    return Check(name="Loopback", verdict=CheckResult.OK if good else CheckResult.LIMITED,
                 found="UDP on 127.0.0.1 works")  # fmt: skip


def _physics() -> Check:
    """Start the vehicle's process, which loads JSBSim and its compiled kernels."""
    with tempfile.TemporaryDirectory() as folder:
        run = subprocess.run(
            [sys.executable, "-c", _LOAD_VEHICLE], capture_output=True, text=True, cwd=folder,
            timeout=120.0, check=False,
        )  # fmt: skip
    if run.returncode == 0:
        return Check(name="Vehicle", verdict=CheckResult.OK, found=run.stdout.strip())
    last = ((run.stderr or run.stdout).strip().splitlines() or ["no message"])[-1]
    return Check(name="Vehicle", verdict=CheckResult.FAILED, found=last,
                 remedy="pip install -e . in the project's folder")  # fmt: skip


def _injection() -> Iterator[Check]:
    """Test tracing and counted breakpoints on a real program."""
    from mavfi_cli.fi.tracer.arch import SUPPORTED
    from mavfi_cli.fi.tracer.doctor import check_counting, check_tracing

    if not SUPPORTED:
        yield Check(name="Tracing", verdict=CheckResult.LIMITED, found="not Linux on x86-64",
                    remedy="instruction-level injection is not available here")  # fmt: skip
        return

    for capability in (check_tracing(), check_counting()):
        remedy = capability.remedy
        if capability.problem is not None:
            remedy = remedy or _ALLOW_PTRACE
        yield Check(
            name=capability.name,
            verdict=CheckResult.LIMITED if remedy else CheckResult.OK,
            found=capability.problem or capability.found,
            remedy=remedy,
        )
